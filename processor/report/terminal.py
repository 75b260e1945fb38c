"""What a run found, for the terminal: the headline, what to do, why, and where the report is."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Message, messages, text
from processor.model import Status, StepRun
from processor.pipeline import Execution
from processor.plain_text import printable
from processor.report import all_tables, headline
from processor.report import table as report_table
from processor.report.reports_of_steps import step_report

MOST_LINES, LONGEST = 15, 300  # of a terminal of 24 lines; characters: two to four of these
TO_DO, REASONS, LIMITS = 4, 3, 3  # most lines of each step
MORE = text("... more in the report; --verbose prints the tables")


def lines(execution: Execution, report: ErrorReport, page: str) -> list[str]:
    """Return at most MOST_LINES lines: the answer first, then what to do and why; last the files, and the page."""
    answer, middle = [_short(one) for one in headline.answer(execution)], list(_middle(execution, report))
    files = _files(Path(page))
    room = MOST_LINES - len(answer) - len(files) - 1
    if len(middle) > room:
        middle = [*middle[: room - 1], MORE]
    return [*answer, *map(_short, middle), *files, f"report: {page}"]


def _short(line: Message) -> str:
    return textwrap.shorten(printable(messages("en").text(line)), LONGEST, placeholder=" ...")


def _files(page: Path) -> list[str]:
    """Name what lies beside the page; nothing where it has not been written."""
    beside = sorted(one.name + "/" * one.is_dir() for one in page.parent.iterdir()) if page.is_file() else []
    return [f"{page.parent}: {', '.join(map(printable, beside))}"] if beside else []


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
