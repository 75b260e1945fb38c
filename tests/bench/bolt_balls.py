"""Bolt balls in ray-cast frames: accuracy, honesty of the intervals and speed, median and worst over seeds.

    python -m tests.bench.bolt_balls --cases small,registration --seeds 10 --output out.json
    python -m tests.bench.bolt_balls --cases frame-1040 --seeds 1 --output out.json

A case is a recipe with settings; every scene is taken blind and with its design. Pulls are errors by stated standard
deviation, rms over all seeds: one scene with badly registered stations is a single draw of what they have in common.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from designgen import recipe_files
from designgen.scenes.make import make
from processor.space_frame import step as space_frame_step
from processor.space_frame.result import Flag

ROOF = ["frame.nodes_x=6", "frame.nodes_y=6", "scan.stations=[2,3]", "scan.clutter=8"]
CASES = {
    "frame-1040": ("frame-1040", []),
    "phase-1040": ("frame-1040-phase", []),
    "small": ("frame-1040", ROOF),
    "registration": ("frame-1040", [*ROOF, "scan.registration_mm=2.0", "scan.registration_mrad=0.05"]),
    "bow": ("frame-1040", [*ROOF, "asbuilt.bow_share=0.001"]),
    "phase": ("frame-1040-phase", ROOF),
    "as-built": ("frame-as-built", []),
    "tubes-114": ("frame-1040", [*ROOF, "frame.tube_diameter_mm=114.0", "frame.radii_mm=[80.0,90.0,100.0]"]),
    "shifted": ("frame-1040", [*ROOF, "frame.radii_mm=[47.0,52.0,63.0,74.0]"]),
    "no-catalogue": ("frame-1040", ROOF),
}
PARAMS = {"shifted": {"radii_mm": (47.0, 52.0, 63.0, 74.0)}, "no-catalogue": {"catalogue": "none"}}


def scene_of(case, seed, settings=()):
    """The scene and truth of a case."""
    recipe, own = CASES[case]
    return make(case, recipe_files.overridden(recipe_files.load(recipe)[1], [*own, *settings]), seed)


def errors(scene, result, truth):
    """Errors of all nodes of a result against the nearest true one, and what was said of them."""
    found = ~result.balls.flagged(Flag.NOT_FOUND) & result.balls.placed
    distance, nearest = cKDTree(truth.centres).query(result.balls.centres[found])
    back = cKDTree(result.balls.centres[found]).query(truth.centres)[0]
    sd = np.sqrt(np.einsum("kii->ki", result.balls.covariance[found]))
    return {
        "recall": back < 3.0,
        "precision": distance < 30.0,
        "centre": result.balls.centres[found] - truth.centres[nearest],
        "centre sd": sd[:, :3],
        "radius": result.balls.radii[found] - truth.radii[nearest],
        "radius sd": sd[:, 3],
        "lowest": result.balls.lowest[found, 2] - truth.lowest[nearest, 2],
        "lowest sd": result.balls.lowest_sd[found],
        "ok": result.balls.flagged(Flag.OK)[found],
        "size": np.abs(result.balls.sizes[found] - truth.radii[nearest]) < 2.5,
    }


def figures(every):
    """Figures of one case over its seeds."""
    joined = {name: np.concatenate([one[name] for one in every]) for name in every[0]}
    ok = joined["ok"]
    centre = np.linalg.norm(joined["centre"], axis=1)

    def of(values, share):
        return float(np.nanpercentile(np.abs(values), share))

    def pull(name):
        values = joined[name][ok] / joined[f"{name} sd"][ok]
        return float(np.sqrt(np.nanmean(values**2)))

    return {
        "seeds": len(every),
        "nodes": len(joined["recall"]),
        "recall": float(joined["recall"].mean()),
        "precision": float(joined["precision"].mean()),
        "unflagged": float(ok.mean()),
        "centre median": of(centre, 50),
        "centre p95": of(centre, 95),
        "centre median, worst seed": max(float(np.median(np.linalg.norm(one["centre"], axis=1))) for one in every),
        "lowest median": of(joined["lowest"][ok], 50),
        "lowest p95": of(joined["lowest"][ok], 95),
        "lowest max": of(joined["lowest"][ok], 100),
        "right size": float(joined["size"][ok].mean()),
        "pull centre": pull("centre"),
        "pull radius": pull("radius"),
        "pull lowest": pull("lowest"),
        "seconds": float(np.median([one["seconds"][0] for one in every])),
    }


def measured(case, seeds, with_design, settings=()):
    """Figures of one case, blind or with its design."""
    every = []
    params = dataclasses.replace(space_frame_step.Params(), **PARAMS.get(case, {}))
    for seed in seeds:
        scene, truth = scene_of(case, seed, settings)
        scene = scene if with_design else dataclasses.replace(scene, frame=None)
        started = time.monotonic()
        result = space_frame_step.run(scene, params)
        every.append({**errors(scene, result, truth.frame), "seconds": np.array([time.monotonic() - started])})
    return figures(every)


def main():
    """Run the cases, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(name for name in CASES if "1040" not in name))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    found = {}
    for case in arguments.cases.split(","):
        for with_design in (False, True):
            name = f"{case}, {'with design' if with_design else 'blind'}"
            found[name] = measured(case, range(1, arguments.seeds + 1), with_design)
            print(name, "  ".join(f"{k} {v:.3f}" for k, v in found[name].items()), flush=True)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
