"""How stitching reports."""

from __future__ import annotations

import collections

from processor.model import StepRun
from processor.pipeline import Execution
from processor.report.section import StepReport
from processor.report.stitching import figures, results, tables, view
from processor.stitching.result import Result


def _summary(result: Result) -> tuple[str, str]:
    statuses = collections.Counter(result.scan_status)
    head = f"{result.status}, {statuses['ok']} of {len(result.scans)} scans without a flag"
    named = ", ".join(f"{statuses[one]} {one}" for one in ("ambiguous", "weak", "failed") if statuses[one])
    pairs = f"{int(result.used.sum())} of {len(result.used)} pairs used."
    return head, f"Flagged: {named}. {pairs}" if named else pairs


def _files(_: Execution, run: StepRun) -> dict[str, bytes]:
    return {results.POSES: results.poses(run.result)}


REPORT = StepReport(
    title="Stitching",
    summary=_summary,
    written=results.written,
    tables=tables.of_runs,
    figures=figures.of_runs,
    files=_files,
    live=view.of_runs,
)
