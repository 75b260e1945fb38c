"""Tables of defects."""

from __future__ import annotations

import collections
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from processor.defects.result import DefectClass, Result
from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import text
from processor.model import Scene, StepRun
from processor.report.characteristics import with_interval
from processor.report.columns import MM, columns
from processor.report.sheet.picture import Callout
from processor.report.table import Table, tabulate, yes_no

MOST_LISTED = 100  # defects on the sheet: two pages
LIST_NOTE = text(
    "Centres in the design's frame; a depth inward is positive. ci95 is the half-width of the 95 % interval. The depth "
    "of a missing part is the design's thickness. Confidence 0.5: both classes are equally likely; "
    "below 0.6 the class is unknown, and the second class is the most probable. lod95 is the level of detection of the "
    "mean that the depth follows from. A defect is doubtful if more than one false alarm as strong is expected on "
    "10 000 m2, or if another attitude of the structure fits as well."
)
LEAST_NOTE = text(
    "The mean deviation from which a place of this size is found, at the given rate of false alarms; median over the "
    "surface. Noise: the scatter of means over such places, by that expected from single points."
)


def step_tables(runs: Sequence[StepRun], _: ErrorReport) -> list[Table]:
    """Tables of the first run in short and in full, and the defects of the methods that it is compared with."""
    result: Result = runs[0].result
    tables = [_summary(result, runs[0].method), *(_list(run, run is runs[0]) for run in runs)]
    if len(result.least_depth):
        tables.append(_least_depth(result))
    if any(len(curve.along) for curve in result.defects.deflection):
        tables.append(_curves(result))
    return tables


def _summary(result: Result, method: str) -> Table:
    counts = collections.Counter(result.defects.defect_class)
    rows: list[tuple[Any, ...]] = [
        (text("defects"), len(result.defects), ""),
        (text("doubtful"), int(result.defects.doubtful.sum()), ""),
        *((kind, counts[kind], "") for kind in DefectClass if counts[kind]),
        (text("surface examined for deviations"), result.examined_mm2 / 1e6, "m2"),
        (text("surface that should have been seen"), result.expected_mm2 / 1e6, "m2"),
        (text("points"), result.points, ""),
        (text("points within reach of the design"), result.points_used, ""),
        (text("side of a cell"), result.cell, "mm"),
        (text("noise of a point, one sd, median"), result.noise, "mm"),
        (text("LOD95 of a cell, median"), result.lod95, "mm"),
        (text("registration error, one sd, median"), result.registration_error, "mm"),
    ]
    title = text("Defects in short, method {method}", method=method)
    return Table(title, columns("what", "value", "unit"), tuple(rows), "defects-summary")


def _list(run: StepRun, is_first: bool) -> Table:
    """List the defects of a run, for the page and the terminal if it is the first."""
    defects = run.result.defects
    cells = {
        "id": defects.id,
        "class": defects.defect_class,
        "confidence": defects.confidence,
        "otherwise": defects.otherwise,
        "component": defects.component,
        "x_mm y_mm z_mm": defects.centre,
        "area_mm2": defects.area_mm2,
        "length_mm width_mm": defects.extent[:, :2],
        "depth_max_mm": defects.depth_max,
        "depth_ci95_mm": defects.depth_ci95,
        "depth_mean_mm": defects.depth_mean,
        "volume_mm3": defects.volume_mm3,
        "volume_ci95_mm3": defects.volume_ci95,
        "edge_mm": defects.edge_distance,
        "curvature_per_m": defects.curvature_per_m,
        "lod95_mm": defects.lod95,
        "by_chance_on_100_m2": defects.chance,
        "doubtful": yes_no(defects.doubtful),
        "remark": defects.reasons,
    }
    title = text("Defects, method {method}", method=run.method)
    file = "defects" if is_first else f"defects-{run.method}"
    note = LIST_NOTE if is_first else text("{reasons}", reasons=run.result.reasons)
    return tabulate(title, cells, file, note, units=MM, on_terminal=is_first)


def listed(_: Scene, run: StepRun) -> list[Table]:
    """List the defects for the sheet, in metres."""
    defects = run.result.defects
    cells = {
        "id": defects.id,
        "class": defects.defect_class,
        "component": defects.component,
        "depth_max_mm": defects.depth_max,
        "depth_ci95_mm": defects.depth_ci95,
        "area_mm2": defects.area_mm2,
        "x_m y_m z_m": defects.centre / 1000.0,
        "doubtful": [text("yes") if doubtful else "" for doubtful in defects.doubtful],
    }
    table = tabulate(text("Defects, method {method}", method=run.method), cells)
    return [replace(table, rows=table.rows[:MOST_LISTED])]


def callouts(_: Scene, run: StepRun) -> list[Callout]:
    """Say what the largest defects that are not doubtful are, and how deep."""
    defects = run.result.defects
    order = np.argsort(-defects.area_mm2, kind="stable").tolist()
    return [
        Callout(
            defects.centre[k],
            text(
                "{id}: {kind} {depth}", id=defects.id[k], kind=defects.defect_class[k],
                depth=with_interval(defects.depth_max[k], defects.depth_ci95[k], "mm"),
            ),
        )
        for k in order
        if not defects.doubtful[k]
    ]  # fmt: skip


def _least_depth(result: Result) -> Table:
    windows = result.least_depth
    cells = {"side_mm": windows.side, "depth_mm": windows.depth, "noise": windows.noise_inflation}
    title = text("Least depth found, by size of place")
    return tabulate(title, cells, "defects-least", LEAST_NOTE, units=MM, on_terminal=False)


def _curves(result: Result) -> Table:
    curves = result.defects.deflection
    cells = {"id": np.repeat(result.defects.id, [len(curve.along) for curve in curves])}
    for name in ("along", "displacement", "ci95"):
        cells[f"{name}_mm"] = np.concatenate([getattr(curve, name) for curve in curves])
    return tabulate(text("Deflection curves"), cells, "defects-curves", units=MM, on_page=False, on_terminal=False)
