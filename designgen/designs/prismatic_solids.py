"""The solids of girders and nodes: sections drawn along their axes, with their marks and bolt holes.

The displacement of a part as built is linear over each side of a section and, between its ends' reaches, a cubic along
it. Faces between cubic curves through the corners of the section are therefore the displaced faces themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from designgen.designs.bolt_holes import Bore
from designgen.designs.prismatic_parts import PAD_HEIGHT_MM, PAD_SIZE_MM, Girder, Node, Part
from designgen.designs.sections import Section
from processor.model import Floats

if TYPE_CHECKING:
    import cadquery as cq

UP = np.array([[0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
SUNK_MM = 2.0  # of a mark as built into its plate, so that no sliver remains between both
AROUND = 64  # points of a bolt hole's circle as built


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
    """Return the node as designed."""
    return _joined(node.T, node.section, (-node.stub, node.stub), node.upright).fuse(
        _mark(node.T, node.section, node.mark)
    )


def _joined(T: Floats, section: Section, chord: tuple[float, float], upright: float) -> cq.Shape:
    """Return a chord and a branch, less the cavities of both, which meet in the middle."""
    outer, *holes = (
        (_prism(T, outline, *chord), _prism(T @ UP, outline, 0.0, upright)) for outline in section.outlines
    )
    shape = outer[0].fuse(outer[1])
    for along, branch in holes:
        shape = shape.cut(along, branch)
    return shape


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


# --- as built ---------------------------------------------------------------------------------------------------------


def as_built(part: Part) -> cq.Shape:
    """Return the CadQuery solid of a girder or node with the errors of its ends, holes as drilled.

    Raises RuntimeError where the kernel does not make one solid of it.
    """
    made_of, reach = part.made_of, max(end.reach for end in part.ends)
    top = 0.5 * made_of.section.height
    half, beside = 0.5 * PAD_SIZE_MM, 0.25 * made_of.section.width
    pad = np.array([[beside - half, beside + half, top - SUNK_MM, top + PAD_HEIGHT_MM]])
    if isinstance(made_of, Node):
        low, high = made_of.stub - reach, made_of.upright - reach
        shape = _joined(made_of.T, made_of.section, (-low, low), high)
        plates, knots = made_of.section.plates, (-made_of.stub, -low, low, made_of.stub)
        arms = [(made_of.T, knots[:2]), (made_of.T, knots[2:]), (made_of.T @ UP, (high, made_of.upright))]
        shape = shape.fuse(*(_displaced(part, T, plates, ends) for T, ends in arms))
    else:
        knots = (0.0, reach, made_of.length - reach, made_of.length)
        shape = _displaced(part, made_of.T, made_of.section.plates, knots)
    ends = (made_of.mark - half, made_of.mark + half)
    between = (ends[0], *(x for x in knots if ends[0] < x < ends[1]), ends[1])
    shape = shape.fuse(_displaced(part, made_of.T, pad, between))
    if isinstance(made_of, Girder) and made_of.bores:
        shape = shape.cut(*(_drill(part, made_of.T, bore) for bore in made_of.bores))
    solids = shape.Solids()
    if len(solids) != 1:
        raise RuntimeError(f"{part.name}: the CAD kernel made {len(solids)} solids of one part")
    return solids[0]


def _sewn(faces: list[cq.Face]) -> cq.Solid:
    import cadquery as cq

    solid = cq.Solid.makeSolid(cq.Shell.makeShell(faces))
    return solid if solid.Volume() > 0.0 else cq.Solid(solid.wrapped.Reversed())


def _displaced(part: Part, T: Floats, plates: Floats, knots: Sequence[float]) -> cq.Solid:
    """Return the solid of plates (k, 4), y0, y1, z0, z1, along x of T, as displaced; cubics between ``knots`` along it.

    All plates are divided by the sides of all others, so that the faces of the solid meet at whole edges.
    """
    import cadquery as cq

    y, z = np.unique(plates[:, :2].round(9)), np.unique(plates[:, 2:].round(9))
    middle_y, middle_z = (0.5 * (x[1:] + x[:-1]) for x in (y, z))
    y0, y1, z0, z1 = plates.T
    within_y = (y0 < middle_y[:, None]) & (middle_y[:, None] < y1)  # (cells, plates)
    within_z = (z0 < middle_z[:, None]) & (middle_z[:, None] < z1)
    steel = np.pad((within_y[:, None] & within_z[None]).any(axis=2), 1)

    def at(x: Floats, i: int, j: int) -> list[cq.Vector]:
        local = np.column_stack([x, np.full(len(x), y[i]), np.full(len(x), z[j])])
        points = local @ T[:3, :3].T + T[:3, 3]
        return [cq.Vector(*point) for point in points + part.displacement(points)]

    def along(x0: float, x1: float, i: int, j: int) -> cq.Edge:
        a, b, c, d = at(np.linspace(x0, x1, 4), i, j)
        first = (a * -5.0 + b * 18.0 + c * -9.0 + d * 2.0) * (1.0 / 6.0)
        second = (a * 2.0 + b * -9.0 + c * 18.0 + d * -5.0) * (1.0 / 6.0)
        return cq.Edge.makeBezier([a, first, second, d])

    faces = []
    for i, j in np.ndindex(len(y) - 1, len(z) - 1):
        here = steel[i + 1, j + 1]
        if here:
            for x in (knots[0], knots[-1]):
                corner = [at(np.array([x]), i + a, j + b)[0] for a, b in ((0, 0), (0, 1), (1, 0), (1, 1))]
                sides = cq.Edge.makeLine(*corner[:2]), cq.Edge.makeLine(*corner[2:])
                faces.append(cq.Face.makeRuledSurface(*sides))
    # A wall stands where steel is on one side alone of an edge between two corners.
    walls = [((i, j), (i + 1, j)) for i, j in np.ndindex(len(y) - 1, len(z)) if steel[i + 1, j] != steel[i + 1, j + 1]]
    walls += [((i, j), (i, j + 1)) for i, j in np.ndindex(len(y), len(z) - 1) if steel[i, j + 1] != steel[i + 1, j + 1]]
    for a, b in walls:
        faces += [cq.Face.makeRuledSurface(along(*xs, *a), along(*xs, *b)) for xs in pairwise(knots)]
    return _sewn(faces)


def _drill(part: Part, T: Floats, bore: Bore) -> cq.Solid:
    """Return what is taken out for a bolt hole as built: its displaced wall, drawn on to planes beyond the plate."""
    import cadquery as cq

    start, end = (np.array([bore.x, *yz]) + bore.shift for yz in (bore.start, bore.end))
    depth = end - start
    axis, turn = depth / np.linalg.norm(depth), np.linspace(0.0, 2.0 * np.pi, AROUND + 1)
    across = np.cross(axis, [1.0, 0.0, 0.0])
    ring = bore.radius * (np.cos(turn)[:, None] * np.array([1.0, 0.0, 0.0]) + np.sin(turn)[:, None] * across)
    low, high = (
        points + part.displacement(points) for points in ((a + ring) @ T[:3, :3].T + T[:3, 3] for a in (start, end))
    )
    out, edges = T[:3, :3] @ axis, []
    reach = 0.5 * float(np.linalg.norm(depth))
    for level in (float((low @ out).min()) - reach, float((high @ out).max()) + reach):
        share = (level - low @ out) / ((high - low) @ out)
        points = [cq.Vector(*point) for point in low + share[:, None] * (high - low)]
        half = AROUND // 2
        parameters = turn[: half + 1].tolist()
        edges.append([cq.Edge.makeSpline(few, parameters=parameters) for few in (points[: half + 1], points[half:])])
    (a, b), (c, d) = edges
    walls = [cq.Face.makeRuledSurface(a, c), cq.Face.makeRuledSurface(b, d)]
    return _sewn([*walls, *(cq.Face.makeFromWires(cq.Wire.assembleEdges(pair)) for pair in edges)])
