"""The section of a part's end: its outer faces, and which of them meet at each key point.

A side whose middle lies on steel is one face from corner to corner, as all four of a box. Of a side whose middle is
open (the sides of an I) only the edges of the plates that end there are faces, one at either corner: as wide as the
plate is thick. So a corner always is where an upright face, a level face and the end face meet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from processor.geometry import rigid
from processor.geometry.mesh_distance import MeshSurface
from processor.model import Bools, Floats, Word

OFF_STEEL_MM = 25.0  # of a key point from the surface: corners of rolled hollow sections are rounded by less
NEAR_MM = 600.0  # of the joint, in which walls are looked for
PARALLEL = 0.99  # cosine between the normals of a plate's two sides
THINNEST_MM, THICKEST_MM = 3.0, 150.0  # of plates
THICKEST_OF_RING_MM = 60.0  # plates of boxes are thinner
NARROW_MM = 40.0  # half the width of a face below which it has no shape across


class PlateFace(Word):
    """An outer face of a part."""

    BOTTOM = "bottom"
    RIGHT = "right"
    TOP = "top"
    LEFT = "left"


class EndFace(NamedTuple):
    """An outer face: the joint's axis and the sense of its normal, its distance from the joint's middle, and its width.

    ``middle`` and ``half`` (mm) are of its width, along the joint's other axis. ``plate``: it is the side of a plate,
    whose end face lies behind it; else the edge of one.
    """

    name: PlateFace
    axis: int
    sense: float
    offset: float
    middle: float
    half: float
    plate: bool = True

    @property
    def across(self) -> int:
        """Number of the axis along the face's width."""
        return 3 - self.axis

    @property
    def narrow(self) -> bool:
        """Whether the face is too narrow to have a shape across."""
        return self.half < NARROW_MM

    def from_middle(self, local: Floats) -> Floats:
        """Distance (n,) across the face, from its middle, of points (n, 3) in the joint's frame, mm."""
        distance: Floats = local[:, self.across] - self.middle
        return distance

    def w(self, local: Floats) -> Floats:
        """Place (n,) across the face of points (n, 3) in the joint's frame: -1 to 1."""
        return self.from_middle(local) / self.half


class Corner(NamedTuple):
    """P1, P2, P3 or P4: its place u, v as shares of half the section, and the numbers of its upright and level face."""

    u: float
    v: float
    upright: int
    level: int


class Section(NamedTuple):
    """Half the section's size (3,), its outer faces, its corners P1..P4, and the face (-1: open) of P5..P8."""

    half: Floats
    faces: tuple[EndFace, ...]
    corners: tuple[Corner, ...]
    middles: tuple[int, ...]
    radius: float = 0.0  # of a round tube, which has no faces and no corners, mm; else 0


SIDES = (  # axis and sense of the normal; P5..P8 are the middles of these
    (PlateFace.BOTTOM, 2, -1.0),
    (PlateFace.RIGHT, 1, -1.0),
    (PlateFace.TOP, 2, 1.0),
    (PlateFace.LEFT, 1, 1.0),
)
ANGLES = np.radians([-45.0, -135.0, 135.0, 45.0, -90.0, 180.0, 90.0, 0.0])  # of P1..P8 of a round tube, left to up
ROUND_SHARE = 0.03  # largest departure of the key points of a round section, by the radius: a mitre makes an ellipse
PLACES = ((1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))  # u, v of P1..P4


def round_radius(local: Floats) -> float:
    """Radius of the round section that has the key points P1..P8 (8, 3) in the joint's frame, mm; 0 of any other.

    P1..P4 of a round section are at 45 degrees, and P5..P8 as far from its middle as these.
    """
    at = local[:, 1:] - local[:4, 1:].mean(axis=0)
    away = np.linalg.norm(at, axis=1)
    off = np.angle(np.exp(1j * (np.arctan2(at[:, 1], at[:, 0]) - ANGLES)))
    radius = float(away.mean())
    is_round = np.abs(away - radius).max() < ROUND_SHARE * radius and np.abs(off).max() < ROUND_SHARE
    return radius if is_round else 0.0


