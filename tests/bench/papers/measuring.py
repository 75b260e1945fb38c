"""Data sets measured: each scene is made by designgen in a child process, and measured in another."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from processor import diagnostics
from processor.jobs import process
from processor.jobs.causes import Cause
from processor.jobs.child import Loss, Lost
from processor.store.making import beside
from processor.writers import step_clouds
from tests.bench.papers import bolt_balls, defects, deviation, preassembly, stitching
from tests.bench.papers.data_sets import DataSet, Measured

PAPERS: dict[str, tuple[str, Any]] = {  # name and module
    "000": ("preassembly", preassembly),
    "001": ("bolt_balls", bolt_balls),
    "002": ("deviation", deviation),
    "003": ("stitching", stitching),
    "004": ("defects", defects),
}
MAKING_S, MEASURING_S = 1800.0, 7200.0  # longest times of a data set
MOST_SAID = 300  # characters of an error message


def module_of(paper: str) -> Any:
    """Return the module of a paper: ``data_sets(seed)``, ``measure(path, data_set)``, ``rows(found)``, ``charts``."""
    return PAPERS[paper][1]


class Job(NamedTuple):
    """A data set to measure: the file of its scene, and a new folder for what the stages of the methods find."""

    data_set: DataSet
    scene: str
    steps: str  # "" = not kept


def measured(job: Job) -> Measured:
    """Measure a data set; runs in a child process."""
    data_set = job.data_set
    with diagnostics.with_clouds(bool(job.steps)), diagnostics.recording() as notes:
        found: Measured = module_of(data_set.paper).measure(Path(job.scene), data_set)
    if job.steps:
        run = step_clouds.OfRun(PAPERS[data_set.paper][0], f"paper {data_set.paper}", notes.clouds, notes.table())
        step_clouds.write(Path(job.steps), [run])
    return found


def make_and_measure(
    data_set: DataSet, stopped: Callable[[], bool] = process.never, *, scratch: str, steps: str = ""
) -> Measured:
    """Make the scene of a data set and measure it, in child processes; the scene is deleted afterwards.

    What the stages of the methods find is kept in a folder of its own in the folder ``steps``, if that is not empty.
    Either child process is ended at its limit of time.
    """
    started = time.monotonic()
    with beside(Path(scratch)) as made:
        scene = made / "scene.h5"
        words = ("designgen", "make", str(data_set.recipe), "-o", str(scene), "--seed", str(data_set.seed))
        words += tuple(word for setting in data_set.settings for word in ("--set", setting))
        ended = process.run(
            (*process.GUARDED, "0", *words), env=process.environment(1), timeout_s=MAKING_S, stopped=stopped
        )
        if ended.cause is not Cause.EXIT or ended.code != 0:
            return Measured(data_set, failed=f"designgen make: {ended.last_line[:MOST_SAID] or ended.cause.value}")
        kept = str(Path(steps, data_set.folder)) if steps else ""
        end = time.monotonic() + MEASURING_S
        job = Job(data_set, str(scene), kept)
        found = process.in_process(measured, job, lambda: stopped() or time.monotonic() > end)
    if isinstance(found, Lost):
        late = found.loss is Loss.STOPPED and not stopped()
        why = f"measuring took longer than {MEASURING_S:.0f} s" if late else found.error[:MOST_SAID] or found.loss.value
        return Measured(data_set, failed=why)
    return Measured(data_set, found.figures, found.series, found.failed, time.monotonic() - started)
