"""The report of a step: ``REPORT`` of the module ``section`` in the folder of the step's name."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Message
from processor.model import Scene, StepRun
from processor.pipeline import Execution, package_of
from processor.report.record_json import as_object
from processor.report.style import Drawn
from processor.report.table import Table


@dataclass(frozen=True)
class StepReport:
    """What a step reports; ``runs`` are its result, then those of other methods on the same scene for comparison."""

    title: str | Message
    summary: Callable[[Any], tuple[Any, Any]]  # of a result: the verdict's head, and what is said below it
    tables: Callable[[Sequence[StepRun], ErrorReport], list[Table]]
    figures: Callable[[Execution, Sequence[StepRun], ErrorReport], Drawn]  # file names are the step's own
    written: Callable[[Any], dict[str, Any]] = as_object  # of a result: its object in results.json
    further: Callable[[Any], list[tuple[Any, Any]]] = lambda _: []  # heads and texts beside the verdict
    files: Callable[[Execution, StepRun], dict[str, bytes]] = lambda *_: {}  # further files in OUT by name
    live: Callable[[Scene, Sequence[StepRun]], dict[str, Any] | None] = lambda *_: None  # what the page's script draws


def of(step: str) -> StepReport:
    """Return how a step reports."""
    report: StepReport = importlib.import_module(f"processor.report.{package_of(step)}.section").REPORT
    return report
