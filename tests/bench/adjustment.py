"""The adjustment's accuracy on bridges of D1's size: median and worst over seeds, and whether its intervals are honest.

    python -m tests.bench.adjustment --seeds 10 --cases 0:5,1:5,1:10,2:5,2:10 --output out.json [--jobs 2]
    python -m tests.bench.adjustment --seeds 10 --recipe arch-s1-rays --with asbuilt.dents=0 --output out.json

A case is sigma:spacing in mm. Perfect parts give key points, splicing and linear error; imperfect ones the gaps' error
against those that the same objective has on the truth. Splicing and linear error are those of the true key points and
edges at the poses found; as measured, key points' noise included, they are given too.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from designgen import recipe_files
from designgen.scenes.make import make
from processor.evaluation import preassembly as preassembly_evaluation
from processor.geometry import rigid
from processor.preassembly import step as preassembly_step
from processor.preassembly.ends.joint_frame import joint_frame

CHECKED = {
    "splicing mean": "splicing error of the true key points, mean",
    "splicing max": "splicing error of the true key points, max",
    "linear mean": "linear error of the true edges, mean",
    "linear max": "linear error of the true edges, max",
    "gap rms": "gaps against the truth's, rms",
    "gap cover": "gaps within their 95 % intervals",
    "key cover": "key points within their 95 % intervals",
}


def figures(recipe, settings, seed):
    """All figures of one bridge."""
    scene, truth = make("bench", recipe_files.overridden(recipe_files.load(recipe)[1], settings), seed)
    started = time.monotonic()
    result = preassembly_step.run(scene, preassembly_step.Params(seed=seed))
    found = {"seconds": time.monotonic() - started, "points": sum(len(scan.points) for scan in scene.scans)}
    checks = {metric.name: metric for metric in preassembly_evaluation.check(scene, result, truth)}
    found |= {name: checks[said].value if said in checks else float("nan") for name, said in CHECKED.items()}
    found["measured splicing mean"], found["measured linear mean"] = (
        result.splicing.mean,
        result.linear.assembled.error.mean,
    )
    found["not ok"] = sum(status != "ok" for status in result.components.status)
    found["wrong"] = checks["wrong poses called ok"].value
    off = key_point_errors(scene.arch, result, truth.arch)
    found["key s"] = float(np.sqrt(np.mean(off[:, 0] ** 2)))
    found["key uv"] = float(np.sqrt(np.mean(off[:, 1:] ** 2)))
    return found


def key_point_errors(design, result, truth):
    """Errors (n, 3) of all key points along the axes of their joints."""
    found = []
    frames = [joint_frame(points)[:3, :3] for points in design.joint_points]
    for i in range(len(result.components)):
        turn = truth.T_bridge_scan[i][:3, :3]
        for end, joint in enumerate((i - 1, i)):
            off = result.components.key_points_scan[i, end] - truth.key_points_scan[i, end]
            if 0 <= joint < len(frames) and np.isfinite(off).all():
                found.append(rigid.apply(rigid.transform(frames[joint].T @ turn, np.zeros(3)), off))
    return np.vstack(found)


def _job(task):
    recipe, settings, seed = task
    return figures(recipe, settings, seed)


def _case(bridge, kind, case):
    """What a row is of: its name, recipe and settings."""
    sigma, spacing = map(float, case.split(":"))
    recipe = f"arch-{bridge}" + ("-as-built" if kind == "imperfect" else "")
    row = {"kind": kind, "sigma_mm": sigma, "spacing_mm": spacing}
    return row, recipe, [f"scan.sigma_mm={sigma}", f"scan.spacing_mm={spacing}"]


def main():
    """Run, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", default="d1")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--cases", default="0:5,1:5,1:10,2:5,2:10")
    parser.add_argument("--kinds", default="perfect,imperfect")
    parser.add_argument("--recipe", help="instead of the cases, one row of this recipe")
    parser.add_argument("--with", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    cases = [
        _case(arguments.set, kind, case) for kind in arguments.kinds.split(",") for case in arguments.cases.split(",")
    ]
    if arguments.recipe:
        cases = [({"kind": arguments.recipe}, arguments.recipe, arguments.settings)]
    rows = []
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        for row, recipe, settings in cases:
            tasks = [(recipe, settings, seed) for seed in range(1, arguments.seeds + 1)]
            every = list(pool.map(_job, tasks))
            table = {name: [one[name] for one in every] for name in every[0]}
            row |= {"settings": settings, "all": table}
            row["median"] = {name: float(np.median(values)) for name, values in table.items()}
            row["worst"] = {name: float(np.max(values)) for name, values in table.items()}
            rows.append(row)
            said = "  ".join(f"{n} {row['median'][n]:.3f} ({row['worst'][n]:.3f})" for n in table if n != "points")
            print(f"{row['kind']} {' '.join(settings)}: {said}", flush=True)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
