"""The report of step ``stitch``."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from processor.language.messages import Message, text
from processor.model import Status, StepRun
from processor.pipeline import Execution
from processor.report.step_report import StepReport, not_ok
from processor.report.stitching import figures, interactive_view, tables, targets
from processor.report.style import Drawn
from processor.stitching.result import Result


def _summary(result: Result) -> tuple[Message, Message]:
    counts = Counter(result.scans.status)
    head = text(
        "{status}, {ok} of {scans} scans without a flag",
        status=result.status,
        ok=counts[Status.OK],
        scans=len(result.scans),
    )
    pairs = text("{used} of {pairs} pairs used.", used=int(result.pairs.used.sum()), pairs=len(result.pairs))
    flags = tuple(
        text("{count} {status}", count=counts[status], status=status)
        for status in (Status.AMBIGUOUS, Status.WEAK, Status.FAILED)
        if counts[status]
    )
    return head, text("Flagged: {flags}. {pairs}", flags=flags, pairs=pairs) if flags else pairs


def _files(execution: Execution, run: StepRun) -> dict[str, bytes]:
    return {"stitch.csv": tables.poses_csv(run.result), **targets.files(execution.scene)}


REPORT = StepReport(
    title=text("Stitching"),
    summary=_summary,
    tables=tables.step_tables,
    figures=lambda *given: Drawn(figures.draw(*given)),
    files=_files,
    sheet_tables=lambda _, run: [replace(tables.scanner_places(run.result, run.method), note="")],
    why=lambda result: not_ok(result, result.scans),
    interactive_data=interactive_view.interactive_data,
)
