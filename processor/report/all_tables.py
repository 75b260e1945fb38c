"""Tables of a run, for the page, for CSV files and for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Text, label, text
from processor.model import METRIC_NAMES, Metric, Statistic, StepRun
from processor.pipeline import Execution
from processor.report import section
from processor.report.table import Table

__all__ = ["Table", "all_of", "grouped", "of_checks", "of_step"]


def of_step(run: StepRun, others: Sequence[StepRun], report: ErrorReport) -> list[Table]:
    """Tables of a step's answer, beside other methods on the same scene."""
    return section.of(run.step).tables((run, *others), report)


def of_checks(report: ErrorReport) -> Table:
    """Table of all checks against the truth."""
    rows = tuple(
        (label(m.step), metric_name(m), m.value, m.limit, m.unit, _outcome(m.limit, m.passed)) for m in report.metrics
    )
    columns = ("step", "check", "value", "limit", "unit", "outcome")
    return Table(text("Checks against the truth"), columns, rows, "checks")


def metric_name(metric: Metric) -> Text:
    """Return the name of a figure as a text."""
    name = figure_name(metric.quantity, metric.statistic)
    return text("{method}: {figure}", method=metric.method, figure=name) if metric.method else name


def figure_name(quantity: str, statistic: Statistic) -> Text:
    """Return the name of a figure without its method."""
    template = METRIC_NAMES.get(statistic, "{quantity}, {statistic}")
    return text(template, quantity=label(quantity), statistic=statistic)


def _outcome(limit: float, passed: bool) -> Text:
    if math.isnan(limit):
        return text("for information")
    return text("passed") if passed else text("MISSED")


def all_of(execution: Execution, report: ErrorReport) -> list[Table]:
    """All tables of a run, the checks last where there are any."""
    tables: list[Table] = []
    for run, others in grouped(execution.runs):
        tables += of_step(run, others, report)
    return [*tables, of_checks(report)] if report.metrics else tables


def grouped(runs: Sequence[StepRun]) -> list[tuple[StepRun, list[StepRun]]]:
    """Pair each step's answer with the runs of other methods made for comparison."""
    answers: dict[str, tuple[StepRun, list[StepRun]]] = {}
    for run in runs:
        if run.step in answers:
            answers[run.step][1].append(run)
        else:
            answers[run.step] = (run, [])
    return list(answers.values())
