"""Deviations compared with a movement that is known: at each core point, that of the nearest points of the truth."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from processor.deviation.result import Result
from processor.evaluation.error_statistics import covered, covered_pulls, pose_pulls
from processor.geometry import rigid
from processor.model import Bools, Floats, Ints, Metric, PoseTruth, Scene, Statistic, Status, StructureTruth, Truth
from processor.registration import principal
from processor.registration.surface_registration import Registration

NEIGHBOURS = 24  # looked through for one on a face alike: more than the corners of a small piece of the truth
REACH_MM = 500.0  # of a core point: a movement is smooth
LEAST_MM = 50.0  # nearer points count the same
NAN = float("nan")
OTHER_POSE = "not compared with the truth: the pose found is another of those that fit about as well, turned by"
STABLE_MM = 1e-6  # of the largest movement of a structure that is as designed
LODS = 2.0  # levels of detection beyond which a movement has to be found
LEAST_SHARE = 0.2  # of a structure's surface that did not move
MOST_FALSE, MOST_MISSED = 6.0, 10.0  # %
STABLE_POSE_MM, STABLE_POSE_MRAD, AS_DESIGNED_MM = 0.5, 0.05, 0.05  # of the method, where stations have no errors
BY_STATIONS = 0.99  # of draws of the stations' errors, that the limits of a pose admit
ALIKE = 0.9  # cosine between normals of one face at places near each other
BEYOND_LIMIT = 5.0  # % of core points farther from the truth than their level of detection


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Hold deviations against the true movement, in the frame that the result is in.

    The truth is in the design's frame, and so is what was registered by steel that did not move. Elsewhere the truth is
    moved along with the scan: what is true of a best fit is what is left after it. Nothing is checked where scans came
    without a pose, or where a structure that is about symmetric was found in another attitude, and called ambiguous:
    its core points have other places' truth.
    """
    if truth.structure is None or not len(truth.structure.points) or result.status == "failed":
        return []
    if any(not scan.T_project_scan.size for scan in scene.scans) and len(scene.scans) > 1:
        return []
    true_pose = np.eye(4) if truth.pose is None else truth.pose.T_design_project
    if result.status == "ambiguous" and (turn := _otherwise(result, true_pose)) is not None:
        return [Metric(OTHER_POSE, turn, unit="deg")]
    true = true_deviation(result, truth.structure, true_pose)
    error = result.core.distance - true
    known = np.isfinite(error) & np.isfinite(result.core.lod95)
    if not known.any():
        return []
    size = np.abs(error[known])
    beyond = 100.0 * float(np.mean(size > result.core.lod95[known]))
    return [
        Metric(
            "core points farther from the truth than their LOD95",
            beyond,
            Statistic.SHARE,
            unit="%",
            limit=BEYOND_LIMIT if _limited(result) else NAN,
        ),
        Metric("deviation error", float(np.median(size)), Statistic.MEDIAN, unit="mm"),
        Metric("deviation error", float(np.quantile(size, 0.95)), Statistic.P95, unit="mm"),
        Metric("deviation error", float(np.mean(error[known])), Statistic.MEAN, unit="mm"),
        Metric("true deviation", float(np.sqrt(np.mean(true[known] ** 2))), Statistic.RMS, unit="mm"),
        Metric("LOD95", float(np.median(result.core.lod95[known])), Statistic.MEDIAN, unit="mm"),
        *covered("deviations", error, result.core.lod95),
        *_extremes(result, true[known]),
        *_moved_and_not(result, truth.structure),
        *([] if truth.pose is None else _pose(result, truth.structure, truth.pose)),
    ]


def _extremes(result: Result, true: Floats) -> list[Metric]:
    """Coverage of the least and the greatest deviation, against the true extremes of the core points (k,)."""
    if not (result.min_ci95.size and result.max_ci95.size):
        return []
    intervals = np.array([result.min_ci95, result.max_ci95])
    errors = intervals.mean(axis=1) - [true.min(), true.max()]
    half = np.ptp(intervals, axis=1) / 2.0
    return covered("least and greatest deviations", errors, half)


