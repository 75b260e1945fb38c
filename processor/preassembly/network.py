"""One adjustment of the whole chain: all joints and the design's curve at once.

Every part i, registered to its design, is moved by a small motion x_i (turn about its own middle, translation) so that

    sum of squared gaps + lambda sum of squared departures of the bottom edges

is least: gaps of eight pairs a joint along three axes, departures sideways and up at stations of both edges. The gap of
parts that are not perfect depends on lambda, so it is stated, and the curve over lambda is part of the answer. All is
linear in what was measured; its covariance goes through.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import Floats
from processor.preassembly.bottom_edges import EdgeStations
from processor.preassembly.joint_ends import JointEnd


@dataclass(frozen=True)
class Member:
    """A part in the network: its ends (start, end; None without a joint), its edges, and the middle it turns about."""

    ends: tuple[JointEnd | None, JointEnd | None]
    edges: EdgeStations
    middle: Floats


@dataclass(frozen=True)
class Adjusted:
    """Motions T (c, 4, 4) of the registered parts; gaps (j, 8, 3) in bridge axes with covariance (j, 24, 24)."""

    motions: Floats
    gaps: Floats
    gap_covariance: Floats
    departures: tuple[Floats, ...]  # (k, 2) a part: sideways and up, after the adjustment


def adjust(members: Sequence[Member], joint_points: Floats, joint_frames: Floats, weight: float) -> Adjusted:
    """Adjust a chain; ``joint_points`` (j, 8, 3) are the design's, ``joint_frames`` (j, 4, 4) T_bridge_joint.

    ``weight`` is lambda. Joints with an end of which nothing is known do not pull; their gaps are NaN.
    """
    count, joints = len(members), len(joint_points)
    rows, values = [], []
    known = [j for j in range(joints) if _known(members[j].ends[1]) and _known(members[j + 1].ends[0])]
    A_gap = np.zeros((joints, 24, 6 * count))
    b_gap = np.full((joints, 24), np.nan)
    for j in known:
        for part, sign in ((j, -1.0), (j + 1, 1.0)):
            A_gap[j, :, 6 * part : 6 * part + 6] = sign * _motion(joint_points[j] - members[part].middle).reshape(24, 6)
        b_gap[j] = _moved(members[j + 1].ends[0], joint_frames[j]) - _moved(members[j].ends[1], joint_frames[j])
        rows.append(A_gap[j])
        values.append(b_gap[j])
    root = np.sqrt(weight)
    A_edge, b_edge, variance = [], [], []
    for i, member in enumerate(members):
        full = _edge_rows(member)
        seen = np.isfinite(member.edges.departure).ravel()
        A = np.zeros((int(seen.sum()), 6 * count))
        A[:, 6 * i : 6 * i + 6] = full[seen]
        A_edge.append(A)
        b_edge.append(member.edges.departure.ravel()[seen])
        variance.append(member.edges.variance.ravel()[seen])
        rows.append(root * A)
        values.append(root * b_edge[-1])
    A, b = np.vstack(rows), np.concatenate(values)
    # Lengths about their own middle and turns differ by thousands: unit columns keep the solution's digits.
    size = np.linalg.norm(A, axis=0)
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv(A / size, rcond=1e-12) / size[:, None]
    x = -inverse @ b
    motions = np.array([_as_motion(x[6 * i : 6 * i + 6], members[i].middle) for i in range(count)])
    gaps = (b_gap + A_gap @ x).reshape(joints, 8, 3)
    covariance = _gap_covariance(members, joint_frames, known, A_gap, inverse, root, np.concatenate(variance))
    departures = tuple(
        member.edges.departure + (_edge_rows(member) @ x[6 * i : 6 * i + 6]).reshape(-1, 2)
        for i, member in enumerate(members)
    )
    return Adjusted(motions, gaps, covariance, departures)


def _known(end: JointEnd | None) -> bool:
    return end is not None and bool(np.isfinite(end.moved).all())


def _moved(end: JointEnd | None, T_bridge_joint: Floats) -> Floats:
    assert end is not None
    found: Floats = (end.moved @ T_bridge_joint[:3, :3].T).ravel()
    return found


def _motion(arm: Floats) -> Floats:
    """Return the derivative (n, 3, 6) of points at arms (n, 3) by a turn and a translation."""
    found = np.zeros((len(arm), 3, 6))
    x, y, z = arm.T
    found[:, 0, 1], found[:, 0, 2] = z, -y
    found[:, 1, 0], found[:, 1, 2] = -z, x
    found[:, 2, 0], found[:, 2, 1] = y, -x
    found[:, :, 3:] = np.eye(3)
    return found


def _edge_rows(member: Member) -> Floats:
    """Return the derivative (2 k, 6) of the departures sideways and up."""
    motion = _motion(member.edges.points - member.middle)
    found: Floats = np.einsum("kai,kij->kaj", member.edges.axes, motion).reshape(-1, 6)
    return found


def _as_motion(x: Floats, middle: Floats) -> Floats:
    R = rigid.rotation_from_vector(x[:3])
    return rigid.transform(R, middle - R @ middle + x[3:])


def _gap_covariance(
    members: Sequence[Member],
    joint_frames: Floats,
    known: Sequence[int],
    A_gap: Floats,
    inverse: Floats,
    root: float,
    edge_variance: Floats,
) -> Floats:
    """Covariance (j, 24, 24) of the gaps, from those of the ends and the edges through the whole adjustment."""
    joints = len(joint_frames)
    found = np.full((joints, 24, 24), np.nan)
    ends = []
    for j in known:
        turn = np.kron(np.eye(8), joint_frames[j][:3, :3])
        left, right = members[j].ends[1], members[j + 1].ends[0]
        assert left is not None
        assert right is not None
        ends.append(turn @ (left.covariance + right.covariance) @ turn.T)
    width = 24 * len(known)
    for j in known:
        # gap_j = e_j + A_j x, x = -inverse (all e; root edges): what is measured at one joint moves all others.
        through = -A_gap[j] @ inverse
        total = np.zeros((24, 24))
        for k, other in enumerate(known):
            block = through[:, 24 * k : 24 * k + 24] + (np.eye(24) if other == j else 0.0)
            total += block @ ends[k] @ block.T
        edge = root * through[:, width:]
        found[j] = total + (edge * edge_variance) @ edge.T
    return found
