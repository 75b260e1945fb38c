"""Balls of a space frame against the truth."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.evaluation.error_statistics import coverage, covered, signed
from processor.geometry import rigid
from processor.model import NORMAL_95, Better, Floats, FrameTruth, Ints, Metric, Scene, Statistic, Truth
from processor.space_frame.design.matching import robust_fit
from processor.space_frame.result import Balls, Flag, MovementGauge, Result
from processor.space_frame.spheres import assessment

NAN = float("nan")
WRONG_MM = 10.0  # a centre farther off is that of another ball
FOUND_MM = 3.0  # a node this near to the true one is found
OTHER_SIZE_MM = 2.0  # tolerances of blanks are less, steps between sizes more
LOWEST_MM = 3.0  # an unflagged lowest point farther off is a wrong answer
NEAR = f"nodes found within {FOUND_MM:g} mm"
WRONG_CENTRE = f"balls called ok, centre over {WRONG_MM:g} mm off"
WRONG_LOWEST = f"balls called ok, lowest point over {LOWEST_MM:g} mm off"


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Compare balls with the truth, by id with a design and by the nearest centre without.

    Limits: RANSAC's radius errors of 0-3 mm in the paper, for their median; no ball that is wrong but flagged ok, and
    by method ``ray`` no such lowest point. All other metrics have no limit.
    """
    if truth.frame is None:
        return []
    true, balls = truth.frame, result.balls
    present = ~balls.flagged(Flag.NOT_FOUND)
    of_truth = np.where(balls.placed & present, true_rows(scene, balls, true), -1)
    rows = np.flatnonzero(of_truth >= 0)
    matches = of_truth[rows]
    ok = balls.flagged(Flag.OK)[rows]
    radius = balls.radii[rows] - true.radii[matches]
    off = balls.centres[rows] - true.centres[matches]
    centre = np.linalg.norm(off, axis=1)
    lowest = balls.lowest[rows, 2] - true.lowest[matches, 2]
    near = set(matches[centre < FOUND_MM].tolist())
    limit = assessment.PAPER_RADIUS_ERROR_MM if result.method == "ransac" and scene.frame is not None else NAN
    metrics = [
        Metric(
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
    sd = np.sqrt(np.einsum("kii->ki", balls.covariance[rows]))
    metrics += [
        Metric("balls not found", float(len(true.ids) - len(set(matches.tolist()))), Statistic.COUNT),
        Metric(
            NEAR,
            100.0 * len(near) / len(true.ids) if len(true.ids) else NAN,
            Statistic.SHARE,
            unit="%",
            better=Better.HIGH,
        ),
        Metric("nodes that are none", float(present.sum() - len(rows)), Statistic.COUNT),
        Metric(WRONG_CENTRE, float(wrong), Statistic.COUNT, limit=0.0),
        Metric(WRONG_LOWEST, float(low), Statistic.COUNT, limit=0.0 if result.method == "ray" else NAN),
        *_coverage("centres", off, sd[:, :3], ok),
        *_coverage("radii", radius, sd[:, 3], ok),
        *_coverage("lowest points", lowest, balls.lowest_sd[rows], ok),
    ]
    bound = balls.bound_sd[rows] if len(balls.bound_sd) else np.full((len(rows), 5), NAN)
    metrics += [
        *signed("centres", off[ok], bound[ok, :3]),
        *signed("radii", radius[ok], bound[ok, 3]),
        *signed("lowest points", lowest[ok], bound[ok, 4]),
        *_movements(scene, result, true, rows, matches, ok),
        *_sizes(balls, true, rows, matches, result.method == "ray"),
        *_tubes(scene, result, truth, of_truth),
    ]
    return metrics


def _sizes(balls: Balls, true: FrameTruth, rows: Ints, matches: Ints, limited: bool) -> list[Metric]:
    """Return numbers of right sizes called wrong, and of wrong sizes that are not, by the design's radii."""
    nominal = balls.nominal_radii[rows] if len(balls.nominal_radii) else np.full(len(rows), NAN)
    known = np.isfinite(nominal)
    if not known.any():
        return []
    wrong = np.abs(true.radii[matches] - nominal)[known] > OTHER_SIZE_MM
    called = balls.flagged(Flag.WRONG_SIZE)[rows][known]
    limit = 0.0 if limited else NAN
    return [
        Metric("right sizes called wrong", float((called & ~wrong).sum()), Statistic.COUNT, limit=limit),
        Metric("wrong sizes called right", float((wrong & ~called).sum()), Statistic.COUNT),
    ]


def _movements(
    scene: Scene, result: Result, true: FrameTruth, rows: Ints, matches: Ints, ok: npt.NDArray[np.bool_]
) -> list[Metric]:
    """Return movements of balls ``rows`` (m,) against the true ones, of those that are ``ok`` (m,).

    By a best fit, the truth is fitted as the balls are: by the robust fit of the same nodes, also of those that are not
    ok. A fit without some of the nodes is another datum.
    """
    balls, design = result.balls, scene.frame
    if design is None or not len(balls.movement):
        return []
    moved = np.isfinite(balls.movement[rows]).all(axis=1)
    rows, matches, ok = rows[moved], matches[moved], ok[moved]
    if not ok.any():
        return []
    known = {int(id_): k for k, id_ in enumerate(design.ids)}
    nominal = np.array([design.centres[known[int(balls.ids[row])]] for row in rows]).reshape(-1, 3)
    places = true.centres[matches]
    if result.movement_reference is not None and result.movement_reference.gauge is MovementGauge.BEST_FIT:
        middle = places.mean(axis=0)
        places = rigid.apply(robust_fit(places - middle, nominal)[0], places - middle)
    vector, rows = (places - nominal)[ok], rows[ok]
    size = np.linalg.norm(vector, axis=1)
    return [
        *covered("movements", balls.movement[rows] - vector, balls.movement_ci95[rows]),
        *covered("sizes of movements", balls.movement_size[rows] - size, balls.movement_size_ci95[rows]),
    ]


def _tubes(scene: Scene, result: Result, truth: Truth, of_truth: Ints) -> list[Metric]:
    """Return errors of tubes against their intervals: of radii, and of axes across at both ends.

    Tubes are built with the design's diameters, and with axes through the centres of the balls they join; scenes with
    eccentric members have no true axes.
    """
    tubes, balls, true = result.tubes, result.balls, truth.frame
    row = {int(id_): int(k) for id_, k in zip(balls.ids, of_truth, strict=True)}
    if true is None or not len(tubes):
        return []
    a, b = (np.array([row.get(int(id_), -1) for id_ in ids], np.int64) for ids in (tubes.a, tubes.b))
    joined = np.flatnonzero((a >= 0) & (b >= 0))
    a, b = a[joined], b[joined]
    metrics: list[Metric] = []
    if scene.frame is not None:
        design = zip(scene.frame.member_a, scene.frame.member_b, scene.frame.tube_diameters, strict=True)
        radii = {frozenset((int(i), int(j))): 0.5 * float(diameter) for i, j, diameter in design}
        ends = zip(true.ids[a].tolist(), true.ids[b].tolist(), strict=True)
        nominal = np.array([radii.get(frozenset(pair), NAN) for pair in ends])
        metrics += covered("radii of tubes", tubes.radii[joined] - nominal, tubes.radius_ci95[joined])
    if len(joined) and (truth.as_built is None or "eccentricity" not in truth.as_built.what):
        along = true.centres[b] - true.centres[a]
        along /= np.linalg.norm(along, axis=1)[:, None]
        off, half = [], []
        for place, ci95 in ((tubes.start, tubes.start_ci95), (tubes.end, tubes.end_ci95)):
            gap = place[joined] - true.centres[a]
            off.append(gap - np.sum(gap * along, axis=1)[:, None] * along)
            half.append(ci95[joined])
        metrics += covered("axes of tubes", np.stack(off), np.stack(half))
    return metrics


def true_rows(scene: Scene, balls: Balls, true: FrameTruth) -> Ints:
    """Return the row (k,) of the truth that corresponds to each ball, -1 = none.

    With a design balls correspond by their ids. Without, ids have no meaning: a ball corresponds to the true one that
    contains its centre.
    """
    if scene.frame is not None:
        known = {int(id_): row for row, id_ in enumerate(true.ids)}
        return np.array([known.get(ball, -1) for ball in balls.ids.tolist()], np.int64)
    rows = np.full(len(balls), -1, np.int64)
    placed = np.flatnonzero(balls.placed)
    if len(true.ids) and len(placed):
        distance, nearest = cKDTree(true.centres).query(balls.centres[placed])
        inside = distance <= true.radii[nearest]
        rows[placed[inside]] = nearest[inside]
    return rows


def _coverage(quantity: str, off: Floats, sd: Floats, ok: npt.NDArray[np.bool_]) -> list[Metric]:
    """Share of errors of balls flagged ok within their 95 % intervals, and their rms in standard deviations."""
    known = np.isfinite(off[ok]) & (sd[ok] > 0.0)
    off, sd = off[ok][known], sd[ok][known]
    if not len(off):
        return []
    rms = float(np.sqrt(np.mean((off / sd) ** 2)))
    return [*coverage(quantity, off, NORMAL_95 * sd), Metric(quantity, rms, Statistic.PULL_RMS)]


def _summary(errors: Floats) -> list[tuple[Statistic, float]]:
    if len(errors) == 0:
        return [(Statistic.MEDIAN, NAN), (Statistic.P95, NAN), (Statistic.MAX, NAN)]
    median, high = np.percentile(errors, [50.0, 95.0])
    return [(Statistic.MEDIAN, float(median)), (Statistic.P95, float(high)), (Statistic.MAX, float(errors.max()))]
