"""The result of the adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from processor.geometry.polyline import Polyline
from processor.model import NORMAL_95, ArchDesign, Floats, Tolerance
from processor.preassembly.chain.adjustment import Adjusted
from processor.preassembly.chain.edge_errors import EdgeErrors
from processor.preassembly.chain.placement import Placement
from processor.preassembly.chain.span_and_closure import Figures, mean_max_ci95
from processor.preassembly.errors import mean_max, splicing_error
from processor.preassembly.params import Params, SystematicParams
from processor.preassembly.parts import systematic_errors
from processor.preassembly.parts.measure import MeasuredPart
from processor.preassembly.result import Result
from processor.preassembly.verdicts.chain import unused_limits
from processor.preassembly.verdicts.joint_measures import RAYLEIGH_95, Measures
from processor.preassembly.verdicts.joints import Verdict
from processor.preassembly.verdicts.trim_and_shim import Proposal


class JudgedJoint(NamedTuple):
    """One joint: its measures, verdict and proposal."""

    measures: Measures
    verdict: Verdict
    proposal: Proposal


@dataclass(frozen=True)
class Assembly:
    """Everything that the adjustment measured; ``trade_off`` has an adjustment for each lambda."""

    design: ArchDesign
    params: Params
    limits: Tolerance
    temperature_corrected: bool
    parts: Sequence[MeasuredPart]
    adjusted: Adjusted
    trade_off: Mapping[float, Adjusted]
    placement: Placement
    edges: EdgeErrors
    figures: Figures
    joints: Sequence[JudgedJoint]
    chain: Verdict


def to_result(assembly: Assembly) -> Result:
    """Make the result record of an assembly."""
    parts, params = assembly.parts, assembly.params
    statuses = [part.status for part in parts]
    sources, budget = _budget(parts, assembly.design, params.systematic)
    result = Result(
        status=_overall(statuses),
        method="adjustment",
        message=_message(assembly),
        components=tuple(part.name for part in parts),
        component_status=tuple(statuses),
        component_message=tuple(part.message for part in parts),
        component_scans=tuple(", ".join(scan.name for scan in part.scans) for part in parts),
        T_bridge_scan=assembly.placement.T_bridge_scan,
        covariance=assembly.placement.covariance,
        T_rival_scan=assembly.placement.T_rival_scan,
        key_points_scan=assembly.placement.key_points_scan,
        key_points_sd=assembly.placement.key_points_sd,
        gauge=f"all joints and the design's curve at once, lambda {params.adjust.weight:g}",
        weight=params.adjust.weight,
        trade_lambda=np.array(list(assembly.trade_off)),
        trade_figures=np.array([_trade_figures(adjusted) for adjusted in assembly.trade_off.values()]),
        **assembly.figures._asdict(),
        budget_source=sources,
        budget_sd=budget,
        residual_points=np.vstack([part.residual_points for part in parts]),
        residual=np.concatenate([part.residuals for part in parts]),
        residual_component=np.repeat(np.arange(len(parts), dtype=np.int32), [len(p.residuals) for p in parts]),
    )
    return _with_edges(_with_joints(result, assembly), assembly)


def _with_joints(result: Result, assembly: Assembly) -> Result:
    """Add the joints, their verdicts and the verdict on the chain."""
    gaps, design = assembly.placement.gaps, assembly.design
    sd = _gap_sd(assembly.adjusted)
    mean, largest = splicing_error(gaps)
    unused = unused_limits(assembly.limits)
    return replace(
        result,
        joints=design.joint_names,
        joint_left=design.joint_left,
        joint_right=design.joint_right,
        gaps=gaps,
        gap_ci95=NORMAL_95 * sd,
        verdict=tuple(joint.verdict.verdict for joint in assembly.joints),
        splicing_mean=mean,
        splicing_max=largest,
        measures=tuple(joint.measures for joint in assembly.joints),
        judged=tuple(joint.verdict for joint in assembly.joints),
        proposals=tuple(joint.proposal for joint in assembly.joints),
        chain_judged=(assembly.chain,),
        not_held=tuple(limit.key for limit in unused),
        not_held_what=tuple(limit.what for limit in unused),
    )


def _with_edges(result: Result, assembly: Assembly) -> Result:
    """Add the linear error, and the intervals of mean and largest errors."""
    edges, gaps = assembly.edges, assembly.placement.gaps
    deviation, best_fit = np.linalg.norm(edges.assembled, axis=1), np.linalg.norm(edges.at_rest, axis=1)
    mean, largest = mean_max(deviation)
    best_fit_mean, best_fit_largest = mean_max(best_fit)
    gap_variance = np.square(_gap_sd(assembly.adjusted)).reshape(-1, 1)
    return replace(
        result,
        linear_mean=mean,
        linear_max=largest,
        best_fit_linear_mean=best_fit_mean,
        best_fit_linear_max=best_fit_largest,
        linear_station=edges.chainage,
        linear_edge=edges.edge,
        linear_deviation=deviation,
        best_fit_linear_deviation=best_fit,
        linear_offset=edges.assembled,
        linear_offset_ci95=NORMAL_95 * np.sqrt(np.maximum(edges.assembled_variance, 0.0)),
        linear_ci95=_band(edges.assembled_variance),
        best_fit_linear_ci95=_band(edges.at_rest_variance),
        errors_ci95=np.array(
            [
                *mean_max_ci95(gaps.reshape(-1, 1), gap_variance),
                *mean_max_ci95(edges.assembled, edges.assembled_variance),
                *mean_max_ci95(edges.at_rest, edges.at_rest_variance),
            ]
        ),
    )


def _gap_sd(adjusted: Adjusted) -> Floats:
    """Return the standard deviations (j, 8, 3) of the gaps."""
    sd: Floats = np.sqrt(np.einsum("jkk->jk", adjusted.gap_covariance)).reshape(-1, 8, 3)
    return sd


def _band(variance: Floats) -> Floats:
    """95 % half-width (s,) of the lengths of departures with variances (s, 2): their errors' lengths are within it."""
    band: Floats = RAYLEIGH_95 * np.sqrt(np.maximum(variance, 0.0).max(axis=1))
    return band


