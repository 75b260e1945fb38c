"""The result of the adjustment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from processor.adjustment.thermal import EXPANSION_PER_K
from processor.geometry.lines_and_polylines import Polyline
from processor.model import NORMAL_95, ArchDesign, Bools, Floats, Reason, Tolerance, reason
from processor.preassembly import topology
from processor.preassembly.assembly_errors import mean_max, splicing_error
from processor.preassembly.chain.adjustment import Adjusted
from processor.preassembly.chain.assembled_parts import Placement
from processor.preassembly.chain.joint_measures import RAYLEIGH_95
from processor.preassembly.chain.linear_error import EdgeErrors
from processor.preassembly.chain.span_and_closure import Figures, mean_max_ci95
from processor.preassembly.params import Params, SystematicParams
from processor.preassembly.parts import part_covariance, systematic_errors
from processor.preassembly.parts.measure import MeasuredPart
from processor.preassembly.result import (
    Adjustment,
    AtJoints,
    Components,
    Deviations,
    EdgeSide,
    Gauge,
    Joints,
    JudgedJoints,
    Linear,
    Loops,
    MeanMax,
    PartShape,
    Residuals,
    Result,
    Rivals,
    ScanPoses,
    TradeOff,
    overall_status,
)
from processor.preassembly.verdicts.chain import unused_limits
from processor.preassembly.verdicts.joints import Conformity, LimitOrigin
from processor.preassembly.verdicts.reasons import of_assignment


@dataclass(frozen=True)
class Assembly:
    """Everything that the adjustment measured; ``trade_off`` has an adjustment for each lambda."""

    design: ArchDesign
    params: Params
    limits: Tolerance
    temperature_corrected: bool
    parts: Sequence[MeasuredPart]
    in_pieces: tuple[Reason, ...]
    of_bends: tuple[Reason, ...]
    adjusted: Adjusted
    trade_off: Mapping[float, Adjusted]
    placement: Placement
    edges: EdgeErrors
    figures: Figures
    loops: Loops | None
    joints: JudgedJoints
    chain: Conformity


def to_result(assembly: Assembly) -> Result:
    """Make the result record of an assembly."""
    parts, placement = assembly.parts, assembly.placement
    joined = assembly.design.joined
    ends = [topology.ends_of(joined, i) for i in range(len(parts))]
    branched = [topology.is_branch(of_part) for of_part in ends]
    components = Components(
        name=tuple(part.name for part in parts),
        status=tuple(part.status for part in parts),
        reasons=tuple(part.reasons for part in parts),
        scans=tuple(", ".join(scan.name for scan in part.scans) for part in parts),
        T_bridge_scan=placement.T_bridge_scan,
        covariance=placement.covariance,
        key_points_scan=_starts_and_ends(_on_steel(placement.key_points_scan, ends, placement.steel), branched),
        key_points_sd=_starts_and_ends(_on_steel(placement.key_points_sd, ends, placement.steel), branched),
        at_joints=_at_joints(assembly, ends) if any(branched) else (),
        scan_poses=tuple(
            ScanPoses(name=tuple(scan.name for scan in part.scans), T_bridge_scan=poses)
            for part, poses in zip(parts, placement.T_bridge_scans, strict=True)
        )
        if any(len(part.scans) > 1 for part in parts)
        else (),
    )
    joints, splicing = _joints(assembly)
    return Result(
        status=overall_status(components.status),
        method="adjustment",
        reasons=tuple(_reasons(assembly)),
        components=components,
        joints=joints,
        splicing=splicing,
        linear=_linear(assembly.edges),
        trade_off=_trade_off(assembly.trade_off),
        adjustment=_adjustment(assembly),
    )


def _on_steel(key_points: Sequence[Floats], ends: Sequence[Sequence[topology.PartEnd]], steel: Bools) -> list[Floats]:
    """Key points (e, 8, 3) of each part's ends, NaN of those that do not lie on steel, by joint (j, 8)."""
    masked = []
    for points, of_part in zip(key_points, ends, strict=True):
        on = np.array([np.ones(8, bool) if end.joint is None else steel[end.joint] for end in of_part])
        masked.append(np.where(on[:, :, None], points, np.nan))
    return masked


