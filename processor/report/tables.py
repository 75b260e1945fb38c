"""Tables of a run: rows for the page, for CSV files and for the terminal."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor.evaluate import ErrorReport
from processor.model import KEY_POINTS, StepRun
from processor.pipeline import Execution


@dataclass(frozen=True)
class Table:
    """A titled table; ``file`` is the name of its CSV file without suffix, empty for none."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    file: str = ""
    note: str = ""


def of_step(run: StepRun, others: Sequence[StepRun], report: ErrorReport) -> list[Table]:
    """Tables of a step's answer, beside other methods on the same scene."""
    return {"preassemble": _preassemble, "spheres": _spheres}[run.step]((run, *others), report)


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


def _preassemble(runs: Sequence[StepRun], report: ErrorReport) -> list[Table]:
    first = runs[0].result
    summary = tuple(
        (
            run.method,
            run.result.splicing_mean,
            run.result.splicing_max,
            run.result.linear_mean,
            run.result.linear_max,
            run.result.best_fit_linear_mean,
            run.result.best_fit_linear_max,
        )
        for run in runs
    )
    gauges = "; ".join(f"{run.method}: {run.result.gauge}" for run in runs)
    rows = [
        (joint, key, *first.gaps[j, k], *first.gap_ci95[j, k])
        for j, joint in enumerate(first.joints)
        for k, key in enumerate(KEY_POINTS)
    ]
    parts = tuple(
        (name, first.component_status[i], first.component_message[i]) for i, name in enumerate(first.components)
    )
    stations = tuple(
        zip(
            first.linear_edge,
            first.linear_station.tolist(),
            first.linear_deviation.tolist(),
            first.best_fit_linear_deviation.tolist(),
            strict=True,
        )
    )
    return [
        Table(
            "Splicing and linear error by method (mm)",
            (
                "method",
                "splicing mean",
                "splicing max",
                "linear mean",
                "linear max",
                "Foot 1 best-fit: linear mean",
                "linear max",
            ),
            summary,
            "summary",
            f"Gauge of the linear error as assembled: {gauges}. Foot 1 best-fit: the whole bridge moved so that "
            "Foot 1 lies on its design.",
        ),
        Table("Components", ("component", "status", "remark"), parts, "components"),
        Table(
            f"Gaps at the joints, method {runs[0].method} (mm): right part minus left part, bridge axes",
            ("joint", "point", "dx_mm", "dy_mm", "dz_mm", "ci95_dx_mm", "ci95_dy_mm", "ci95_dz_mm"),
            tuple(rows),
            "gaps",
        ),
        Table(
            "Linear error by station",
            ("edge", "station_mm", "deviation_mm", "foot1_best_fit_deviation_mm"),
            stations,
            "linear",
        ),
    ]


def _spheres(runs: Sequence[StepRun], report: ErrorReport) -> list[Table]:
    true = {} if report.true_balls is None else {int(i): k for k, i in enumerate(report.true_balls.ids)}
    tables = []
    for run in runs:
        result = run.result
        rows = []
        for i, ball in enumerate(result.ids.tolist()):
            radius = float("nan")
            if report.true_balls is not None and ball in true:
                radius = float(report.true_balls.radii[true[ball]])
            sd = math.sqrt(result.covariance[i, 3, 3]) if result.covariance[i, 3, 3] >= 0.0 else float("nan")
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
            )
        )
    if report.true_balls is not None:
        tables.insert(0, _radius_errors(tables))
    return tables


def _radius_errors(balls: Sequence[Table]) -> Table:
    rows = []
    for table in balls:
        error = np.array([abs(row[7]) for row in table.rows], dtype=np.float64)
        known = error[np.isfinite(error)]
        figures = np.quantile(known, [0.5, 0.95, 1.0]).tolist() if len(known) else [float("nan")] * 3
        rows.append((table.title[len("Balls, method ") :].split(" ")[0], len(known), len(error), *figures))
    columns = ("method", "fitted", "balls", "median |dr|", "95 % |dr|", "largest |dr|")
    return Table("Radius error by method (mm)", columns, tuple(rows), "summary")


def csv_text(table: Table) -> str:
    """Write a table as CSV; text that a spreadsheet would take for a formula gets a leading apostrophe."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows([_csv_cell(cell) for cell in row] for row in table.rows)
    return out.getvalue()


def _csv_cell(cell: Any) -> Any:
    if isinstance(cell, float | np.floating):
        return "" if not math.isfinite(cell) else repr(round(float(cell), 6))
    if isinstance(cell, str) and cell[:1] in ("=", "+", "-", "@", "\t", "\r"):
        return "'" + cell
    return cell


def shown(cell: Any) -> str:
    """Write a cell for people: three decimals, a dash where there is no number."""
    if isinstance(cell, float | np.floating):
        return "–" if not math.isfinite(cell) else f"{cell:.3f}"
    return str(cell)


def plain_text(table: Table, most: int = 40) -> str:
    """Write a table for the terminal, columns aligned, at most so many rows."""
    cells = [list(table.columns), *([shown(cell) for cell in row] for row in table.rows[:most])]
    widths = [max(len(row[i]) for row in cells) for i in range(len(table.columns))]
    lines = [table.title]
    lines += ["  " + "  ".join(_aligned(cell, width) for cell, width in zip(row, widths, strict=True)) for row in cells]
    if len(table.rows) > most:
        lines.append(f"  ... and {len(table.rows) - most} more in {table.file}.csv")
    return "\n".join(line.rstrip() for line in lines)


def _aligned(cell: str, width: int) -> str:
    number = cell.replace(".", "", 1).replace("-", "", 1).isdigit() or cell == "–"
    return cell.rjust(width) if number else cell.ljust(width)