def _overall(statuses: Sequence[str]) -> str:
    if all(status == "ok" for status in statuses):
        return "ok"
    return "failed" if all(status == "failed" for status in statuses) else "partial"


def _trade_figures(adjusted: Adjusted) -> tuple[float, float, float, float]:
    """Splicing mean and maximum, linear mean and maximum."""
    sizes = np.concatenate([np.linalg.norm(departure, axis=1) for departure in adjusted.departures])
    return (*splicing_error(adjusted.gaps), *mean_max(sizes))


def _budget(
    parts: Sequence[MeasuredPart], design: ArchDesign, systematic: SystematicParams
) -> tuple[tuple[str, ...], Floats]:
    """Return the sources of error of an end of the longest part, and their standard deviations, mm.

    The first is the median over the coordinates of the ends as measured: noise, form and differences of stations.
    """
    variances = [
        np.diag(end.covariance) - systematic_errors.end_variances(systematic, design_part)
        for part, design_part in zip(parts, design.parts, strict=True)
        for end in part.member.ends
        if end is not None and np.isfinite(end.covariance).all()
    ]
    median_sd = float(np.sqrt(max(np.median(variances), 0.0))) if variances else float("nan")
    stated = systematic_errors.budget(
        systematic, max(Polyline.through(part.bottom_edge_left).length for part in design.parts)
    )
    return ("ends as measured, median", *stated), np.array([median_sd, *stated.values()])


def _message(assembly: Assembly) -> str:
    limits = assembly.limits
    remarks = [f"lambda {assembly.params.adjust.weight:g}"]
    remarks.append(
        "temperature corrected" if assembly.temperature_corrected else "no temperature given: taken as the reference"
    )
    verdicts = [*(joint.verdict for joint in assembly.joints), assembly.chain]
    unverified = any(not verified for verdict in verdicts for verified in verdict.verified)
    remarks.append(f"limits of {limits.standard or 'the project'}{', not verified' if unverified else ''}")
    unused = unused_limits(limits)
    if unused:
        remarks.append(f"limits that nothing is held against: {', '.join(limit.key for limit in unused)}")
    if not assembly.params.systematic.known:
        remarks.append("intervals hold noise and what stations differ by: state what they share, offset and scale")
    return "; ".join(remarks)
