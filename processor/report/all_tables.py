"""Tables of a run for the page, CSV files and the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Text, label, text
from processor.model import METRIC_NAMES, Metric, Statistic, StepRun
from processor.pipeline import Execution
from processor.report import characteristics
from processor.report.columns import columns
from processor.report.reports_of_steps import characteristics_of, step_report
from processor.report.table import Table

LIMITS = "-limits"  # ends the file of what a step compared with limits


def tables_of_step(run: StepRun, others: Sequence[StepRun], report: ErrorReport) -> list[Table]:
    """Tables of a step's result, with those of other methods on the same scene."""
    limits = characteristics.limit_table(characteristics.limits_of(run), f"{run.step}{LIMITS}")
    return [*limits, *step_report(run.step).tables((run, *others), report)]


def checks_table(report: ErrorReport) -> Table:
    """Table of all checks against the truth."""
    free, kept, missed = text("for information"), text("passed"), text("MISSED")
    rows = tuple(
        (label(m.step), metric_name(m), m.value, m.limit, m.unit,
         free if math.isnan(m.limit) else kept if m.passed else missed)
        for m in report.metrics
    )  # fmt: skip
    header = columns("step", "check", "value", "limit", "unit", "outcome")
    return Table(text("Checks against the truth"), header, rows, "checks")


def metric_name(metric: Metric) -> Text:
    """Return the name of a figure as a text."""
    name = figure_name(metric.quantity, metric.statistic)
    return text("{method}: {figure}", method=metric.method, figure=name) if metric.method else name


def figure_name(quantity: str, statistic: Statistic) -> Text:
    """Return the name of a figure without its method."""
    template = METRIC_NAMES.get(statistic, "{quantity}, {statistic}")
    return text(template, quantity=label(quantity), statistic=statistic)


def tables_of_run(execution: Execution, report: ErrorReport) -> list[Table]:
    """All tables of a run, the checks last where there are any."""
    tables: list[Table] = []
    for run, others in execution.by_step():
        tables += tables_of_step(run, others, report)
    held = [one for run, _ in execution.by_step() for one in characteristics_of(execution.scene, run)]
    tables += [characteristics.table(held)] if held else []
    return [*tables, checks_table(report)] if report.metrics else tables
