"""Results held against the truth. The only reader of truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from processor import folder, pipeline, store
from processor.model import Floats, FrameTruth, InputError, Ints, Metric, Scene
from processor.pipeline import Execution
from processor.steps import spheres


@dataclass(frozen=True)
class ErrorReport:
    """The checks of a run; by method of spheres the true radius (k,) and centre (k, 3) of each ball found, mm.

    NaN where it is none.
    """

    metrics: tuple[Metric, ...] = ()
    true_radii: Mapping[str, Floats] = field(default_factory=dict)
    true_centres: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether no limit was missed."""
        return all(metric.passed for metric in self.metrics)


def evaluate(path: Path, execution: Execution) -> ErrorReport:
    """Check every run against the truth of the input at ``path``; empty where it holds none.

    The name of a check begins with the method's where the run was made for comparison. Raises InputError for a truth
    that cannot be read, or is that of another scene.
    """
    source = folder.truth_file(path)
    truth = None if source is None else store.read_truth(source, labels=execution.stored is None)
    if source is None or truth is None:
        return ErrorReport()
    modules = pipeline.step_modules()
    metrics: list[Metric] = []
    answered: set[str] = set()
    for run in execution.runs:
        try:
            found = modules[run.step].check(execution.scene, run.result, truth)
        except (LookupError, ValueError) as error:
            raise InputError(
                f"{source}: the truth does not fit what step {run.step} found ({error!r}); is it of another scene?"
            ) from error
        if run.step in answered:
            found = [dataclasses.replace(metric, name=f"{run.method}: {metric.name}") for metric in found]
        answered.add(run.step)
        metrics += found
    true = truth.frame
    if true is None:
        return ErrorReport(tuple(metrics))
    rows = {
        run.method: true_rows(execution.scene, run.result, true)
        for run in execution.runs
        if isinstance(run.result, spheres.Result)
    }
    radii, centres = np.append(true.radii, np.nan), np.vstack([true.centres, np.full(3, np.nan)])
    return ErrorReport(
        tuple(metrics),
        {method: radii[row] for method, row in rows.items()},
        {method: centres[row] for method, row in rows.items()},
    )


def true_rows(scene: Scene, result: spheres.Result, true: FrameTruth) -> Ints:
    """Return the row (k,) of the truth that each ball of a result is, -1 where there is no such ball.

    With a design a ball is known by its id. Without, ids mean nothing: it is the true ball that its centre lies in.
    """
    if scene.frame is not None:
        known = {int(id_): row for row, id_ in enumerate(true.ids)}
        return np.array([known.get(ball, -1) for ball in result.ids.tolist()], np.int64)
    found = np.full(len(result.ids), -1, np.int64)
    there = np.flatnonzero(np.isfinite(result.centres).all(axis=1))
    if len(true.ids) and len(there):
        distance, nearest = cKDTree(true.centres).query(result.centres[there])
        inside = distance <= true.radii[nearest]
        found[there[inside]] = nearest[inside]
    return found
