"""Stitching held against the stations' true poses, after a datum fit."""

from __future__ import annotations

import numpy as np

from processor.geometry import rigid
from processor.model import NORMAL_95, Floats, Metric, Scene, Statistic, Truth
from processor.stitching import frames
from processor.stitching.result import Result

POSITION_MM, ROTATION_MRAD = 0.5, 0.02
WRONG_MM = 50.0
AFTER_FIT = "station positions after datum fit"
WRONG_BUT_OK = f"scans called ok, over {WRONG_MM:g} mm off"
LEAST_SURE = 3  # scans without a flag that hold the datum alone
NAN = float("nan")


def datum(T: Floats, true: Floats) -> Floats:
    """Motion (4, 4) of poses T (k, 4, 4) that brings them closest to the true ones: positions and attitudes weighed.

    A turn counts by how far it moves a point at the stations' mean distance from their middle.
    """
    middle = T[:, :3, 3].mean(axis=0)
    reach = max(float(np.sqrt(((T[:, :3, 3] - middle) ** 2).sum(axis=1).mean())), 1000.0)
    M = np.eye(4)
    own = np.vstack([(one[:3, 3] + reach * np.vstack([axis, -axis])) for one in T for axis in one[:3, :3].T])
    target = np.vstack([(one[:3, 3] + reach * np.vstack([axis, -axis])) for one in true for axis in one[:3, :3].T])
    M = rigid.fit(own, target)
    return M


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Compare poses with the stations' of the truth; the limits are those asked of scans with 2 mm of noise."""
    if truth.stations is None:
        return []
    known = dict(zip(truth.stations.ids, truth.stations.T_project_station, strict=True))
    rows = [i for i, name in enumerate(result.scans) if name in known and np.isfinite(result.T_project_scan[i]).all()]
    failed = sum(not np.isfinite(T).all() for T in result.T_project_scan)
    metrics = [Metric("stitch", "scans not placed", float(failed), Statistic.COUNT)]
    if len(rows) < 2:
        return metrics
    T = result.T_project_scan[rows]
    true = np.stack([known[result.scans[i]] for i in rows])
    sure = np.array([result.scan_status[i] == "ok" for i in rows])
    # A scan that is rightly called weak may be centimetres off: it must not pull the good ones away from the truth.
    fit = sure if sure.sum() >= LEAST_SURE else np.ones(len(rows), bool)
    fitted = datum(T[fit], true[fit]) @ T
    off = np.linalg.norm(fitted[:, :3, 3] - true[:, :3, 3], axis=1)
    turn = 1e3 * np.array([rigid.rotation_angle(a[:3, :3] @ b[:3, :3].T) for a, b in zip(fitted, true, strict=True)])
    # What picks by hand allow is no limit of the software's.
    position, rotation = (NAN, NAN) if result.method == "three-point" else (POSITION_MM, ROTATION_MRAD)
    metrics += [
        Metric("stitch", AFTER_FIT, float(off.max()), Statistic.MAX, unit="mm", limit=position),
        Metric("stitch", AFTER_FIT, float(np.sqrt((off**2).mean())), Statistic.RMS, unit="mm"),
        Metric("stitch", "rotations after datum fit", float(turn.max()), Statistic.MAX, unit="mrad", limit=rotation),
        Metric("stitch", WRONG_BUT_OK, float((off[sure] > WRONG_MM).sum()), Statistic.COUNT, limit=0.0),
    ]
    if result.by_control:
        apart = float(np.linalg.norm(T[:, :3, 3] - true[:, :3, 3], axis=1)[fit].max())
        metrics.append(Metric("stitch", "station positions by control points", apart, Statistic.MAX, unit="mm"))
    pulls = pulls_of(result, rows, true)
    if len(pulls):
        share = 100.0 * float((np.abs(pulls) < NORMAL_95).mean())
        metrics.append(Metric("stitch", "pose components", share, Statistic.COVERAGE, unit="%"))
    return metrics


def pulls_of(result: Result, rows: list[int], true: Floats) -> Floats:
    """Errors by standard deviations (m,) of poses: relative to the reference which holds the datum, or by control."""
    held, M = -1, np.eye(4)
    if not result.by_control:
        if result.reference not in [result.scans[i] for i in rows]:
            return np.empty(0)
        held = result.scans.index(result.reference)
        M = result.T_project_scan[held] @ rigid.invert(true[rows.index(held)])
    found = []
    for one, i in zip(true, rows, strict=True):
        if i == held or not np.isfinite(result.position_sd[i]).all():
            continue
        at = M @ one
        place = result.position[i]
        scan_place = rigid.apply(rigid.invert(result.T_project_scan[i]), place)
        d = frames.difference(result.T_project_scan[i], at)
        shift = place - rigid.apply(at, scan_place)
        found.append(np.concatenate([shift / result.position_sd[i], d[:3] / result.rotation_sd[i]]))
    return np.concatenate(found) if found else np.empty(0)
