"""The solids of girders and nodes: sections drawn along their axes, with their marks and bolt holes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from designgen.designs.prismatic_parts import PAD_HEIGHT_MM, PAD_SIZE_MM, Girder, Node
from designgen.designs.sections import Section
from processor.model import Floats

if TYPE_CHECKING:
    import cadquery as cq


def solid(part: Girder | Node) -> cq.Shape:
    """Return the CadQuery solid of a girder or node as designed, holes as drilled, in the frame of T."""
    return _node(part) if isinstance(part, Node) else _girder(part)


def _girder(girder: Girder) -> cq.Shape:
    import cadquery as cq

    outer, *holes = (_prism(girder.T, outline, 0.0, girder.length) for outline in girder.section.outlines)
    shape = outer.cut(*holes) if holes else outer
    shape = shape.fuse(_mark(girder.T, girder.section, girder.mark))
    for bore in girder.bores:
        start, end = (np.array([bore.x, *yz]) + bore.shift for yz in (bore.start, bore.end))
        axis = girder.T[:3, :3] @ (end - start)
        place = girder.T[:3, :3] @ start + girder.T[:3, 3]
        drill = cq.Solid.makeCylinder(bore.radius, float(np.linalg.norm(axis)), cq.Vector(*place), cq.Vector(*axis))
        shape = shape.cut(drill)
    return shape


def _node(node: Node) -> cq.Shape:
    """Return the chord and the branch, less the cavities of both, which meet in the middle."""
    up = np.eye(4)
    up[:3, :3] = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]  # x along the node's z
    outer, *holes = (
        (_prism(node.T, outline, -node.stub, node.stub), _prism(node.T @ up, outline, 0.0, node.upright))
        for outline in node.section.outlines
    )
    shape = outer[0].fuse(outer[1])
    for chord, branch in holes:
        shape = shape.cut(chord, branch)
    return shape.fuse(_mark(node.T, node.section, node.mark))


def _prism(T: Floats, outline: Floats, x0: float, x1: float) -> cq.Shape:
    """Return the solid of an outline (n, 2), drawn along x of T from x0 to x1."""
    import cadquery as cq

    corners = np.column_stack([np.full(len(outline), x0), outline]) @ T[:3, :3].T + T[:3, 3]
    along = T[:3, :3] @ np.array([x1 - x0, 0.0, 0.0])
    wire = cq.Wire.makePolygon([cq.Vector(*corner) for corner in corners], close=True)
    return cq.Solid.extrudeLinear(wire, [], cq.Vector(*along))


def _mark(T: Floats, section: Section, at: float) -> cq.Shape:
    """Return the pad on the left half of the top, at x ``at``."""
    half, place = 0.5 * PAD_SIZE_MM, np.array([0.25 * section.width, 0.5 * section.height])
    square = place + np.array([[-half, 0.0], [half, 0.0], [half, PAD_HEIGHT_MM], [-half, PAD_HEIGHT_MM]])
    return _prism(T, square, at - half, at + half)
