"""Tables of defects."""

from __future__ import annotations

import collections
from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.defects.result import CLASSES, Result
from processor.evaluation.evaluate import ErrorReport
from processor.model import StepRun
from processor.report.table import Table

LIST_NOTE = (
    "Centres in the design's frame; a depth inward is positive. ci95 is the half-width of the 95 % interval. What is "
    "missing is as deep as the design is thick. Confidence 0.5 is a coin's; below 0.6 a class is unknown, and "
    "otherwise says what it would be. lod95 is the level of detection of the means that a depth comes from. "
    "Doubtful is what chance brings as strong on less than 10 000 m2."
)
LEAST_NOTE = (
    "What a place of this size has to deviate by, on the median of the surface, to be found at the false alarms asked "
    "for; noise by how much means of such places vary more than single points say."
)


def of_runs(runs: Sequence[StepRun], _: ErrorReport) -> list[Table]:
    """Tables of the answer, in short and in full, and the defects of each method compared with it."""
    first: Result = runs[0].result
    tables = [_in_short(first, runs[0].method)]
    tables += [_list(run, run is runs[0]) for run in runs]
    if len(first.scale_mm):
        tables.append(_least(first))
    if len(first.curve_defect):
        tables.append(_curves(first))
    return tables


def _in_short(result: Result, method: str) -> Table:
    counts = collections.Counter(result.classes)
    rows: list[tuple[Any, ...]] = [("defects", len(result.ids), "")]
    rows += [("doubtful", int(result.doubtful.sum()), "")]
    rows += [(kind, counts[kind], "") for kind in CLASSES if counts[kind]]
    rows += [
        ("surface examined for deviations", result.examined_mm2 / 1e6, "m2"),
        ("surface that should have been seen", result.expected_mm2 / 1e6, "m2"),
        ("points", result.points, ""),
        ("points within reach of the design", result.used, ""),
        ("side of a cell", result.cell_mm, "mm"),
        ("noise of a point, one sd, median", result.noise_mm, "mm"),
        ("LOD95 of a cell, median", result.lod95_mm, "mm"),
        ("registration error, one sd, median", result.registration_error_mm, "mm"),
    ]
    return Table(f"Defects in short, method {method}", ("what", "value", "unit"), tuple(rows), "defects-summary")


def _list(run: StepRun, answer: bool) -> Table:
    result: Result = run.result
    rows = tuple(
        (
            id_,
            result.classes[k],
            float(result.confidence[k]),
            result.second[k],
            result.components[k],
            *result.centres[k].tolist(),
            float(result.area_mm2[k]),
            *result.extent[k].tolist(),
            float(result.depth_max[k]),
            float(result.depth_ci95[k]),
            float(result.depth_mean[k]),
            float(result.volume_mm3[k]),
            float(result.volume_ci95[k]),
            float(result.edge_mm[k]),
            float(result.curvature_per_m[k]),
            float(result.lod95[k]),
            float(result.chance[k]),
            "yes" if result.doubtful[k] else "no",
            result.remarks[k],
        )
        for k, id_ in enumerate(result.ids.tolist())
    )
    columns = (
        "id", "class", "confidence", "otherwise", "component", "x_mm", "y_mm", "z_mm", "area_mm2", "length_mm",
        "width_mm", "depth_max_mm", "depth_ci95_mm", "depth_mean_mm", "volume_mm3", "volume_ci95_mm3", "edge_mm",
        "curvature_per_m", "lod95_mm", "by_chance_on_100_m2", "doubtful", "remark",
    )  # fmt: skip
    file = "defects" if answer else f"defects-{run.method}"
    note = LIST_NOTE if answer else result.message
    return Table(f"Defects, method {run.method} (mm)", columns, rows, file, note, on_terminal=answer)


def _least(result: Result) -> Table:
    rows = tuple(
        zip(*(x.tolist() for x in (result.scale_mm, result.scale_least_mm, result.scale_inflation)), strict=True)
    )
    return Table(
        "Least depth found, by size of place (mm)", ("side_mm", "depth_mm", "noise"), rows, "defects-least", LEAST_NOTE,
        on_terminal=False,
    )  # fmt: skip


def _curves(result: Result) -> Table:
    ids = result.ids[result.curve_defect]
    rows = tuple(zip(*(x.tolist() for x in (ids, result.curve_at_mm, result.curve_mm, result.curve_ci95)), strict=True))
    known = np.isfinite(result.curve_ci95).all()
    note = "From the middle of the component; displacement outward of its largest face." if known else ""
    return Table(
        "Deflection curves (mm)", ("id", "along_mm", "displacement_mm", "ci95_mm"), rows, "defects-curves", note,
        on_page=False, on_terminal=False,
    )  # fmt: skip
