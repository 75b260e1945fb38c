"""The parts as assembled: poses, key points as scanned, and gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import ArchDesign, Bools, Floats
from processor.preassembly import topology
from processor.preassembly.chain.adjustment import Adjusted
from processor.preassembly.parts.measure import MeasuredPart


@dataclass(frozen=True)
class Placement:
    """Poses T_bridge_scan (c, 4, 4) with covariance (c, 6, 6), rival poses, key points, and gaps (j, 8, 3).

    ``T_bridge_scans`` (s, 4, 4) are the poses of all s scans of each part, the first one's first.
    Key points (e, 8, 3) are of the e ends of each part. Poses and key points are of the scan's frame with its origin,
    lengths of poses at the reference temperature and of key points as scanned; mm, NaN = unknown. ``steel`` (j, 8)
    marks the key points that lie on steel.
    """

    T_bridge_scan: Floats
    T_bridge_scans: tuple[Floats, ...]
    covariance: Floats
    T_rival_scan: Floats
    key_points_scan: tuple[Floats, ...]
    key_points_sd: tuple[Floats, ...]
    gaps: Floats
    steel: Bools


def place(
    parts: Sequence[MeasuredPart], adjusted: Adjusted, design: ArchDesign, frames: Floats, steel: Bools
) -> Placement:
    """Place the measured parts by their adjusted motions; ``frames`` (j, 4, 4) are T_bridge_joint.

    ``steel`` (j, 8) marks the key points of the joints that lie on steel.
    """
    T_bridge_scans = tuple(
        np.array(
            [
                rigid.with_origin(T @ pose, scan.origin * part.shrink)
                for pose, scan in zip((part.T_bridge_scan, *part.T_further_scans), part.scans, strict=True)
            ]
        )
        for T, part in zip(adjusted.motions, parts, strict=True)
    )
    T_bridge_scan = np.array([poses[0] for poses in T_bridge_scans])
    key_points, key_points_sd = _key_points(parts, design, frames)
    ends = [
        [rigid.apply(T, end * part.shrink) for end in ends]
        for T, ends, part in zip(T_bridge_scan, key_points, parts, strict=True)
    ]
    # Equal to the linear ones of the adjustment, to second order.
    gaps = [ends[right.part][right.end] - ends[left.part][left.end] for left, right in topology.sides_of(design.joined)]
    return Placement(
        T_bridge_scan=T_bridge_scan,
        T_bridge_scans=T_bridge_scans,
        covariance=_covariances(parts, adjusted, T_bridge_scan),
        T_rival_scan=np.array([rigid.with_origin(part.T_rival, part.scans[0].origin * part.shrink) for part in parts]),
        key_points_scan=key_points,
        key_points_sd=key_points_sd,
        gaps=np.array(gaps).reshape(-1, 8, 3),
        steel=steel,
    )


def _covariances(parts: Sequence[MeasuredPart], adjusted: Adjusted, poses: Floats) -> Floats:
    """Covariances (c, 6, 6) of the assembled poses, NaN of parts without a pose.

    The error of the registration cancels: ends and edges are measured from the registered pose.
    """
    covariances = np.full((len(parts), 6, 6), np.nan)
    for i, part in enumerate(parts):
        if np.isfinite(poses[i]).all():
            rows = slice(6 * i, 6 * i + 6)
            of_motion = adjusted.motion_covariance[rows, rows]
            if adjusted.in_pieces:
                of_motion = of_motion + adjusted.placing_covariance[i]
            covariances[i] = rigid.about_origin(of_motion, part.member.centre)
    return covariances


def _key_points(
    parts: Sequence[MeasuredPart], design: ArchDesign, frames: Floats
) -> tuple[tuple[Floats, ...], tuple[Floats, ...]]:
    """Key points (e, 8, 3) of each part's ends as scanned, and the standard deviation of each coordinate."""
    joined, of_parts = design.joined, []
    for i, part in enumerate(parts):
        ends = topology.ends_of(joined, i)
        points, sd = np.full((len(ends), 8, 3), np.nan), np.full((len(ends), 8, 3), np.nan)
        for e, ((joint, _), end) in enumerate(zip(ends, part.member.ends, strict=True)):
            if joint is None or end is None or not np.isfinite(end.departure).all():
                continue
            R = frames[joint][:3, :3]
            in_bridge = design.joint_points[joint] + end.departure @ R.T
            in_scan = rigid.apply(rigid.invert(part.T_bridge_scan), in_bridge)
            points[e] = in_scan / part.shrink + part.scans[0].origin
            turn = part.T_bridge_scan[:3, :3].T @ R
            for k in range(8):
                block = end.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
                sd[e, k] = np.sqrt(np.diag(turn @ block @ turn.T)) / part.shrink
        of_parts.append((points, sd))
    return tuple(points for points, _ in of_parts), tuple(sd for _, sd in of_parts)
