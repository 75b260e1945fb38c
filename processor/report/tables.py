"""Tables of a run, for the page, for CSV files and for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from processor.evaluate import ErrorReport
from processor.model import StepRun
from processor.pipeline import Execution
from processor.report import tables_preassembly
from processor.report.table import NAN, Table

__all__ = ["Table", "all_of", "grouped", "of_checks", "of_step"]


def of_step(run: StepRun, others: Sequence[StepRun], report: ErrorReport) -> list[Table]:
    """Tables of a step's answer, beside other methods on the same scene."""
    return {"preassemble": tables_preassembly.of_runs, "spheres": _spheres}[run.step]((run, *others), report)


def of_checks(report: ErrorReport) -> Table:
    """Table of all checks against the truth."""
    rows = tuple((m.step, m.name, m.value, m.limit, m.unit, _outcome(m.limit, m.passed)) for m in report.metrics)
    return Table("Checks against the truth", ("step", "check", "value", "limit", "unit", "outcome"), rows, "checks")


def _outcome(limit: float, passed: bool) -> str:
    return "for information" if math.isnan(limit) else "passed" if passed else "MISSED"


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


def _spheres(runs: Sequence[StepRun], report: ErrorReport) -> list[Table]:
    tables = []
    for run in runs:
        result = run.result
        true = report.true_radii.get(run.method, np.full(len(result.ids), NAN)).tolist()
        rows = []
        for i, ball in enumerate(result.ids.tolist()):
            radius = true[i]
            sd = math.sqrt(result.covariance[i, 3, 3]) if result.covariance[i, 3, 3] >= 0.0 else NAN
            rows.append(
                (
                    ball,
                    *result.centres[i].tolist(),
                    float(result.radii[i]),
                    1.96 * sd,
                    radius,
                    float(result.radii[i]) - radius,
                    float(result.lowest[i, 2]),
                    1.96 * float(result.lowest_sd[i]),
                    int(result.points[i]),
                    result.flag[i],
                    result.reason[i],
                )
            )
        tables.append(
            Table(
                f"Balls, method {run.method} (mm)",
                (
                    "id",
                    "x_mm",
                    "y_mm",
                    "z_mm",
                    "radius_mm",
                    "formal_ci95_radius_mm",
                    "true_radius_mm",
                    "radius_error_mm",
                    "lowest_z_mm",
                    "formal_ci95_lowest_z_mm",
                    "points",
                    "flag",
                    "remark",
                ),
                tuple(rows),
                "balls" if run is runs[0] else f"balls-{run.method}",
                "" if run is runs[0] else result.message,
                on_terminal=run is runs[0],
            )
        )
    doubtful = tuple(row for row in tables[0].rows if row[-2] != "ok")
    if doubtful:
        columns = ("id", "flag", "remark", "x_mm", "y_mm", "z_mm", "radius_mm")
        rows_to_see = tuple((row[0], row[-2], row[-1], *row[1:5]) for row in doubtful)
        tables.insert(0, Table(f"Balls to look at, method {runs[0].method} (mm)", columns, rows_to_see))
    if report.true_radii:
        tables.insert(0, _radius_errors(runs, report))
    return tables


def _radius_errors(runs: Sequence[StepRun], report: ErrorReport) -> Table:
    rows = []
    for run in runs:
        error = np.abs(run.result.radii - report.true_radii[run.method])
        known = error[np.isfinite(error)]
        figures = np.quantile(known, [0.5, 0.95, 1.0]).tolist() if len(known) else [NAN] * 3
        rows.append((run.method, len(known), len(error), *figures))
    columns = ("method", "fitted", "balls", "median_mm", "quantile_95_mm", "largest_mm")
    return Table("|radius error| by method (mm)", columns, tuple(rows), "summary")
