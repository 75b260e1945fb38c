"""How defects report."""

from __future__ import annotations

import collections

from processor.defects.result import CLASSES, Result
from processor.report import figures_defects, results_defects, tables_defects, view_defects
from processor.report.printing import shown
from processor.report.step_report import StepReport


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
    written=results_defects.written,
    tables=tables_defects.of_runs,
    figures=lambda execution, runs, report: figures_defects.of_runs(execution.scene, runs, report),
    files=lambda _, run: figures_defects.files(run.result),
    live=view_defects.of_runs,
)
