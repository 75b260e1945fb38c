"""What a run found, for the terminal: the headline, what to do, why, and where the report is."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Message, label, messages, text
from processor.model import Status, StepRun, Verdict
from processor.pipeline import Execution
from processor.plain_text import printable
from processor.report import all_tables, headline
from processor.report import table as report_table
from processor.report.characteristics import limits_of, worst_first
from processor.report.reports_of_steps import step_report

MOST_LINES, LONGEST = 15, 200  # of a terminal of 24 lines; characters: two or three of these
TO_DO, REASONS, LIMITS = 4, 3, 3  # most lines of each step
MORE = text("... more in the report; --verbose prints the tables")


def lines(execution: Execution, report: ErrorReport, page: str) -> list[str]:
    """Return at most MOST_LINES lines; the headline stands first, the path of the page last."""
    middle = list(_middle(execution, report))
    if len(middle) > MOST_LINES - 2:
        middle = [*middle[: MOST_LINES - 3], MORE]
    written = [textwrap.shorten(printable(messages("en").text(line)), LONGEST, placeholder=" ...") for line in middle]
    return [printable(headline.of_run(execution)), *written, f"report: {page}"]


def verbose(execution: Execution, report: ErrorReport, page: str) -> Iterator[str]:
    """Yield the lines of :func:`lines`, and before the last the tables that have rows, each as one text."""
    *brief, last = lines(execution, report, page)
    yield from brief
    yield ""
    for table in all_tables.tables_of_run(execution, report):
        if table.on_terminal and table.rows:
            yield report_table.plain_text(table) + "\n"
    yield last


def failures(execution: Execution) -> Iterator[str]:
    """Yield a line for each step that failed altogether, with its reasons."""
    for run, _ in execution.by_step():
        if run.result.status == Status.FAILED:
            reasons = _reasons(run)
            why = messages("en").text(reasons) if reasons else "no reason is known"
            yield f"{run.step} ({run.method}) failed: {why}"


def _middle(execution: Execution, report: ErrorReport) -> Iterator[Message]:
    firsts = [run for run, _ in execution.by_step()]
    if (to_confirm := headline.to_confirm(execution)) is not None:
        yield to_confirm
    for run in firsts:
        yield from _beyond_limits(run)
    for run in firsts:
        for sentence in list(step_report(run.step).to_do(run.result))[:TO_DO]:
            yield text("to do: {sentence}", sentence=sentence)
    for run in firsts:
        if run.result.status != Status.OK:
            title = step_report(run.step).title
            for one in _reasons(run)[:REASONS]:
                yield text("{step} is {status}: {reason}", step=title, status=run.result.status, reason=one)
    missed = [metric for metric in report.metrics if not metric.passed]
    for metric in missed[:LIMITS]:
        name = all_tables.metric_name(metric)
        yield text(
            "accuracy limit missed: {figure} {value:g} {unit}, limit {limit:g}",
            figure=name, value=metric.value, unit=metric.unit, limit=metric.limit,
        )  # fmt: skip


def _reasons(run: StepRun) -> Sequence[Message]:
    return list(step_report(run.step).why(run.result))


def _beyond_limits(run: StepRun) -> Iterator[Message]:
    """Yield the comparisons that did not pass, the worst first."""
    limits = limits_of(run)
    if limits is None:
        return
    rows = [one for one in worst_first(limits.rows) if one.verdict != Verdict.PASS]
    for one in rows[:LIMITS]:
        yield text(
            "{verdict}: {of}, {what}: {value} ± {ci95} {unit}, {allowed}",
            verdict=one.verdict, of=one.of, what=label(one.what), value=one.value, ci95=one.ci95, unit=one.unit,
            allowed=_allowed(one.low, one.high),
        )  # fmt: skip
    if len(rows) > LIMITS:
        yield text("... and {count} more of {step}", count=len(rows) - LIMITS, step=step_report(run.step).title)


def _allowed(low: float, high: float) -> Message:
    if math.isnan(low) or math.isnan(high):
        return text("allowed by a size that is not known")
    if math.isinf(low):
        return text("at most {high} allowed", high=high)
    return (
        text("at least {low} allowed", low=low)
        if math.isinf(high)
        else text("{low} to {high} allowed", low=low, high=high)
    )
