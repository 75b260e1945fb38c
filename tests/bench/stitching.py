"""Stitching held against truth: errors over seeds, intervals, random starts, picked points with their propagation.

    python -m tests.bench.stitching --output out.json [--jobs 2]
    python -m tests.bench.stitching --parts seeds --seeds 10 --set scan.step_mrad=2.6 --output out.json
    python -m tests.bench.stitching --parts starts --starts 20 --output out.json
    python -m tests.bench.stitching --parts picks --draws 100 --output out.json

seeds: the recipe made anew with each seed, stitched by ``automatic``: largest error of station positions and rotations
after a datum fit, share of the poses' 95 % intervals that hold, flags, seconds of wall clock and of processors.
starts: every scan's frame turned and moved at random, on the first seed: how many come out right. picks: three common
points a pair with noise on every coordinate, on the stations of the first seed, by the paper's seven parameters and by
six: errors by what their propagation through the network lets expect; see :mod:`tests.bench.stitching_picks`.

Scans are thinner than the recipe's 1 M points (--set scan.step_mrad=2.6 has them as they are): errors grow with the
step, so that what holds here holds there.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from designgen import recipe_files
from designgen.scenes.make import make
from processor.evaluation import stitching as stitching_evaluation
from processor.model import NORMAL_95
from processor.stitching import step as stitching_step
from tests.bench import stitching_picks

PARTS = ("seeds", "starts", "picks")
RIGHT_MM = 5.0
STEP = "scan.step_mrad=5"
SHOWN = ("position_mm", "rotation_mrad", "within_95", "pull_rms", "wall_s", "cpu_s")


@functools.lru_cache(maxsize=1)
def made(recipe, settings, seed):
    """Scene and truth; kept, as the starts of a process all turn the same one."""
    name, found = recipe_files.load(recipe)
    return make(name, recipe_files.overridden(found, [f"seed={seed}", *settings]))


def measured(scene, truth, params):
    """Figures of one run of ``automatic``."""
    wall, cpu = time.monotonic(), time.process_time()
    result = stitching_step.run(scene, params)
    wall, cpu = time.monotonic() - wall, time.process_time() - cpu
    found = {metric.name: metric.value for metric in stitching_evaluation.check(scene, result, truth)}
    true = dict(zip(truth.stations.ids, truth.stations.T_project_station, strict=True))
    scans = result.scans
    rows = np.flatnonzero(scans.placed).tolist()
    pulls = stitching_evaluation.pulls_of(result, rows, np.stack([true[scans.name[i]] for i in rows]))
    return {
        "points": int(sum(len(scan.points) for scan in scene.scans)),
        "position_mm": found.get("station positions after datum fit, max", float("inf")),
        "rotation_mrad": found.get("rotations after datum fit, max", float("inf")),
        "stated_position_mm": float(np.nanmax(scans.position_sd)),
        "stated_rotation_mrad": float(1e3 * np.nanmax(scans.rotation_sd)),
        "components": len(pulls),
        "within_95": float((np.abs(pulls) < NORMAL_95).mean()) if len(pulls) else float("nan"),
        "pull_rms": float(np.sqrt(np.mean(pulls**2))) if len(pulls) else float("nan"),
        "flags": [s for s in scans.status if s != "ok"],
        "pairs_used": f"{int(result.pairs.used.sum())}/{len(result.pairs)}",
        "closure_mm": float(result.closures.mm.max()) if len(result.closures) else float("nan"),
        "wall_s": wall,
        "cpu_s": cpu,
    }


def turned(scene, truth, start):
    """Turn and move every scan's frame at random; truth follows."""
    rng = np.random.default_rng(start)
    scans, poses = [], []
    for scan, T in zip(scene.scans, truth.stations.T_project_station, strict=True):
        R, t = Rotation.random(random_state=rng).as_matrix(), rng.normal(0.0, 2e4, 3)
        scans.append(dataclasses.replace(scan, points=scan.points @ R.T, origin=t, position=t))
        D = np.eye(4)
        D[:3, :3], D[:3, 3] = R, t
        poses.append(T @ np.linalg.inv(D))
    stations = dataclasses.replace(truth.stations, T_project_station=np.array(poses))
    return dataclasses.replace(scene, scans=tuple(scans)), dataclasses.replace(truth, stations=stations)


def row(task):
    """Figures of one task (part, recipe, settings, seed, number)."""
    part, recipe, settings, seed, number = task
    scene, truth = made(recipe, settings, seed)
    if part == "seeds":
        return {"part": part, "seed": seed, **measured(scene, truth, stitching_step.Params())}
    if part == "starts":
        found = measured(*turned(scene, truth, number), stitching_step.Params())
        right = found["position_mm"] < RIGHT_MM and not found["flags"]
        wrong = found["position_mm"] >= RIGHT_MM and not found["flags"]
        return {"part": part, "start": number, "right": right, "wrong_without_flag": wrong, **found}
    return {"part": part, **stitching_picks.figures(scene, truth, number)}


def summary(rows, part):
    """Median and worst of a part's rows."""
    own = [one for one in rows if one["part"] == part]
    if not own:
        return {}
    if part == "picks":
        return stitching_picks.summary(own)
    values = {key: [one[key] for one in own] for key in SHOWN}
    found = {key: {"median": float(np.median(v)), "worst": float(np.max(v))} for key, v in values.items()}
    count = np.array([one["components"] for one in own], float)
    found["within_95"] = {
        "all": float((count * values["within_95"]).sum() / count.sum()),
        "least": min(values["within_95"]),
    }
    found["flagged"] = sum(bool(one["flags"]) for one in own)
    if part == "starts":
        found["right"] = f"{sum(one['right'] for one in own)} of {len(own)}"
        found["wrong without a flag"] = sum(one["wrong_without_flag"] for one in own)
    return found


def main() -> None:
    """Run the parts asked for; a line a row as it comes, a summary, and one JSON file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default=",".join(PARTS), help="of " + ", ".join(PARTS))
    parser.add_argument("--recipe", default="truss-bridge")
    parser.add_argument("--set", action="append", default=[], help=f"of the recipe; {STEP} where none is given")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--output", type=Path, required=True)
    asked = parser.parse_args()
    parts = asked.parts.split(",")
    if not set(parts) <= set(PARTS):
        parser.error(f"parts are of {', '.join(PARTS)}")
    settings = tuple(asked.set) or (STEP,)
    tasks = []
    if "seeds" in parts:
        tasks += [("seeds", asked.recipe, settings, seed, 0) for seed in range(1, asked.seeds + 1)]
    if "starts" in parts:
        tasks += [("starts", asked.recipe, settings, 1, start) for start in range(asked.starts)]
    if "picks" in parts:
        tasks += [("picks", asked.recipe, settings, 1, draw) for draw in range(asked.draws)]
    rows = []
    with ProcessPoolExecutor(asked.jobs, mp_context=get_context("spawn")) as pool:
        for found in pool.map(row, tasks):
            rows.append(found)
            print(json.dumps(found), flush=True)
    summaries = {part: summary(rows, part) for part in parts}
    print(json.dumps(summaries, indent=1))
    asked.output.parent.mkdir(parents=True, exist_ok=True)
    asked.output.write_text(json.dumps({"rows": rows, "summary": summaries}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
