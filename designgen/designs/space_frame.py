"""Space frame of bolt balls: a single-layer or square-on-square double-layer grid with sleeves, cones and tubes."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from designgen.checks import expect_all
from designgen.designs import bolt_ball
from designgen.rigid import perpendicular
from processor.model import Floats, Ints, UsageError

if TYPE_CHECKING:
    import cadquery as cq

ABOUT = "space frame: bolt balls on a grid, joined by sleeves, cones and tubes"

SHAPES = ("flat", "free-form", "dome")
HEXAGON = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.arange(6) * np.pi / 3.0])  # unit corners


@dataclass(frozen=True)
class Params:
    """A grid of ``nodes_x`` by ``nodes_y`` balls, mm; a second layer above it has one less in both directions.

    One layer may be a row of balls, or one ball alone.

    ``shape``: flat; free-form, which rises and falls by ``rise_mm``; dome, a spherical cap of that rise.
    """

    nodes_x: int = 4
    nodes_y: int = 4
    layers: int = 2
    spacing_mm: float = 3000.0
    depth_mm: float = 2100.0
    height_mm: float = 6000.0  # of the lowest layer
    radii_mm: tuple[float, ...] = (45.0,)  # assigned to the balls in rotation
    tube_diameter_mm: float = 60.0
    process_hole: bool = True
    shape: str = "flat"
    rise_mm: float = 0.0
    diagonals: bool = False  # with one layer: a diagonal in each cell

    def __post_init__(self) -> None:
        nodes, count = (self.nodes_x, self.nodes_y), self.nodes_x * self.nodes_y
        reach = 0.5 * self.spacing_mm * (max(nodes) - 1)
        flat = self.shape != "dome" or self.rise_mm < 0.7 * reach
        least = 4.0 * max(self.radii_mm, default=0.0)
        expect_all(
            "frame",
            (min(nodes) >= self.layers, "nodes_x, nodes_y", nodes, "2 or more, or with one layer 1 or more"),
            (count <= 1_000_000, "nodes_x * nodes_y", count, "a million at most"),
            (self.layers in (1, 2), "layers", self.layers, "1 or 2"),
            (self.shape in SHAPES, "shape", self.shape, f"one of {', '.join(SHAPES)}"),
            (self.rise_mm >= 0.0, "rise_mm", self.rise_mm, "0 or a length"),
            (flat, "rise_mm", self.rise_mm, "a flatter dome"),
            (len(self.radii_mm) > 0, "radii_mm", list(self.radii_mm), "one radius or more"),
            (self.spacing_mm > least, "spacing_mm", self.spacing_mm, f"more than four radii ({least:g})"),
            (self.depth_mm > 0.0, "depth_mm", self.depth_mm, "a length above 0"),
            *((radius > 0.0, "radii_mm", radius, "radii above 0") for radius in self.radii_mm),
        )


@dataclass(frozen=True)
class Frame:
    """The frame's nodes and members, as designed or as built, mm.

    A member's axis ends at its nodes' centres displaced by ``offsets`` (m, 2, 3). Its tube is bowed by ``bows`` (m, 3)
    at the middle; ``missing`` (m, 2) marks ends without sleeve and bolt. Empty arrays: as designed.
    """

    centres: Floats  # (k, 3)
    radii: Floats  # (k,)
    members: Ints  # (m, 2) rows of centres
    connection: bolt_ball.Connection
    process_hole: bool
    offsets: Floats = field(default_factory=lambda: np.empty((0, 2, 3)))
    bows: Floats = field(default_factory=lambda: np.empty((0, 3)))
    missing: np.ndarray = field(default_factory=lambda: np.empty((0, 2), bool))

    @cached_property
    def directions(self) -> tuple[Floats, ...]:
        """Unit vectors (m, 3) from each node along its members."""
        of_nodes: list[list[Floats]] = [[] for _ in self.centres]
        for m, (i, j) in enumerate(self.members):
            a, b = self.ends(m)
            unit = (b - a) / np.linalg.norm(b - a)
            of_nodes[i].append(unit)
            of_nodes[j].append(-unit)
        return tuple(np.array(units).reshape(-1, 3) for units in of_nodes)

    def ends(self, member: int) -> tuple[Floats, Floats]:
        """Return where a member's axis starts and ends, (3,) each."""
        i, j = self.members[member]
        a, b = self.centres[i], self.centres[j]
        return (a + self.offsets[member, 0], b + self.offsets[member, 1]) if len(self.offsets) else (a, b)

    def bow(self, member: int) -> Floats:
        """Return the bow (3,) of a member's tube."""
        result: Floats = self.bows[member] if len(self.bows) else np.zeros(3)
        return result

    @cached_property
    def stacks(self) -> Floats:
        """Where sleeve, cone and tube start (m, 2, 3) on a member's axis, from either end, mm.

        Raises UsageError for a ball that cannot be built.
        """
        flats = np.array([self.ball(node).flat_distance for node in range(len(self.centres))])[self.members]
        cones = flats + self.connection.sleeve_length
        return np.stack([flats, cones, cones + self.connection.cone_length], axis=-1)

    def tube_lengths(self) -> Floats:
        """Return the lengths (m,) of the tubes between their cones, mm.

        Raises UsageError for a ball that cannot be built, and for a tube without length.
        """
        axes = self.centres[self.members[:, 1]] - self.centres[self.members[:, 0]]
        if len(self.offsets):
            axes = axes + self.offsets[:, 1] - self.offsets[:, 0]
        lengths: Floats = np.linalg.norm(axes, axis=1) - self.stacks[:, :, 2].sum(axis=1)
        if not (lengths > 0.0).all():
            worst = int(np.argmin(lengths))
            raise UsageError(
                f"frame.spacing_mm, depth_mm: expected balls so far apart that tubes fit between, got member {worst} "
                f"with {-lengths[worst]:.1f} mm too little for its sleeves and cones"
            )
        return lengths

    def has_sleeve(self, member: int, end: int) -> bool:
        """Return whether a member's end has its sleeve and bolt."""
        return not (len(self.missing) and self.missing[member, end])

    def bolted(self, node: int) -> list[bool]:
        """Return whether there is a bolt along each of a node's directions."""
        return [
            self.has_sleeve(m, end) for m in range(len(self.members)) for end in (0, 1) if self.members[m, end] == node
        ]

    def ball(self, node: int) -> bolt_ball.Params:
        """Return the design of one ball."""
        return bolt_ball.Params(float(self.radii[node]), self.directions[node], self.connection, self.process_hole)


