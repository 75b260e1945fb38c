"""What a step says of itself in a report: ``REPORT`` of the module ``of_<step>``, found by the step's name."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from processor.evaluation.evaluate import ErrorReport
from processor.model import Scene, StepRun
from processor.pipeline import Execution, package_of
from processor.report.style import Drawn
from processor.report.table import Table


@dataclass(frozen=True)
class StepReport:
    """How a step's answer is told; ``runs`` are the answer, then other methods on the same scene for comparison."""

    title: str
    summary: Callable[[Any], tuple[str, str]]  # of a result: the verdict's head, and what is said below it
    written: Callable[[Any], dict[str, Any]]  # of a result: its object in results.json, arrays and NaN as they are
    tables: Callable[[Sequence[StepRun], ErrorReport], list[Table]]
    figures: Callable[[Execution, Sequence[StepRun], ErrorReport], Drawn]  # file names are the step's own
    further: Callable[[Any], list[tuple[str, str]]] = lambda _: []  # heads and texts beside the verdict
    files: Callable[[Execution, StepRun], dict[str, bytes]] = lambda *_: {}  # further files in OUT by name
    live: Callable[[Scene, Sequence[StepRun]], dict[str, Any] | None] = lambda *_: None  # what the page's script draws


def of(step: str) -> StepReport:
    """Return how a step reports."""
    found: StepReport = importlib.import_module(f"processor.report.{package_of(step)}.section").REPORT
    return found
