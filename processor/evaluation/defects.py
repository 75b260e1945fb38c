"""Comparison of defects with the truth: missed, false alarms, depth, class."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from processor.defects.result import DefectClass, Defects, Result
from processor.evaluation.error_statistics import covered, covered_pulls, pose_pulls, signed
from processor.model import Better, BodyTruth, DefectTruth, Floats, Ints, Metric, Scene, Statistic, Truth

DEPTH_SHARE = 0.10  # required: of the depth, or DEPTH_LODS where noise is more
DEPTH_LODS = 2.0  # required: levels of detection
CLASS_SHARE = 0.9  # required: of the defects found
NAN = float("nan")
FALSE_ALARMS, DEPTH_ERROR = "false alarms", "depth error"
WRONG_DEPTHS = "depths off by more than a tenth and 2 LOD95"
NEAR_MM = 30.0  # chosen: half the largest cell; a report farther off is of another place
OPPOSITE = -0.9  # cosine between the normals of two sides of a plate
# Sizes of true defects that detection is counted by, mm: depth, and diameter of a disc of the same area.
DEPTHS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
DIAMETERS = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)  # and as many steps a decade
FOUND_BY_DEPTH = {f"found of depth {low:g} to {high:g} mm": (low, high) for low, high in pairwise(DEPTHS)}
FOUND_BY_AREA = {f"found of diameter {low:g} to {high:g} mm": (low, high) for low, high in pairwise(DIAMETERS)}
ALARM_SDS = 3.0  # standard deviations of the number of false alarms that the limit allows


def matched(defects: Defects, truth: DefectTruth, named: bool = False) -> Ints:
    """Return the row (t,) of each true defect among those found, -1 = missed.

    It is the one whose centre is nearest, within the radius of a disc of the true area and ``NEAR_MM``; of those
    within, one of the same class goes first, and before it, where components are ``named`` bodies, one of the same.
    """
    rows = np.full(len(truth.ids), -1, np.int64)
    taken: set[int] = set()
    for k in np.argsort(-truth.area_mm2, kind="stable").tolist():
        if not len(defects):
            break
        distance = np.linalg.norm(defects.centre - truth.centres[k], axis=1)
        reach = np.sqrt(truth.area_mm2[k] / np.pi) + NEAR_MM
        if truth.classes[k] == DefectClass.CRACK:  # long: half its length
            reach = max(reach, 0.5 * float(defects.extent[int(np.argmin(distance)), 0]) + NEAR_MM)
        order = sorted(
            (row for row in np.flatnonzero(distance < reach).tolist() if row not in taken),
            key=lambda row: (
                named and defects.component[row] != truth.components[k],
                defects.defect_class[row] != truth.classes[k],
                distance[row],
            ),
        )
        if order:
            rows[k] = order[0]
            taken.add(order[0])
    return rows


def depth_errors(defects: Defects, truth: DefectTruth, rows: Ints) -> tuple[Floats, Floats]:
    """Return measured less true depth (t,), mm, and the allowed error: the larger of a tenth and twice the LOD95."""
    error, allowed = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    matches = rows >= 0
    depth = np.abs(truth.depth_max_mm[matches])
    error[matches] = np.abs(defects.depth_max[rows[matches]]) - depth
    allowed[matches] = np.maximum(DEPTH_SHARE * depth, DEPTH_LODS * defects.lod95[rows[matches]])
    return error, allowed


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Compare with limits: false alarms, one on 100 m2 and chance on top; depths, a tenth or 2 LOD95; classes."""
    if truth.defects is None:
        return []
    bodies = truth.structure.bodies if truth.structure is not None else None
    if scene.structure is None or scene.structure.bodies is None:
        bodies = None  # components that are not named by the design have no true name
    rows = matched(result.defects, truth.defects, named=bodies is not None)
    classes = np.array(truth.defects.classes)
    metrics = [
        Metric(missed_quantity(kind), float((rows[classes == kind] < 0).sum()), Statistic.COUNT, limit=0.0)
        for kind in dict.fromkeys(truth.defects.classes)
    ]
    metrics += _found_by_size(np.abs(truth.defects.depth_max_mm), rows >= 0, FOUND_BY_DEPTH)
    metrics += _found_by_size(2.0 * np.sqrt(truth.defects.area_mm2 / np.pi), rows >= 0, FOUND_BY_AREA)
    behind = _other_sides(result.defects, truth.defects, rows) if bodies is not None else 0
    false = len(result.defects) - int((rows >= 0).sum()) - behind
    expected = result.examined_mm2 / 1e8
    most = np.floor(expected + ALARM_SDS * np.sqrt(expected) + 1.0) if np.isfinite(expected) else NAN
    metrics += [
        Metric(FALSE_ALARMS, float(false), Statistic.COUNT, limit=float(most)),
        Metric("surface examined", result.examined_mm2 / 1e6, unit="m2", better=Better.HIGH),
    ]
    if bodies is not None:
        metrics += _bodies(result.defects, truth.defects, rows, bodies)
        metrics.append(Metric("other sides of dents and bulges", float(behind), Statistic.COUNT))
    if truth.pose is not None and result.T_design_project.size and result.covariance.size:
        pulls = pose_pulls(result.T_design_project, truth.pose.T_design_project, result.covariance)
        metrics += covered_pulls("poses", pulls)
    if (rows >= 0).any():
        metrics += _classes_and_depths(result.defects, truth.defects, rows)
    # Figures of the baseline have no limits
    return [dataclasses.replace(one, limit=NAN) for one in metrics] if result.method == "paper" else metrics


