"""Method ``adjustment``: every part registered to its design, its ends and edges measured, the chain adjusted at once.

Unlike the source paper's methods it uses all of a part's surface, states an interval for every gap, and says what the
gaps of imperfect parts depend on: the weight lambda of the design's curve against the joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from processor.geometry import rigid
from processor.geometry.polyline import Polyline
from processor.limits import standards
from processor.model import NORMAL_95, ArchDesign, Floats, Scan, Scene, Tolerance
from processor.preassembly.baselines import edge_features
from processor.preassembly.chain import adjustment, span_and_closure
from processor.preassembly.params import Params
from processor.preassembly.parts import systematic_errors
from processor.preassembly.parts.measure import Measured, finished, see
from processor.preassembly.parts.systematic_errors import EXPANSION_PER_K, SystematicParams
from processor.preassembly.result import Result
from processor.preassembly.verdicts import chain as verdicts_chain
from processor.preassembly.verdicts import joint_measures
from processor.preassembly.verdicts.joints import Verdict, judge
from processor.preassembly.verdicts.trim_and_shim import propose
from processor.progress import tracked

REFERENCE_C = 20.0
TRADE_OFF = (1000.0, 1.0, 0.1, 0.01, 0.001)


def assemble(scans: Sequence[Sequence[Scan]], scene: Scene, design: ArchDesign, params: Params) -> Result:
    """Assemble a bridge; ``scans`` are those of each part, in the design's order."""
    temperature_C, weight = scene.temperature_C, params.adjust.weight
    degrees = temperature_C - REFERENCE_C if np.isfinite(temperature_C) else 0.0
    shrink = 1.0 / (1.0 + EXPANSION_PER_K * degrees)
    seen = [see(own, index, design, shrink, params.systematic) for index, own in enumerate(tracked(scans))]
    parts = finished(seen, params.systematic)
    firsts = [part.scans[0] for part in parts]
    frames = np.array([edge_features.joint_frame(points) for points in design.joint_points])
    members = [part.member for part in parts]
    curve = {one: adjustment.adjust(members, design.joint_points, frames, one) for one in {*TRADE_OFF, weight}}
    adjusted = curve[weight]
    sd = np.sqrt(np.einsum("jkk->jk", adjusted.gap_covariance)).reshape(-1, 8, 3)
    poses = np.array([motion @ part.T_bridge_scan for motion, part in zip(adjusted.motions, parts, strict=True)])
    key_points, key_sd = _key_points(parts, firsts, design, frames)
    placed = np.array([rigid.with_origin(T, scan.origin * shrink) for T, scan in zip(poses, firsts, strict=True)])
    ends = np.array(
        [[rigid.apply(T, end * shrink) for end in both] for T, both in zip(placed, key_points, strict=True)]
    )
    gaps = ends[1:, 0] - ends[:-1, 1]  # the linear answer's, but for its second order
    departures, first_at_rest = np.vstack(adjusted.departures), np.vstack(_with_first_at_rest(members, adjusted))
    assembled, best_fit = _size(departures), _size(first_at_rest)
    limits = standards.default_for(scene.tolerance)
    measures = [
        joint_measures.measure(*one)
        for one in zip(gaps, adjusted.gap_covariance, frames, design.joint_points, strict=True)
    ]
    sides = list(pairwise(parts))
    unsure = [_unsure(*both) for both in sides]
    judged = [_if_told(judge(one, limits), why) for one, why in zip(measures, unsure, strict=True)]
    proposals = [
        propose(name, one, limits, params.trim, unsure=why, rests_on=_weak(*both))
        for name, one, why, both in zip(design.joint_names, measures, unsure, sides, strict=True)
    ]
    span, span_ci95 = span_and_closure.span(parts, adjusted, design)
    chain = verdicts_chain.judge(
        verdicts_chain.quantities(members, adjusted, span, span_ci95),
        limits,
        span_and_closure.design_span(design),
        _unsure_of_all(parts, adjusted, design),
    )
    idle = verdicts_chain.not_held(limits)
    closure, closure_ci95 = span_and_closure.closure(parts, members, design, frames)
    limiting, advice = span_and_closure.limiting(parts, adjusted, design, frames)
    budget = params.systematic.budget(max(Polyline.through(part.bottom_edge_left).length for part in design.parts))
    measured = _median_sd(parts, design, params.systematic)
    statuses = [part.status for part in parts]
    mean, largest = _mean_max(np.abs(gaps))
    return Result(
        status=_overall(statuses),
        method="adjustment",
        message=_message(params, limits, degrees, [*judged, chain]),
        components=tuple(part.name for part in parts),
        component_status=tuple(statuses),
        component_message=tuple(part.message for part in parts),
        component_scans=tuple(", ".join(scan.name for scan in part.scans) for part in parts),
        T_bridge_scan=placed,
        covariance=_pose_covariances(parts, adjusted, placed),
        key_points_scan=key_points,
        key_points_sd=key_sd,
        joints=design.joint_names,
        joint_left=design.joint_left,
        joint_right=design.joint_right,
        gaps=gaps,
        gap_ci95=NORMAL_95 * sd,
        verdict=tuple(one.verdict for one in judged),
        splicing_mean=mean,
        splicing_max=largest,
        gauge=f"all joints and the design's curve at once, lambda {weight:g}",
        linear_mean=_mean_max(assembled)[0],
        linear_max=_mean_max(assembled)[1],
        best_fit_linear_mean=_mean_max(best_fit)[0],
        best_fit_linear_max=_mean_max(best_fit)[1],
        linear_station=_stations(design, members),
        linear_edge=tuple(side for member in members for side in member.edges.side),
        linear_deviation=assembled,
        best_fit_linear_deviation=best_fit,
        trade_lambda=np.array(TRADE_OFF),
        trade_figures=np.array([_figures(curve[one]) for one in TRADE_OFF]),
        weight=weight,
        T_rival_scan=np.array(
            [rigid.with_origin(p.T_rival, s.origin * shrink) for p, s in zip(parts, firsts, strict=True)]
        ),
        measures=tuple(measures),
        judged=tuple(judged),
        proposals=tuple(proposals),
        chain_judged=(chain,),
        not_held=tuple(limit.key for limit in idle),
        not_held_what=tuple(limit.what for limit in idle),
        linear_offset=departures,
        linear_offset_ci95=NORMAL_95 * np.sqrt(np.maximum(np.vstack(adjusted.departure_variance), 0.0)),
        linear_ci95=_band(adjusted.departure_variance),
        best_fit_linear_ci95=_band(adjusted.at_rest_variance),
        errors_ci95=np.array(
            [
                *span_and_closure.mean_max_ci95(gaps.reshape(-1, 1), np.square(sd).reshape(-1, 1)),
                *span_and_closure.mean_max_ci95(departures, np.vstack(adjusted.departure_variance)),
                *span_and_closure.mean_max_ci95(first_at_rest, np.vstack(adjusted.at_rest_variance)),
            ]
        ),
        span_departure=span,
        span_ci95=span_ci95,
        closure=closure,
        closure_ci95=closure_ci95,
        limiting=limiting,
        advice=advice,
        budget_source=("ends as measured, median", *budget),
        budget_sd=np.array([measured, *budget.values()]),
        residual_points=np.vstack([part.residual_points for part in parts]),
        residual=np.concatenate([part.residuals for part in parts]),
        residual_component=np.repeat(np.arange(len(parts), dtype=np.int32), [len(p.residuals) for p in parts]),
    )