def build(params: Params) -> Frame:
    """Return the frame as designed; UsageError where sleeves would touch or a tube has no length."""
    nx, ny, a = params.nodes_x, params.nodes_y, params.spacing_mm
    index = np.arange(nx * ny).reshape(nx, ny)
    x, y = np.meshgrid(np.arange(nx) * a, np.arange(ny) * a, indexing="ij")
    centres = [np.stack([x.ravel(), y.ravel(), np.full(nx * ny, params.height_mm)], axis=1)]
    members = [
        np.stack([index[:-1].ravel(), index[1:].ravel()], axis=1),
        np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], axis=1),
    ]
    if params.layers == 2:
        upper = nx * ny + np.arange((nx - 1) * (ny - 1)).reshape(nx - 1, ny - 1)
        x, y = np.meshgrid((np.arange(nx - 1) + 0.5) * a, (np.arange(ny - 1) + 0.5) * a, indexing="ij")
        z = np.full(upper.size, params.height_mm + params.depth_mm)
        centres.append(np.stack([x.ravel(), y.ravel(), z], axis=1))
        members += [
            np.stack([upper[:-1].ravel(), upper[1:].ravel()], axis=1),
            np.stack([upper[:, :-1].ravel(), upper[:, 1:].ravel()], axis=1),
        ]
        corners = (index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:])
        members += [np.stack([lower.ravel(), upper.ravel()], axis=1) for lower in corners]
    elif params.diagonals:
        members.append(np.stack([index[:-1, :-1].ravel(), index[1:, 1:].ravel()], axis=1))
    nodes = _shaped(np.vstack(centres), params)
    frame = Frame(
        centres=nodes,
        radii=np.resize(np.array(params.radii_mm), len(nodes)),
        members=np.vstack(members).astype(np.int64),
        connection=bolt_ball.connection(params.tube_diameter_mm),
        process_hole=params.process_hole,
    )
    frame.tube_lengths()  # for its checks
    return frame


