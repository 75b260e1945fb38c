"""One adjustment of the whole assembly: all joints and the design's curve at once.

Every part i, registered to its design, is moved by a small motion x_i (turn about its own centre, translation) that
minimises

    sum of squared gaps + lambda sum of squared departures of the bottom edges

over gaps of eight pairs per joint along three axes, and departures sideways and up at regular chainages of both edges.
The joints may form any graph: a row, a closed ring, branches. A part without bottom edges has the departures of its key
points across its joints in their place.
The error of a part's registration moves both its ends and its edges, and the adjustment removes it. A ring could turn
within itself: wherever the joints form no row, and where a joint has no answer, the square of every part's movement
along its chord is added with a weight of HOLD. Where the joints with an answer leave the assembly in pieces, nothing
that was measured places one piece against another. Then the mean square of the movement of every part, whole, has that
weight, and the design alone places each piece: see :mod:`processor.preassembly.chain.design_places`. The gaps of
imperfect parts depend on lambda, so it is stated, and the curve over lambda is part of the result. All is linear in the
measurements, and their covariance is propagated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from processor.adjustment import body_motions
from processor.geometry import rigid
from processor.model import Floats, Ints
from processor.preassembly import topology
from processor.preassembly.chain import design_places
from processor.preassembly.ends.bottom_edges import EdgeDepartures
from processor.preassembly.ends.joint_end import JointEnd
from processor.preassembly.parts.part_in_chain import Member
from processor.preassembly.topology import Side, Sides

HOLD = 1e-3  # weight of a part's movement along its chord, or of its whole movement; small against gaps and edges


class Solution(NamedTuple):
    """The motions (6 c,) of least squares and the edges' departures after them, by the n observations.

    ``to_motion`` (6 c, n), ``to_departures`` (k, n) a part, with NaN where a departure is unknown; covariance (n, n) of
    the observations, and ``with_pose`` (n, 6 c) that with the parts' registrations. Departures have rows sideways and
    up in turn.
    """

    to_motion: Floats
    to_departures: tuple[Floats, ...]
    covariance: Floats
    with_pose: Floats


@dataclass(frozen=True)
class Adjusted:
    """Motions T (c, 4, 4) of the registered parts, with covariance (6 c, 6 c) about the parts' centres, and the gaps.

    ``motion_with_pose`` (6 c, 6 c) is the covariance of the motions with the parts' registrations. ``solution`` is
    what other figures of the chain are propagated with.
    ``gaps`` (j, 8, 3) at these motions in bridge axes, with covariance (j, 24, 24). ``departures`` (k, 2) a part,
    sideways and up, are after the adjustment, with variances (k, 2). ``at_rest_variance`` (k, 2) are those with the
    whole bridge moved so that the first part lies where its registration has it.
    ``piece`` (c,) numbers the pieces that the joints with an answer leave; one of several is placed by the design
    alone, which adds ``placing_covariance`` (c, 6, 6), of motions about the parts' centres, to its poses and edges.
    """

    motions: Floats
    motion_covariance: Floats
    motion_with_pose: Floats
    gaps: Floats
    gap_covariance: Floats
    departures: tuple[Floats, ...]
    departure_variance: tuple[Floats, ...]
    at_rest_variance: tuple[Floats, ...]
    solution: Solution
    piece: Ints
    placing_covariance: Floats

    @property
    def in_pieces(self) -> bool:
        """Whether the joints with an answer leave more than one piece."""
        return bool(self.piece.any())


class _Rows(NamedTuple):
    """Some observations: derivative (n, p) by the parts' motions, values (n,), covariance without that of poses (n, n).

    ``by_pose`` (n, p) is the derivative of their errors by those of the parts' registrations; ``with_end`` (n, 24) the
    covariance of a line's departures with those of their end in the bridge's axes.
    """

    A: Floats
    value: Floats
    covariance: Floats
    by_pose: Floats
    with_end: Floats = np.empty((0, 24))


@dataclass(frozen=True)
class _Observations:
    """All observations: derivative A (n, p) by the parts' motions, values (n,), and their covariance (n, n).

    ``with_pose`` (n, p) is their covariance with the parts' registrations. Rows are the gaps of joints with an answer,
    24 each, the edges' departures, those of the key points of parts without edges, and the ``held`` last ones, of the
    parts' movements. ``gap_row`` is -1 of joints without an answer, ``edge_rows`` are those of each part, ``piece``
    (c,) its number.
    """

    A: Floats
    value: Floats
    covariance: Floats
    with_pose: Floats
    gap_row: Ints
    edge_rows: tuple[slice, ...]
    held: int
    piece: Ints
    in_row: bool


def adjust(
    members: Sequence[Member],
    joint_points: Floats,
    joint_frames: Floats,
    weight: float,
    sides: Sides | None = None,
    place_sd_mm: float = 0.0,
) -> Adjusted:
    """Adjust an assembly; ``joint_points`` (j, 8, 3) are the design's, ``joint_frames`` (j, 4, 4) T_bridge_joint.

    ``weight`` is lambda; ``sides`` of each joint, None for parts in a row. Joints with an unknown end have no
    observations; their gaps are NaN. A piece's place in the design has the standard deviation ``place_sd_mm``.
    """
    sides = topology.sides_of(topology.row(len(members))) if sides is None else sides
    observed = _observations(members, joint_points, joint_frames, sides)
    to_motion = _solve(observed, weight)
    x = to_motion @ observed.value
    motions, centres = x.reshape(-1, 6), [member.centre for member in members]
    # Residuals by observations, after the motion.
    after = np.eye(len(observed.value)) + observed.A @ to_motion
    residual = after @ observed.value
    # Motions are few: with their covariance with the observations no product of two matrices (n, n) is needed.
    with_motion = to_motion @ observed.covariance
    gaps, gap_covariance = np.full((len(joint_points), 8, 3), np.nan), np.full((len(joint_points), 24, 24), np.nan)
    for j, row in enumerate(observed.gap_row):
        if row >= 0:
            gaps[j] = residual[row : row + 24].reshape(8, 3)
            # Of the gap at the poses found: the ends' errors that the motions follow are in it.
            gap_covariance[j] = observed.covariance[row : row + 24, row : row + 24]
    departures, variances, at_rest, to_departures = [], [], [], []
    for member, rows in zip(members, observed.edge_rows, strict=True):
        departure, variance, at_rest_variance = (np.full(member.edges.departure.shape, np.nan) for _ in range(3))
        known = np.isfinite(member.edges.departure)
        with_residual = observed.covariance[rows] + observed.A[rows] @ with_motion
        departure[known], variance[known] = residual[rows], np.einsum("ki,ki->k", with_residual, after[rows])
        # The first part at rest: the inverse of its motion moves every edge.
        by_first = _edge_motion(member.edges, members[0].centre)[known.ravel()]
        at_rest_variance[known] = np.einsum(
            "ki,ki->k", with_residual - by_first @ with_motion[:6], after[rows] - by_first @ to_motion[:6]
        )
        of_part = np.full((known.size, len(observed.value)), np.nan)
        of_part[known.ravel()] = after[rows]
        to_departures.append(of_part)
        departures.append(departure)
        variances.append(variance)
        at_rest.append(at_rest_variance)
    adjusted = Adjusted(
        motions=np.array([body_motions.transform_about(*of_part) for of_part in zip(motions, centres, strict=True)]),
        motion_covariance=with_motion @ to_motion.T,
        motion_with_pose=to_motion @ observed.with_pose,
        gaps=gaps,
        gap_covariance=gap_covariance,
        departures=tuple(departures),
        departure_variance=tuple(variances),
        at_rest_variance=tuple(at_rest),
        solution=Solution(to_motion, tuple(to_departures), observed.covariance, observed.with_pose),
        piece=observed.piece,
        placing_covariance=np.zeros((len(members), 6, 6)),
    )
    return _placed_by_design(adjusted, members, x, sides, joint_points, place_sd_mm) if adjusted.in_pieces else adjusted


def _placed_by_design(
    adjusted: Adjusted, members: Sequence[Member], x: Floats, sides: Sides, joint_points: Floats, sd_mm: float
) -> Adjusted:
    """Add the covariance of the pieces' places in the design, to which the parts' motions x (6 c,) belong."""
    places = [design_places.places(members, i, sides, joint_points) for i in range(len(members))]
    placing = design_places.covariances(x.reshape(-1, 6), places, members, adjusted.piece, sd_mm)
    variances, at_rest = [], []
    for i, member in enumerate(members):
        own, first = (_edge_motion(member.edges, members[k].centre) for k in (i, 0))
        by_own, by_first = (
            body_motions.variances(motion, placing[k]).reshape(-1, 2) for motion, k in ((own, i), (first, 0))
        )
        variances.append(adjusted.departure_variance[i] + by_own)
        at_rest.append(adjusted.at_rest_variance[i] + by_own + by_first)
    return replace(
        adjusted,
        departure_variance=tuple(variances),
        at_rest_variance=tuple(at_rest),
        placing_covariance=placing,
    )


def left_open(
    members: Sequence[Member], joint_points: Floats, joint_frames: Floats, weight: float, sides: Sides, joint: int
) -> tuple[Floats, Floats]:
    """Gaps (8, 3) of a joint where all others alone place the parts, and their covariance (24, 24); NaN = unknown."""
    observed = _observations(members, joint_points, joint_frames, sides)
    start = int(observed.gap_row[joint])
    if start < 0:
        return np.full((8, 3), np.nan), np.full((24, 24), np.nan)
    rows = slice(start, start + 24)
    # The constraint along the chord has the joints' weight, so that it does not restrain them.
    to_motion = _solve(observed, weight, hold=weight, without=rows)
    after = np.eye(len(observed.value))[rows] + observed.A[rows] @ to_motion
    return (after @ observed.value).reshape(8, 3), after @ observed.covariance @ after.T


def _solve(observed: _Observations, weight: float, hold: float = HOLD, without: slice = slice(0, 0)) -> Floats:
    """Matrix (p, n) from observations to the motions of least weighted squares; some rows may be left out."""
    root = np.ones(len(observed.value))
    root[24 * int((observed.gap_row >= 0).sum()) : -observed.held] = np.sqrt(weight)
    # A chain without a break is free to slide: a constraint would change its gaps by hundredths of a mm.
    broken = (observed.gap_row < 0).any() or not len(observed.gap_row)
    root[-observed.held :] = np.sqrt(hold) if broken or not observed.in_row else 0.0
    root[without] = 0.0
    weighted = observed.A * root[:, None]
    # Turns and translations differ in scale by thousands: unit columns keep the digits of the solution.
    size = np.linalg.norm(weighted, axis=0)
    size[size == 0.0] = 1.0
    to_motion: Floats = -(np.linalg.pinv(weighted / size, rcond=1e-12) / size[:, None]) * root
    return to_motion


def _observations(members: Sequence[Member], joint_points: Floats, joint_frames: Floats, sides: Sides) -> _Observations:
    gap_row = np.full(len(joint_points), -1, np.int64)
    blocks: list[_Rows] = []
    for j in range(len(joint_points)):
        rows = _gap_rows(members, sides[j], joint_points[j], joint_frames[j][:3, :3])
        if rows is not None:
            gap_row[j] = 24 * len(blocks)
            blocks.append(rows)
    edges = [_edge_rows(members, i) for i in range(len(members))]
    ends = 24 * len(blocks) + np.cumsum([0, *(len(rows.value) for rows in edges)])
    lines: list[tuple[_Rows, int, float]] = [
        (_line_rows(members, side, joint_points[j], joint_frames[j][:3, :3]), int(gap_row[j]), sign)
        for j, both in enumerate(sides)
        for side, sign in zip(both, (-1.0, 1.0), strict=True)
        if not len(members[side.part].edges.points) and _known(members, side) is not None
    ]
    joined = np.array([[side.part for side in both] for both in sides], np.int64).reshape(-1, 2)
    piece = topology.pieces(joined, gap_row >= 0, len(members))
    held = (_place_rows if piece.any() else _chord_rows)(members, sides, joint_points)
    blocks += [*edges, *(line[0] for line in lines), held]
    A, value = np.vstack([rows.A for rows in blocks]), np.concatenate([rows.value for rows in blocks])
    by_pose = np.vstack([rows.by_pose for rows in blocks])
    with_pose = by_pose @ block_diag(*(member.pose for member in members))
    of_blocks = block_diag(*(rows.covariance for rows in blocks))
    start = int(ends[-1])
    for line, gap, sign in lines:
        at = slice(start, start + len(line.value))
        start = at.stop
        if gap >= 0:  # the line's departures and the gaps are of the same end
            of_blocks[at, gap : gap + 24] = sign * line.with_end
            of_blocks[gap : gap + 24, at] = sign * line.with_end.T
    covariance = of_blocks + with_pose @ by_pose.T
    edge_rows = tuple(slice(int(start), int(stop)) for start, stop in pairwise(ends))
    return _Observations(
        A=A,
        value=value,
        covariance=covariance,
        with_pose=with_pose,
        gap_row=gap_row,
        edge_rows=edge_rows,
        held=len(held.value),
        piece=piece,
        in_row=sides == topology.sides_of(topology.row(len(members))),
    )


def _known(members: Sequence[Member], side: Side) -> JointEnd | None:
    """Return the end on a side of a joint; None where it is unknown."""
    end = members[side.part].ends[side.end] if members[side.part].ends else None
    return end if end is not None and np.isfinite(end.departure).all() else None


def _gap_rows(members: Sequence[Member], sides: tuple[Side, Side], points: Floats, R: Floats) -> _Rows | None:
    """Gaps of a joint with key points (8, 3) and axes R (3, 3), or None where an end is unknown."""
    left, right = (_known(members, side) for side in sides)
    if left is None or right is None:
        return None
    A, by_pose = np.zeros((2, 24, 6 * len(members)))
    turn = np.kron(np.eye(8), R)
    at = [side.part for side in sides]
    for part, end, sign in ((at[0], left, -1.0), (at[1], right, 1.0)):
        columns = slice(6 * part, 6 * part + 6)
        A[:, columns] = sign * rigid.motion(points - members[part].centre).reshape(24, 6)
        by_pose[:, columns] = sign * turn @ end.by_pose
    noise = left.without_pose(members[at[0]].pose) + right.without_pose(members[at[1]].pose)
    return _Rows(A, turn @ (right.departure - left.departure).ravel(), turn @ noise @ turn.T, by_pose)


def _line_rows(members: Sequence[Member], side: Side, points: Floats, R: Floats) -> _Rows:
    """Departures across a joint, sideways and up, of the key points (8, 3) of a part's end."""
    end, member = _known(members, side), members[side.part]
    assert end is not None
    across = np.delete(np.arange(24), np.arange(0, 24, 3))
    columns = slice(6 * side.part, 6 * side.part + 6)
    A, by_pose = np.zeros((2, 16, 6 * len(members)))
    local = np.kron(np.eye(8), R.T)
    A[:, columns] = (local @ rigid.motion(points - member.centre).reshape(24, 6))[across]
    by_pose[:, columns] = end.by_pose[across]
    noise = end.without_pose(member.pose)[across]
    return _Rows(A, end.departure.ravel()[across], noise[:, across], by_pose, noise @ local)


