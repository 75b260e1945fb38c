"""The report of step ``preassemble``."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from processor.language.messages import Message, Text, text
from processor.limits.judging import JudgedLimits
from processor.model import Scene, Status, StepRun, Verdict, worst
from processor.preassembly.result import MeanMax, Result
from processor.report import verdict_counts
from processor.report.preassembly import characteristics, figures, interactive_view, tables
from processor.report.sheet import picture
from processor.report.sheet.picture import Callout
from processor.report.step_report import StepReport, not_ok
from processor.report.style import Drawn

# Reasons by which a joint that passes is not all there is to do.
NOT_DONE = ("preassemble.part-fails", "preassemble.joint-of-piece", "preassemble.closes-by-moving")


def _summary(result: Result) -> tuple[Message, Message]:
    in_pieces = [one for one in result.reasons if one.code == "preassemble.in-pieces"]
    placed = 0 if in_pieces else sum(status != Status.FAILED for status in result.components.status)
    head = text(
        "{status}, {placed} of {parts} parts placed",
        status=result.status,
        placed=placed,
        parts=len(result.components),
    )
    if in_pieces:
        head = text("{head} by measured joints; {reasons}", head=head, reasons=in_pieces)
    linear = result.linear.assembled.error
    body = [
        text("Splicing error {errors}.", errors=_mean_max(result.splicing)),
        text("Linear error {errors}.", errors=_mean_max(linear)),
    ]
    if result.adjustment is None:
        body.append(text("Joints: {verdicts}.", verdicts=verdict_counts.each(result.joints.verdict) or text("none")))
    if result.adjustment is not None:
        told = verdict_counts.summary(verdict_counts.JOINTS, result.joints.name, result.joints.verdict)
        chain = [limits for limits in result.adjustment.chain if len(limits.limits)]
        head = text("assembly {head}", head=head)
        if (whole := worst(limits.verdict for limits in chain)) not in (Verdict.NONE, Verdict.PASS):
            head = text("whole chain: {verdict}; {head}", verdict=whole, head=head)
        head = text("{verdicts}; {head}", verdicts=told, head=head)
        body += [text("Whole chain: {verdict}.", verdict=limits.verdict) for limits in chain]
    return head, text("{sentences:.}", sentences=body)


def _mean_max(error: MeanMax) -> Text:
    if not np.isfinite(error.ci95).any():
        return text("{mean} mm mean, {largest} mm at most", mean=error.mean, largest=error.max)
    mean_ci95, largest_ci95 = error.ci95.tolist()
    return text(
        "{mean} ± {mean_ci95} mm mean, {largest} ± {largest_ci95} mm at most",
        mean=error.mean, mean_ci95=mean_ci95, largest=error.max, largest_ci95=largest_ci95,
    )  # fmt: skip


def _callouts(scene: Scene, run: StepRun) -> list[Callout]:
    """Say at each joint which of its quantities is worst or nearest to its limit."""
    result: Result = run.result
    if scene.arch is None or result.adjustment is None:
        return []
    limits = [one.limits.rows for one in result.adjustment.joints.conformity]
    return [
        picture.of_judged(points.mean(axis=0), judged, name)
        for name, points, judged in zip(result.joints.name, scene.arch.joint_points, limits, strict=False)
        if judged
    ]


def _to_do(result: Result) -> Iterator[Message]:
    """Yield the work at the joints that do not pass or are not all there is to do, then the scan that would help."""
    if result.adjustment is None:
        return
    joints = result.adjustment.joints
    done = []
    for name, verdict, proposal in zip(joints.name, result.joints.verdict, joints.proposal, strict=True):
        if verdict is Verdict.PASS and not any(one.code in NOT_DONE for one in proposal.reasons):
            done.append(name)
            continue
        sentence = text("{reasons:.}", reasons=proposal.reasons)
        yield text("joint {joint} ({verdict}): {sentence}", joint=name, verdict=verdict, sentence=sentence)
    if done:
        yield text("{joints}: nothing to do", joints=done)
    yield from result.adjustment.advice[:1]


def _limits(result: Result) -> list[JudgedLimits]:
    adjustment = result.adjustment
    if adjustment is None:
        return []
    return [one.limits for one in (*adjustment.joints.conformity, *adjustment.chain)]


REPORT = StepReport(
    title=text("Preassembly"),
    summary=_summary,
    tables=tables.step_tables,
    figures=lambda execution, runs, _: Drawn(figures.draw(execution.scene, runs)),
    to_do=_to_do,
    why=lambda result: not_ok(result, result.components),
    limits=_limits,
    callouts=_callouts,
    characteristics=characteristics.of_run,
    interactive_data=interactive_view.interactive_data,
)
