"""What stands about a part or a structure while it is scanned: floor, walls, trestles, neighbours, scaffold, people.

All of it is of no part (-1 in the labels), so that the truth says of each point whether it belongs to the structure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.distance import cdist

from designgen.checks import expect
from designgen.randomness import generator
from designgen.rigid import rigid
from designgen.scanning import clutter
from designgen.scanning.surfaces import Builder
from processor.model import Floats, Steel

KINDS = ("workshop", "site", "room")
ABOVE_FLOOR_MM = 800.0  # height of a part on trestles
HIGHEST_TRESTLE_MM = 2_000.0  # chosen: parts lie on some 0.8 m; what stands higher stands on its own
SCANNER_MM = 400.0  # least height of a scanner above the floor: on a low tripod, which sees below the part
CLEAR_MM = 1_500.0  # chosen: from a scanner to a person; at 0.5 m he hides an eighth of the turn
ALBEDO = {"floor": 0.7, "wall": 1.3, "wood": 0.9}  # by the structure's: dusty concrete, paint, boards
# Of parts on trestles: what is scanned is not bent by its weight, so by this modulus no sag is taken out of it either.
RIGID = Steel(E_MPa=1e12)
FLAT = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])

Local = Floats | Sequence[float]  # (3,) in the axes of a box


@dataclass(frozen=True)
class Params:
    """Section ``surroundings`` of a recipe."""

    kind: str = "workshop"

    def __post_init__(self) -> None:
        expect(self.kind in KINDS, "surroundings.kind", self.kind, f"one of {', '.join(KINDS)}")

    @property
    def steel(self) -> Steel | None:
        """Steel of parts scanned in them, where it is not that of every structure."""
        return RIGID if self.kind == "workshop" else None


@dataclass(frozen=True)
class Box:
    """A box about what is scanned: axes (3, 3, rows) along, across and up, middle (3,) and half sizes (3,), mm.

    ``bottom`` (n, 3) are points along an underside that is not the box's, in the scene's frame.
    """

    axes: Floats
    middle: Floats
    half: Floats
    bottom: Floats | None = None

    @classmethod
    def about(cls, points: Floats) -> Box:
        """Return the box along the axes of the scene about points (n, 3)."""
        low, high = points.min(axis=0), points.max(axis=0)
        return cls(np.eye(3), 0.5 * (low + high), 0.5 * (high - low))

    def at(self, local: Local) -> Floats:
        """Return the places (n, 3) of local coordinates (n, 3)."""
        placed: Floats = self.middle + np.asarray(local) @ self.axes
        return placed

    def lowest(self, along: float, half: float) -> float:
        """Return the height of the underside between ``half`` on both sides of a place along."""
        if self.bottom is None:
            return -float(self.half[2])
        local = (self.bottom - self.middle) @ self.axes.T
        within = np.linspace(along - half, along + half, 9)
        return float(np.interp(within, local[:, 0], local[:, 2]).min())

    def levelled(self, T: Floats) -> Floats:
        """Return a pose T_scan_scene (4, 4) with the heading and the place of another one, in which the box is up."""
        c, s = T[:2, 0] / np.linalg.norm(T[:2, 0])
        return rigid(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ self.axes, T[:3, 3])


def add(
    builder: Builder,
    params: Params | None,
    box: Box,
    poses: Mapping[str, Floats],
    seed: int,
    name: str = "",
    *,
    on_ground: bool = False,
) -> None:
    """Add surroundings, if any, of a box that is scanned from stations with ``poses`` (4, 4); walls stand beyond these.

    The floor lies a trestle's height below the box, or below the scanners where these stand lower; with ``on_ground``
    the scene has a floor of its own. ``name`` tells the surroundings of several boxes apart.
    """
    if params is None:
        return
    rng = generator(seed, f"surroundings {name}")
    local = (np.array([T[:3, 3] for T in poses.values()]) - box.middle) @ box.axes.T
    low = -float(box.half[2])
    floor = min(low - ABOVE_FLOOR_MM, float(local[:, 2].min()) - SCANNER_MM)
    reach = np.maximum(np.abs(local[:, :2]).max(axis=0), box.half[:2]) + rng.uniform(1_000.0, 5_000.0, 2)
    if not on_ground:
        if params.kind == "site":
            _add_ground(builder, box, reach, floor, rng)
        else:
            _add_rectangle(builder, box, "floor", [0.0, 0.0, floor], [reach[0], 0.0, 0.0], [0.0, reach[1], 0.0])
    if params.kind == "site":
        _add_scaffold(builder, box, floor, rng)
    else:
        _add_walls(builder, box, reach, floor, closed=params.kind == "room")
    if params.kind == "workshop":
        if low - floor < HIGHEST_TRESTLE_MM:  # a roof stands on its own
            _add_trestles(builder, box, floor, rng)
        _add_cable(builder, box, floor, rng)
        # A part of the same kind beyond the stations
        aside = float(np.abs(local[:, 1]).max()) + box.half[1] + 500.0
        _add_box(builder, box, "neighbour", np.array([0.1 * box.half[0], aside, 0.0]), box.half)
    _add_people_and_crates(builder, box, local, floor, rng)


def _add_walls(builder: Builder, box: Box, reach: Floats, floor: float, *, closed: bool) -> None:
    """Add two walls that meet, or four and a ceiling."""
    top = box.half[2] + 2_500.0
    middle, half = 0.5 * (floor + top), 0.5 * (top - floor)
    for k, (axis, side) in enumerate(((0, 1.0), (1, 1.0), (0, -1.0), (1, -1.0))[: 4 if closed else 2]):
        at, along = np.array([0.0, 0.0, middle]), np.zeros(3)
        at[axis], along[1 - axis] = side * reach[axis], reach[1 - axis]
        _add_rectangle(builder, box, f"wall {k + 1}", at, along, [0.0, 0.0, half], "wall")
    if closed:
        _add_rectangle(builder, box, "ceiling", [0.0, 0.0, top], [reach[0], 0.0, 0.0], [0.0, reach[1], 0.0], "wall")


def _add_ground(builder: Builder, box: Box, reach: Floats, floor: float, rng: np.random.Generator) -> None:
    """Add uneven ground as triangles; it lies lower than a floor would by up to its unevenness."""
    x, y = (np.linspace(-1.0, 1.0, 13) * size for size in reach)
    z = floor - rng.uniform(0.0, 300.0, (13, 13))
    for i, j in np.ndindex(12, 12):
        corners = np.array([[x[a], y[b], z[a, b]] for a, b in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))])
        for rows in ([0, 1, 2], [0, 2, 3]):
            builder.polygon(-1, "ground", box.at(corners[rows]), ALBEDO["floor"])


def _add_trestles(builder: Builder, box: Box, floor: float, rng: np.random.Generator) -> None:
    """Add two trestles that touch what is in the box from below."""
    for side in (-1.0, 1.0):
        along = side * rng.uniform(0.45, 0.75) * box.half[0]
        half = np.array([75.0, 1.1 * box.half[1], 0.5 * (box.lowest(along, 75.0) - floor)])
        _add_box(builder, box, "trestle", np.array([along, 0.0, floor + half[2]]), half)


def _add_cable(builder: Builder, box: Box, floor: float, rng: np.random.Generator) -> None:
    """Add a cable that lies across the top of the box and hangs down to the floor on both sides."""
    y = np.linspace(-1.0, 1.0, 15) * (box.half[1] + 400.0)
    over = np.abs(y) <= box.half[1]
    down = (np.abs(y) - box.half[1]).clip(0.0) / 400.0
    z = np.where(over, box.half[2] + 12.0, box.half[2] + 12.0 + down**1.5 * (floor - box.half[2]))
    points = box.at(np.column_stack([np.full(15, rng.uniform(-0.6, 0.6) * box.half[0]), y, z]))
    for start, end in pairwise(points):
        length = float(np.linalg.norm(end - start))
        clutter.add_bar(builder, "cable", start, (end - start) / length, 12.0, length)


def _add_scaffold(builder: Builder, box: Box, floor: float, rng: np.random.Generator) -> None:
    """Add a scaffold along one side of the box, some 0.2 m off: standards, ledgers and boards on two levels."""
    gap = box.half[1] + rng.uniform(150.0, 400.0)
    x = np.linspace(-1.0, 1.0, max(2, int(np.ceil(2.0 * box.half[0] / 2_000.0)) + 1)) * box.half[0]
    rows, top = (gap, gap + 700.0), box.half[2] + 1_000.0
    for at in np.array([[along, y, floor] for along in x for y in rows]):
        clutter.add_bar(builder, "standard", box.at(at), box.axes[2], 24.0, top - floor)
    for z in np.linspace(floor, top, 4)[1:3]:
        for y in rows:
            clutter.add_bar(builder, "ledger", box.at([x[0], y, z]), box.axes[0], 24.0, float(np.ptp(x)))
        half = np.array([0.5 * np.ptp(x), 300.0, 20.0])
        _add_box(builder, box, "board", np.array([0.0, gap + 350.0, z + 45.0]), half, "wood")


def _add_people_and_crates(
    builder: Builder, box: Box, stations: Floats, floor: float, rng: np.random.Generator
) -> None:
    """Add a person and two crates between the box and the stations, which stand on the floor."""
    for name in ("person", "crate", "crate"):
        towards = stations[rng.integers(len(stations)), :2] + rng.normal(0.0, 300.0, 2)
        # Off the box, and off the scanners: those below a roof stand within its box
        edge = float((box.half[:2] / np.maximum(np.abs(towards), 1.0)).min())
        at = towards * min(1.0, edge + rng.uniform(0.3, 0.6) * max(1.0 - edge, 0.0))
        x, y = _clear_of(stations[:, :2], at)
        if name == "crate":
            half = rng.uniform(150.0, 300.0, 3)
            _add_box(builder, box, name, np.array([x, y, floor + half[2]]), half, "wood")
        else:
            clutter.add_bar(builder, name, box.at([x, y, floor]), box.axes[2], 200.0, 1_450.0)
            builder.sphere(-1, name, box.at([x, y, floor + 1_600.0]), 120.0, [])


def _clear_of(stations: Floats, at: Floats) -> Floats:
    """Return a place (2,), or if it is near a station (s, 2) that one of eight about it that is farthest from all."""
    turn = np.arange(8) * np.pi / 4.0
    places = np.vstack([at, at + CLEAR_MM * np.column_stack([np.cos(turn), np.sin(turn)])])
    away = cdist(places, stations).min(axis=1)
    place: Floats = places[0 if away[0] >= CLEAR_MM else away.argmax()]
    return place


def _add_box(builder: Builder, box: Box, name: str, centre: Floats, half: Floats, like: str = "floor") -> None:
    for axis in range(3):
        one, other = np.zeros(3), np.zeros(3)
        one[(axis + 1) % 3], other[(axis + 2) % 3] = half[(axis + 1) % 3], half[(axis + 2) % 3]
        for side in (-1.0, 1.0):
            at = centre.copy()
            at[axis] += side * half[axis]
            _add_rectangle(builder, box, name, at, one, other, like)


def _add_rectangle(
    builder: Builder, box: Box, name: str, centre: Local, one: Local, other: Local, like: str = "floor"
) -> None:
    """Add a rectangle by its centre (3,) and halves (3,) of its sides, local."""
    corners = np.asarray(centre) + FLAT @ np.array([one, other], np.float64)
    builder.polygon(-1, name, box.at(corners), ALBEDO[like])
