"""Figures of the whole chain: its span, its closure by the joints alone, and what limits the accuracy of its gaps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from processor.adjustment import maximum_interval
from processor.geometry import rigid
from processor.model import KEY_POINTS, NORMAL_95, ArchDesign, Floats, Reason, Status, Word, reason
from processor.preassembly import topology
from processor.preassembly.chain import adjustment
from processor.preassembly.chain.adjustment import Adjusted
from processor.preassembly.parts.measure import MeasuredPart

JOINTS_ALONE = 1e-9  # lambda with which the design's curve only fixes the position of the bridge


class EndSurface(Word):
    """The surfaces that place a joint end along its x, y and z axes."""

    END_FACE = "end face"
    WEBS = "webs"
    BOTTOM_AND_TOP = "bottom and top"


class PartEnd(Word):
    """An end of a part along the bridge."""

    START = "start"
    END = "end"


class _OuterEnd(NamedTuple):
    """What an outer end adds to a distance: a value with a variance, the derivative (n,) of it by the observations.

    Beyond these, it moves with its part in the direction ``along`` (3,).
    """

    value: float
    variance: float
    by_value: Floats
    along: Floats


class Figures(NamedTuple):
    """Figures of the chain, named as in the result: see :func:`span`, :func:`closure` and :func:`limiting`."""

    span_departure: float
    span_ci95: float
    closure: Floats
    closure_ci95: Floats
    limiting: tuple[Reason, ...]
    advice: tuple[Reason, ...]


def measure(parts: Sequence[MeasuredPart], adjusted: Adjusted, design: ArchDesign, frames: Floats) -> Figures:
    """Measure all figures of a chain; ``frames`` (j, 4, 4) are T_bridge_joint."""
    return Figures(
        *span(parts, adjusted, design), *closure(parts, design, frames), *limiting(parts, adjusted, design, frames)
    )


def span(parts: Sequence[MeasuredPart], adjusted: Adjusted, design: ArchDesign) -> tuple[float, float]:
    """Departure of the distance between the bridge's outer ends from the design's, mm, and its 95 % half-width.

    The adjustment does not constrain the span: parts that are too short bring the feet closer together. NaN where a
    joint has no answer, since the distance of the parts beside it is not measured. An outer end is placed along its
    part by its end face, and square to it by the bottom edges there; what was not seen of it is taken to be as
    designed.
    """
    if not has_span(design) or not np.isfinite(adjusted.gaps).all():
        return float("nan"), float("nan")
    ends = _outer_ends(design)
    chord = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    solution = adjusted.solution
    departure, own, by_value, by_pose = 0.0, 0.0, np.zeros(len(solution.covariance)), np.zeros(len(solution.to_motion))
    for i, at, sign in ((0, ends[0], -1.0), (len(parts) - 1, ends[1], 1.0)):
        outer = _outer_end(parts, adjusted, i, at, sign * chord)
        departure += outer.value + float(outer.along @ (rigid.apply(adjusted.motions[i], at[None])[0] - at))
        own += outer.variance
        by_value += outer.by_value + outer.along @ _point_motion(parts, i, at) @ solution.to_motion
        by_pose[6 * i : 6 * i + 6] += outer.along @ rigid.motion(at[None])[0]
    both = by_value @ solution.with_pose @ by_pose
    registered = by_pose @ block_diag(*(part.member.pose for part in parts)) @ by_pose
    variance = by_value @ solution.covariance @ by_value + 2.0 * both + registered + own
    return departure, NORMAL_95 * float(np.sqrt(max(variance, 0.0)))


def _outer_end(parts: Sequence[MeasuredPart], adjusted: Adjusted, i: int, at: Floats, axis: Floats) -> _OuterEnd:
    """Return what the outer end ``at`` (3,) of part i adds to a distance along an ``axis`` (3,)."""
    edges, face = parts[i].member.edges, parts[i].outer
    to_departures = adjusted.solution.to_departures[i]
    value, variance, along = 0.0, 0.0, axis
    by_value = np.zeros(to_departures.shape[1])
    nearest = [np.argsort(np.linalg.norm(edges.points - at, axis=1) + np.where(of_side, 0.0, np.inf))[:2]
               for of_side in (np.array(edges.side) == side for side in ("left", "right"))]  # fmt: skip
    if np.isfinite(adjusted.departures[i][np.ravel(nearest), 1]).all():
        up = edges.axes[nearest[0][0], 1]
        along = axis - (axis @ up) * up
        # Half an interval beyond the last departure.
        for rows in nearest:
            for row, weight in zip(rows, (0.75, -0.25), strict=True):
                value += weight * float(axis @ up) * float(adjusted.departures[i][row, 1])
                by_value += weight * float(axis @ up) * to_departures[2 * row + 1]
    if face is not None:
        value += float(along @ face.departure)
        variance = face.variance * float(along @ face.direction) ** 2
    return _OuterEnd(value, variance, by_value, along)


def has_span(design: ArchDesign) -> bool:
    """Whether the parts form a row with bottom edges at its outer ends."""
    return design.in_row and all(len(part.bottom_edge_left) > 0 for part in (design.parts[0], design.parts[-1]))


def design_span(design: ArchDesign) -> float:
    """Distance of the bridge's outer ends as designed, mm; NaN where it has none."""
    if not has_span(design):
        return float("nan")
    ends = _outer_ends(design)
    return float(np.linalg.norm(ends[1] - ends[0]))


