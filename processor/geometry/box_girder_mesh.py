"""Mesh of a part's outer box from its design curves alone, for a part whose design has no mesh.

The bottom lies between the two bottom edges. The webs are perpendicular to the soffit, and their height is linear along
the arc between the sections at the two joints. A foot has one joint only, and its height elsewhere is unknown. Its webs
are assumed to grow with its width, which has no effect since they are flat further up; its top is left out except near
the joint, and so is its base. The ends at joints are rings, somewhat thinner than ``plate_mm``. There are no inner
walls: with a plate thickness that is only assumed they would be in the wrong place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import Akima1DInterpolator, make_interp_spline

from processor.geometry import rigid
from processor.model import DesignPart, Floats, InputError, Ints

SOURCE = "curves"
PLATE_MM = 20.0  # assumed where the design states none: a usual plate of box girders
RING_SHARE = 0.7  # of a plate's thickness, so that points on the inner wall are not taken for the ring
MESH_ERROR_MM = 0.002  # along the curve
LONGEST_STEP_MM, SHORTEST_STEP_MM = 250.0, 5.0  # work: a straight part needs no more facets, a kink no smaller ones
SAME_WIDTH = 0.002  # relative change of a foot's width below which its height is taken as constant
OFF_JOINT = 0.05  # of the width: edges that end farther from a joint's P1 and P2 belong to another joint
KINK_RATIO, KINK_RAD = 2.0, 0.002  # an edge has a kink where it turns by so much more than at adjacent points
ALIKE_MM = 10.0  # parts whose edges differ by less are of one shape
CORNERS = 4  # bottom left, bottom right, top right, top left


@dataclass(frozen=True)
class Edge:
    """A curve through the points of an edge, of smooth pieces; its parameter is the share of the length from 0 to 1.

    ``knots`` (n,) are the shares of the points, ``starts`` (k,) those where a piece begins.
    """

    length: float
    knots: Floats
    starts: Floats
    pieces: tuple[Callable[[Floats], Floats], ...]

    @staticmethod
    def through(points: Floats) -> Edge:
        """Interpolate points (n, 3), n >= 2: smooth between kinks, straight between points on a line."""
        chords = np.diff(points, axis=0)
        sizes = np.linalg.norm(chords, axis=1)
        share = np.concatenate([[0.0], np.cumsum(sizes)])
        share = share / share[-1]  # the last is exactly 1: beyond it the curve has no value
        ways = chords / sizes[:, None]
        turn = np.concatenate([[0.0], np.linalg.norm(np.diff(ways, axis=0), axis=1), [0.0]])
        beside = np.maximum(np.append(turn[1:], 0.0), np.append(0.0, turn[:-1]))
        kinks = np.flatnonzero((turn > KINK_RATIO * beside + KINK_RAD)[1:-1]) + 1
        bounds = [0, *kinks.tolist(), len(points) - 1]
        pieces = [
            Akima1DInterpolator(share[i : k + 1], points[i : k + 1])
            if k - i > 1
            else make_interp_spline(share[i : k + 1], points[i : k + 1], k=1)
            for i, k in pairwise(bounds)
        ]
        return Edge(float(sizes.sum()), share, share[bounds[:-1]], tuple(pieces))

    def at(self, share: Floats) -> Floats:
        """Points (n, 3) at shares (n,) of the length."""
        which = np.clip(np.searchsorted(self.starts, share, side="right") - 1, 0, len(self.pieces) - 1)
        points = np.empty((len(share), 3))
        for k, piece in enumerate(self.pieces):
            points[which == k] = piece(share[which == k])
        return points


def mesh(
    left: Floats, right: Floats, start: Floats | None, end: Floats | None, plate_mm: float = PLATE_MM
) -> tuple[Floats, Ints]:
    """Vertices (v, 3) and triangles (f, 3), normals outward, of a part's outer box; mm.

    ``left`` and ``right`` (n, 3) are its bottom edges from start to end, ``start`` and ``end`` the key points (8, 3) of
    the joints there; one of them may be missing. Raises InputError for edges that do not end at the joints.
    """
    edges = (Edge.through(left), Edge.through(right))
    joints = [(share, points) for share, points in ((0.0, start), (1.0, end)) if points is not None]
    if not joints:
        raise InputError("expected a joint at one end or both, or a mesh")
    for share, points in joints:
        _check(edges, share, points)
    length = 0.5 * (edges[0].length + edges[1].length)
    at = _chainages(edges, length, max(float(np.linalg.norm(points[3] - points[0])) for _, points in joints))
    sections = _sections(edges, at, joints)
    count = len(at)
    number = np.arange(CORNERS * count).reshape(-1, CORNERS)
    faces = []
    for k in range(CORNERS):
        after = (k + 1) % CORNERS
        rows = np.arange(count - 1)
        if k == 2:
            rows = rows[_top_known(edges, at, joints, length)]
        corners = (number[rows, k], number[rows, after], number[rows + 1, after], number[rows + 1, k])
        faces.append(_quads(*corners)[:, ::-1])
    vertices = [sections.reshape(-1, 3)]
    for share, points in joints:
        ring, triangles = _ring(points[:4], plate_mm)
        faces.append((triangles[:, ::-1] if share == 1.0 else triangles) + sum(map(len, vertices)))
        vertices.append(ring)
    return np.vstack(vertices), np.vstack(faces).astype(np.int64)


def motions(part: DesignPart, other: DesignPart) -> list[Floats]:
    """Rigid motions T_part_other (4, 4), no mirror images, that map the other part's edges to this part's."""
    share = np.linspace(0.0, 1.0, 9)

    def places(left: Floats, right: Floats) -> Floats:
        return np.vstack([Edge.through(edge).at(share) for edge in (left, right)])

    target = places(part.bottom_edge_left, part.bottom_edge_right)
    poses = []
    for left, right in (
        (other.bottom_edge_left, other.bottom_edge_right),
        (other.bottom_edge_right[::-1], other.bottom_edge_left[::-1]),
    ):
        source = places(left, right)
        T = rigid.fit(source, target)
        if np.linalg.norm(rigid.apply(T, source) - target, axis=1).max() < ALIKE_MM:
            poses.append(T)
    return poses


def _check(edges: tuple[Edge, Edge], share: float, points: Floats) -> None:
    """Raise InputError unless the edges end at the key points (8, 3) of the joint at ``share``, 0 or 1."""
    ends = np.vstack([edge.at(np.array([share])) for edge in edges])
    width = float(np.linalg.norm(points[0] - points[1]))
    off = float(np.linalg.norm(ends - points[:2], axis=1).max())
    if not off <= OFF_JOINT * width:
        where = "end" if share else "start"
        raise InputError(
            f"expected the bottom edges to {where} at P1 and P2 of the joint there, found them {off:.0f} mm away; "
            "correct them or give a mesh"
        )
    along = edges[0].at(np.array([abs(share - 1e-3)])) - edges[0].at(np.array([share]))
    up = np.cross(along[0] * (1.0 if share == 0.0 else -1.0), points[0] - points[1])
    if not (up @ (points[3] - points[0]) > 0.0 and up @ (points[2] - points[1]) > 0.0):
        raise InputError(
            "expected P3 and P4 of its joints above P2 and P1, left and right as seen along the edges; "
            "correct them or give a mesh"
        )


def _frames(edges: tuple[Edge, Edge], share: Floats) -> tuple[Floats, Floats]:
    """Midpoints (n, 3) of the bottom, and frames (n, 3, 3) there: columns along, to the left, up."""
    step = 1e-4
    before, after = np.maximum(share - step, 0.0), np.minimum(share + step, 1.0)
    along = sum(edge.at(after) - edge.at(before) for edge in edges)
    along = along / np.linalg.norm(along, axis=1)[:, None]
    left = edges[0].at(share) - edges[1].at(share)
    left = left - np.einsum("ni,ni->n", left, along)[:, None] * along
    left = left / np.linalg.norm(left, axis=1)[:, None]
    middle: Floats = 0.5 * (edges[0].at(share) + edges[1].at(share))
    return middle, np.stack([along, left, np.cross(along, left)], axis=2)


def _chainages(edges: tuple[Edge, Edge], length: float, height: float) -> Floats:
    """Shares of the length between which chords are within MESH_ERROR_MM of the curve, at the bottom and at the top."""
    along = _frames(edges, np.linspace(0.0, 1.0, 201))[1][:, :, 0]
    bend = np.linalg.norm(np.diff(along, axis=0), axis=1).max() / (length / 200.0)
    step = np.sqrt(8.0 * MESH_ERROR_MM / max(bend * (1.0 + bend * height), 1e-12))
    step = float(np.clip(step, SHORTEST_STEP_MM, LONGEST_STEP_MM))
    # Every point of the edges is included: there they may have kinks.
    even = np.linspace(0.0, 1.0, int(np.ceil(length / step)) + 1)
    share = np.unique(np.concatenate([even, *(edge.knots for edge in edges)]))
    distinct: Floats = share[np.concatenate([[True], np.diff(share) * length > 0.5])]
    distinct[-1] = 1.0
    return distinct


def _sections(edges: tuple[Edge, Edge], share: Floats, joints: list[tuple[float, Floats]]) -> Floats:
    """Corners (n, 4, 3) of the outer sections."""
    low = [edge.at(share) for edge in edges]
    frames = _frames(edges, share)[1]
    known = []
    for at, points in joints:
        frame = _frames(edges, np.array([at]))[1][0]
        known.append(np.array([(points[3] - points[0]) @ frame, (points[2] - points[1]) @ frame]))
    if len(known) == 2:
        upright: Floats = known[0] + share[:, None, None] * (known[1] - known[0])
    else:
        upright = _widths(edges, share, joints[0][0])[:, None, None] * known[0]
    high = [low[k] + np.einsum("nij,nj->ni", frames, upright[:, k]) for k in range(2)]
    return np.stack([low[0], low[1], high[1], high[0]], axis=1)


def _widths(edges: tuple[Edge, Edge], share: Floats, joint: float) -> Floats:
    """Widths (n,) relative to the width at a joint."""
    at = np.append(share, joint)
    width: Floats = np.linalg.norm(edges[0].at(at) - edges[1].at(at), axis=1)
    by_joint: Floats = width[:-1] / width[-1]
    return by_joint


def _top_known(
    edges: tuple[Edge, Edge], share: Floats, joints: list[tuple[float, Floats]], length: float
) -> np.ndarray:
    """Mark the steps (n - 1,) between sections whose height is known."""
    if len(joints) == 2:
        return np.ones(len(share) - 1, bool)
    (at, points) = joints[0]
    away = np.abs(share - at) * length
    same = np.abs(_widths(edges, share, at) - 1.0) <= SAME_WIDTH
    first_change = away[~same].min(initial=np.inf)
    known = away < min(first_change, float(np.linalg.norm(points[3] - points[0])))
    return np.asarray(known[1:] & known[:-1], bool)


def _ring(corners: Floats, plate_mm: float) -> tuple[Floats, Ints]:
    """Vertices (8, 3) and triangles of the ring within corners (4, 3), normals towards the part's start."""
    after, before = np.roll(corners, -1, axis=0) - corners, np.roll(corners, 1, axis=0) - corners
    plate = np.minimum(RING_SHARE * plate_mm, 0.4 * min(np.linalg.norm(after, axis=1)))
    inward = [side / np.linalg.norm(side, axis=1)[:, None] for side in (after, before)]
    o = np.arange(CORNERS)
    n = o + CORNERS
    triangles = _quads(o, np.roll(o, -1), np.roll(n, -1), n)
    return np.vstack([corners, corners + plate * (inward[0] + inward[1])]), triangles


def _quads(a: Ints, b: Ints, c: Ints, d: Ints) -> Ints:
    """Triangles (2n, 3) of quadrilaterals with corners a, b, c, d (n,)."""
    quads = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
    triangles: Ints = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return triangles
