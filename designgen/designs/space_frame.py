"""Space frame of bolt balls: a single-layer or square-on-square double-layer grid with sleeves, cones and tubes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from designgen.designs import bolt_ball
from processor.model import Floats, Ints, UsageError

if TYPE_CHECKING:
    import cadquery as cq

ABOUT = "space frame: bolt balls on a grid, joined by sleeves, cones and tubes"

HEXAGON = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.arange(6) * np.pi / 3.0])  # unit corners


@dataclass(frozen=True)
class Params:
    """A grid of ``nodes_x`` by ``nodes_y`` balls, and with two layers one less each way above it, mm."""

    nodes_x: int = 4
    nodes_y: int = 4
    layers: int = 2
    spacing_mm: float = 3000.0
    depth_mm: float = 2100.0
    height_mm: float = 6000.0  # of the lowest layer
    radii_mm: tuple[float, ...] = (45.0,)  # taken in turn along the grid
    tube_diameter_mm: float = 60.0
    process_hole: bool = True

    def __post_init__(self) -> None:
        _expect(self.nodes_x >= 2 and self.nodes_y >= 2, "nodes_x, nodes_y", (self.nodes_x, self.nodes_y), "2 or more")
        _expect(
            self.nodes_x * self.nodes_y <= 1_000_000,
            "nodes_x * nodes_y",
            self.nodes_x * self.nodes_y,
            "a million at most",
        )
        _expect(self.layers in (1, 2), "layers", self.layers, "1 or 2")
        _expect(len(self.radii_mm) > 0, "radii_mm", list(self.radii_mm), "one radius or more")
        least = 4.0 * max(self.radii_mm, default=0.0)
        _expect(self.spacing_mm > least, "spacing_mm", self.spacing_mm, f"more than four radii ({least:g})")
        _expect(self.depth_mm > 0.0, "depth_mm", self.depth_mm, "a length above 0")
        for radius in self.radii_mm:
            _expect(radius > 0.0, "radii_mm", radius, "radii above 0")


def _expect(fits: bool, key: str, came: object, expected: str) -> None:
    if not fits:
        raise UsageError(f"frame.{key}: expected {expected}, got {came!r}")


@dataclass(frozen=True)
class Frame:
    """The frame's nodes and members; ``directions[i]`` are the unit vectors (m, 3) from node i to its neighbours."""

    centres: Floats  # (k, 3)
    radii: Floats  # (k,)
    members: Ints  # (m, 2) rows of centres
    connection: bolt_ball.Connection
    process_hole: bool
    directions: tuple[Floats, ...]

    def ball(self, node: int) -> bolt_ball.Params:
        """Return the design of one ball."""
        return bolt_ball.Params(float(self.radii[node]), self.directions[node], self.connection, self.process_hole)


def build(params: Params) -> Frame:
    """Lay out the frame; every ball is checked for sleeves that would meet."""
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
        for below in (index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]):
            members.append(np.stack([below.ravel(), upper.ravel()], axis=1))
    nodes = np.vstack(centres)
    ends = np.vstack(members).astype(np.int64)
    neighbours: list[list[Floats]] = [[] for _ in nodes]
    for i, j in ends:
        unit = (nodes[j] - nodes[i]) / np.linalg.norm(nodes[j] - nodes[i])
        neighbours[i].append(unit)
        neighbours[j].append(-unit)
    radii = np.resize(np.array(params.radii_mm), len(nodes))
    frame = Frame(
        nodes,
        radii,
        ends,
        bolt_ball.connection(params.tube_diameter_mm),
        params.process_hole,
        tuple(np.array(units) for units in neighbours),
    )
    for node in range(len(nodes)):
        frame.ball(node)
    return frame


def solid(frame: Frame) -> cq.Compound:
    """CadQuery compound of all balls, sleeves, cones and tubes."""
    import cadquery as cq

    shapes: list[cq.Shape] = [
        bolt_ball.build(frame.ball(i)).moved(cq.Location(cq.Vector(*centre))) for i, centre in enumerate(frame.centres)
    ]
    joined = frame.connection
    for i, j in frame.members:
        span = frame.centres[j] - frame.centres[i]
        length, unit = float(np.linalg.norm(span)), span / np.linalg.norm(span)
        starts = []
        for node, out in ((i, unit), (j, -unit)):
            foot = frame.centres[node] + frame.ball(node).flat_distance * out
            plane = cq.Plane(origin=tuple(foot), normal=tuple(out))
            corners = [plane.toWorldCoords(tuple(c)) for c in joined.sleeve_corner_radius * HEXAGON]
            hexagon = cq.Wire.makePolygon(corners, close=True)
            shapes.append(cq.Solid.extrudeLinear(hexagon, [], cq.Vector(*(joined.sleeve_length * out))))
            tip = foot + joined.sleeve_length * out
            shapes.append(
                cq.Solid.makeCone(
                    joined.sleeve_corner_radius + 3.0,
                    0.5 * joined.tube_diameter,
                    joined.cone_length,
                    cq.Vector(*tip),
                    cq.Vector(*out),
                )
            )
            starts.append(np.linalg.norm(tip - frame.centres[node]) + joined.cone_length)
        begin = frame.centres[i] + starts[0] * unit
        shapes.append(
            cq.Solid.makeCylinder(0.5 * joined.tube_diameter, length - sum(starts), cq.Vector(*begin), cq.Vector(*unit))
        )
    return cq.Compound.makeCompound(shapes)