def closure(parts: Sequence[MeasuredPart], design: ArchDesign, frames: Floats) -> tuple[Floats, Floats]:
    """Closure of the chain: departure of its outer end when the joints alone place all parts after the first.

    Departure (2, 3) from the design, mm along the bridge's axes and mrad about them, with 95 % half-widths (2, 3); NaN
    where a joint has no answer. The first part rests on its design.
    """
    if not has_span(design):
        return np.full((2, 3), np.nan), np.full((2, 3), np.nan)
    alone = adjustment.adjust([part.member for part in parts], design.joint_points, frames, JOINTS_ALONE)
    if not np.isfinite(alone.gaps).all():
        return np.full((2, 3), np.nan), np.full((2, 3), np.nan)
    at = _outer_ends(design)[1]
    T = rigid.invert(alone.motions[0]) @ alone.motions[-1]
    shift, turn = rigid.apply(T, at[None])[0] - at, rigid.vector_from_rotation(T[:3, :3])
    by_motion, by_pose = np.zeros((2, 6, len(alone.motion_covariance)))
    for i, sign in ((0, -1.0), (len(parts) - 1, 1.0)):
        by_motion[:3] += sign * _point_motion(parts, i, at)
        by_pose[:3, 6 * i : 6 * i + 6] += sign * rigid.motion(at[None])[0]
        for derivative in (by_motion, by_pose):
            derivative[3:, 6 * i : 6 * i + 3] += sign * np.eye(3)
    covariance = _covariance(parts, alone, by_motion, by_pose)
    unit = np.array([[1.0], [1e3]])
    return np.stack([shift, turn]) * unit, NORMAL_95 * np.sqrt(np.diag(covariance)).reshape(2, 3) * unit


