"""Tables of an assembled bridge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.model import KEY_POINTS, NORMAL_95, Floats, StepRun
from processor.report.preassembly.adjustment_tables import adjusted
from processor.report.table import NAN, Table, shown

NO_VERDICT = (
    "A verdict needs an uncertainty: pass where the largest |d| and its uncertainty keep within the limit, fail where "
    "it is beyond by more, else indeterminate."
)


def of_runs(runs: Sequence[StepRun], _: ErrorReport) -> list[Table]:
    """Tables of an assembled bridge, what to do first; ``runs`` are the answer and the methods compared with it."""
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
    parts = tuple(
        (name, first.component_status[i], first.component_message[i]) for i, name in enumerate(first.components)
    )
    stations = tuple(
        zip(
            first.linear_edge,
            first.linear_station.tolist(),
            first.linear_deviation.tolist(),
            _or_nan(first.linear_ci95, first.linear_deviation).tolist(),
            first.best_fit_linear_deviation.tolist(),
            _or_nan(first.best_fit_linear_ci95, first.linear_deviation).tolist(),
            strict=True,
        )
    )
    return [
        *adjusted(first, method),
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
            f"assembled, is moved so that Foot 1 lies on its design.{_halves(runs)}",
            ("", *["splicing error"] * 2, *["linear error, as assembled"] * 2, *["linear error, Foot 1 best-fit"] * 2),
        ),
        Table("Components", ("component", "status", "remark"), parts, "components"),
        *_others(runs[1:]),
        Table(
            f"Joints, method {method} (mm)",
            ("joint", "left_part", "right_part", "mean_mm", "largest_mm", "at", "verdict"),
            tuple(_joint(first, j) for j in range(len(first.joints))),
            "joints",
            "Mean and largest |d| of 8 point pairs and 3 axes. "
            + ("The verdict is by the limits, each held against its 95 % interval." if first.judged else NO_VERDICT),
        ),
        *_by_point(first, method, first.gaps, "Splicing error"),
        *(_by_point(first, method, first.gap_ci95, "95 % half-widths") if np.isfinite(first.gap_ci95).any() else ()),
        *(
            replace(one, on_terminal=False)
            for run in runs[1:]
            for one in _by_point(run.result, run.method, run.result.gaps, "Splicing error")
        ),
        *(_gaps(run, "gaps" if run is runs[0] else f"gaps-{run.method}") for run in runs),
        Table(
            f"Linear error by station, method {method}",
            ("edge", "station_mm", "deviation_mm", "ci95_mm", "foot1_best_fit_deviation_mm", "foot1_best_fit_ci95_mm"),
            stations,
            "linear",
            on_page=False,
            on_terminal=False,
        ),
    ]


def _halves(runs: Sequence[StepRun]) -> str:
    """Intervals of the figures, of the methods that state them."""
    said = ""
    for run in runs:
        halves = ", ".join(shown(half) for half in run.result.errors_ci95)
        if run.result.bands_as_designed:
            said += (
                f" Of a bridge exactly as designed, scanned alike, {run.method} states up to {halves} (95 % or more)."
            )
        elif np.isfinite(run.result.errors_ci95).any():
            said += f" 95 % or more of the true figures of {run.method} are within ± {halves}"
            said += " of those stated, in the table's order."
    return said


def _or_nan(values: Floats, like: Floats) -> Floats:
    """Fill up what a method does not state."""
    return values if len(values) else np.full_like(like, np.nan)


def _others(runs: Sequence[StepRun]) -> list[Table]:
    """Say of the methods compared which parts have no sure answer, and why."""
    rows = tuple(
        (run.method, name, run.result.component_status[i], run.result.component_message[i])
        for run in runs
        for i, name in enumerate(run.result.components)
        if run.result.component_status[i] != "ok" or run.result.component_message[i]
    )
    columns = ("method", "component", "status", "remark")
    return [Table("Components by the methods compared", columns, rows, "components-compared")] if rows else []


def _gaps(run: StepRun, name: str) -> Table:
    result = run.result
    rows = [
        (joint, key, *result.gaps[j, k], *result.gap_ci95[j, k])
        for j, joint in enumerate(result.joints)
        for k, key in enumerate(KEY_POINTS)
    ]
    columns: tuple[str, ...] = ("joint", "point", "dx_mm", "dy_mm", "dz_mm", "ci95_dx_mm", "ci95_dy_mm", "ci95_dz_mm")
    if result.measures:  # in the joint's own axes as well
        axes = ("along", "left", "up")
        columns = (*columns, *(f"{one}_mm" for one in axes), *(f"ci95_{one}_mm" for one in axes))
        spread = np.array([np.diag(one.covariance).reshape(8, 3) for one in result.measures])
        local = np.concatenate(
            [[one.gaps for one in result.measures], NORMAL_95 * np.sqrt(np.maximum(spread, 0.0))], axis=2
        )
        rows = [(*row, *own) for row, own in zip(rows, local.reshape(-1, 6), strict=True)]
    return Table(
        f"Gaps at the joints, method {run.method}", columns, tuple(rows), name, on_page=False, on_terminal=False
    )


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
