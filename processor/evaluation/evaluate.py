"""Results compared with the truth. The only reader of truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from processor import pipeline
from processor.evaluation import truth_json
from processor.evaluation.space_frame import true_rows
from processor.model import Floats, InputError, Metric, PlainError, Truth
from processor.pipeline import Execution
from processor.scan_folder import folder
from processor.space_frame import step as space_frame_step
from processor.store import store


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
    """Compare every run with the truth of the input at ``path``; empty where it holds none.

    Raises InputError for a truth that cannot be read, or is that of another scene.
    """
    truth = truth_of(path, labels=execution.stored is None)
    source = folder.truth_file(path) or path / truth_json.NAME
    return ErrorReport() if truth is None else against(truth, execution, str(source))


def truth_of(path: Path, labels: bool = True) -> Truth | None:
    """Return the truth of the input at ``path``, with or without the labels of its points; None where it holds none.

    Raises InputError for a truth that cannot be read.
    """
    source = folder.truth_file(path)
    if source is not None:
        return store.read_truth(source, labels=labels)
    return truth_json.read(path) if path.is_dir() else None


def against(truth: Truth, execution: Execution, source: str) -> ErrorReport:
    """Compare every run with a truth, which ``source`` names in errors.

    A metric of a run made for comparison names the method. Raises InputError for a truth of another scene.
    """
    metrics: list[Metric] = []
    answered: set[str] = set()
    for run in execution.runs:
        module = pipeline.module_of("evaluation", run.step)
        if module is None:
            continue  # there are no metrics of this step
        try:
            found: list[Metric] = module.check(execution.scene, run.result, truth)
        except PlainError:  # of points that are read here
            raise
        except (LookupError, ValueError) as error:
            raise InputError(
                f"{source}: the truth does not fit what step {run.step} found ({error!r}); is it of another scene?"
            ) from error
        method = run.method if run.step in answered else ""
        metrics += [dataclasses.replace(metric, step=run.step, method=method) for metric in found]
        answered.add(run.step)
    true = truth.frame
    if true is None:
        return ErrorReport(tuple(metrics))
    rows = {
        run.method: true_rows(execution.scene, run.result.balls, true)
        for run in execution.runs
        if isinstance(run.result, space_frame_step.Result)
    }
    radii, centres = np.append(true.radii, np.nan), np.vstack([true.centres, np.full(3, np.nan)])
    return ErrorReport(
        tuple(metrics),
        {method: radii[row] for method, row in rows.items()},
        {method: centres[row] for method, row in rows.items()},
    )
