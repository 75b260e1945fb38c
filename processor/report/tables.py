"""Tables of a run, for the page, for CSV files and for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor.evaluate import ErrorReport
from processor.model import KEY_POINTS, Floats, StepRun
from processor.pipeline import Execution

NAN = float("nan")


@dataclass(frozen=True)
class Table:
    """A titled table: in a CSV file of the name ``file`` where that is not empty, on the page and on the terminal.

    ``groups`` are headings above the columns, one each, equal neighbours taken together; CSV files have none.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    file: str = ""
    note: str = ""
    groups: tuple[str, ...] = ()
    on_page: bool = True
    on_terminal: bool = True


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
    method = runs[0].method
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
                "splicing_mean_mm",
                "splicing_max_mm",
                "linear_mean_mm",
                "linear_max_mm",
                "foot1_best_fit_linear_mean_mm",
                "foot1_best_fit_linear_max_mm",
            ),
            summary,
            "summary",
            f"Linear error as assembled, that is with: {gauges}. Foot 1 best-fit to the design: the whole bridge, as "
            "assembled, is moved so that Foot 1 lies on its design.",
            ("", *["splicing error"] * 2, *["linear error, as assembled"] * 2, *["linear error, Foot 1 best-fit"] * 2),
        ),
        Table("Components", ("component", "status", "remark"), parts, "components"),
        Table(
            f"Joints, method {method} (mm)",
            ("joint", "left_part", "right_part", "mean_mm", "largest_mm", "at", "verdict"),
            tuple(_joint(first, j) for j in range(len(first.joints))),
            "joints",
            "Mean and largest |d| of 8 point pairs and 3 axes. A verdict needs an uncertainty: pass where the largest "
            "|d| and its uncertainty keep within the limit, fail where it is beyond by more, else indeterminate.",
        ),
        *_by_point(first, method, first.gaps, "Splicing error"),
        *(_by_point(first, method, first.gap_ci95, "95 % half-widths") if np.isfinite(first.gap_ci95).any() else ()),
        Table(
            f"Gaps at the joints, method {method}",
            ("joint", "point", "dx_mm", "dy_mm", "dz_mm", "ci95_dx_mm", "ci95_dy_mm", "ci95_dz_mm"),
            tuple(rows),
            "gaps",
            on_page=False,
            on_terminal=False,
        ),
        Table(
            f"Linear error by station, method {method}",
            ("edge", "station_mm", "deviation_mm", "foot1_best_fit_deviation_mm"),
            stations,
            "linear",
            on_page=False,
            on_terminal=False,
        ),
    ]


def _joint(result: Any, j: int) -> tuple[Any, ...]:
    """Row of the table of joints; a joint without an answer shows none."""
    size = np.abs(result.gaps[j])
    row = (result.joints[j], result.joint_left[j], result.joint_right[j])
    if not np.isfinite(size).any():
        return (*row, NAN, NAN, "", result.verdict[j])
    point, axis = np.unravel_index(int(np.nanargmax(size)), size.shape)
    where = f"{KEY_POINTS[point]}, {'xyz'[axis]}"
    return (*row, float(np.nanmean(size)), float(np.nanmax(size)), where, result.verdict[j])


JOINTS_ABREAST = 4


def _by_point(result: Any, method: str, values: Floats, what: str) -> list[Table]:
    """Lay out (j, 8, 3) as the source paper does (paper 000, tables 4 to 7): point pairs down, joints across."""
    found = []
    for start in range(0, len(result.joints), JOINTS_ABREAST):
        chosen = range(start, min(start + JOINTS_ABREAST, len(result.joints)))
        found.append(
            Table(
                f"{what}, method {method} (mm)",
                ("point", *["dx", "dy", "dz"] * len(chosen)),
                tuple((key, *values[chosen, k].ravel().tolist()) for k, key in enumerate(KEY_POINTS)),
                note="Right part minus left part, bridge axes: x along the span, z up. P1 to P4 are the corners "
                "bottom-left, bottom-right, top-right, top-left (left = +y), P5 to P8 the middles of the bottom, "
                "right, top and left edges."
                if start == 0
                else "",
                groups=(
                    "",
                    *(
                        f"{result.joints[j]}: {result.joint_left[j]} & {result.joint_right[j]}"
                        for j in chosen
                        for _ in range(3)
                    ),
                ),
            )
        )
    return found


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