def _edge_rows(members: Sequence[Member], part: int) -> _Rows:
    """Known departures of a part's edges."""
    member, edges = members[part], members[part].edges
    columns = slice(6 * part, 6 * part + 6)
    known = np.isfinite(edges.departure).ravel()
    A, by_pose = np.zeros((2, int(known.sum()), 6 * len(members)))
    A[:, columns] = _edge_motion(edges, member.centre)[known]
    by_pose[:, columns] = edges.by_pose.reshape(-1, 6)[known]
    covariance = np.zeros((len(edges.points), 2, len(edges.points), 2))
    for axis in range(2):
        covariance[:, axis, :, axis] = edges.covariance[axis]
    of_known = covariance.reshape(len(known), len(known))[np.ix_(known, known)]
    return _Rows(A, edges.departure.ravel()[known], of_known, by_pose)


def _chord_rows(members: Sequence[Member], sides: Sides, joint_points: Floats) -> _Rows:
    """Movement of each part along its chord, which is to be zero; without edges that between its outermost joints."""
    count = len(members)
    A = np.zeros((count, count, 6))
    for i, member in enumerate(members):
        points = member.edges.points
        if not len(points):
            at = [j for j, both in enumerate(sides) if i in (both[0].part, both[1].part)]
            points = np.array([member.centre, *joint_points[at].mean(axis=1)])[-2:]
        chord = points[-1] - points[0]
        A[i, i, 3:] = chord / max(float(np.linalg.norm(chord)), 1e-12)
    zeros = np.zeros((count, 6 * count))
    return _Rows(A.reshape(count, 6 * count), np.zeros(count), np.zeros((count, count)), zeros)


def _place_rows(members: Sequence[Member], sides: Sides, joint_points: Floats) -> _Rows:
    """Movement of each part's places in the design, which is to be zero: their sum of squares is the mean of a part."""
    blocks = []
    for i, member in enumerate(members):
        places = design_places.places(members, i, sides, joint_points)
        A = np.zeros((3 * len(places), 6 * len(members)))
        A[:, 6 * i : 6 * i + 6] = rigid.motion(places - member.centre).reshape(-1, 6) / np.sqrt(len(places))
        blocks.append(A)
    count = sum(map(len, blocks))
    return _Rows(np.vstack(blocks), np.zeros(count), np.zeros((count, count)), np.zeros((count, 6 * len(members))))


def _edge_motion(edges: EdgeDepartures, centre: Floats) -> Floats:
    """Return the derivative (2 k, 6) of departures by a motion about ``centre``."""
    derivative: Floats = np.einsum("kai,kij->kaj", edges.axes, rigid.motion(edges.points - centre)).reshape(-1, 6)
    return derivative