def _unsure(left: Measured, right: Measured) -> str:
    """Say why a joint's gaps may be wrong: a part that may lie otherwise, an end taken for another side; or nothing."""
    said = [f"{part.name} is ambiguous" for part in (left, right) if part.status == "ambiguous"]
    for part, end in ((left, left.member.ends[1]), (right, right.member.ends[0])):
        said += [f"{part.name}: {end.trouble}"] if end is not None and end.trouble else []
    return "; ".join(said)


def _weak(left: Measured, right: Measured) -> str:
    """Name the parts beside a joint that are weak, and why."""
    return ", ".join(f"{part.name} ({part.message})" for part in (left, right) if part.status == "weak")


def _if_told(verdict: Verdict, unsure: str) -> Verdict:
    """Leave a joint open, and each of its limits, where its gaps may be wrong."""
    if not unsure:
        return verdict
    return replace(
        verdict,
        verdict="indeterminate",
        probability=float("nan"),
        each=("indeterminate",) * len(verdict.each),
        each_probability=np.full_like(verdict.each_probability, np.nan),
        said=unsure,
    )


def _unsure_of_all(parts: Sequence[Measured], adjusted: adjustment.Adjusted, design: ArchDesign) -> str:
    """Say why the chain as a whole is not known well enough to be judged; empty where it is."""
    said = [f"{part.name} is ambiguous" for part in parts if part.status == "ambiguous"]
    both = zip(design.joint_names, adjusted.gaps, strict=True)
    said += [f"{name} has no answer" for name, gaps in both if not np.isfinite(gaps).all()]
    return "; ".join(said)


def _pose_covariances(parts: Sequence[Measured], adjusted: adjustment.Adjusted, placed: Floats) -> Floats:
    """Covariances (c, 6, 6) of the assembled poses, NaN of parts without one.

    The registration's own error cancels: ends and edges were measured from where it puts the part.
    """
    found = np.full((len(parts), 6, 6), np.nan)
    for i, part in enumerate(parts):
        if np.isfinite(placed[i]).all():
            own = slice(6 * i, 6 * i + 6)
            found[i] = rigid.about_origin(adjusted.motion_covariance[own, own], part.member.middle)
    return found


