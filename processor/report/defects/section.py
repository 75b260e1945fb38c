"""How defects report."""

from __future__ import annotations

import collections

from processor.defects.result import CLASSES, Result
from processor.report.defects import figures, results, tables, view
from processor.report.section import StepReport
from processor.report.table import shown


def _summary(result: Result) -> tuple[str, str]:
    if result.status == "failed":
        return result.status, result.message
    counts = collections.Counter(result.classes)
    named = ", ".join(f"{counts[kind]} {kind}" for kind in CLASSES if counts[kind])
    doubtful = int(result.doubtful.sum())
    sure = len(result.ids) - doubtful
    head = f"{result.status}, {sure or 'no'} defect{'' if sure == 1 else 's'} found"
    head += f" and {doubtful} doubtful" if doubtful else ""
    said = f"{named.capitalize()}. " if named else ""
    said += f"{result.examined_mm2 / 1e6:.1f} m2 examined"
    if len(result.scale_mm):
        middle = len(result.scale_mm) // 2
        said += (
            f"; a place {result.scale_mm[middle]:.0f} mm wide is found from "
            f"{shown(float(result.scale_least_mm[middle]))} mm of mean depth"
        )
    return head, said + "."


REPORT = StepReport(
    title="Defects",
    summary=_summary,
    written=results.written,
    tables=tables.of_runs,
    figures=lambda execution, runs, report: figures.of_runs(execution.scene, runs, report),
    files=lambda _, run: figures.files(run.result),
    live=view.of_runs,
)
