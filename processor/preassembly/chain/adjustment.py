"""One adjustment of the whole chain: all joints and the design's curve at once.

Every part i, registered to its design, is moved by a small motion x_i (turn about its own middle, translation) so that

    sum of squared gaps + lambda sum of squared departures of the bottom edges

is least: gaps of eight pairs a joint along three axes, departures sideways and up at stations of both edges. What the
registration of a part is wrong by moves both its ends and its edges alike, and the adjustment takes it back. Where a
joint is not known its parts could slide along themselves: then the square of every part's movement along its chord
counts too, by a weight of HOLD. The gap of parts that are not perfect depends on lambda, so it is stated, and the curve
over lambda is part of the answer. All is linear in what was measured; its covariance goes through.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from processor.geometry import rigid
from processor.model import Floats, Ints
from processor.preassembly.ends.bottom_edges import EdgeStations
from processor.preassembly.ends.joint_end import JointEnd

HOLD = 1e-3  # of a part where its registration has it


@dataclass(frozen=True)
class Member:
    """A part in the network: its ends (start, end; None without a joint), its edges, and the middle it turns about.

    ``pose`` (6, 6) is the covariance of its registration, about the bridge's origin.
    """

    ends: tuple[JointEnd | None, JointEnd | None]
    edges: EdgeStations
    middle: Floats
    pose: Floats


@dataclass(frozen=True)
class Adjusted:
    """Motions T (c, 4, 4) of the registered parts, with covariance (6 c, 6 c) about the parts' middles, and the gaps.

    ``motion_with_pose`` (6 c, 6 c) is the covariance of the motions with the parts' registrations.
    ``gaps`` (j, 8, 3) in bridge axes with covariance (j, 24, 24); ``departures`` (k, 2) a part, sideways and up, after
    the adjustment, with variances (k, 2); ``at_rest_variance`` (k, 2) are those with the whole bridge moved so that the
    first part lies where its registration has it.
    """

    motions: Floats
    motion_covariance: Floats
    motion_with_pose: Floats
    gaps: Floats
    gap_covariance: Floats
    departures: tuple[Floats, ...]
    departure_variance: tuple[Floats, ...]
    at_rest_variance: tuple[Floats, ...]


@dataclass(frozen=True)
class _Observations:
    """What was measured: values (n,) and covariance (n, n); A (n, p) is how they change with the parts' motions.

    ``with_pose`` (n, p) is their covariance with the parts' registrations.
    First the known joints' gaps, 24 rows each, then the edges' departures, then each part's movement along its chord;
    ``gap_row`` of joints without an answer is -1, ``edge_rows`` are those of each part.
    """

    A: Floats
    value: Floats
    covariance: Floats
    with_pose: Floats
    gap_row: Ints
    edge_rows: tuple[slice, ...]


def adjust(members: Sequence[Member], joint_points: Floats, joint_frames: Floats, weight: float) -> Adjusted:
    """Adjust a chain; ``joint_points`` (j, 8, 3) are the design's, ``joint_frames`` (j, 4, 4) T_bridge_joint.

    ``weight`` is lambda. Joints with an end of which nothing is known do not pull; their gaps are NaN.
    """
    seen = _observations(members, joint_points, joint_frames)
    root = np.ones(len(seen.value))
    root[24 * int((seen.gap_row >= 0).sum()) : -len(members)] = np.sqrt(weight)
    # A chain that hangs together slides as the objective says: to hold it would move its gaps by hundredths.
    root[-len(members) :] = np.sqrt(HOLD) if (seen.gap_row < 0).any() or not len(seen.gap_row) else 0.0
    weighted = seen.A * root[:, None]
    # Lengths about their own middle and turns differ by thousands: unit columns keep the solution's digits.
    size = np.linalg.norm(weighted, axis=0)
    size[size == 0.0] = 1.0
    to_motion = -(np.linalg.pinv(weighted / size, rcond=1e-12) / size[:, None]) * root
    x = to_motion @ seen.value
    # What is left of an observation after the motion, by all that was observed.
    after = np.eye(len(seen.value)) + seen.A @ to_motion
    left = after @ seen.value
    spread = after @ seen.covariance @ after.T
    gaps, gap_covariance = np.full((len(joint_points), 8, 3), np.nan), np.full((len(joint_points), 24, 24), np.nan)
    for j, row in enumerate(seen.gap_row):
        if row >= 0:
            gaps[j] = left[row : row + 24].reshape(8, 3)
            gap_covariance[j] = spread[row : row + 24, row : row + 24]
    departures, variances, at_rest = [], [], []
    for member, rows in zip(members, seen.edge_rows, strict=True):
        departure, variance, first_at_rest = (np.full(member.edges.departure.shape, np.nan) for _ in range(3))
        known = np.isfinite(member.edges.departure)
        departure[known], variance[known] = left[rows], np.diag(spread)[rows]
        # Moved with the bridge, an edge goes where the first part's own motion takes it, the other way.
        by_first = after[rows] - _along(member.edges, members[0].middle)[known.ravel()] @ to_motion[:6]
        first_at_rest[known] = np.einsum("ki,ij,kj->k", by_first, seen.covariance, by_first, optimize=True)
        departures.append(departure)
        variances.append(variance)
        at_rest.append(first_at_rest)
    blocks = [slice(6 * i, 6 * i + 6) for i in range(len(members))]
    return Adjusted(
        np.array([_as_motion(x[block], member.middle) for block, member in zip(blocks, members, strict=True)]),
        to_motion @ seen.covariance @ to_motion.T,
        to_motion @ seen.with_pose,
        gaps,
        gap_covariance,
        tuple(departures),
        tuple(variances),
        tuple(at_rest),
    )


def _observations(members: Sequence[Member], joint_points: Floats, joint_frames: Floats) -> _Observations:
    count, joints = len(members), len(joint_points)
    rows: list[Floats] = []
    values, blocks, by_pose = [], [], []
    gap_row = np.full(joints, -1, np.int64)
    for j in range(joints):
        left, right = members[j].ends[1], members[j + 1].ends[0]
        if left is None or right is None or not (_known(left) and _known(right)):
            continue
        gap_row[j] = 24 * len(rows)
        A, follows = np.zeros((2, 24, 6 * count))
        turn = np.kron(np.eye(8), joint_frames[j][:3, :3])
        for part, end, sign in ((j, left, -1.0), (j + 1, right, 1.0)):
            own = slice(6 * part, 6 * part + 6)
            A[:, own] = sign * rigid.motion(joint_points[j] - members[part].middle).reshape(24, 6)
            follows[:, own] = sign * turn @ end.by_pose
        rows.append(A)
        values.append(turn @ (right.moved - left.moved).ravel())
        own_noise = of_itself(left, members[j].pose) + of_itself(right, members[j + 1].pose)
        blocks.append(turn @ own_noise @ turn.T)
        by_pose.append(follows)
    edge_rows = []
    start = 24 * len(rows)
    for i, member in enumerate(members):
        edges = member.edges
        known = np.isfinite(edges.departure).ravel()
        A, follows = np.zeros((2, int(known.sum()), 6 * count))
        A[:, 6 * i : 6 * i + 6] = _along(edges, member.middle)[known]
        follows[:, 6 * i : 6 * i + 6] = edges.by_pose.reshape(-1, 6)[known]
        whole = np.zeros((len(edges.points), 2, len(edges.points), 2))
        for k in range(2):
            whole[:, k, :, k] = edges.covariance[k]
        rows.append(A)
        values.append(edges.departure.ravel()[known])
        blocks.append(whole.reshape(len(known), len(known))[np.ix_(known, known)])
        by_pose.append(follows)
        edge_rows.append(slice(start, start + len(A)))
        start += len(A)
    held = np.zeros((count, count, 6))
    for i, member in enumerate(members):
        chord = member.edges.points[-1] - member.edges.points[0]
        held[i, i, 3:] = chord / max(float(np.linalg.norm(chord)), 1e-12)
    rows.append(held.reshape(count, 6 * count))
    values.append(np.zeros(count))
    blocks.append(np.zeros((count, count)))
    by_pose.append(np.zeros((count, 6 * count)))
    with_pose = np.vstack(by_pose) @ block_diag(*(member.pose for member in members))
    covariance = block_diag(*blocks) + with_pose @ np.vstack(by_pose).T
    return _Observations(np.vstack(rows), np.concatenate(values), covariance, with_pose, gap_row, tuple(edge_rows))


def _along(edges: EdgeStations, middle: Floats) -> Floats:
    """How departures (2 k, 6) follow a motion about ``middle``."""
    found: Floats = np.einsum("kai,kij->kaj", edges.axes, rigid.motion(edges.points - middle)).reshape(-1, 6)
    return found


def _known(end: JointEnd) -> bool:
    return bool(np.isfinite(end.moved).all())


def of_itself(end: JointEnd, pose: Floats) -> Floats:
    """Return the covariance (24, 24) of an end beyond what the registration's error, ``pose`` (6, 6), brings to it."""
    found: Floats = end.covariance - end.by_pose @ pose @ end.by_pose.T
    return found


def _as_motion(x: Floats, middle: Floats) -> Floats:
    R = rigid.rotation_from_vector(x[:3])
    return rigid.transform(R, middle - R @ middle + x[3:])
