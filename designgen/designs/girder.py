"""The solid of a girder: its section drawn along its axis, with its mark and its bolt holes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from designgen.designs.prismatic import PAD_HEIGHT_MM, PAD_SIZE_MM, Girder
from processor.model import Floats

if TYPE_CHECKING:
    import cadquery as cq


def solid(girder: Girder) -> cq.Shape:
    """Return the CadQuery solid of a girder as designed, its holes as drilled, in the frame of T."""
    import cadquery as cq

    def place(x: float, yz: Floats) -> cq.Vector:
        return cq.Vector(*(girder.T[:3, :3] @ np.array([x, *yz]) + girder.T[:3, 3]))

    along = cq.Vector(*(girder.T[:3, :3] @ np.array([girder.length, 0.0, 0.0])))
    outer, *holes = [
        cq.Wire.makePolygon([place(0.0, corner) for corner in outline], close=True)
        for outline in girder.section.outlines
    ]
    shape: cq.Shape = cq.Solid.extrudeLinear(outer, holes, along)
    half = 0.5 * PAD_SIZE_MM
    at = np.array([0.25 * girder.section.width, 0.5 * girder.section.height])
    square = [(-half, -half), (half, -half), (half, half), (-half, half)]
    corners = [place(girder.mark + x, at + np.array([y, 0.0])) for x, y in square]
    up = cq.Vector(*(girder.T[:3, :3] @ np.array([0.0, 0.0, PAD_HEIGHT_MM])))
    shape = shape.fuse(cq.Solid.extrudeLinear(cq.Wire.makePolygon(corners, close=True), [], up))
    for bore in girder.bores:
        start, end = (np.array([bore.x, *yz]) + bore.shift for yz in (bore.start, bore.end))
        axis = girder.T[:3, :3] @ (end - start)
        drill = cq.Solid.makeCylinder(
            bore.radius, float(np.linalg.norm(axis)), place(start[0], start[1:]), cq.Vector(*axis)
        )
        shape = shape.cut(drill)
    return shape
