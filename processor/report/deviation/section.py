"""The report of step ``deviation``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.deviation.result import CorePoints, Result
from processor.evaluation.evaluate import ErrorReport
from processor.geometry.m3c2 import Z95
from processor.language.messages import Message, text
from processor.model import Ints, Scene, Status, StepRun
from processor.pipeline import Execution
from processor.report.characteristics import with_interval
from processor.report.charts import surface_view
from processor.report.charts.stepped_colours import Band
from processor.report.deviation import core_points_csv, face_maps, figures
from processor.report.sheet.picture import Callout
from processor.report.step_report import StepReport
from processor.report.style import CaptionedPngs, Drawn
from processor.report.table import figures_of

MAP, HISTOGRAM = "deviation-map.png", "deviation-histogram.png"
LIMIT = "deviation_mm"  # of a project
LABEL = "scan minus design along the normal"


def _summary(result: Result) -> tuple[Message, Message]:
    if not len(result.core):
        return result.status, text("{reasons}", reasons=result.reasons)
    low, high = result.significant_share_ci95.tolist()
    (least_low, least_high), (greatest_low, greatest_high) = result.min_ci95.tolist(), result.max_ci95.tolist()
    head = text(
        "{status}, {share:.1f} % of the surface measured is beyond its LOD95",
        status=result.status,
        share=100.0 * result.significant_share,
    )
    body = text(
        "95 % interval of this share: {low:.1f} to {high:.1f} %. "
        "Least deviation {least} mm (95 %: {least_low} to {least_high}), greatest {greatest} mm "
        "(95 %: {greatest_low} to {greatest_high}), {near:.1f} % within 10 mm; median LOD95 {lod95} mm, "
        "{registration} mm of it registration. "
        "{measured} of {core} core points were measured.",
        low=100.0 * low,
        high=100.0 * high,
        least=result.min,
        least_low=least_low,
        least_high=least_high,
        greatest=result.max,
        greatest_low=greatest_low,
        greatest_high=greatest_high,
        near=100.0 * result.within_10mm_share,
        lod95=result.lod95_median,
        registration=_of_registration(result.core),
        measured=result.core_points_measured,
        core=result.core_points,
    )
    if result.status is Status.OK:
        return head, body
    return head, text("{reason}. {rest}", reason=result.reasons[:1], rest=body)


def _of_registration(core: CorePoints) -> float:
    """Return what the registration has of LOD95, mm: the median of what points and stations do not have of it."""
    at = np.isfinite(core.lod95)
    n1, n2 = np.maximum(core.n1[at], 1), np.maximum(core.n2[at], 1)
    return float(np.median(core.lod95[at] - Z95 * np.sqrt(core.std1[at] ** 2 / n1 + core.std2[at] ** 2 / n2)))


def _band(scene: Scene, run: StepRun) -> Band:
    """Return the deviations that the project allows, or those that the scan does not tell from none."""
    limits = () if scene.tolerance is None else scene.tolerance.limits
    for limit in limits:
        if limit.key == LIMIT and np.isfinite([limit.low, limit.high]).all():
            name = text("allowed, {low:g} to {high:g} mm", low=limit.low, high=limit.high)
            return Band(limit.low, limit.high, name)
    return face_maps.not_sure(run.result.core.distances, "mm")


def _figures(execution: Execution, runs: Sequence[StepRun], __: ErrorReport) -> CaptionedPngs:
    core = runs[0].result.core
    if not np.isfinite(core.lod95).any():
        return {}
    points = core.points + runs[0].result.origin
    return {
        MAP: face_maps.face_maps(points, core.normals, core.distances, _band(execution.scene, runs[0]), (LABEL, "mm")),
        HISTOGRAM: figures.histogram(core.distances, LABEL, "mm"),
    }


def _files(_: Execution, run: StepRun) -> dict[str, bytes]:
    core = run.result.core
    table = core_points_csv.csv_text(run.result.origin, core.points, core.distances, core.normals)
    return {"deviation.csv": table.encode("ascii")}


def _live(_: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    core = runs[0].result.core
    points = core.points + runs[0].result.origin
    everything: Ints = np.arange(len(points), dtype=np.int64)
    return surface_view.surface_view_data(
        text("Deviation in space"),
        runs[0].method,
        points,
        core.distance,
        [("surface", everything)],
        named=False,
        grey=face_maps.not_sure(core.distances, "mm").high,
    )


def _callouts(_: Scene, run: StepRun) -> list[Callout]:
    """Say what the least and the greatest deviation are, with their level of detection."""
    core, known = run.result.core, np.isfinite(run.result.core.lod95)
    rows = (
        np.flatnonzero(known)[[np.argmin(core.distance[known]), np.argmax(core.distance[known])]] if known.any() else ()
    )
    return [
        Callout(
            core.points[k] + run.result.origin,
            text("{value}", value=with_interval(float(core.distance[k]), float(core.lod95[k]), "mm")),
        )
        for k in rows
    ]


REPORT = StepReport(
    title=text("Deviation"),
    summary=_summary,
    tables=lambda runs, _: [figures_of("Deviation of the surface from the design", runs, "deviation-figures")],
    figures=lambda *given: Drawn(_figures(*given)),
    files=_files,
    callouts=_callouts,
    sheet_tables=lambda _, run: [figures_of("Deviation of the surface from the design", [run], "")],
    interactive_data=_live,
)
