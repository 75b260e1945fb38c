"""Defects found, by class, size and scanner: share found, false alarms, depth, class.

    python -m tests.bench.defects [--scanners phase,pulse,long-range] [--sizes 0.05,0.2,1] [--scenes 20] [--seed 1]
        [--jobs 2]

Every scene is a row of plates of 1 m with a defect of each class and one without, places drawn anew; ``--scenes`` is so
the number of defects of each class, size and scanner. A size multiplies depths, angles, the pieces lost, and the width
of cracks. Prints a table and the smallest size that was found in nine of ten, and writes JSON with ``--json``.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from designgen import recipe_files
from designgen.asbuilt import defects as asbuilt_defects
from designgen.scenes.make import make
from processor.defects import step as defects_step
from processor.evaluation import defects as evaluation_defects

FOUND = 0.9
CRACK_MM = 8.0  # width of a crack of size 1


def scene_of(scanner: str, size: float, seed: int, step_mrad: float = 0.8, stations: int = 5) -> tuple[Any, Any]:
    """Make a row of plates, one with a defect of each class and one undamaged; size 0: all are undamaged."""
    recipe = recipe_files.load("plates-defects")[1]
    if not size:
        recipe["structure"]["components"] = ["none"] * 12
    settings = [f"scan.scanner={scanner}", f"scan.step_mrad={step_mrad}", f"scan.stations={stations}"]
    if size:
        settings += [f"asbuilt.size={size}", f"asbuilt.crack_width_mm={CRACK_MM * size}"]
    recipe = recipe_files.overridden(recipe, settings)
    recipe["seed"] = seed
    return make(f"{scanner} {size:g}", recipe)


def run_one(scanner: str, size: float, seed: int) -> dict[str, Any]:
    """Run one scene and hold it against its truth."""
    scene, truth = scene_of(scanner, size, seed)
    started = time.monotonic()
    result = defects_step.run(scene, defects_step.Params())
    took = time.monotonic() - started
    found: dict[str, Any] = {
        "scanner": scanner, "size": size, "seed": seed, "seconds": took, "area_m2": result.examined_mm2 / 1e6,
        "points": result.points, "noise": result.noise,
    }  # fmt: skip
    if truth.defects is None or not len(truth.defects.ids):
        return {**found, "false": len(result.defects), "sure": int((~result.defects.doubtful).sum()), "rows": []}
    rows = evaluation_defects.matched(result.defects, truth.defects)
    error, allowed = evaluation_defects.depth_errors(result.defects, truth.defects, rows)
    other = ~np.isin(np.arange(len(result.defects)), rows)
    found["false"], found["sure"] = int(other.sum()), int((other & ~result.defects.doubtful).sum())
    found["rows"] = [
        {
            "class": kind,
            "found": bool(rows[k] >= 0),
            "doubtful": bool(rows[k] >= 0 and result.defects.doubtful[rows[k]]),
            "named": str(result.defects.defect_class[rows[k]]) if rows[k] >= 0 else "",
            "error": float(error[k]),
            "allowed": float(allowed[k]),
            "bound": bool(rows[k] >= 0 and result.defects.depth_is_bound[rows[k]]),
            "confidence": float(result.defects.confidence[rows[k]]) if rows[k] >= 0 else 0.0,
        }
        for k, kind in enumerate(truth.defects.classes)
    ]
    return found


def table(runs: list[dict[str, Any]]) -> str:
    """Sum up runs by scanner, class and size."""
    lines = []
    for scanner in dict.fromkeys(run["scanner"] for run in runs):
        own = [run for run in runs if run["scanner"] == scanner]
        area, false = sum(run["area_m2"] for run in own), sum(run["false"] for run in own)
        lines.append(
            f"{scanner}: {false} false alarms on {area:.0f} m2 examined = {100.0 * false / area:.2f} on 100 m2, "
            f"{sum(run['sure'] for run in own)} of them not called doubtful"
        )
        sizes = sorted({run["size"] for run in own if run["rows"]})
        heads = "".join(f"{f'size {size:g}':>28}" for size in sizes)
        lines.append(f"  {'class':14}{heads}   (found, class right, depth within 10 % or 2 LOD95)   smallest")
        for kind in asbuilt_defects.CLASSES:
            cells, smallest = [], ""
            for size in sizes:
                rows = [row for run in own if run["size"] == size for row in run["rows"] if row["class"] == kind]
                got = [row for row in rows if row["found"]]
                right = [row["named"] == kind for row in got]
                close = [abs(row["error"]) <= row["allowed"] for row in got if not row["bound"]]
                if not smallest and rows and len(got) >= FOUND * len(rows):
                    smallest = f"{size:g}"
                cells.append(f"{len(got)}/{len(rows)} {sum(right)}/{len(right)} {sum(close)}/{len(close)}")
            lines.append(f"  {kind:14}" + "".join(f"{cell:>28}" for cell in cells) + f"   {smallest or 'none'}")
    return "\n".join(lines)


def main() -> None:
    """Run the bench."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scanners", default="phase,pulse,long-range")
    parser.add_argument("--sizes", default="0.05,0.2,1")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    scenes = [
        (scanner, size, seed)
        for scanner in given.scanners.split(",")
        for size in map(float, given.sizes.split(","))
        for seed in range(given.seed, given.seed + given.scenes)
    ]
    runs = []
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        for run in pool.map(run_one, *zip(*scenes, strict=True)):
            runs.append(run)
            print(f"{run['scanner']} size {run['size']:g} seed {run['seed']}: {run['seconds']:.1f} s", flush=True)
            if given.json:
                given.json.write_text(json.dumps(runs), "utf-8")
    print(table(runs))
    by_chance = [(run["size"], row["doubtful"]) for run in runs for row in run["rows"] if row["found"]]
    for size in sorted({one for one, _ in by_chance}):
        own = [doubtful for one, doubtful in by_chance if one == size]
        print(f"size {size:g}: {sum(own)} of {len(own)} found called doubtful")
    unsure = [row for run in runs for row in run["rows"] if row["found"]]
    for low, high in ((0.0, 0.6), (0.6, 0.9), (0.9, 0.99), (0.99, 1.01)):
        own = [row["named"] == row["class"] for row in unsure if low <= row["confidence"] < high]
        if own:
            print(f"confidence {low:g} to {min(high, 1):g}: {np.mean(own):.2f} of {len(own)} right")


if __name__ == "__main__":
    main()
