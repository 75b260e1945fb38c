"""How bolt balls report."""

from __future__ import annotations

import collections

from processor.model import StepRun
from processor.pipeline import Execution
from processor.report import dxf, figures_ball, figures_balls, results_balls, tables_balls, view_balls
from processor.report.step_report import StepReport
from processor.steps import spheres


def _summary(result: spheres.Result) -> tuple[str, str]:
    flags = collections.Counter(result.flag)
    named = ", ".join(f"{flags[name]} {name}" for name in ("low-confidence", "wrong-size", "not-found") if flags[name])
    head = f"{result.status}, {flags['ok']} of {len(result.flag)} balls without a flag"
    return head, f"Flagged: {named}." if named else ""


def _files(execution: Execution, run: StepRun) -> dict[str, bytes]:
    found = {"nodes.dxf": dxf.drawing(run.result)} if len(run.result.tube_radii) else {}
    if tables_balls.has_bounds(run.result):
        pages = figures_ball.document(execution.scene, run.result, execution.stored)
        found |= {figures_ball.DOCUMENT: pages} if pages else {}
    return found


REPORT = StepReport(
    title="Bolt balls",
    summary=_summary,
    written=results_balls.written,
    tables=tables_balls.of_runs,
    figures=lambda execution, runs, report: figures_balls.of_runs(execution.scene, runs, report, execution.stored),
    files=_files,
    live=view_balls.of_runs,
)