def of_round(half: Floats, radius: float) -> Section:
    """Return the section of a round tube."""
    return Section(half, (), (), (0, 0, 0, 0), radius)


def of_box(half: Floats) -> Section:
    """Return the section of a hollow box, ``half`` (3,) of its size."""
    return _made(half, (True,) * 4, np.zeros(4))


def of_surface(half: Floats, T_bridge_joint: Floats, surface: MeshSurface) -> Section:
    """Return the section of a part by its design's surface at a joint; of a box where nothing else is seen there."""
    closed = _closed(half, T_bridge_joint, surface)
    thickness = np.array([plate_thickness(half, T_bridge_joint, surface, axis, sense) for _, axis, sense in SIDES])
    # The edges of an open side are those of the plates beside it.
    if closed.all() or not all(closed[(k + 1) % 4] and thickness[(k + 1) % 4] > 0.0 for k in range(4) if not closed[k]):
        return of_box(half)
    return _made(half, tuple(closed.tolist()), thickness)


def plate_thickness(half: Floats, T_bridge_joint: Floats, surface: MeshSurface, axis: int, sense: float) -> float:
    """Thickness of the plate on a side of a section, mm: the distance of the nearest parallel wall; 0 = unknown."""
    T = rigid.invert(T_bridge_joint)
    centre = rigid.apply(T, surface.vertices[surface.faces].mean(axis=1))
    parallel = np.abs(surface.normals @ T_bridge_joint[:3, axis]) > PARALLEL
    depth = half[axis] - sense * centre[:, axis]
    beside = np.abs(centre[:, 3 - axis]) < half[3 - axis]
    near = parallel & beside & (depth > THINNEST_MM) & (depth < THICKEST_MM)
    near &= np.abs(centre[:, 0]) < NEAR_MM + np.abs(centre[near, 0]).min(initial=np.inf)
    return float(depth[near].min()) if near.any() else 0.0


def _closed(half: Floats, T_bridge_joint: Floats, surface: MeshSurface) -> Bools:
    """Mark the sides (4,) that are of steel at their middle, or beside it: there may be a hole."""
    places = np.zeros((4, 3, 3))
    for k, (_, axis, sense) in enumerate(SIDES):
        places[k, :, axis] = sense * half[axis]
        places[k, :, 3 - axis] = half[3 - axis] * np.array([-0.5, 0.0, 0.5])
    nearest = surface.nearest(rigid.apply(T_bridge_joint, places.reshape(-1, 3)), OFF_STEEL_MM)[0].reshape(4, 3)
    return np.asarray((nearest >= 0).any(axis=1), bool)


def _made(half: Floats, closed: tuple[bool, ...], thickness: Floats) -> Section:
    faces: list[EndFace] = []
    number: dict[tuple[int, float], int] = {}  # of the face of a side, or of its part at one of its ends
    for k, (name, axis, sense) in enumerate(SIDES):
        width = float(half[3 - axis])
        if closed[k]:
            number[k, -1.0] = number[k, 1.0] = len(faces)
            faces.append(EndFace(name, axis, sense, offset=float(half[axis]), middle=0.0, half=width))
            continue
        for end in (-1.0, 1.0):
            plate = next(j for j, (_, a, s) in enumerate(SIDES) if a == 3 - axis and s == end)
            edge = 0.5 * float(thickness[plate])
            number[k, end] = len(faces)
            offset, middle = float(half[axis]), end * (width - edge)
            faces.append(EndFace(name, axis, sense, offset=offset, middle=middle, half=edge, plate=False))
    corners = []
    for u, v in PLACES:
        upright = next(j for j, (_, a, s) in enumerate(SIDES) if a == 1 and s == u)
        level = next(j for j, (_, a, s) in enumerate(SIDES) if a == 2 and s == v)
        corners.append(Corner(u, v, number[upright, v], number[level, u]))
    middles = tuple(number[k, 1.0] if closed[k] else -1 for k in range(4))
    return Section(half, tuple(faces), tuple(corners), middles)
