"""Method ``adjustment``: every part registered to its design, its ends and edges measured, the chain adjusted at once.

Unlike the source paper's methods it uses all of a part's surface, gives an interval for every gap, and states what the
gaps of imperfect parts depend on: the weight lambda of the design's curve against the joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from processor.adjustment import thermal
from processor.geometry import rigid
from processor.limits import standards
from processor.model import ArchDesign, Bools, Floats, Reason, Scan, Scene, Tolerance, Verdict, reason
from processor.preassembly import to_result, topology
from processor.preassembly.chain import (
    adjustment,
    assembled_parts,
    joint_measures,
    linear_error,
    loop_closure,
    span_and_closure,
)
from processor.preassembly.chain.adjustment import Adjusted
from processor.preassembly.ends.joint_frame import end_place, joint_frame
from processor.preassembly.params import AdjustParams, Params, TrimParams
from processor.preassembly.parts import measure, straightening
from processor.preassembly.parts.attitude import Attitude, Shapes
from processor.preassembly.parts.each_part import each_part
from processor.preassembly.parts.measure import MeasuredPart
from processor.preassembly.result import JudgedJoints, Result
from processor.preassembly.to_result import Assembly
from processor.preassembly.verdicts import chain as chain_verdicts
from processor.preassembly.verdicts import joints, reasons, trim_and_build_up
from processor.preassembly.verdicts.joints import Conformity

TRADE_OFF = (1000.0, 1.0, 0.1, 0.01, 0.001)  # weights drawn: one objective alone, then by decades


def assemble(
    scans: Sequence[Sequence[Scan]],
    scene: Scene,
    design: ArchDesign,
    params: Params,
    attitudes: dict[int, Attitude] | None = None,
) -> Result:
    """Assemble a bridge; ``scans`` are those of each part, in the design's order.

    The ``attitudes`` found of scans, by the numbers of their parts, are kept for other methods.
    """
    shrink = 1.0 / thermal.expansion(scene.temperature_C)
    limits = standards.default_for(scene.tolerance)
    frames = np.array([joint_frame(points) for points in design.joint_points])
    shapes = Shapes(design, attitudes)
    fitted = each_part(lambda k: measure.fit(scans[k], k, shapes, shrink, params.systematic), scans)
    as_scanned = measure.assigned(measure.estimate(fitted, params.systematic))
    parts, of_bends = straightening.straighten(as_scanned, scene, design, params.systematic.gradient_K)
    curve = _adjust(parts, design, frames, params.adjust)
    adjusted = curve[params.adjust.weight]
    placed = assembled_parts.place(parts, adjusted, design, frames, _on_steel(shapes, design))
    in_pieces = reasons.of_pieces(adjusted, design, params.adjust.place_sd_mm)
    figures = span_and_closure.measure(parts, adjusted, design, frames)
    assembly = Assembly(
        design=design,
        params=params,
        limits=limits,
        temperature_corrected=shrink != 1.0,
        parts=reasons.placed_by_design(parts, in_pieces),
        in_pieces=in_pieces,
        of_bends=of_bends,
        adjusted=adjusted,
        trade_off={weight: curve[weight] for weight in TRADE_OFF},
        placement=placed,
        edges=linear_error.along_bridge(parts, adjusted, design),
        figures=figures,
        loops=loop_closure.measure([part.member for part in parts], design, frames),
        joints=_judge_joints(parts, placed.gaps, adjusted, design, frames, limits, params.trim, in_pieces),
        chain=_judge_chain(parts, adjusted, figures, design, limits),
    )
    return to_result.to_result(assembly)


def _on_steel(shapes: Shapes, design: ArchDesign) -> Bools:
    """Mark the key points (j, 8) of the joints that lie on steel: the middle of an open side of an I does not."""
    marks = np.ones((len(design.joint_points), 8), bool)
    for mark, points, pair in zip(marks, design.joint_points, design.joined.tolist(), strict=True):
        for part in pair:
            mark[4:] &= np.array(end_place(points, 1.0, shapes[part].mesh).section.middles) >= 0
    return marks


def _adjust(
    parts: Sequence[MeasuredPart], design: ArchDesign, frames: Floats, params: AdjustParams
) -> dict[float, Adjusted]:
    """Adjust the chain with lambda = ``params.weight`` and with each of TRADE_OFF."""
    members = [part.member for part in parts]
    sides = topology.sides_of(design.joined)
    return {
        weight: adjustment.adjust(members, design.joint_points, frames, weight, sides, params.place_sd_mm)
        for weight in {*TRADE_OFF, params.weight}
    }


def _judge_joints(
    parts: Sequence[MeasuredPart],
    gaps: Floats,
    adjusted: Adjusted,
    design: ArchDesign,
    frames: Floats,
    limits: Tolerance,
    trim: TrimParams,
    in_pieces: tuple[Reason, ...],
) -> JudgedJoints:
    """Measure every joint by its gaps (8, 3), compare it with the limits, and propose work on it.

    ``in_pieces`` is the reason of an assembly in pieces: there a joint that closes only by moving its parts is open.
    """
    judged = []
    judges_places = span_and_closure.has_span(design) or not design.in_row
    for j, sides in enumerate(topology.sides_of(design.joined)):
        measures = joint_measures.measure(gaps[j], adjusted.gap_covariance[j], frames[j], design.joint_points[j])
        left, right = (parts[side.part] for side in sides)
        doubts, weak = reasons.of_joint(parts, sides), reasons.weak_parts(left, right)
        conformity = joints.judge(measures, limits)
        moved: tuple[Reason, ...] = ()
        if (adjusted.in_pieces or not judges_places) and conformity.verdict is Verdict.PASS:
            moved = _closes_by_moving(parts, adjusted, design, frames, limits, j)
        doubts += moved if adjusted.in_pieces else ()
        if doubts:
            conformity = joints.judge(measures, limits, doubts)
        proposal = trim_and_build_up.propose(measures, limits, trim, doubts=doubts, weak_parts=weak, moved=moved)
        if in_pieces and measures.known:
            remark = reason("preassemble.joint-of-piece", joints=in_pieces[0].values["joints"])
            proposal = replace(proposal, reasons=(*proposal.reasons, remark))
        judged.append((measures, conformity, proposal))
    measured, conformities, proposals = zip(*judged, strict=True) if judged else ((), (), ())
    return JudgedJoints(name=design.joint_names, measures=measured, conformity=conformities, proposal=proposals)


def _closes_by_moving(
    parts: Sequence[MeasuredPart],
    adjusted: Adjusted,
    design: ArchDesign,
    frames: Floats,
    limits: Tolerance,
    joint: int,
) -> tuple[Reason, ...]:
    """State by how much the parts of a joint were moved where it does not surely pass with both at their places."""
    ends = [parts[side.part].member.ends[side.end] for side in topology.sides_of(design.joined)[joint]]
    left, right = (np.full((8, 3), np.nan) if end is None else end.departure for end in ends)
    gaps = (right - left) @ frames[joint][:3, :3].T
    unmoved = joint_measures.measure(gaps, adjusted.gap_covariance[joint], frames[joint], design.joint_points[joint])
    if joints.judge(unmoved, limits).verdict is Verdict.PASS:
        return ()
    points = [np.vstack([parts[i].member.centre, design.joint_points[joint]]) for i in design.joined[joint]]
    moves = [
        np.linalg.norm(rigid.apply(adjusted.motions[i], at) - at, axis=1).max()
        for i, at in zip(design.joined[joint], points, strict=True)
    ]
    return (reason("preassemble.closes-by-moving", move=float(max(moves)), gap=float(np.abs(gaps).max())),)


def _judge_chain(
    parts: Sequence[MeasuredPart],
    adjusted: Adjusted,
    figures: span_and_closure.Figures,
    design: ArchDesign,
    limits: Tolerance,
) -> Conformity:
    """Compare span and edges with the limits of the whole chain."""
    members = [part.member for part in parts]
    quantities = chain_verdicts.quantities(members, adjusted, figures.span_departure, figures.span_ci95)
    edges = any(len(part.bottom_edge_left) for part in design.parts)
    absent = (
        *(() if span_and_closure.has_span(design) else chain_verdicts.OF_SPAN),
        *(() if edges else chain_verdicts.OF_EDGES),
    )
    limits = replace(limits, limits=tuple(limit for limit in limits.limits if limit.measure not in absent))
    doubts = reasons.of_chain(parts, design.joint_names, adjusted.gaps)
    return chain_verdicts.judge(quantities, limits, span_and_closure.design_span(design), doubts)
