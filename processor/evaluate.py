"""Results held against the truth. The only reader of truth."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from processor import folder, pipeline, store
from processor.model import FrameTruth, Metric
from processor.pipeline import Execution


@dataclass(frozen=True)
class ErrorReport:
    """The checks of a run, and the true balls where the scene has any (for tables of errors)."""

    metrics: tuple[Metric, ...] = ()
    true_balls: FrameTruth | None = None

    @property
    def passed(self) -> bool:
        """Whether no limit was missed."""
        return all(metric.passed for metric in self.metrics)


def evaluate(path: Path, execution: Execution) -> ErrorReport:
    """Check every run against the truth of the input at ``path``; empty where it holds none.

    The name of a check begins with the method's where the run was made for comparison.
    """
    source = folder.truth_file(path)
    truth = None if source is None else store.read_truth(source)
    if truth is None:
        return ErrorReport()
    modules = pipeline.step_modules()
    metrics: list[Metric] = []
    answered: set[str] = set()
    for run in execution.runs:
        found = modules[run.step].check(execution.scene, run.result, truth)
        if run.step in answered:
            found = [dataclasses.replace(metric, name=f"{run.method}: {metric.name}") for metric in found]
        answered.add(run.step)
        metrics += found
    return ErrorReport(tuple(metrics), truth.frame)