def _pose(result: Result, truth: StructureTruth, truth_pose: PoseTruth) -> list[Metric]:
    """Error of the pose of a structure that is not in the design's frame, at the middle of what did not move.

    The covariance is that of the fit, which has the true pose where enough of the structure did not move. Errors that
    stations share move and turn the scan as a whole, by a normal law that the truth states; they add to what the method
    may be off by. Of three components with covariance C the norm is below sqrt(chi2_3(p) max eig C) with probability p.
    """
    true_pose = truth_pose.T_design_project
    size = np.linalg.norm(truth.displacement, axis=1)
    still = size < STABLE_MM
    in_part = bool(LEAST_SHARE < still.mean() < 1.0)
    middle = truth.points[still if still.any() else slice(None)].mean(axis=0)
    off = result.T_design_scan @ rigid.invert(true_pose)
    shift, turn = rigid.apply(off, middle[None])[0] - middle, rigid.vector_from_rotation(off[:3, :3])
    by_stations = _by_stations(truth_pose, middle)
    limits = np.hypot([STABLE_POSE_MM, STABLE_POSE_MRAD], by_stations) if in_part and _limited(result) else (NAN, NAN)
    shift_limit, turn_limit = (float(limit) for limit in limits)
    wrong = result.status == Status.OK and _otherwise(result, true_pose) is not None
    metrics = [
        Metric("wrong poses called ok", float(wrong), Statistic.COUNT, limit=0.0),
        Metric("pose, shift of the middle", float(np.linalg.norm(shift)), unit="mm", limit=shift_limit),
        Metric("pose, turn", 1e3 * float(np.linalg.norm(turn)), unit="mrad", limit=turn_limit),
    ]
    if result.covariance.size and still.mean() > LEAST_SHARE:
        metrics += covered_pulls("poses", pose_pulls(result.T_design_scan, true_pose, result.covariance))
    return metrics


def _by_stations(truth: PoseTruth, middle: Floats) -> tuple[float, float]:
    """Return by how much stations' errors may shift the middle (3,), mm, and turn the scan, mrad; see BY_STATIONS."""
    if not truth.covariance.size:
        return 0.0, 0.0
    at_middle = rigid.motion(middle[None])[0]
    most = [
        float(np.sqrt(chdtri(3, 1.0 - BY_STATIONS) * np.linalg.eigvalsh(covariance)[-1]))
        for covariance in (at_middle @ truth.covariance @ at_middle.T, truth.covariance[:3, :3])
    ]
    return most[0], 1e3 * most[1]


def _moved_and_not(result: Result, truth: StructureTruth) -> list[Metric]:
    """Return what was found of steel that moved and of steel that did not, in the true frame of the design.

    A core point moved where the movement along its normal is over twice its LOD95. Limits are for structures of which
    one part moved, and for the mean of those exactly as designed: zero within AS_DESIGNED_MM or its interval.
    """
    displacement = truth.displacement[_nearest(result, truth)]
    still = np.linalg.norm(displacement, axis=1) < STABLE_MM
    along = np.abs(np.einsum("ki,ki->k", displacement, result.core.normals))
    lod95, found = result.core.lod95, np.abs(result.core.distance)
    known, limited = np.isfinite(found) & np.isfinite(lod95), _limited(result)
    if still.all() and known.any():
        mean = float(result.core.distance[known].mean())
        half = 0.5 * float(np.ptp(result.mean_ci95)) if result.mean_ci95.size else 0.0
        limit = max(AS_DESIGNED_MM, half) if limited else NAN
        metric = Metric("mean of steel as designed", abs(mean), unit="mm", limit=limit)
        return [metric, *(covered("means", np.array([mean]), np.array([half])) if half > 0.0 else [])]
    moved = known & (along > LODS * lod95)
    if not LEAST_SHARE < still.mean() < 1.0 or not moved.any():
        return []
    false = 100.0 * float(np.mean((found > lod95)[known & still]))
    missed = 100.0 * float(np.mean((found <= lod95)[moved]))
    limits = (MOST_FALSE, MOST_MISSED) if limited else (NAN, NAN)
    return [
        Metric("unmoved steel beyond LOD95", false, Statistic.SHARE, unit="%", limit=limits[0]),
        Metric("moved steel within LOD95", missed, Statistic.SHARE, unit="%", limit=limits[1]),
    ]


