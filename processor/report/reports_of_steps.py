"""The report of each step: ``REPORT`` of ``section.py`` in the folder of the step's package."""

from __future__ import annotations

import importlib

from processor.limits.judging import Judged
from processor.model import Scene, StepRun
from processor.pipeline import package_of
from processor.report.characteristics import of_limits, worst_first
from processor.report.step_report import StepReport


def step_report(step: str) -> StepReport:
    """Return the functions that make the report of a step."""
    report: StepReport = importlib.import_module(f"processor.report.{package_of(step)}.section").REPORT
    return report


def characteristics_of(scene: Scene, run: StepRun) -> list[Judged]:
    """Return the characteristics of a step, worst first, else in their order."""
    own = step_report(run.step).characteristics(scene, run)
    return worst_first([*own, *of_limits(getattr(run.result, "limits", None))])
