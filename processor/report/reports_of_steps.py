"""The report of each step: ``REPORT`` of ``section.py`` in the folder of the step's package."""

from __future__ import annotations

import importlib
from dataclasses import replace

from processor.language.messages import label
from processor.limits.judging import Judged
from processor.model import Scene, StepRun
from processor.pipeline import package_of
from processor.report.characteristics import limits_of, worst_first
from processor.report.step_report import StepReport


def step_report(step: str) -> StepReport:
    """Return the functions that make the report of a step."""
    report: StepReport = importlib.import_module(f"processor.report.{package_of(step)}.section").REPORT
    return report


def characteristics_of(scene: Scene, run: StepRun) -> list[Judged]:
    """Return the characteristics of a step, worst first, else in their order."""
    limits = limits_of(run)
    worded = (
        replace(one, of=label(one.of), what=label(one.what), clause=label(one.clause))
        for one in ([] if limits is None else limits.rows)
    )
    return worst_first([*step_report(run.step).characteristics(scene, run), *worded])