def missed_quantity(kind: str) -> str:
    """Return the quantity of the metric of the missed defects of a true class."""
    return f"missed: {kind}"


def _found_by_size(
    size: Floats, found: npt.NDArray[np.bool_], bounds: Mapping[str, tuple[float, float]]
) -> list[Metric]:
    """Return the share of the true defects of each size (t,), mm, that were found, and their number."""
    metrics = []
    for quantity, (low, high) in bounds.items():
        inside = (size >= low) & (size < high)
        if inside.any():
            share = 100.0 * float(found[inside].mean())
            metrics.append(Metric(quantity, share, Statistic.SHARE, unit="%", better=Better.HIGH))
            metrics.append(Metric(quantity, float(inside.sum()), Statistic.NUMBER))
    return metrics


def _other_sides(defects: Defects, truth: DefectTruth, rows: Ints) -> int:
    """Return the number of unmatched defects that are the other side of a plate with a dent or bulge that was found.

    They lie on the same body within the true radius, face the other way and have a depth of the other sign.
    """
    free = np.setdiff1d(np.arange(len(defects)), rows)
    behind = np.zeros(len(free), bool)
    for k, row in enumerate(rows.tolist()):
        if row < 0 or truth.classes[k] not in (DefectClass.DENT, DefectClass.BULGE):
            continue
        near = np.linalg.norm(defects.centre[free] - truth.centres[k], axis=1) < np.sqrt(truth.area_mm2[k] / np.pi)
        against = defects.axes[free, 2] @ defects.axes[row, 2] < OPPOSITE
        against &= defects.depth_max[free] * defects.depth_max[row] < 0.0
        behind |= near & against & np.array([defects.component[i] == truth.components[k] for i in free], bool)
    return int(behind.sum())


def _bodies(defects: Defects, truth: DefectTruth, rows: Ints, bodies: BodyTruth) -> list[Metric]:
    """Return how far defects are of the right bodies: each that moved is one misalignment, and no other is one."""
    found = Counter(
        name
        for name, kind in zip(defects.component, defects.defect_class, strict=True)
        if kind is DefectClass.MISALIGNMENT
    )
    moved = {name for name, has_moved in zip(bodies.names, bodies.moved, strict=True) if has_moved}
    wrong = sum(
        row >= 0 and defects.component[row] != name for row, name in zip(rows.tolist(), truth.components, strict=True)
    )
    not_one, others = sum(found[name] != 1 for name in moved), len(set(found) - moved)
    return [
        Metric("defects of another body than the true one", float(wrong), Statistic.COUNT, limit=0.0),
        Metric("moved bodies that are not one misalignment", float(not_one), Statistic.COUNT, limit=0.0),
        Metric("bodies called misaligned that did not move", float(others), Statistic.COUNT, limit=0.0),
    ]


def _classes_and_depths(defects: Defects, truth: DefectTruth, rows: Ints) -> list[Metric]:
    """Return the metrics of those true defects that were found; a depth that is a lower bound has no error."""
    matches = rows >= 0
    bound: npt.NDArray[np.bool_] = np.zeros(len(rows), np.bool_)
    bound[matches] = defects.depth_is_bound[rows[matches]]
    error, allowed = depth_errors(defects, truth, rows)
    measured = matches & ~bound & np.isfinite(error)  # parts that are gone have no depth
    size = np.abs(error[measured])
    wrong = float((np.array(defects.defect_class)[rows[matches]] != np.array(truth.classes)[matches]).mean())
    most_wrong = 100.0 * (1.0 - CLASS_SHARE) + 1e-9
    wrong_depths = float((size - allowed[measured] > 0.0).sum())
    found = rows[measured]
    volume = np.abs(defects.volume_mm3[found]) - np.abs(truth.volume_mm3[measured])
    area = defects.area_mm2[found] / truth.area_mm2[measured] - 1.0
    return [
        Metric("class wrong", 100.0 * wrong, Statistic.SHARE, unit="%", limit=most_wrong),
        Metric(WRONG_DEPTHS, wrong_depths, Statistic.COUNT, limit=0.0),
        Metric(DEPTH_ERROR, float(np.median(size)) if len(size) else NAN, Statistic.MEDIAN, unit="mm"),
        Metric(DEPTH_ERROR, float(size.max(initial=0.0)), Statistic.MAX, unit="mm"),
        Metric("depths that are bounds alone", float(bound.sum()), Statistic.COUNT),
        *covered("depths", error[measured], defects.depth_ci95[found]),
        *covered("volumes", volume, defects.volume_ci95[found], unit="mm3"),
        *signed("areas", 100.0 * area, unit="%"),  # they have no intervals
    ]