def _starts_and_ends(key_points: Sequence[Floats], branched: Sequence[bool]) -> Floats:
    """Key points (c, 2, 8, 3) at start and end; NaN of branches."""
    no_names = np.full((2, 8, 3), np.nan)
    return np.array([no_names if branch else points for points, branch in zip(key_points, branched, strict=True)])


def _at_joints(assembly: Assembly, ends: Sequence[Sequence[topology.PartEnd]]) -> tuple[AtJoints, ...]:
    """Key points of each part by the names of its joints."""
    placement, found = assembly.placement, []
    points, sd = (_on_steel(of, ends, placement.steel) for of in (placement.key_points_scan, placement.key_points_sd))
    for i, of_part in enumerate(ends):
        rows = [e for e, end in enumerate(of_part) if end.joint is not None]
        found.append(
            AtJoints(
                joint=tuple(assembly.design.joint_names[end.joint] for end in of_part if end.joint is not None),
                key_points_scan=points[i][rows],
                key_points_sd=sd[i][rows],
            )
        )
    return tuple(found)


def _joints(assembly: Assembly) -> tuple[Joints, MeanMax]:
    """Return the joints and their splicing error."""
    design, on = assembly.design, assembly.placement.steel[:, :, None]
    gaps = np.where(on, assembly.placement.gaps, np.nan)
    sd = np.sqrt(np.einsum("jkk->jk", assembly.adjusted.gap_covariance)).reshape(-1, 8, 3)
    sd = np.where(on, sd, np.nan)
    mean, largest = splicing_error(gaps)
    joints = Joints(
        name=design.joint_names,
        left=design.joint_left,
        right=design.joint_right,
        gaps=gaps,
        gap_ci95=NORMAL_95 * sd,
        verdict=tuple(one.verdict for one in assembly.joints.conformity),
    )
    ci95 = np.array(mean_max_ci95(gaps.reshape(-1, 1), np.square(sd).reshape(-1, 1)))
    return joints, MeanMax(mean=mean, max=largest, ci95=ci95)


def _linear(edges: EdgeErrors) -> Linear:
    return Linear(
        gauge=Gauge.ALL,
        chainage=edges.chainage,
        edge=tuple(map(EdgeSide, edges.edge)),
        assembled=_deviations(edges.assembled, edges.assembled_variance),
        best_fit=_deviations(edges.at_rest, edges.at_rest_variance),
    )


def _deviations(vectors: Floats, variance: Floats) -> Deviations:
    """Return the lengths of departures (s, 2) with variances (s, 2)."""
    deviation = np.linalg.norm(vectors, axis=1)
    mean, largest = mean_max(deviation)
    error = MeanMax(mean=mean, max=largest, ci95=np.array(mean_max_ci95(vectors, variance)))
    return Deviations(error=error, deviation=deviation, ci95=_band(variance))


def _trade_off(by_weight: Mapping[float, Adjusted]) -> TradeOff:
    figures = np.array([
        (*splicing_error(one.gaps), *mean_max(np.concatenate([np.linalg.norm(d, axis=1) for d in one.departures])))
        for one in by_weight.values()
    ])  # fmt: skip
    return TradeOff(
        weight=np.array(list(by_weight)),
        splicing_mean=figures[:, 0],
        splicing_max=figures[:, 1],
        linear_mean=figures[:, 2],
        linear_max=figures[:, 3],
    )


