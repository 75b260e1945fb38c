"""Stitching held against truth over seeds, with random frames of the scans, its covariance's bound, and its time.

    python -m tests.bench.stitching [--recipe truss-bridge] [--seeds 1 2 3] [--set scan.step_mrad=6] [--turned 20]

For each seed: largest error of station positions (mm) and rotations (mrad) after a datum fit, against the largest that
the stated covariance lets expect (one standard deviation), share of the 95 % intervals that hold, flags, seconds of
wall clock and of processors. The covariance of a least-squares adjustment at the truth is the Cramer-Rao bound of its
model: an error well above it is a fault of the method, one near it is what the scans can tell. ``--turned N`` turns
and moves every scan's frame at random, N times on the first seed, and counts the right answers.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time

import numpy as np
from scipy.spatial.transform import Rotation

from designgen import recipes
from designgen.scene import make
from processor.steps import stitch
from processor.stitching import against_truth

RIGHT_MM = 5.0


def measured(scene, truth, params):
    """One run's figures."""
    wall, cpu = time.monotonic(), time.process_time()
    result = stitch.run(scene, params)
    wall, cpu = time.monotonic() - wall, time.process_time() - cpu
    found = {metric.name: metric.value for metric in stitch.check(scene, result, truth)}
    true = dict(zip(truth.stations.ids, truth.stations.T_project_station, strict=True))
    rows = [i for i, name in enumerate(result.scans) if np.isfinite(result.T_project_scan[i]).all()]
    pulls = against_truth.pulls_of(result, rows, np.stack([true[result.scans[i]] for i in rows]))
    return {
        "points": int(sum(len(scan.points) for scan in scene.scans)),
        "position_mm": found.get("station positions after datum fit, max"),
        "rotation_mrad": found.get("rotations after datum fit, max"),
        "bound_position_mm": float(np.nanmax(result.position_sd)),
        "bound_rotation_mrad": float(1e3 * np.nanmax(result.rotation_sd)),
        "within_95": float((np.abs(pulls) < 1.96).mean()) if len(pulls) else float("nan"),
        "pull_rms": float(np.sqrt(np.mean(pulls**2))) if len(pulls) else float("nan"),
        "flags": [s for s in result.scan_status if s != "ok"],
        "pairs_used": f"{int(result.used.sum())}/{len(result.used)}",
        "closure_mm": float(result.closure_mm.max()) if len(result.closure_mm) else float("nan"),
        "wall_s": wall,
        "cpu_s": cpu,
    }


def turned(scene, truth, seed):
    """Turn and move every scan's frame at random; truth follows."""
    rng = np.random.default_rng(seed)
    scans, poses = [], []
    for scan, T in zip(scene.scans, truth.stations.T_project_station, strict=True):
        R, t = Rotation.random(random_state=rng).as_matrix(), rng.normal(0.0, 2e4, 3)
        scans.append(dataclasses.replace(scan, points=scan.points @ R.T, origin=t, position=t))
        D = np.eye(4)
        D[:3, :3], D[:3, 3] = R, t
        poses.append(T @ np.linalg.inv(D))
    stations = dataclasses.replace(truth.stations, T_project_station=np.array(poses))
    return dataclasses.replace(scene, scans=tuple(scans)), dataclasses.replace(truth, stations=stations)


def main() -> None:
    """Run and print a table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", default="truss-bridge")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--turned", type=int, default=0)
    asked = parser.parse_args()
    rows = []
    for seed in asked.seeds:
        name, recipe = recipes.load(asked.recipe)
        recipe = recipes.overridden(recipe, [f"seed={seed}", *asked.set])
        scene, truth = make(name, recipe)
        rows.append({"seed": seed, **measured(scene, truth, stitch.Params())})
        print(json.dumps(rows[-1]), flush=True)
        if seed == asked.seeds[0] and asked.turned:
            found = [measured(*turned(scene, truth, k), stitch.Params()) for k in range(asked.turned)]
            right = sum(one["position_mm"] < RIGHT_MM and not one["flags"] for one in found)
            wrong = sum(one["position_mm"] >= RIGHT_MM and not one["flags"] for one in found)
            worst = max(one["position_mm"] for one in found)
            print(
                f"turned: {right} of {len(found)} right, {wrong} wrong without a flag, worst {worst:.3f} mm", flush=True
            )
    for key in ("position_mm", "rotation_mrad", "bound_position_mm", "within_95", "pull_rms", "wall_s", "cpu_s"):
        values = [row[key] for row in rows]
        print(f"{key:>20}: median {np.median(values):.4g}, worst {np.max(values):.4g}, least {np.min(values):.4g}")
    sys.exit(0)


if __name__ == "__main__":
    main()
