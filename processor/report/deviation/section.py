"""How deviations report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.deviation.result import Result
from processor.evaluation.evaluate import ErrorReport
from processor.geometry.m3c2 import Z95
from processor.model import Ints, Scene, StepRun
from processor.pipeline import Execution
from processor.report import surface_view
from processor.report.deviation import csv, figures, results
from processor.report.section import StepReport
from processor.report.style import Drawn
from processor.report.table import Table, shown

MAP, HISTOGRAM = "deviation-map.png", "deviation-histogram.png"


def _summary(result: Result) -> tuple[str, str]:
    if not len(result.core):
        return result.status, result.message
    found = results.figures(result)
    head = f"{result.status}, {_percent(result.significant_share)} % of the surface measured is beyond its LOD95"
    low, high, near = (
        _percent(one) for one in (result.significant_low, result.significant_high, found["within_10mm_share"])
    )
    registration = shown(Z95 * result.registration_error)
    said = (
        f"95 %: {low} to {high} %. From {shown(found['min'])} ± {shown(found['min_lod95'])} to "
        f"{shown(found['max'])} ± {shown(found['max_lod95'])} mm (95 %), {near} % within 10 mm; "
        f"median LOD95 {shown(found['lod95_median'])} mm, {registration} mm of it registration. "
        f"{found['measured']:.0f} of {len(result.core)} core points were measured."
    )
    return head, said


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f}" if np.isfinite(share) else "–"


def _tables(runs: Sequence[StepRun], _: ErrorReport) -> list[Table]:
    columns = [_column(run.result) for run in runs]
    names = ("figure", *(run.method for run in runs), "unit")
    rows = tuple((name, *(one[name][0] for one in columns), unit) for name, (_, unit) in columns[0].items())
    return [Table("Deviation of the surface from the design", names, rows, "deviation-figures")]


def _column(result: Result) -> dict[str, tuple[Any, str]]:
    found = results.figures(result)
    return {
        "status": (result.status, ""),
        "core points": (len(result.core), ""),
        "core points measured": (int(found["measured"]), ""),
        "beyond LOD95": (100.0 * result.significant_share, "%"),
        "beyond LOD95, 95 % from": (100.0 * result.significant_low, "%"),
        "beyond LOD95, 95 % to": (100.0 * result.significant_high, "%"),
        "within 10 mm": (100.0 * found["within_10mm_share"], "%"),
        "mean": (found["mean"], "mm"),
        "median": (found["median"], "mm"),
        "least": (found["min"], "mm"),
        "least, its LOD95": (found["min_lod95"], "mm"),
        "greatest": (found["max"], "mm"),
        "greatest, its LOD95": (found["max_lod95"], "mm"),
        "LOD95, median": (found["lod95_median"], "mm"),
        "registration error, one sd": (result.registration_error, "mm"),
        "from": (result.registration_error_from, ""),
        "registration": (result.registration, ""),
        "ambiguity: error of the next best attitude": (result.ambiguity, "times"),
        "points read": (result.points_read, ""),
        "points kept by the outlier removal": (result.points_kept, ""),
        "points on the surface": (100.0 * result.on_surface_share, "%"),
        "spacing of the scan": (result.spacing, "mm"),
        "sd of a point from the surface": (result.sigma, "mm"),
        "normal diameter": (result.normal_diameter, "mm"),
        "projection diameter": (result.projection_diameter, "mm"),
        "depth to either side": (result.max_depth, "mm"),
    }


def _figures(_: Execution, runs: Sequence[StepRun], __: ErrorReport) -> Drawn:
    result: Result = runs[0].result
    if not np.isfinite(result.lod95).any():
        return {}
    return {
        MAP: figures.deviation_map(result.core + result.origin, result.normals, result.distances, "mm"),
        HISTOGRAM: figures.histogram(result.distances, "mm"),
    }


def _files(_: Execution, run: StepRun) -> dict[str, bytes]:
    result: Result = run.result
    text = csv.csv_text(result.origin, result.core, result.distances, result.normals)
    return {"deviation.csv": text.encode("ascii")}


def _live(_: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    result: Result = runs[0].result
    points = result.core + result.origin
    everything: Ints = np.arange(len(points), dtype=np.int64)
    return surface_view.of_points(
        "Deviation in space", runs[0].method, points, result.distances.distance, [("surface", everything)], named=False
    )


REPORT = StepReport(
    title="Deviation",
    summary=_summary,
    written=results.written,
    tables=_tables,
    figures=_figures,
    files=_files,
    live=_live,
)