def limiting(
    parts: Sequence[MeasuredPart], adjusted: Adjusted, design: ArchDesign, frames: Floats
) -> tuple[tuple[Reason, ...], tuple[Reason, ...]]:
    """Return the joint and the measured face that limit the gaps' accuracy, and the further scan that would help."""
    worst, where = 0.0, (0, 0, 0)
    for j, (covariance, frame) in enumerate(zip(adjusted.gap_covariance, frames, strict=True)):
        turn = np.kron(np.eye(8), frame[:3, :3].T)
        sd = np.sqrt(np.maximum(np.diag(turn @ covariance @ turn.T), 0.0))
        if np.isfinite(sd).all() and sd.max() > worst:
            k = int(np.argmax(sd))
            worst, where = float(sd[k]), (j, k // 3, k % 3)
    missing = _missing(parts, adjusted, design)
    if worst == 0.0 or any(part.of_others for part in parts):
        return missing, missing
    j, point, axis = where
    variance: dict[PartEnd, float] = {}
    left, right = topology.sides_of(design.joined)[j]
    for side, of_joint in ((PartEnd.END, left), (PartEnd.START, right)):
        part = parts[of_joint.part]
        joint_end = part.member.ends[of_joint.end]
        if joint_end is not None:
            # An end's error by its part's registration is common to both ends: it cancels, so it limits nothing.
            covariance = joint_end.without_pose(part.member.pose)
            variance[side] = float(np.diag(covariance)[3 * point + axis])
    side = max(variance, key=lambda side: variance[side])
    name = parts[left.part if side is PartEnd.END else right.part].name
    surface = tuple(EndSurface)[axis]
    limit = reason(
        "preassemble.limiting",
        joint=design.joint_names[j],
        point=KEY_POINTS[point],
        ci95=NORMAL_95 * worst,
        share=variance[side] / sum(variance.values()),
        surface=surface,
        end=side,
        part=name,
    )
    return (limit,), (*missing, reason("preassemble.scan-more", part=name, surface=surface, end=side))


def mean_max_ci95(vectors: Floats, variance: Floats) -> tuple[float, float]:
    """Half-widths that cover the mean and the largest length of vectors (n, d) with 95 % or more.

    ``variance`` (n, d) is of their coordinates; their correlation need not be known. A length is off by no more than
    its vector, the mean by no more than the root mean square of all: a mean of squares of normal variables exceeds
    1.96**2 times its expectation no more often than a single one does (Szekely and Bakirov, Probab. Theory Relat.
    Fields 126 (2003)). The largest has the simultaneous band of all that may be it.
    """
    known = np.isfinite(vectors).all(axis=1) & np.isfinite(variance).all(axis=1)
    if not known.any():
        return float("nan"), float("nan")
    variance = np.maximum(variance[known], 0.0)
    size, sd = np.linalg.norm(vectors[known], axis=1), np.sqrt(variance.max(axis=1))
    largest, low, high = maximum_interval.of_independent(size, sd, vectors.shape[1])
    return NORMAL_95 * float(np.sqrt(variance.sum(axis=1).mean())), max(high - largest, largest - low)


def _missing(parts: Sequence[MeasuredPart], adjusted: Adjusted, design: ArchDesign) -> tuple[Reason, ...]:
    """Return what to do where joints have no result."""
    others = tuple(part.name for part in parts if part.of_others)
    if others:
        return (reason("preassemble.assign-scans", parts=others),)
    failed: dict[tuple[str, ...], list[str]] = {}
    unmeasured: dict[tuple[str, ...], list[str]] = {}
    sides_of = topology.sides_of(design.joined)
    for name, gaps, sides in zip(design.joint_names, adjusted.gaps, sides_of, strict=True):
        if np.isfinite(gaps).all():
            continue
        beside = [(parts[side.part], parts[side.part].member.ends[side.end]) for side in sides]
        of_failed = tuple(part.name for part, _ in beside if part.status == Status.FAILED)
        unknown = tuple(part.name for part, end in beside if end is None or not np.isfinite(end.departure).all())
        (failed.setdefault(of_failed, []) if of_failed else unmeasured.setdefault(unknown, [])).append(name)
    return (
        *(reason("preassemble.scan-failed-parts", joints=tuple(at), parts=names) for names, at in failed.items()),
        *(
            reason("preassemble.scan-both-ends", joints=tuple(at))
            if len(names) > 1
            else reason("preassemble.scan-end", joints=tuple(at), parts=names)
            for names, at in unmeasured.items()
        ),
    )


def _covariance(parts: Sequence[MeasuredPart], adjusted: Adjusted, by_motion: Floats, by_pose: Floats) -> Floats:
    """Covariance (k, k) of quantities with derivatives (k, 6 c) by the motions and by the registrations."""
    both = by_motion @ adjusted.motion_with_pose @ by_pose.T
    registered = by_pose @ block_diag(*(part.member.pose for part in parts)) @ by_pose.T
    covariance: Floats = by_motion @ adjusted.motion_covariance @ by_motion.T + both + both.T + registered
    return covariance


def _outer_ends(design: ArchDesign) -> Floats:
    """Points (2, 3) in the middle of the bottom at the start of the first and at the end of the last part."""
    first, last = design.parts[0], design.parts[-1]
    return np.array(
        [
            0.5 * (first.bottom_edge_left[0] + first.bottom_edge_right[0]),
            0.5 * (last.bottom_edge_left[-1] + last.bottom_edge_right[-1]),
        ]
    )


def _point_motion(parts: Sequence[MeasuredPart], index: int, at: Floats) -> Floats:
    """Return the derivative (3, 6 c) of a point of a part by all motions."""
    derivative = np.zeros((3, 6 * len(parts)))
    derivative[:, 6 * index : 6 * index + 6] = rigid.motion((at - parts[index].member.centre)[None])[0]
    return derivative
