"""Defects held against the truth: found, missed, invented, how deep, of what class."""

from __future__ import annotations

import numpy as np

from processor.defects.result import Result
from processor.model import Better, DefectTruth, Floats, Ints, Metric, Scene, Statistic, Truth

DEPTH_SHARE = 0.10
DEPTH_LODS = 2.0
CLASS_SHARE = 0.9
NAN = float("nan")
WRONG_DEPTHS = "depths off by more than a tenth and 2 LOD95"
WHOLE = ("bend", "twist", "waviness", "step", "misalignment")
WHOLE_SHARE = 0.6  # of a component's reach that the centre of its shape may be off
NEAR_MM = 30.0


def matched(result: Result, truth: DefectTruth) -> Ints:
    """Return the row (t,) of the result that is each true defect, -1 = missed.

    It is the one whose centre is nearest, within the radius of a disc of the true area and ``NEAR_MM``; of those
    within, one of the same class goes first.
    """
    found = np.full(len(truth.ids), -1, np.int64)
    taken: set[int] = set()
    for k in np.argsort(-truth.area_mm2, kind="stable").tolist():
        if not len(result.ids):
            break
        away = np.linalg.norm(result.centres - truth.centres[k], axis=1)
        reach = np.sqrt(truth.area_mm2[k] / np.pi) + NEAR_MM
        if truth.classes[k] == "crack":  # long: half its length
            reach = max(reach, 0.5 * float(result.extent[int(np.argmin(away)), 0]) + NEAR_MM)
        order = sorted(
            (row for row in np.flatnonzero(away < reach).tolist() if row not in taken),
            key=lambda row: (result.classes[row] != truth.classes[k], away[row]),
        )
        if order:
            found[k] = order[0]
            taken.add(order[0])
    return found


def depth_errors(result: Result, truth: DefectTruth, rows: Ints) -> tuple[Floats, Floats]:
    """Depth found less the true one (t,), mm, and what is allowed: the larger of a tenth and twice the LOD95."""
    error, allowed = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    got = rows >= 0
    error[got] = np.abs(result.depth_max[rows[got]]) - np.abs(truth.depth_max_mm[got])
    allowed[got] = np.maximum(DEPTH_SHARE * np.abs(truth.depth_max_mm[got]), DEPTH_LODS * result.lod95[rows[got]])
    return error, allowed


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Limits: no more false alarms than one on 100 m2 and chance on top, depths within a tenth or 2 LOD95, classes."""
    if truth.defects is None:
        return []
    true = truth.defects
    rows = matched(result, true)
    metrics: list[Metric] = []
    held = result.method != "paper"  # a baseline: its figures inform
    kinds = np.array(true.classes)
    named = np.array(result.classes)
    for kind in dict.fromkeys(true.classes):
        own = kinds == kind
        metrics.append(
            Metric(
                "defects", f"missed: {kind}", float((rows[own] < 0).sum()), Statistic.COUNT, limit=0.0 if held else NAN
            )
        )
    false = len(result.ids) - int((rows >= 0).sum())
    area = result.examined_mm2 / 1e8
    likely = area + 3.0 * np.sqrt(area) + 1.0 if np.isfinite(area) else NAN
    error, allowed = depth_errors(result, true, rows)
    got = rows >= 0
    # Of a crack that no beam sees the ground of, a depth is a bound and says so.
    bound = np.array([row >= 0 and result.remarks[row].startswith("at least") for row in rows], bool)
    judged = got & ~bound
    metrics += [
        Metric(
            "defects",
            "false alarms",
            float(false),
            Statistic.COUNT,
            limit=float(np.floor(likely)) if np.isfinite(area) and held else NAN,
        ),
        Metric("defects", "surface examined", result.examined_mm2 / 1e6, unit="m2", better=Better.HIGH),
    ]
    if got.any():
        wrong = float((named[rows[got]] != kinds[got]).mean())
        off = np.abs(error[judged]) - allowed[judged]
        metrics += [
            Metric(
                "defects",
                "class wrong",
                100.0 * wrong,
                Statistic.SHARE,
                unit="%",
                limit=100.0 * (1.0 - CLASS_SHARE) + 1e-9 if held else NAN,
            ),
            Metric("defects", WRONG_DEPTHS, float((off > 0.0).sum()), Statistic.COUNT, limit=0.0 if held else NAN),
            Metric(
                "defects",
                "depth error",
                float(np.median(np.abs(error[judged]))) if judged.any() else NAN,
                Statistic.MEDIAN,
                unit="mm",
            ),
            Metric("defects", "depth error", float(np.abs(error[judged]).max(initial=0.0)), Statistic.MAX, unit="mm"),
            Metric("defects", "depths that are bounds alone", float(bound.sum()), Statistic.COUNT),
        ]
    return metrics
