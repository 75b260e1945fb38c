"""Poses of stitched scans compared with the stations' true poses, after a datum fit."""

from __future__ import annotations

import numpy as np

from processor.evaluation.error_statistics import covered_pulls, pose_pulls
from processor.geometry import rigid
from processor.model import Floats, Metric, Scene, StationTruth, Statistic, Status, Truth
from processor.stitching import poses_with_scale
from processor.stitching.result import Result

POSITION_MM, ROTATION_MRAD = 0.5, 0.02  # required of automatic stitching
WRONG_MM = 50.0  # a hundred times the limit of a position: another pose was taken, no error of a fit is as large
AFTER_FIT = "station positions after datum fit"
WRONG_BUT_OK = f"scans called ok, over {WRONG_MM:g} mm off"
LEAST_OK = 3  # scans without a flag that determine the datum alone
NAN = float("nan")


def datum(T: Floats, true: Floats) -> Floats:
    """Return the motion (4, 4) of poses T (k, 4, 4) that brings them closest to the true ones, by least squares.

    A rotation is weighted by the displacement that it causes at the stations' mean distance from their centroid.
    """
    centroid = T[:, :3, 3].mean(axis=0)
    reach = max(float(np.sqrt(((T[:, :3, 3] - centroid) ** 2).sum(axis=1).mean())), 1000.0)
    return rigid.fit(_axis_ends(T, reach), _axis_ends(true, reach))


def _axis_ends(T: Floats, reach: float) -> Floats:
    """Return points (6k, 3) at ``reach`` along the axes of poses T (k, 4, 4), to both sides."""
    return np.vstack([pose[:3, 3] + reach * np.vstack([axis, -axis]) for pose in T for axis in pose[:3, :3].T])


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Compare poses with the stations' of the truth; the limits are those required of scans with 2 mm of noise."""
    if truth.stations is None:
        return []
    scans = result.scans
    known = dict(zip(truth.stations.ids, true_poses(truth.stations), strict=True))
    rows = [i for i, name in enumerate(scans.name) if name in known and scans.placed[i]]
    metrics = [Metric("scans not placed", float((~scans.placed).sum()), Statistic.COUNT)]
    if len(rows) < 2:
        return metrics
    T = scans.T_project_scan[rows]
    true = np.stack([known[scans.name[i]] for i in rows])
    ok = np.array([scans.status[i] == Status.OK for i in rows])
    # A scan that is rightly called weak may be centimetres off: it must not affect the datum.
    fit = ok if ok.sum() >= LEAST_OK else np.ones(len(rows), bool)
    fitted = datum(T[fit], true[fit]) @ T
    off = np.linalg.norm(fitted[:, :3, 3] - true[:, :3, 3], axis=1)
    turn = 1e3 * np.array(
        [rigid.rotation_angle(poses_with_scale.rotation_of(a) @ b[:3, :3].T) for a, b in zip(fitted, true, strict=True)]
    )
    # The accuracy of points picked by hand is no limit of the software.
    position, rotation = (NAN, NAN) if result.method == "three-point" else (POSITION_MM, ROTATION_MRAD)
    metrics += [
        Metric(AFTER_FIT, float(off.max()), Statistic.MAX, unit="mm", limit=position),
        Metric(AFTER_FIT, float(np.sqrt((off**2).mean())), Statistic.RMS, unit="mm"),
        Metric("rotations after datum fit", float(turn.max()), Statistic.MAX, unit="mrad", limit=rotation),
        Metric(WRONG_BUT_OK, float((off[ok] > WRONG_MM).sum()), Statistic.COUNT, limit=0.0),
    ]
    if result.by_control:
        error = float(np.linalg.norm(T[:, :3, 3] - true[:, :3, 3], axis=1)[fit].max())
        metrics.append(Metric("station positions by control points", error, Statistic.MAX, unit="mm"))
    return [
        *metrics,
        *covered_pulls("pose components", pulls_of(result, rows, true)),
        *covered_pulls("poses of pairs", _pulls_of_pairs(result, known)),
        *covered_pulls("scales", _pulls_of_scales(result, truth.stations)),
    ]


def true_poses(truth: StationTruth) -> Floats:
    """Return the poses (k, 4, 4) that bring the stations' points to where they were: without the tilts of the scans.

    A scan whose points are all turned by a tilt of its scanner has its frame turned back: no registration by points
    can tell the two apart.
    """
    tilt = truth.tilt if len(truth.tilt) else np.zeros((len(truth.ids), 2))
    back = [rigid.transform(rigid.rotation_from_vector(-np.append(row, 0.0)), np.zeros(3)) for row in tilt]
    return truth.T_project_station @ np.reshape(back, (-1, 4, 4))


def _pulls_of_scales(result: Result, truth: StationTruth) -> Floats:
    """Return errors by standard deviations (m,) of the scales of the pairs, of stations with scales of their own."""
    ppm = truth.scale_ppm if len(truth.scale_ppm) else np.zeros(len(truth.ids))
    scale = dict(zip(truth.ids, 1.0 + 1e-6 * ppm, strict=True))
    pairs = result.pairs
    if not (np.isfinite(pairs.scale) & (pairs.scale_sd > 0.0)).any():
        return np.empty(0)
    true = np.array([scale.get(a, NAN) / scale.get(b, NAN) for a, b in zip(pairs.a, pairs.b, strict=True)])
    return np.asarray((pairs.scale - true) / np.where(pairs.scale_sd > 0.0, pairs.scale_sd, NAN))


def _pulls_of_pairs(result: Result, known: dict[str, Floats]) -> Floats:
    """Return errors by standard deviations (m,) of the poses of the pairs that were used."""
    pulls, pairs = [], result.pairs
    for i, (a, b) in enumerate(zip(pairs.a, pairs.b, strict=True)):
        if pairs.used[i] and a in known and b in known and np.isfinite(pairs.covariance[i]).all():
            pulls.append(pose_pulls(pairs.T_a_b[i], rigid.invert(known[a]) @ known[b], pairs.covariance[i]))
    return np.concatenate(pulls) if pulls else np.empty(0)


def pulls_of(result: Result, rows: list[int], true: Floats) -> Floats:
    """Return errors by standard deviations (m,) of poses: relative to the reference scan, or by control points."""
    scans, reference, M = result.scans, -1, np.eye(4)
    if not result.by_control:
        reference = scans.name.index(result.reference)
        if reference not in rows:
            return np.empty(0)
        M = scans.T_project_scan[reference] @ rigid.invert(true[rows.index(reference)])
    pulls = []
    for true_pose, i in zip(true, rows, strict=True):
        if i == reference or not np.isfinite(scans.position_sd[i]).all():
            continue
        expected = M @ true_pose
        position = scans.position[i]
        in_scan = rigid.apply(poses_with_scale.invert(scans.T_project_scan[i]), position)
        rotation = poses_with_scale.difference(scans.T_project_scan[i], expected)[:3]
        shift = position - rigid.apply(expected, in_scan)
        pulls.append(np.concatenate([shift / scans.position_sd[i], rotation / scans.rotation_sd[i]]))
    return np.concatenate(pulls) if pulls else np.empty(0)
