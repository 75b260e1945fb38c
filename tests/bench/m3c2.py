"""M3C2 beside py4dgeo, the fastest peer, on the same two clouds in the same run; exactness against brute force.

    python -m tests.bench.m3c2 --output out.json

1 M + 1 M points, every tenth of the first a core point, normal diameter 110 mm, projection diameter 55 mm. Both build
their index of the clouds, fit normals and measure distances; compiled code is warm, threads equal, rounds in turn.
With --upright the surface stands on edge: no normal has a side that up tells, and processor looks for one.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from pathlib import Path

import numpy as np

from processor.geometry import m3c2, nearest_neighbours, normal_orientation
from tests.support.clouds.m3c2_clouds import brute

NORMAL_MM, PROJECTION_MM, DEPTH_MM = 110.0, 55.0, 100.0


def cloud(count, off, seed):
    """A wavy surface of 10 x 10 m with 2 mm of noise."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, 10_000.0, (2, count))
    return np.column_stack([x, y, 200.0 * np.sin(x / 900.0) * np.cos(y / 700.0) + off + rng.normal(0.0, 2.0, count)])


def ours(first, second, core, threads):
    """Seconds by stage, and the answer."""
    marks = [time.perf_counter()]
    grids = m3c2.grid(first, PROJECTION_MM), m3c2.grid(second, PROJECTION_MM)
    marks.append(time.perf_counter())
    normals = normal_orientation.turned(m3c2.normals(grids[0], core, NORMAL_MM, threads), core, NORMAL_MM).normals
    marks.append(time.perf_counter())
    found = m3c2.distances(
        *grids, core, normals, projection_diameter_mm=PROJECTION_MM, max_depth_mm=DEPTH_MM, threads=threads
    )
    marks.append(time.perf_counter())
    return np.diff(marks), normals, found.distance


def theirs(first, second, core, threads):
    """Seconds by stage, and the answer."""
    import py4dgeo

    py4dgeo.set_num_threads(threads)
    epochs = py4dgeo.Epoch(first), py4dgeo.Epoch(second)
    marks = [time.perf_counter()]
    for epoch in epochs:
        epoch.build_kdtree()
    marks.append(time.perf_counter())
    run = py4dgeo.M3C2(
        epochs=epochs, corepoints=core, cyl_radius=0.5 * PROJECTION_MM, normal_radii=[0.5 * NORMAL_MM],
        max_distance=DEPTH_MM,
    )  # fmt: skip
    normals = run.directions()
    marks.append(time.perf_counter())
    distance = run.calculate_distances(*epochs)[0]
    marks.append(time.perf_counter())
    return np.diff(marks), normals, distance


def main() -> None:
    """Run the comparison."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--points", type=int, default=1_000_000)
    arguments.add_argument("--rounds", type=int, default=3)
    arguments.add_argument("--upright", action="store_true")
    arguments.add_argument("--output", type=Path)
    given = arguments.parse_args()
    threads = len(os.sched_getaffinity(0))
    first, second = cloud(given.points, 0.0, 1), cloud(given.points, 5.0, 2)
    if given.upright:
        first, second = (np.ascontiguousarray(one[:, [0, 2, 1]]) for one in (first, second))
    core = first[::10].copy()
    peers = {"processor": ours, "py4dgeo": theirs}
    try:
        import py4dgeo  # noqa: F401
    except ImportError:
        peers.pop("py4dgeo")
        print("py4dgeo is not installed: left out (pip install steel-scan-check[bench])")
    ours(first[:10_000], second[:10_000], core[:100], threads)  # compiled
    times = {name: [] for name in peers}
    answers = {}
    for _ in range(given.rounds):
        for name, peer in peers.items():
            seconds, *answers[name] = peer(first, second, core, threads)
            times[name].append([*seconds, sum(seconds)])
    rows = np.random.default_rng(3).choice(len(core), 200, replace=False)
    report = {"points": given.points, "core_points": len(core), "threads": threads, "rounds": given.rounds}
    for name, (normals, distance) in answers.items():
        exact = brute(first, second, core[rows], np.asarray(normals)[rows], PROJECTION_MM, DEPTH_MM, 0.0)[0]
        stages = [statistics.median(one) for one in zip(*times[name], strict=True)]
        error = float(np.nanmax(np.abs(np.asarray(distance)[rows] - exact)))
        report[name] = dict(zip(("index", "normals", "distances", "total"), stages, strict=True)) | {"error": error}
        print(f"{name:10s} " + " ".join(f"{k} {v:9.3g}" for k, v in report[name].items()))
    if "py4dgeo" in peers:
        ratios = [a[-1] / b[-1] for a, b in zip(times["py4dgeo"], times["processor"], strict=True)]
        report["ratio"] = {"median": statistics.median(ratios), "least": min(ratios)}
        print(f"faster by {report['ratio']['median']:.2f} (least of {given.rounds} rounds {min(ratios):.2f})")
    grid_seconds = time.perf_counter()
    grid = nearest_neighbours.of_spacing(first)
    nearest_neighbours.statistical_inliers(grid, 20, 1.0)
    report["outlier_removal"] = {"processor": time.perf_counter() - grid_seconds}
    report["outlier_removal"]["tree, leaf order"] = leaf_order(first, threads)
    print("outlier removal, K = 20: " + ", ".join(f"{k} {v:.2f} s" for k, v in report["outlier_removal"].items()))
    if given.output:
        given.output.parent.mkdir(parents=True, exist_ok=True)
        given.output.write_text(json.dumps(report, indent=1) + "\n")


def leaf_order(points, threads):
    """Seconds of the same by SciPy's tree, queried in the order of its leaves."""
    from scipy.spatial import cKDTree

    started = time.perf_counter()
    tree = cKDTree(points)
    mean = tree.query(points[tree.indices], k=21, workers=threads)[0][:, 1:].mean(axis=1)
    np.count_nonzero(mean <= mean.mean() + mean.std())
    return time.perf_counter() - started


if __name__ == "__main__":
    main()