def _adjustment(assembly: Assembly) -> Adjustment:
    parts, edges, figures = assembly.parts, assembly.edges, assembly.figures
    T_rival = assembly.placement.T_rival_scan
    ambiguous = [i for i in range(len(parts)) if np.isfinite(T_rival[i]).all()]
    unused = unused_limits(assembly.limits)
    return Adjustment(
        weight=assembly.params.adjust.weight,
        joints=assembly.joints,
        chain=(assembly.chain,),
        unused_limits=tuple(limit.key for limit in unused),
        unused_limits_what=tuple(limit.what for limit in unused),
        linear_offset=edges.assembled,
        linear_offset_ci95=NORMAL_95 * np.sqrt(np.maximum(edges.assembled_variance, 0.0)),
        rivals=Rivals(component=tuple(parts[i].name for i in ambiguous), T_rival_scan=T_rival[ambiguous]),
        budget_sd=_budget(parts, assembly.design, assembly.params.systematic),
        residuals=Residuals(
            points=np.vstack([part.residuals.places for part in parts]),
            distance=np.concatenate([part.residuals.distance for part in parts]),
            component=np.repeat(np.arange(len(parts), dtype=np.int32), [len(p.residuals.distance) for p in parts]),
        ),
        loops=assembly.loops,
        shapes=tuple(_shapes(parts, assembly.design)),
        **figures._asdict(),
    )


def _shapes(parts: Sequence[MeasuredPart], design: ArchDesign) -> Iterator[PartShape]:
    """Yield the shape of each part, in the design's order."""
    joined = design.joined
    for index, part in enumerate(parts):
        ends = topology.ends_of(joined, index)
        measured = part_covariance.measured(
            part, [None if end.joint is None else design.joint_points[end.joint] for end in ends]
        )
        edges = part.member.edges
        yield PartShape(
            name=part.name,
            ends=measured.ends,
            ends_covariance=measured.ends_covariance,
            edge=tuple(map(EdgeSide, edges.side)),
            chainage=edges.chainage,
            departure=edges.departure,
            departure_covariance=measured.edges_covariance,
            outer=measured.outer,
            outer_variance=measured.outer_variance,
        )


def _band(variance: Floats) -> Floats:
    """95 % half-width (s,) of the lengths of departures with variances (s, 2): their errors' lengths are within it."""
    band: Floats = RAYLEIGH_95 * np.sqrt(np.maximum(variance, 0.0).max(axis=1))
    return band


def _budget(parts: Sequence[MeasuredPart], design: ArchDesign, systematic: SystematicParams) -> Floats:
    """Return the standard deviations, mm, of an end of the longest part by source, in the order of BudgetSource.

    The first is the median over the coordinates of the ends as measured: noise, form and differences of stations.
    """
    variances = [
        np.diag(end.covariance) - systematic_errors.end_variances(systematic, design_part)
        for part, design_part in zip(parts, design.parts, strict=True)
        for end in part.member.ends
        if end is not None and np.isfinite(end.covariance).all()
    ]
    median_sd = float(np.sqrt(max(np.median(variances), 0.0))) if variances else float("nan")
    lengths = (
        Polyline.through(part.bottom_edge_left).length if len(part.bottom_edge_left) else systematic_errors.chord(part)
        for part in design.parts
    )
    stated = systematic_errors.budget(systematic, max(lengths))
    return np.array([median_sd, *stated.values()])


def _reasons(assembly: Assembly) -> Iterator[Reason]:
    """Yield the remarks on the whole assembly."""
    limits = assembly.limits
    yield from of_assignment(assembly.parts)
    yield from assembly.in_pieces
    yield reason("preassemble.weight", weight=assembly.params.adjust.weight)
    if assembly.temperature_corrected:
        yield reason("preassemble.temperature-corrected")
    else:
        yield reason("preassemble.reference-temperature")
        if not assembly.params.systematic.temperature_C:
            longest = max(systematic_errors.chord(part) for part in assembly.design.parts)
            yield reason("preassemble.one-kelvin", length=1e-3 * longest, change=EXPANSION_PER_K * longest)
    yield from assembly.of_bends
    yield reason("preassemble.limits", standard=limits.standard or LimitOrigin.PROJECT)
    unused = unused_limits(limits)
    if unused:
        yield reason("preassemble.unused-limits", limits=tuple(limit.key for limit in unused))
    if not assembly.params.systematic.known:
        yield reason("preassemble.systematic-errors-unknown")
