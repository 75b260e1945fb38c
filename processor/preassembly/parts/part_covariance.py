"""Ends and edges of a measured part with one covariance each, the errors of its registration included."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from processor.model import Floats
from processor.preassembly.ends.joint_frame import joint_frame
from processor.preassembly.parts.measure import MeasuredPart

NAN = float("nan")


class Shape(NamedTuple):
    """Ends (2, 8, 3) in the bridge's frame with covariance (48, 48), and covariance (2, k, k) of the edges.

    ``outer`` is by what an end without a joint departs outward, mm, with its variance.
    """

    ends: Floats
    ends_covariance: Floats
    edges_covariance: Floats
    outer: float
    outer_variance: float


def measured(part: MeasuredPart, joint_points: Sequence[Floats | None]) -> Shape:
    """Return the shape of a part between joints with the design's P1..P8 (8, 3) at its start and its end.

    The ends of a branch, which are others than these, are not known. Both ends share the error of the registration,
    which cancels in all that does not depend on the part's pose.
    """
    member = part.member
    ends, noise, by_pose = np.full((2, 8, 3), np.nan), np.full((48, 48), np.nan), np.full((48, 6), np.nan)
    for k, (end, points) in enumerate(zip(member.ends, joint_points, strict=True)):
        if len(joint_points) != 2 or end is None or points is None:
            continue
        rows = slice(24 * k, 24 * k + 24)
        R = joint_frame(points)[:3, :3]
        turn = np.kron(np.eye(8), R)
        ends[k] = points + end.departure @ R.T
        noise[rows, rows] = turn @ end.without_pose(member.pose) @ turn.T
        by_pose[rows] = turn @ end.by_pose
    noise[:24, 24:] = noise[24:, :24] = 0.0
    edges = member.edges
    of_edges = np.stack(
        [edges.covariance[a] + edges.by_pose[:, a] @ member.pose @ edges.by_pose[:, a].T for a in range(2)]
    )
    outer = part.outer
    return Shape(
        ends=ends,
        ends_covariance=noise + by_pose @ member.pose @ by_pose.T,
        edges_covariance=of_edges,
        outer=NAN if outer is None else float(outer.departure @ outer.direction),
        outer_variance=NAN if outer is None else outer.variance,
    )