def _shaped(nodes: Floats, params: Params) -> Floats:
    """Return the nodes (k, 3) of a flat grid raised to the roof's shape."""
    span = params.spacing_mm * np.array([params.nodes_x - 1, params.nodes_y - 1])
    x, y = (nodes[:, :2] - 0.5 * span).T
    if params.shape == "free-form":
        u, v = 2.0 * np.pi * x / span[0], 2.0 * np.pi * y / span[1]
        rise = 0.25 * params.rise_mm * (2.0 + np.cos(0.5 * u) + 0.6 * np.sin(0.8 * v + 0.3) + 0.4 * np.cos(u + 0.7 * v))
    elif params.shape == "dome":
        reach = float(np.hypot(*(0.5 * span)))
        radius = (reach**2 + params.rise_mm**2) / (2.0 * params.rise_mm)
        rise = np.sqrt(radius**2 - x * x - y * y) - (radius - params.rise_mm)
    else:
        rise = np.zeros(len(nodes))
    shaped: Floats = nodes + rise[:, None] * np.array([0.0, 0.0, 1.0])
    return shaped


def solid(frame: Frame) -> cq.Compound:
    """Return the CadQuery compound of all balls, sleeves, cones and tubes, as designed or as built.

    Where a bolt is missing the flat has no hole, as in the surface that is scanned.
    """
    import cadquery as cq

    shapes: list[cq.Shape] = [
        bolt_ball.build(frame.ball(i), frame.bolted(i)).moved(cq.Location(cq.Vector(*centre)))
        for i, centre in enumerate(frame.centres)
    ]
    for member in range(len(frame.members)):
        shapes += _member(frame, member)
    return cq.Compound.makeCompound(shapes)


def _member(frame: Frame, member: int) -> list[cq.Shape]:
    """Return sleeves, cones and tube of a member; its ends without bolt have no sleeve."""
    import cadquery as cq

    connection, tube = frame.connection, 0.5 * frame.connection.tube_diameter
    begin_of, end_of = frame.ends(member)
    stacks, span = frame.stacks[member], end_of - begin_of
    length, unit = float(np.linalg.norm(span)), span / np.linalg.norm(span)
    shapes: list[cq.Shape] = []
    for end, (origin, out) in enumerate(((begin_of, unit), (end_of, -unit))):
        foot, tip = (origin + start * out for start in stacks[end, :2])
        if frame.has_sleeve(member, end):
            plane = cq.Plane(origin=tuple(foot), xDir=tuple(perpendicular(out)), normal=tuple(out))
            corners = [plane.toWorldCoords(tuple(c)) for c in connection.sleeve_corner_radius * HEXAGON]
            hexagon = cq.Wire.makePolygon(corners, close=True)
            shapes.append(cq.Solid.extrudeLinear(hexagon, [], cq.Vector(*(connection.sleeve_length * out))))
        radii = connection.cone_radius, tube
        shapes.append(cq.Solid.makeCone(*radii, connection.cone_length, cq.Vector(*tip), cq.Vector(*out)))
    begin, size = begin_of + stacks[0, 2] * unit, length - stacks[:, 2].sum()
    if not frame.bow(member).any():
        return [*shapes, cq.Solid.makeCylinder(tube, size, cq.Vector(*begin), cq.Vector(*unit))]
    # Circles square to the straight axis, moved along a parabola: three of them determine it.
    plane = cq.Plane(origin=tuple(begin), xDir=tuple(perpendicular(unit)), normal=tuple(unit))
    rings = [
        cq.Wire.makeCircle(
            tube, cq.Vector(*(begin + q * size * unit + 4.0 * q * (1.0 - q) * frame.bow(member))), plane.zDir
        )
        for q in (0.0, 0.5, 1.0)
    ]
    return [*shapes, cq.Solid.makeLoft(rings)]
