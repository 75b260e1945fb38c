"""Figures of real cells over many seeds, kept in fixtures/ for the tests of the nights, which draw from them.

python -m tests.bench.stored_cells --seeds 24 --output fixtures/validation/stored-cells.json
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import math
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from designgen import recipe_files
from designgen.scenes.make import make
from processor import pipeline

FRAME = ("frame.nodes_x=4", "frame.nodes_y=4", "scan.spacing_mm=8")
CASES = (
    ("frame-small", (*FRAME, "scan.sigma_mm=1"), "spheres", ("ray", "ransac", "least-squares")),
    ("frame-small", (*FRAME, "scan.sigma_mm=2"), "spheres", ("ray", "ransac", "least-squares")),
    ("frame-small", (*FRAME, "scan.sigma_mm=3"), "spheres", ("ray", "ransac", "least-squares")),
    ("balls-100", ("frame.nodes_x=6", "frame.nodes_y=6"), "spheres", ("ransac", "least-squares")),
    ("arch-s1", ("scan.spacing_mm=20",), "preassemble", ("adjustment",)),
)


def figures(task):
    """Return all figures of one scene: rows of method, name, value and unit."""
    (recipe, settings, step, methods), seed = task
    scene, truth = make(recipe, recipe_files.overridden(recipe_files.load(recipe)[1], settings), seed)
    module = pipeline.step_modules()[step]
    check = importlib.import_module(f"processor.evaluation.{pipeline.package_of(step)}").check
    rows = []
    for method in methods:
        result = module.run(scene, dataclasses.replace(module.Params(), method=method))
        rows += [[method, m.name, m.value, m.unit] for m in check(scene, result, truth)]
    return rows


def rounded(value):
    """Keep six digits: no more are needed to draw from, and the file stays small."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


def main():
    """Make all cells and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--cases", default=",".join(map(str, range(len(CASES)))), help="numbers, comma-separated")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    cases = []
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        for case in (CASES[int(i)] for i in arguments.cases.split(",")):
            recipe, settings, step, _ = case
            every = list(pool.map(figures, [(case, seed) for seed in range(1, arguments.seeds + 1)]))
            table = {}
            for i, rows in enumerate(every):
                for method, name, value, unit in rows:
                    one = table.setdefault((method, name), {"method": method, "name": name, "unit": unit, "values": {}})
                    one["values"][i] = rounded(value)
            for one in table.values():
                one["values"] = [one["values"].get(i) for i in range(len(every))]
            cases.append({"recipe": recipe, "settings": settings, "step": step, "figures": list(table.values())})
            print(f"{recipe} {' '.join(settings)}: {len(every)} seeds, {len(table)} figures", flush=True)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    text = ",\n".join(json.dumps(case, ensure_ascii=False) for case in cases)
    arguments.output.write_text(f'{{"seeds": {arguments.seeds}, "cases": [\n{text}\n]}}\n', encoding="utf-8")


if __name__ == "__main__":
    main()
