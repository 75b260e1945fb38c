"""Figures of the whole chain: its span, how it closes by the joints alone, and what limits the accuracy of its gaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from processor.geometry import rigid
from processor.model import KEY_POINTS, NORMAL_95, ArchDesign, Floats
from processor.preassembly.chain import adjustment
from processor.preassembly.chain.adjustment import Adjusted
from processor.preassembly.parts.measure import Measured
from processor.preassembly.verdicts.chain import greatest

JOINTS_ALONE = 1e-9  # lambda with which the design's curve only says which way the bridge lies
AXES = ("end face", "webs", "bottom and top")  # what places a joint end along its x, y and z


def span(parts: Sequence[Measured], adjusted: Adjusted, design: ArchDesign) -> tuple[float, float]:
    """How much farther apart the bridge's outer ends are than designed, mm, and the half-width of its interval.

    Nothing in the adjustment holds the span: parts that are too short bring the feet nearer to each other. NaN where
    a joint has no answer: then nothing says how far apart the parts beside it are.
    """
    if not np.isfinite(adjusted.gaps).all():
        return float("nan"), float("nan")
    ends = _outer_ends(design)
    chord = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    found, D, own = 0.0, *np.zeros((2, 1, len(adjusted.motion_covariance)))
    for i, at, sign in ((0, ends[0], -1.0), (len(parts) - 1, ends[1], 1.0)):
        found += sign * float(chord @ (rigid.apply(adjusted.motions[i], at[None])[0] - at))
        D[0] += sign * chord @ _to_point(parts, i, at)
        own[0, 6 * i : 6 * i + 6] += sign * chord @ rigid.motion(at[None])[0]
    return found, NORMAL_95 * float(np.sqrt(_covariance(parts, adjusted, D, own)[0, 0]))


def closure(
    parts: Sequence[Measured], members: Sequence[adjustment.Member], design: ArchDesign, frames: Floats
) -> tuple[Floats, Floats]:
    """Where the last part's outer end comes to lie when the joints alone place all parts after the first.

    Departure (6,) from the design, mm along the bridge's axes and mrad about them, with half-widths (6,); NaN where a
    joint has no answer. The first part rests on its design.
    """
    alone = adjustment.adjust(members, design.joint_points, frames, JOINTS_ALONE)
    if not np.isfinite(alone.gaps).all():
        return np.full(6, np.nan), np.full(6, np.nan)
    at = _outer_ends(design)[1]
    T = rigid.invert(alone.motions[0]) @ alone.motions[-1]
    shift, turn = rigid.apply(T, at[None])[0] - at, rigid.vector_from_rotation(T[:3, :3])
    D, own = np.zeros((2, 6, len(alone.motion_covariance)))
    for i, sign in ((0, -1.0), (len(parts) - 1, 1.0)):
        D[:3] += sign * _to_point(parts, i, at)
        own[:3, 6 * i : 6 * i + 6] += sign * rigid.motion(at[None])[0]
        for one in (D, own):
            one[3:, 6 * i : 6 * i + 3] += sign * np.eye(3)
    covariance = _covariance(parts, alone, D, own)
    unit = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3])
    return np.concatenate([shift, turn]) * unit, NORMAL_95 * np.sqrt(np.diag(covariance)) * unit


def limiting(parts: Sequence[Measured], adjusted: Adjusted, design: ArchDesign, frames: Floats) -> tuple[str, str]:
    """Say which joint and which measured face limit the gaps' accuracy, and which further scan would help."""
    worst, where = 0.0, (0, 0, 0)
    for j, (covariance, frame) in enumerate(zip(adjusted.gap_covariance, frames, strict=True)):
        turn = np.kron(np.eye(8), frame[:3, :3].T)
        spread = np.sqrt(np.maximum(np.diag(turn @ covariance @ turn.T), 0.0))
        if np.isfinite(spread).all() and spread.max() > worst:
            k = int(np.argmax(spread))
            worst, where = float(spread[k]), (j, k // 3, k % 3)
    missing = _missing(parts, adjusted, design)
    if worst == 0.0:
        return missing, missing
    j, point, axis = where
    ends = {"end": parts[j].member.ends[1], "start": parts[j + 1].member.ends[0]}
    # What an end follows of its part's registration is the same at the other end: it cancels, so it limits nothing.
    poses = {"end": parts[j].member.pose, "start": parts[j + 1].member.pose}
    own = {
        side: float(np.diag(adjustment.of_itself(end, poses[side]))[3 * point + axis])
        for side, end in ends.items()
        if end is not None
    }
    side = max(own, key=lambda one: own[one])
    part = parts[j].name if side == "end" else parts[j + 1].name
    share = own[side] / sum(own.values())
    limit = f"{design.joint_names[j]} {KEY_POINTS[point]}: +-{NORMAL_95 * worst:.3f} mm (95 %), {share:.0%} of the "
    limit += f"variance from the {AXES[axis]} at the {side} of {part}"
    advice = f"a scan of {part} that shows more of the {AXES[axis]} at its {side}: four times the points halve its part"
    return limit, "; ".join(filter(None, (missing, advice)))


def mean_max_ci95(vectors: Floats, variance: Floats) -> tuple[float, float]:
    """Half-widths that hold the mean and the largest size of vectors (n, d) with 95 % or more.

    ``variance`` (n, d) is of their coordinates; what goes together among them need not be known. A size is off by no
    more than its vector, the mean by no more than the root mean square of all: of squares of normal numbers none
    leaves 1.96**2 times its mean more often than a single one does (Szekely and Bakirov, Probab. Theory Relat. Fields
    126 (2003)). The largest may be any that is near it, each widened as if all were independent.
    """
    known = np.isfinite(vectors).all(axis=1) & np.isfinite(variance).all(axis=1)
    if not known.any():
        return float("nan"), float("nan")
    variance = np.maximum(variance[known], 0.0)
    size, sd = np.linalg.norm(vectors[known], axis=1), np.sqrt(variance.max(axis=1))
    largest, low, high = greatest(size, sd, vectors.shape[1])
    return NORMAL_95 * float(np.sqrt(variance.sum(axis=1).mean())), max(high - largest, largest - low)


def _missing(parts: Sequence[Measured], adjusted: Adjusted, design: ArchDesign) -> str:
    """Say what to scan where joints have no answer."""
    said: dict[str, list[str]] = {}
    for name, gaps, *beside in zip(design.joint_names, adjusted.gaps, parts, parts[1:], strict=False):
        if not np.isfinite(gaps).all():
            failed = " and ".join(part.name for part in beside if part.status == "failed")
            said.setdefault(f"{failed} has no scan that fits" if failed else "scan both ends there", []).append(name)
    return "; ".join(f"no answer at {', '.join(joints)}: {what}" for what, joints in said.items())


def _covariance(parts: Sequence[Measured], adjusted: Adjusted, by_motion: Floats, by_pose: Floats) -> Floats:
    """Covariance (k, k) of what follows the motions (k, 6 c) and, where nothing was measured, the registrations."""
    both = by_motion @ adjusted.motion_with_pose @ by_pose.T
    registered = by_pose @ block_diag(*(part.member.pose for part in parts)) @ by_pose.T
    found: Floats = by_motion @ adjusted.motion_covariance @ by_motion.T + both + both.T + registered
    return found


def design_span(design: ArchDesign) -> float:
    """Distance of the bridge's outer ends as designed, mm."""
    ends = _outer_ends(design)
    return float(np.linalg.norm(ends[1] - ends[0]))


def _outer_ends(design: ArchDesign) -> Floats:
    """Points (2, 3) in the middle of the bottom at the start of the first and at the end of the last part."""
    first, last = design.parts[0], design.parts[-1]
    return np.array(
        [
            0.5 * (first.bottom_edge_left[0] + first.bottom_edge_right[0]),
            0.5 * (last.bottom_edge_left[-1] + last.bottom_edge_right[-1]),
        ]
    )


def _to_point(parts: Sequence[Measured], index: int, at: Floats) -> Floats:
    """Return the derivative (3, 6 c) of a point of a part by all motions."""
    found = np.zeros((3, 6 * len(parts)))
    found[:, 6 * index : 6 * index + 6] = rigid.motion((at - parts[index].member.middle)[None])[0]
    return found
