"""Verdicts on defects by depth and area, and on what may be there and was not found.

A limit of the defect's class wins over one of any class, one that names the component over one of all. Where the class
is not sure, the limits of the second most probable class must give the same verdict. A doubtful defect fails nothing:
it is indeterminate, and so is a pass of a depth that is a lower bound. A surface without a defect passes where the
least depth that is found keeps the limit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from processor.defects.result import DefectClass, Result
from processor.limits import judging, measurands, standards
from processor.limits.judging import Judged, JudgedLimits, Measured
from processor.model import Limit, Scene, Status, Tolerance, Verdict

SURE = 0.95  # confidence of a class, from which limits of another class do not matter
SURFACE = "surface"  # of what may be there and was not found


def judge(scene: Scene, result: Result) -> JudgedLimits | None:
    """Compare the defects of a result with the limits of a scene; None where none is given."""
    tolerance = standards.default_for(scene.tolerance)
    kinds = (measurands.DEFECT_DEPTH, measurands.DEFECT_AREA)
    if not any(limit.measure in kinds for limit in tolerance.limits):
        return None
    rows: list[Judged] = []
    for measure in kinds:
        of_measure = [limit for limit in tolerance.limits if limit.measure == measure]
        if of_measure and result.status is Status.FAILED:
            rows.append(judging.judge(of_measure[0], Measured(SURFACE), tolerance))
            continue
        for row in range(len(result.defects)):
            rows += _of_defect(result, row, tolerance, measure)
    rows += _not_found(result, tolerance) if result.status is not Status.FAILED else ()
    return judging.table(rows)


def _of_defect(result: Result, row: int, tolerance: Tolerance, measure: str) -> Iterator[Judged]:
    """Compare one defect by one measure with the limits of its class and component; at most one comparison."""
    defects = result.defects
    limits = judging.limits_for(tolerance, measure, defects.component[row])
    limit = _limit(limits, defects.defect_class[row])
    measured = _depth(result, row) if measure == measurands.DEFECT_DEPTH else _area(result, row)
    sure = bool(defects.confidence[row] >= SURE)
    other = limit if sure else _limit(limits, defects.otherwise[row])
    if limit is None:
        return
    judged = judging.judge(limit, measured, tolerance)
    if other is None or judging.judge(other, measured, tolerance).verdict is not judged.verdict:
        judged = replace(judged, verdict=Verdict.INDETERMINATE)
    yield judged


def _limit(limits: Sequence[Limit], kind: DefectClass) -> Limit | None:
    """Return the limit of a class, of any class without one."""
    by_class = {measurands.class_of(limit): limit for limit in limits}
    return by_class.get(str(kind), by_class.get(""))


def _name(result: Result, row: int) -> str:
    defects = result.defects
    return f"{defects.id[row]} {defects.defect_class[row]} {defects.component[row]}"


def _depth(result: Result, row: int) -> Measured:
    defects = result.defects
    depth, half = abs(float(defects.depth_max[row])), float(defects.depth_ci95[row])
    most = math.inf if defects.depth_is_bound[row] else depth + half
    return Measured(_name(result, row), depth, max(depth - half, 0.0), most, doubtful=bool(defects.doubtful[row]))


def _area(result: Result, row: int) -> Measured:
    """Area of a defect: its outline is known to a cell, of which half may count on either side."""
    defects = result.defects
    area, extent = float(defects.area_mm2[row]), defects.extent[row]
    outline = 2.0 * float(np.nansum(extent))  # of the rectangle about it
    half = 0.5 * result.cell * outline if math.isfinite(result.cell) else math.nan
    least = max(area - half, min(area, 1.0))  # a defect that is there has an area
    return Measured(_name(result, row), area, least, area + half, doubtful=bool(defects.doubtful[row]))


def _not_found(result: Result, tolerance: Tolerance) -> Iterator[Judged]:
    """Compare the least depth that is found with the strictest limit of depth: shallower defects may be there."""
    depths = [limit for limit in tolerance.limits if limit.measure == measurands.DEFECT_DEPTH]
    if not depths:
        return
    strictest = min(depths, key=lambda limit: limit.high)
    rows = len(result.least_depth)
    found_from = float(result.least_depth.depth[rows // 2]) if rows else math.nan
    yield judging.judge(strictest, Measured(SURFACE, 0.0, 0.0, found_from), tolerance)
