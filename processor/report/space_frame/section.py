"""How bolt balls report."""

from __future__ import annotations

import collections

from processor.model import StepRun
from processor.pipeline import Execution
from processor.report.section import StepReport
from processor.report.space_frame import close_ups, dxf, figures, results, tables, view
from processor.space_frame import step as space_frame_step


def _summary(result: space_frame_step.Result) -> tuple[str, str]:
    flags = collections.Counter(result.flag)
    named = ", ".join(f"{flags[name]} {name}" for name in ("low-confidence", "wrong-size", "not-found") if flags[name])
    head = f"{result.status}, {flags['ok']} of {len(result.flag)} balls without a flag"
    return head, f"Flagged: {named}." if named else ""


def _files(execution: Execution, run: StepRun) -> dict[str, bytes]:
    found = {"nodes.dxf": dxf.drawing(run.result)} if len(run.result.tube_radii) else {}
    if tables.has_bounds(run.result):
        pages = close_ups.document(execution.scene, run.result, execution.stored)
        found |= {close_ups.DOCUMENT: pages} if pages else {}
    return found


REPORT = StepReport(
    title="Bolt balls",
    summary=_summary,
    written=results.written,
    tables=tables.of_runs,
    figures=lambda execution, runs, report: figures.of_runs(execution.scene, runs, report, execution.stored),
    files=_files,
    live=view.of_runs,
)
