"""The report of step ``preassemble``."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from processor.language.messages import Message, Text, text
from processor.limits.judging import JudgedLimits
from processor.model import Floats, Status, Verdict, worst
from processor.preassembly.result import Adjustment, MeanMax, Result
from processor.report import verdict_counts
from processor.report.preassembly import characteristics, figures, interactive_view, tables
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


def _further(result: Result) -> list[tuple[Message, Message] | tuple[Message, Message, Verdict]]:
    """Return what the adjustment states of the whole bridge, beside the verdict."""
    adjustment = result.adjustment
    if adjustment is None:
        return []
    rows: list[tuple[Message, Message] | tuple[Message, Message, Verdict]] = []
    if np.isfinite(adjustment.span_departure):
        sentences = [
            text("{span} mm against the design", span=_with_ci95(adjustment.span_departure, adjustment.span_ci95))
        ]
        if np.isfinite(adjustment.closure).any():
            sentences.append(_closure(adjustment.closure[0], adjustment.closure_ci95[0]))
        rows.append((text("Span"), text("{sentences:.}", sentences=sentences), _verdict_on_span(adjustment)))
    if adjustment.limiting:
        rows.append((text("What limits the accuracy"), text("{reasons:.}", reasons=adjustment.limiting)))
    if adjustment.advice:
        rows.append((text("Which scan would help"), text("{reasons:.}", reasons=adjustment.advice)))
    return rows


def _verdict_on_span(adjustment: Adjustment) -> Verdict:
    """Return the worst verdict on the limits of the distance of the outer ends; none without such a limit."""
    return worst(
        verdict
        for one in adjustment.chain
        for key, verdict in zip(one.limits.key, one.limits.verdict, strict=True)
        if key.startswith(characteristics.CHORDS)
    )


def _closure(shift: Floats, ci95: Floats) -> Text:
    along, across, up = (_with_ci95(value, half) for value, half in zip(shift.tolist(), ci95.tolist(), strict=True))
    return text(
        "Closure by the joints alone, along / across / up: {along} / {across} / {up} mm",
        along=along,
        across=across,
        up=up,
    )


def _with_ci95(value: float, ci95: float) -> Text:
    return text("{value} ± {ci95}", value=value, ci95=ci95)


def _to_do(result: Result) -> Iterator[Message]:
    """Yield the work at the joints that do not pass or are not all there is to do, then the scan that would help."""
    if result.adjustment is None:
        return
    joints = result.adjustment.joints
    for name, verdict, proposal in zip(joints.name, result.joints.verdict, joints.proposal, strict=True):
        if verdict is not Verdict.PASS or any(one.code in NOT_DONE for one in proposal.reasons):
            sentence = text("{reasons:.}", reasons=proposal.reasons)
            yield text("joint {joint} ({verdict}): {sentence}", joint=name, verdict=verdict, sentence=sentence)
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
    further_verdicts=_further,
    to_do=_to_do,
    why=lambda result: not_ok(result, result.components),
    limits=_limits,
    characteristics=characteristics.of_run,
    characteristics_note=characteristics.NOTE,
    live_figures=figures.SHOWN_LIVE,
    further_figures=figures.OF_OTHER_METHODS,
    interactive_data=interactive_view.interactive_data,
)
