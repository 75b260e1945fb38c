"""Picked points with noise on the stations of a scene, and what its propagation through the network lets expect.

The propagation is the linear least-squares one of all picks at once, written here anew: unknown are the poses, with
seven parameters a scale a pair too.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from designgen.scanning import picking
from processor.stitching import step as stitching_step

NOISE_MM = 5.0
POINTS = 3  # as in the paper


def picked(scene, truth, draw):
    """Scene with noisy picks, true poses (k, 4, 4), and the places picked (p, POINTS, 3) with their pairs."""
    known = dict(zip(truth.stations.ids, truth.stations.T_project_station, strict=True))
    T = np.stack([known[scan.name] for scan in scene.scans])
    picks, places = picking.pick(scene.scans, T, picking.Params(POINTS, NOISE_MM), draw)
    row = {scan.name: k for k, scan in enumerate(scene.scans)}
    pairs = [(row[a], row[b]) for a, b in zip(picks.scan_a[::POINTS], picks.scan_b[::POINTS], strict=True)]
    return dataclasses.replace(scene, picks=picks), T, pairs, places.reshape(-1, POINTS, 3)


def expected(T, pairs, places, scale_free):
    """Covariance (k, 6, 6) of poses relative to the first: turns about the station, and its shift; project axes."""
    k = len(T)
    rows = 3 * sum(len(x) for x in places)
    J = np.zeros((rows, 6 * k + len(pairs)))
    at = 0
    for number, ((a, b), x) in enumerate(zip(pairs, places, strict=True)):
        for p in x:
            for s, sign in ((a, -1.0), (b, 1.0)):
                q = p - T[s][:3, 3]
                J[at : at + 3, 6 * s : 6 * s + 3] = sign * np.array(
                    [[0, q[2], -q[1]], [-q[2], 0, q[0]], [q[1], -q[0], 0]]
                )
                J[at : at + 3, 6 * s + 3 : 6 * s + 6] = sign * np.eye(3)
            J[at : at + 3, 6 * k + number] = p - T[b][:3, 3]
            at += 3
    J = J[:, 6:] if scale_free else J[:, 6 : 6 * k]
    unit = np.sqrt((J**2).sum(axis=0))
    C = 2.0 * NOISE_MM**2 * np.linalg.inv((J / unit).T @ (J / unit)) / unit[:, None] / unit[None]
    found = np.zeros((k, 6, 6))
    for s in range(1, k):
        found[s] = C[6 * s - 6 : 6 * s, 6 * s - 6 : 6 * s]
    return found


def figures(scene, truth, draw):
    """Errors of one draw of picks by both forms, by what is expected, and the share of intervals that hold."""
    scene, T, pairs, places = picked(scene, truth, draw)
    found = {"draw": draw}
    for name, scale in (("six", "fixed"), ("seven", "free")):
        result = stitching_step.run(
            scene, stitching_step.Params(method="three-point", scale=scale, weak_mm=1e3, weak_mrad=1e2)
        )
        base = result.scans.T_project_scan[0] @ np.linalg.inv(T[0])
        C = expected(base @ T, pairs, places, scale == "free")
        shift, ratio, pull = [], [], []
        for s in range(1, len(T)):
            want = base @ T[s]
            own = np.linalg.inv(result.scans.T_project_scan[s])
            place = own[:3, :3] @ result.scans.position[s] + own[:3, 3]
            d = result.scans.position[s] - (want[:3, :3] @ place + want[:3, 3])
            station = result.scans.T_project_scan[s][:3, 3] - want[:3, 3]
            shift.append(np.linalg.norm(station))
            ratio.append(station / np.sqrt(np.diag(C[s])[3:]))
            pull.append(d / result.scans.position_sd[s])
        found[name] = {
            "position_mm": float(max(shift)),
            "expected_mm": float(np.sqrt(max(np.trace(one[3:, 3:]) for one in C))),
            "by_expected": float(np.sqrt(np.mean(np.square(ratio)))),
            "within_95": float((np.abs(pull) < 1.96).mean()),
            "not_placed": int((~result.scans.placed).sum()),
        }
    return found


def summary(rows):
    """Median and worst of the draws, for both forms."""
    found = {}
    for name in ("six", "seven"):
        own = [one[name] for one in rows]
        found[name] = {
            "position_mm": {
                "median": float(np.median([o["position_mm"] for o in own])),
                "worst": max(o["position_mm"] for o in own),
            },
            "expected_mm": {"median": float(np.median([o["expected_mm"] for o in own]))},
            "rms error by expected": float(np.sqrt(np.mean([o["by_expected"] ** 2 for o in own]))),
            "within_95": float(np.mean([o["within_95"] for o in own])),
        }
    return found