def _limited(result: Result) -> bool:
    """Whether limits are for this method; figures of the baseline have none."""
    return result.method == "default"


def _otherwise(result: Result, true_pose: Floats) -> float | None:
    """By what the pose found is turned, degrees, where it is another one than the true one; else nothing."""
    if not len(result.core):
        return None
    T = result.T_design_scan @ rigid.invert(true_pose)
    centre = result.origin + result.core.points.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(result.core.points, axis=0)))
    if not principal.differ(T, np.eye(4), centre, size):
        return None
    return float(np.degrees(rigid.rotation_angle(T[:3, :3])))


def _held_by_steel_at_rest(result: Result, truth: StructureTruth) -> bool:
    """Whether a scan was registered by its stable part, of a structure of which enough did not move."""
    if not result.T_stable_fit.size or result.registration is Registration.AS_GIVEN:
        return False
    at_rest = float(np.mean(np.linalg.norm(truth.displacement, axis=1) < STABLE_MM))
    return at_rest > LEAST_SHARE and np.allclose(result.T_design_scan, result.T_stable_fit, rtol=0.0, atol=1e-6)


def _nearest(result: Result, truth: StructureTruth) -> Ints:
    """Return the nearest row (k,) of the truth to each core point; with named bodies one on a face as its own."""
    count = 1 if truth.bodies is None else min(NEIGHBOURS, len(truth.points))
    index = cKDTree(truth.points).query(result.core.points + result.origin, k=count)[1].reshape(len(result.core), -1)
    first = _first_alike(result, truth, index, np.ones(index.shape, bool))
    rows: Ints = np.take_along_axis(index, first[:, None], axis=1)[:, 0]
    return rows


def _first_alike(result: Result, truth: StructureTruth, at: Ints, near: Bools) -> Ints:
    """Return which (k,) of the neighbours ``at`` (k, n) of each core point is the first on a face as its own, or 0.

    Bodies that touch move apart: what is true of one is not of the other.
    """
    alike = near & (np.einsum("knc,kc->kn", truth.normals[at], result.core.normals) > ALIKE)
    first: Ints = np.argmax(alike, axis=1)
    return first


def true_deviation(result: Result, truth: StructureTruth, true_pose: Floats) -> Floats:
    """Movement (k,) along the normal of each core point by the nearest points of the truth, NaN where none is near."""
    places = truth.points - result.origin
    distance, index = cKDTree(places).query(
        result.core.points, k=min(NEIGHBOURS, len(places)), distance_upper_bound=REACH_MM
    )
    distance, index = distance.reshape(len(result.core), -1), index.reshape(len(result.core), -1)
    near = np.isfinite(distance)
    at = np.minimum(index, len(places) - 1)
    if truth.bodies is not None:
        body, first = truth.bodies.of_point[at], _first_alike(result, truth, at, near)
        near &= body == np.take_along_axis(body, first[:, None], axis=1)
    off = (places[at] - result.core.points[:, None]) / REACH_MM
    weight = np.where(near, 1.0 / (distance**2 + LEAST_MM**2), 0.0)
    basis = np.concatenate([np.ones((*off.shape[:2], 1)), off], axis=2)  # a plane: the movement at the core point
    normal = np.einsum("nk,nki,nkj->nij", weight, basis, basis)
    normal[:, 1:, 1:] += 1e-3 * weight.sum(axis=1)[:, None, None] * np.eye(3) * 1e-1
    normal += 1e-12 * np.eye(4)
    right = np.einsum("nk,nki,nkj->nij", weight, basis, truth.displacement[at])
    moved = np.linalg.solve(normal, right)[:, 0]
    moved[~near.any(axis=1)] = np.nan
    if _held_by_steel_at_rest(result, truth):
        along: Floats = np.einsum("ni,ni->n", moved, result.core.normals)
        return along
    T = rigid.with_origin(result.T_design_scan @ rigid.invert(true_pose), -result.origin)
    T = rigid.transform(T[:3, :3], T[:3, 3] - result.origin)
    found: Floats = np.einsum(
        "ni,ni->n", rigid.apply(T, result.core.points + moved) - result.core.points, result.core.normals
    )
    return found
