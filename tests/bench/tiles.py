"""One scene on a Dask cluster: step deviation of a large cloud on one worker and on two, a processor each.

    python -m tests.bench.tiles --output out.json

5 M points of a box girder of 30 m. Workers have one thread and a processor of their own (taskset), as if each were a
machine; scheduler and client share the processors with them. Rounds in turn; kernels are compiled beforehand. The
results of all runs are compared.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from contextlib import ExitStack
from pathlib import Path
from statistics import median

import numpy as np
import trimesh

import processor
from processor.model import Scan, Scene, StructureDesign
from processor.store import store
from tests.support.dask_cluster import cluster_in


def scene(count: int) -> Scene:
    """Return a girder of plates with 1 mm of noise, seen from two stations, a third of it moved by 3 mm."""
    parts = [
        trimesh.creation.box((30_000.0, 20.0, 2_000.0), trimesh.transformations.translation_matrix((0.0, y, 0.0)))
        for y in (-1_000.0, 1_000.0)
    ]
    parts += [
        trimesh.creation.box((30_000.0, 2_400.0, 20.0), trimesh.transformations.translation_matrix((0.0, 0.0, z)))
        for z in (-1_020.0, 1_020.0)
    ]
    mesh = trimesh.util.concatenate(parts)
    rng = np.random.default_rng(1)
    points = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=1)[0])
    points = points + rng.normal(0.0, 1.0, points.shape)
    points[points[:, 0] > 5_000.0, 2] += 3.0
    scans = tuple(
        Scan(f"S{k}", part, position=np.array([x, -9_000.0, 3_000.0]), T_project_scan=np.eye(4))
        for k, (part, x) in enumerate(zip(np.array_split(points, 2), (-8_000.0, 8_000.0), strict=True))
    )
    design = StructureDesign("girder", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return Scene("girder", "structure", scans, structure=design, units="mm")


def timed(path: Path, out: Path, cluster: str | None) -> float:
    """Return the seconds that step deviation takes, without reading and report."""
    lines: list[str] = []
    processor.run(path, out, steps="deviation", cluster=cluster, log=lines.append)
    line = next(line for line in lines if line.startswith("deviation (default)"))
    return float(line.rpartition(", ")[2].removesuffix(" s"))


def main() -> None:
    """Run the comparison."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--points", type=int, default=5_000_000)
    arguments.add_argument("--rounds", type=int, default=2)
    arguments.add_argument("--output", type=Path)
    given = arguments.parse_args()
    cores = sorted(os.sched_getaffinity(0))[:2]
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        store.write_scene(folder / "girder.h5", scene(given.points), None, {})
        clusters = {}
        for workers in (1, 2):
            (folder / str(workers)).mkdir()
            cluster = clusters[workers] = stack.enter_context(cluster_in(folder / str(workers)))
            for core in cores[:workers]:
                cluster.add_worker(str(core), command=("taskset", "-c", str(core)))
        seconds: dict[int, list[float]] = {1: [], 2: []}
        for k in range(given.rounds + 1):
            for workers, cluster in clusters.items():
                out = folder / f"{workers}-out"
                taken = timed(folder / "girder.h5", out, cluster.address)
                print(f"round {k}, {workers} workers: {taken:.1f} s", flush=True)
                seconds[workers] += [taken] if k else []  # in the first round kernels are loaded or compiled
        same = (folder / "1-out/results.h5").read_bytes() == (folder / "2-out/results.h5").read_bytes()
    ratio = median(seconds[1]) / median(seconds[2])
    record = {"points": given.points, "seconds": seconds, "speed_up": ratio, "same_bytes": same}
    print(json.dumps(record))
    if given.output:
        given.output.write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
