"""How stitching reports."""

from __future__ import annotations

import collections

from processor.model import StepRun
from processor.pipeline import Execution
from processor.report import figures_stitch, results_stitch, tables_stitch, view_stitch
from processor.report.step_report import StepReport
from processor.stitching.result import Result


def _summary(result: Result) -> tuple[str, str]:
    statuses = collections.Counter(result.scan_status)
    head = f"{result.status}, {statuses['ok']} of {len(result.scans)} scans without a flag"
    named = ", ".join(f"{statuses[one]} {one}" for one in ("ambiguous", "weak", "failed") if statuses[one])
    pairs = f"{int(result.used.sum())} of {len(result.used)} pairs used."
    return head, f"Flagged: {named}. {pairs}" if named else pairs


def _files(_: Execution, run: StepRun) -> dict[str, bytes]:
    return {results_stitch.POSES: results_stitch.poses(run.result)}


REPORT = StepReport(
    title="Stitching",
    summary=_summary,
    written=results_stitch.written,
    tables=tables_stitch.of_runs,
    figures=figures_stitch.of_runs,
    files=_files,
    live=view_stitch.of_runs,
)
