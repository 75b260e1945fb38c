"""Balls of a space frame against the truth."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.evaluation.error_statistics import signed
from processor.model import NORMAL_95, Better, Floats, FrameTruth, Ints, Metric, Scene, Statistic, Truth
from processor.space_frame import step as space_frame_step
from processor.space_frame.result import Result
from processor.space_frame.spheres import isolated


def true_rows(scene: Scene, result: space_frame_step.Result, true: FrameTruth) -> Ints:
    """Return the row (k,) of the truth that each ball of a result is, -1 where there is no such ball.

    With a design a ball is known by its id. Without, ids mean nothing: it is the true ball that its centre lies in.
    """
    if scene.frame is not None:
        known = {int(id_): row for row, id_ in enumerate(true.ids)}
        return np.array([known.get(ball, -1) for ball in result.ids.tolist()], np.int64)
    found = np.full(len(result.ids), -1, np.int64)
    there = np.flatnonzero(np.isfinite(result.centres).all(axis=1))
    if len(true.ids) and len(there):
        distance, nearest = cKDTree(true.centres).query(result.centres[there])
        inside = distance <= true.radii[nearest]
        found[there[inside]] = nearest[inside]
    return found


NAN = float("nan")


WRONG_MM = 10.0  # a centre farther off than this is another thing


FOUND_MM = 3.0  # a node this near to the true one is found


LOWEST_MM = 3.0  # an unflagged lowest point farther off is a wrong answer
NEAR = f"nodes found within {FOUND_MM:g} mm"
WRONG_CENTRE = f"balls called ok, centre over {WRONG_MM:g} mm off"
WRONG_LOWEST = f"balls called ok, lowest point over {LOWEST_MM:g} mm off"


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Hold balls against the truth, by id with a design and by the nearest centre without.

    Limits: RANSAC's radius errors of 0-3 mm in the paper, held against their median; no ball that is wrong but called
    ok, and by method ``ray`` no lowest point that is. All else informs.
    """
    if truth.frame is None:
        return []
    true = truth.frame
    rows, matches = _matched(scene, result, true)
    found = np.array([flag != "not-found" for flag in result.flag], bool)
    ok = np.array([flag == "ok" for flag in result.flag], bool)[rows]
    radius = result.radii[rows] - true.radii[matches]
    off = result.centres[rows] - true.centres[matches]
    centre = np.linalg.norm(off, axis=1)
    lowest = result.lowest[rows, 2] - true.lowest[matches, 2]
    near = set(matches[centre < FOUND_MM].tolist())
    limit = isolated.PAPER_RADIUS_ERROR_MM if result.method == "ransac" and scene.frame is not None else NAN
    metrics = [
        Metric(
            "spheres",
            quantity,
            value,
            statistic,
            unit="mm",
            limit=limit if (quantity, statistic) == ("radius error", Statistic.MEDIAN) else NAN,
        )
        for quantity, errors in (("radius error", radius), ("centre error", centre), ("lowest point error", lowest))
        for statistic, value in _summary(np.abs(errors[np.isfinite(errors)]))
    ]
    wrong = int((ok & (centre > WRONG_MM)).sum())
    low = int((ok & (np.abs(lowest) > LOWEST_MM)).sum())
    sd = np.sqrt(np.einsum("kii->ki", result.covariance[rows]))
    metrics += [
        Metric("spheres", "balls not found", float(len(true.ids) - len(set(matches.tolist()))), Statistic.COUNT),
        Metric("spheres", NEAR, _share(len(near), len(true.ids)), Statistic.SHARE, unit="%", better=Better.HIGH),
        Metric("spheres", "nodes that are none", float(found.sum() - len(rows)), Statistic.COUNT),
        Metric("spheres", WRONG_CENTRE, float(wrong), Statistic.COUNT, limit=0.0),
        Metric("spheres", WRONG_LOWEST, float(low), Statistic.COUNT, limit=0.0 if result.method == "ray" else NAN),
        *_honesty("centres", off, sd[:, :3], ok),
        *_honesty("radii", radius, sd[:, 3], ok),
        *_honesty("lowest points", lowest, result.lowest_sd[rows], ok),
    ]
    bound = result.bound_sd[rows] if len(result.bound_sd) else np.full((len(rows), 5), NAN)
    metrics += [
        *signed("spheres", "centres", off[ok], bound[ok, :3]),
        *signed("spheres", "radii", radius[ok], bound[ok, 3]),
        *signed("spheres", "lowest points", lowest[ok], bound[ok, 4]),
    ]
    return metrics


def _matched(scene: Scene, result: Result, true: FrameTruth) -> tuple[Ints, Ints]:
    """Rows of the result, and of the truth: the ball of the same id, or without a design that whose inside it is in."""
    got = np.flatnonzero(
        np.isfinite(result.centres).all(axis=1) & np.array([f != "not-found" for f in result.flag], bool)
    )
    if scene.frame is not None:
        row_of = {int(id_): row for row, id_ in enumerate(true.ids)}
        pairs = [(row, row_of[int(result.ids[row])]) for row in got.tolist() if int(result.ids[row]) in row_of]
        rows, matches = np.array(pairs, np.int64).reshape(-1, 2).T
        return rows, matches
    if not len(true.ids) or not len(got):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    distance, nearest = cKDTree(true.centres).query(result.centres[got])
    inside = distance <= true.radii[nearest]
    return got[inside], nearest[inside].astype(np.int64)


def _honesty(quantity: str, off: Floats, sd: Floats, ok: npt.NDArray[np.bool_]) -> list[Metric]:
    """How many errors of balls called ok lie within their 95 % intervals, and their rms in standard deviations."""
    known = np.isfinite(off[ok]) & (sd[ok] > 0.0)
    pull = off[ok][known] / sd[ok][known]
    if not len(pull):
        return []
    return [
        Metric(
            "spheres",
            quantity,
            _share(int((np.abs(pull) < NORMAL_95).sum()), len(pull)),
            Statistic.COVERAGE,
            unit="%",
        ),
        Metric("spheres", quantity, float(np.sqrt(np.mean(pull**2))), Statistic.PULL_RMS),
    ]


def _share(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else NAN


def _summary(errors: Floats) -> list[tuple[Statistic, float]]:
    if len(errors) == 0:
        return [(Statistic.MEDIAN, NAN), (Statistic.P95, NAN), (Statistic.MAX, NAN)]
    median, high = np.percentile(errors, [50.0, 95.0])
    return [(Statistic.MEDIAN, float(median)), (Statistic.P95, float(high)), (Statistic.MAX, float(errors.max()))]
