"""One scene on a Dask cluster: step deviation of a large cloud on one worker and on two, a processor each.

    python -m tests.bench.tiles --output out.json

5 M points of a box girder of 30 m. Workers have one thread and a processor of their own (taskset), as if each were a
machine; scheduler and client share the processors with them. Rounds in turn; kernels are compiled beforehand. The
results of all runs are compared.

Beside the seconds are those of processors: of the client, of the scheduler and of each worker. On a machine that does
other work, too, the speed-up is judged by them: ``by_processor`` is (client + worker) of one worker over (client + the
busier worker) of two, as if the client never worked while workers do, which is less than the true one.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
import trimesh

import processor
from processor.model import Scan, Scene, StructureDesign
from processor.store import store
from tests.support.processes.dask_cluster import DaskCluster, cluster_in


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


class Taken(NamedTuple):
    """Seconds of step deviation, without reading and report, and those of processors in the whole run."""

    seconds: float
    client: float
    scheduler: float
    workers: list[float]

    @property
    def in_turn(self) -> float:
        """Seconds of processors where client and workers never work at the same time."""
        return self.client + max(self.workers)


def used(process: subprocess.Popen) -> float:
    """Return the seconds of processors that a process has used."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def timed(path: Path, out: Path, cluster: DaskCluster) -> Taken:
    """Run step deviation on a cluster."""
    scene_ = processor.read(path)
    before = [used(one) for one in cluster.processes], time.process_time(), time.perf_counter()
    results = processor.run(scene_, steps="deviation", cluster=cluster.address)
    seconds, client = time.perf_counter() - before[2], time.process_time() - before[1]
    scheduler, *workers = (used(one) - was for one, was in zip(cluster.processes, before[0], strict=True))
    store.write_results(out, results.execution.runs, results.execution.provenance)
    return Taken(seconds, client, scheduler, workers)


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
        taken: dict[int, list[Taken]] = {1: [], 2: []}
        for k in range(given.rounds + 1):
            for workers, cluster in clusters.items():
                one = timed(folder / "girder.h5", folder / f"{workers}.h5", cluster)
                print(f"round {k}, {workers} workers: {one}", flush=True)
                taken[workers] += [one] if k else []  # in the first round kernels are loaded or compiled
        same = (folder / "1.h5").read_bytes() == (folder / "2.h5").read_bytes()
    first, second = taken[1], taken[2]
    record = {
        "points": given.points,
        "runs": {number: [one._asdict() for one in of_number] for number, of_number in taken.items()},
        "speed_up": median(one.seconds for one in first) / median(one.seconds for one in second),
        "by_processor": median(one.in_turn for one in first) / median(one.in_turn for one in second),
        "same_bytes": same,
    }
    print(json.dumps(record))
    if given.output:
        given.output.write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
