"""The source papers' comparisons: preassembly methods on D1-D3, two estimators on 100 balls.

Median and worst over seeds, printed as a table and written as JSON:

    python -m tests.bench.paper_comparison --seeds 5 --sets D1,D2,D3 --sigmas 0,1 --spacing 5 --output bench.json
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path

import numpy as np

from designgen import recipe_files
from designgen.scenes.make import make
from processor.evaluation import preassembly as preassembly_evaluation
from processor.preassembly import step as preassembly_step
from processor.preassembly.baselines import methods as baselines_methods
from processor.preassembly.params import PAPER_METHODS
from processor.space_frame import step as space_frame_step

FIGURES = ("splicing mean", "splicing max", "linear mean", "linear max", "best-fit linear mean", "true linear mean")


def bridges(sets, seeds, sigmas, spacing, methods):
    """Figures of every method, set and sigma: (sets, sigmas, methods, seeds, figures)."""
    rows = []
    for name in sets:
        for sigma in sigmas:
            found = {method: [] for method in methods}
            for seed in seeds:
                settings = [f"scan.sigma_mm={float(sigma)}", f"scan.spacing_mm={float(spacing)}"]
                scene, truth = make(
                    name, recipe_files.overridden(recipe_files.load(f"arch-{name.lower()}")[1], settings), seed
                )
                started = time.monotonic()
                if set(methods) & set(PAPER_METHODS):
                    scans = [own[0] for own in preassembly_step.scans_in_order(scene, scene.arch)]
                    parts = baselines_methods.extract(scans, scene.arch, preassembly_step.Params(seed=seed))
                for method in methods:
                    params = preassembly_step.Params(method=method, seed=seed)
                    if method in PAPER_METHODS:
                        result = baselines_methods.assemble(parts, scene.arch, params)
                    else:
                        result = preassembly_step.run(scene, params)
                    checks = {metric.name: metric for metric in preassembly_evaluation.check(scene, result, truth)}
                    found[method].append(
                        [
                            *(value for error in result.errors[:2] for value in (error.mean, error.max)),
                            result.linear.best_fit.error.mean,
                            checks["linear error of the true edges, mean"].value,
                        ]
                    )
                    if result.status != "ok" or not checks["wrong poses called ok"].passed:
                        print(f"{name} seed {seed} {method}: {result.status} {result.components.status}", flush=True)
                print(f"{name} sigma {sigma} seed {seed}: {time.monotonic() - started:.0f} s", flush=True)
            for method, values in found.items():
                table = np.array(values)
                rows.append(
                    {
                        "set": name,
                        "sigma_mm": sigma,
                        "spacing_mm": spacing,
                        "method": method,
                        "seeds": len(table),
                        "median": dict(zip(FIGURES, np.median(table, axis=0).tolist(), strict=True)),
                        "worst": dict(zip(FIGURES, table.max(axis=0).tolist(), strict=True)),
                        "all": table.tolist(),
                    }
                )
                _print_row(rows[-1])
    return rows


def _print_row(row):
    figures = "  ".join(f"{row['median'][f]:8.2f} ({row['worst'][f]:.2f})" for f in FIGURES)
    print(f"{row['set']}  sigma {row['sigma_mm']}  {row['method']:<13} {figures}", flush=True)


def balls(seeds):
    """Radius errors of both estimators on 100 balls."""
    rows = []
    for method in space_frame_step.METHODS:
        errors = []
        for seed in seeds:
            scene, truth = make("balls-100", recipe_files.load("balls-100")[1], seed)
            result = space_frame_step.run(
                scene, dataclasses.replace(space_frame_step.Params(), method=method, seed=seed)
            )
            errors.append(np.abs(result.balls.radii - truth.frame.radii))
        quantiles = np.nanquantile(np.array(errors), [0.5, 0.95, 1.0], axis=1)
        rows.append(
            {
                "method": method,
                "seeds": len(errors),
                "not found": int(np.isnan(errors).sum()),
                "median |dr|": float(np.median(quantiles[0])),
                "95 % |dr|": float(np.median(quantiles[1])),
                "largest |dr|": float(quantiles[2].max()),
            }
        )
        print(rows[-1], flush=True)
    return rows


def main():
    """Run the comparisons that the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", default="S1", help="S1, D1, D2, D3, comma-separated")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--sigmas", default="0,1", help="mm, comma-separated")
    parser.add_argument("--spacing", type=float, default=5.0, help="mm")
    parser.add_argument("--methods", default=",".join(preassembly_step.METHODS), help="of preassembly, comma-separated")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    seeds = range(arguments.seeds)
    print("median (worst) over seeds, mm: " + ", ".join(FIGURES))
    found = {
        "balls": balls(seeds),
        "bridges": bridges(
            arguments.sets.split(","),
            seeds,
            [float(s) for s in arguments.sigmas.split(",")],
            arguments.spacing,
            arguments.methods.split(","),
        ),
    }
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
