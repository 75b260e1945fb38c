"""An earlier run and the input it was made from, opened to export clouds of them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from processor import pipeline
from processor.clouds.points import InMemory, Points, Spool
from processor.model import Scene, UsageError
from processor.pipeline import Execution
from processor.results.file_names import RESULTS_H5
from processor.scan_folder.files import missing
from processor.store import store
from processor.store.streaming import points_of


@dataclass(frozen=True)
class Run:
    """What was run on a scene: the result of each step, and its parameters, by the name of the step."""

    name: str  # of the input
    scene: Scene  # may be without its points
    points: Points
    steps: Mapping[str, Any]
    parameters: Mapping[str, Mapping[str, Any]]
    digest: str  # of the scene

    def step(self, name: str, what: str) -> Any:
        """Return the result of a step. Raises UsageError where it was not run."""
        if name not in self.steps:
            steps = ",".join((*self.steps, name))
            raise UsageError(
                f"{what} needs the step {name}, which was not run on {self.name}: run it with the others by "
                f"processor run {self.name} -o OUT --steps {steps}, then export again"
            )
        return self.steps[name]


def _run(execution: Execution, scene: Scene, points: Points) -> Run:
    firsts = [run for run, _ in execution.by_step()]
    parameters: dict[str, Mapping[str, Any]] = {}
    for one in execution.provenance["parameters"]:
        parameters.setdefault(one["step"], one)
    provenance = execution.provenance
    steps = {run.step: run.result for run in firsts}
    return Run(provenance["input"], scene, points, steps, parameters, digest=provenance["input_sha256"])


@contextmanager
def opened(out: Path, input_: Path | None, units: str | None, aside: Path) -> Iterator[Run]:
    """Open the run in a folder of results; points of a scan folder are put aside below the folder ``aside``.

    Raises UsageError for a folder without results or whose input is not found, InputError for an input that is not the
    one that was processed.
    """
    results = out / RESULTS_H5
    if not results.is_file():
        raise UsageError(f"{out}: expected a folder of results of processor run ({RESULTS_H5}), found none")
    path = input_ or pipeline.find_input(results)
    if not path.exists():
        raise missing(path)
    runs, provenance = pipeline.read_runs(results)
    is_scene = path.is_file() and path.suffix.lower() == ".h5"
    with tempfile.TemporaryDirectory(prefix=".points-", dir=aside) as spooled:
        spool = Spool(Path(spooled))
        scene = pipeline.read(path, units, is_scene, spool.keep)
        with points_of(path) if is_scene else nullcontext(spool) as points:
            digest = store.scene_hash(scene, points.pieces)
            pipeline.check_same_input(results, provenance, path, digest)
            yield _run(Execution(scene, runs, provenance), scene, points)


@contextmanager
def of_execution(execution: Execution) -> Iterator[Run]:
    """Open a run that is in memory, but for the points of a scene file, where they are still in it.

    Raises InputError where that file has changed.
    """
    if execution.stored is None:
        yield _run(execution, execution.scene, InMemory(execution.scene))
        return
    with points_of(execution.stored) as points:
        digest = store.scene_hash(execution.scene, points.pieces)
        pipeline.check_same_input(execution.stored, execution.provenance, execution.stored, digest)
        yield _run(execution, execution.scene, points)