def _overall(statuses: Sequence[str]) -> str:
    if all(one == "ok" for one in statuses):
        return "ok"
    return "failed" if all(one == "failed" for one in statuses) else "partial"


def _key_points(
    parts: Sequence[Measured], scans: Sequence[Scan], design: ArchDesign, frames: Floats
) -> tuple[Floats, Floats]:
    """Key points (c, 2, 8, 3) as scanned, and the standard deviation of each coordinate."""
    points, spreads = np.full((len(parts), 2, 8, 3), np.nan), np.full((len(parts), 2, 8, 3), np.nan)
    for i, (part, scan) in enumerate(zip(parts, scans, strict=True)):
        for e, joint in enumerate((i - 1, i)):
            end = part.member.ends[e]
            if end is None or not np.isfinite(end.moved).all():
                continue
            R = frames[joint][:3, :3]
            there = design.joint_points[joint] + end.moved @ R.T
            points[i, e] = rigid.apply(rigid.invert(part.T_bridge_scan), there) / part.shrink + scan.origin
            turn = part.T_bridge_scan[:3, :3].T @ R
            for k in range(8):
                block = end.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
                spreads[i, e, k] = np.sqrt(np.diag(turn @ block @ turn.T)) / part.shrink
    return points, spreads


def _median_sd(parts: Sequence[Measured], design: ArchDesign, stated: SystematicParams) -> float:
    """Median sd of a coordinate of the ends, mm: noise, form and what stations differ by, without what was stated."""
    variances = [
        np.diag(end.covariance) - systematic_errors.same_of_end(stated, own)
        for part, own in zip(parts, design.parts, strict=True)
        for end in part.member.ends
        if end is not None and np.isfinite(end.covariance).all()
    ]
    return float(np.sqrt(max(np.median(variances), 0.0))) if variances else float("nan")


def _size(departure: Floats) -> Floats:
    found: Floats = np.linalg.norm(departure, axis=1)
    return found


def _band(variance: Sequence[Floats]) -> Floats:
    """How far (s,) the linear error of each station may be off: the offset's error, left and up, is within it."""
    found: Floats = joint_measures.RAYLEIGH_95 * np.sqrt(np.maximum(np.vstack(variance), 0.0).max(axis=1))
    return found


def _with_first_at_rest(members: Sequence[adjustment.Member], adjusted: adjustment.Adjusted) -> list[Floats]:
    """Departures (k, 2) of every part with the whole bridge moved so that the first part lies on its design."""
    back = rigid.invert(adjusted.motions[0])
    found = []
    for member, departure in zip(members, adjusted.departures, strict=True):
        edges = member.edges
        at = edges.points + np.einsum("ka,kai->ki", departure, edges.axes)
        moved = rigid.apply(back, at) - edges.points
        found.append(np.einsum("kai,ki->ka", edges.axes, moved))
    return found


def _stations(design: ArchDesign, members: Sequence[adjustment.Member]) -> Floats:
    """Arc lengths of all stations from the start of the design's bottom edge."""
    found, before = [], {"left": 0.0, "right": 0.0}
    for part, member in zip(design.parts, members, strict=True):
        start = np.array([before[side] for side in member.edges.side])
        found.append(start + member.edges.arc)
        before["left"] += Polyline.through(part.bottom_edge_left).length
        before["right"] += Polyline.through(part.bottom_edge_right).length
    return np.concatenate(found)


def _mean_max(values: Floats) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    return (float(known.mean()), float(known.max())) if len(known) else (float("nan"), float("nan"))


def _figures(adjusted: adjustment.Adjusted) -> tuple[float, float, float, float]:
    sizes = np.concatenate([_size(one) for one in adjusted.departures])
    return (*_mean_max(np.abs(adjusted.gaps)), *_mean_max(sizes))


def _message(params: Params, limits: Tolerance, degrees: float, judged: Sequence[Verdict]) -> str:
    said = [f"lambda {params.adjust.weight:g}"]
    said.append("temperature corrected" if degrees else "no temperature given: taken as the reference")
    unverified = any(not verified for one in judged for verified in one.verified)
    said.append(f"limits of {limits.standard or 'the project'}{', not verified' if unverified else ''}")
    idle = verdicts_chain.not_held(limits)
    if idle:
        said.append(f"limits that nothing is held against: {', '.join(limit.key for limit in idle)}")
    if not params.systematic.known:
        said.append("intervals hold noise and what stations differ by: state what they share, offset and scale")
    return "; ".join(said)
