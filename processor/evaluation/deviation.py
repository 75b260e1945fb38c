"""Deviations held against a movement that is known: at each core point, that of the nearest points of the truth."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from processor.deviation.result import Result
from processor.evaluation.error_statistics import signed
from processor.geometry import principal, rigid
from processor.model import Floats, Metric, Scene, Statistic, StructureTruth, Truth

NEIGHBOURS = 24
REACH_MM = 500.0  # of a core point: a movement is smooth
LEAST_MM = 50.0  # nearer points count the same
NAN = float("nan")
OTHER_POSE = "not compared with the truth: the pose found is another of those that fit about as well, turned by"
BEYOND_LIMIT = 5.0  # % of core points farther from the truth than their level of detection


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Hold deviations against the true movement, in the frame that the result is in.

    The truth is in the design's frame. Where the scan was moved to fit, the truth is moved along: what is true of a
    best fit is what is left after it. Nothing is checked where scans came without a pose, or where a structure that is
    about symmetric was found in another attitude, and called ambiguous: its core points have other places' truth.
    """
    if truth.structure is None or not len(truth.structure.points) or result.status == "failed":
        return []
    if any(not scan.T_project_scan.size for scan in scene.scans) and len(scene.scans) > 1:
        return []
    if result.status == "ambiguous" and (turn := _otherwise(result)) is not None:
        return [Metric("deviation", OTHER_POSE, turn, unit="deg")]
    true = true_deviation(result, truth.structure)
    error = result.core.distance - true
    known = np.isfinite(error) & np.isfinite(result.core.lod95)
    if not known.any():
        return []
    size = np.abs(error[known])
    beyond = 100.0 * float(np.mean(size > result.core.lod95[known]))
    return [
        Metric(
            "deviation",
            "core points farther from the truth than their LOD95",
            beyond,
            Statistic.SHARE,
            unit="%",
            limit=BEYOND_LIMIT if result.method == "default" else NAN,
        ),
        Metric("deviation", "deviation error", float(np.median(size)), Statistic.MEDIAN, unit="mm"),
        Metric("deviation", "deviation error", float(np.quantile(size, 0.95)), Statistic.P95, unit="mm"),
        Metric("deviation", "deviation error", float(np.mean(error[known])), Statistic.MEAN, unit="mm"),
        Metric("deviation", "true deviation", float(np.sqrt(np.mean(true[known] ** 2))), Statistic.RMS, unit="mm"),
        Metric("deviation", "LOD95", float(np.median(result.core.lod95[known])), Statistic.MEDIAN, unit="mm"),
        *signed("deviation", "deviations", error[known]),
    ]


def _otherwise(result: Result) -> float | None:
    """By what the pose found is turned, degrees, where it is another one than the design's; else nothing."""
    if not len(result.core):
        return None
    T = result.T_design_scan
    centre = result.origin + result.core.points.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(result.core.points, axis=0)))
    if not principal.differ(T, np.eye(4), centre, size):
        return None
    return float(np.degrees(rigid.rotation_angle(T[:3, :3])))


def true_deviation(result: Result, truth: StructureTruth) -> Floats:
    """Movement (k,) along the normal of each core point by the nearest points of the truth, NaN where none is near."""
    places = truth.points - result.origin
    distance, index = cKDTree(places).query(
        result.core.points, k=min(NEIGHBOURS, len(places)), distance_upper_bound=REACH_MM
    )
    distance, index = distance.reshape(len(result.core), -1), index.reshape(len(result.core), -1)
    near = np.isfinite(distance)
    at = np.minimum(index, len(places) - 1)
    off = (places[at] - result.core.points[:, None]) / REACH_MM
    weight = np.where(near, 1.0 / (distance**2 + LEAST_MM**2), 0.0)
    basis = np.concatenate([np.ones((*off.shape[:2], 1)), off], axis=2)  # a plane: the movement at the core point
    normal = np.einsum("nk,nki,nkj->nij", weight, basis, basis)
    normal[:, 1:, 1:] += 1e-3 * weight.sum(axis=1)[:, None, None] * np.eye(3) * 1e-1
    normal += 1e-12 * np.eye(4)
    right = np.einsum("nk,nki,nkj->nij", weight, basis, truth.displacement[at])
    moved = np.linalg.solve(normal, right)[:, 0]
    moved[~near.any(axis=1)] = np.nan
    T = rigid.with_origin(result.T_design_scan, -result.origin)
    T = rigid.transform(T[:3, :3], T[:3, 3] - result.origin)
    found: Floats = np.einsum(
        "ni,ni->n", rigid.apply(T, result.core.points + moved) - result.core.points, result.core.normals
    )
    return found
