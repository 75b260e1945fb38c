"""Results held against the truth. The only reader of truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from processor import folder, pipeline, store
from processor.model import Floats, FrameTruth, InputError, Metric, Scene
from processor.pipeline import Execution
from processor.steps import spheres


@dataclass(frozen=True)
class ErrorReport:
    """The checks of a run; by method of spheres the true radius (k,) mm of each ball found, NaN where it is none."""

    metrics: tuple[Metric, ...] = ()
    true_radii: Mapping[str, Floats] = field(default_factory=dict)

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
    truth = None if source is None else store.read_truth(source)
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
    radii = {
        run.method: true_radii(execution.scene, run.result, truth.frame)
        for run in execution.runs
        if isinstance(run.result, spheres.Result) and truth.frame is not None
    }
    return ErrorReport(tuple(metrics), radii)


def true_radii(scene: Scene, result: spheres.Result, true: FrameTruth) -> Floats:
    """Return the true radius (k,) in mm of each ball of a result, NaN where there is no such ball.

    With a design a ball is known by its id. Without, ids mean nothing: it is the true ball that its centre lies in.
    """
    if scene.frame is not None:
        known = dict(zip(true.ids.tolist(), true.radii.tolist(), strict=True))
        return np.array([known.get(ball, np.nan) for ball in result.ids.tolist()], np.float64)
    if not len(true.ids):
        return np.full(len(result.ids), np.nan)
    distance = np.linalg.norm(result.centres[:, None] - true.centres[None], axis=2)
    distance[~np.isfinite(distance)] = np.inf
    nearest = distance.argmin(axis=1)
    inside = distance.min(axis=1) <= true.radii[nearest]
    return np.where(inside, true.radii[nearest], np.nan)
