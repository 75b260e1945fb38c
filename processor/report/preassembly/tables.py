"""Tables of an assembled bridge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Message, Text, text
from processor.model import KEY_POINTS, Floats, Status, StepRun
from processor.preassembly.result import Result
from processor.report.columns import MM, columns, under
from processor.report.preassembly.adjustment_tables import adjusted
from processor.report.table import NAN, Table, tabulate

NO_VERDICT = text(
    "Mean and largest |d| of 8 point pairs and 3 axes. A verdict needs an uncertainty: pass where the largest |d| and "
    "its uncertainty keep within the limit, fail where it is beyond by more, else indeterminate."
)
BY_LIMITS = text(
    "Mean and largest |d| of 8 point pairs and 3 axes. The verdict is by the limits, each compared with its 95 % "
    "interval."
)
POINTS = text(
    "Right part minus left part, bridge axes: x along the span, z up. P1 to P4 are the corners bottom-left, "
    "bottom-right, top-right, top-left (left = +y), P5 to P8 the middles of the bottom, right, top and left edges."
)


def step_tables(runs: Sequence[StepRun], _: ErrorReport) -> list[Table]:
    """Tables of an assembled bridge, what to do first; ``runs`` are the result and the methods compared with it."""
    first, method = runs[0].result, runs[0].method
    tables = [*adjusted(first, method), _summary(runs), _components(first), *_others(runs[1:]), _joints(first, method)]
    tables += _by_point(first, text("Splicing error, method {method}", method=method), first.joints.gaps)
    tables += [_gaps(run, "gaps" if run is runs[0] else f"gaps-{run.method}") for run in runs]
    return [*tables, _linear(first, method)]


def _summary(runs: Sequence[StepRun]) -> Table:
    header = (
        *columns("method"),
        *under(text("splicing error"), "splicing_mean_mm", "splicing_max_mm"),
        *under(text("linear error, as assembled"), "linear_mean_mm", "linear_max_mm"),
        *under(text("linear error, Foot 1 best-fit"), "foot1_best_fit_linear_mean_mm", "foot1_best_fit_linear_max_mm"),
    )
    rows = tuple(
        (run.method, *(value for error in run.result.errors for value in (error.mean, error.max))) for run in runs
    )
    gauges = [text("{method}: {gauge}", method=run.method, gauge=run.result.linear.gauge) for run in runs]
    note = [
        text("Linear error as assembled, that is with: {gauges:;}.", gauges=gauges),
        text(
            "Foot 1 best-fit to the design: the whole bridge, as assembled, is moved so that Foot 1 lies on its design."
        ),
        *_half_widths(runs),
    ]
    title = text("Splicing and linear error by method")
    return Table(title, header, rows, file="summary", note=text("{sentences:.}", sentences=note), units=MM)


def _half_widths(runs: Sequence[StepRun]) -> list[Text]:
    """State the intervals of the errors, of the methods that have them."""
    half_widths = []
    for run in runs:
        ci95 = tuple(run.result.errors_ci95.tolist())
        if np.isfinite(run.result.errors_ci95).any():
            half_widths.append(
                text(
                    "95 % or more of the true errors by {method} are within ± {ci95} of those stated, in the table's "
                    "order.",
                    method=run.method,
                    ci95=ci95,
                )
            )
    return half_widths


def _components(result: Result) -> Table:
    parts = result.components
    remarks = [text("{reasons:;}", reasons=reasons) for reasons in parts.reasons]
    cells = {"component": parts.name, "status": parts.status, "remark": remarks}
    return tabulate(text("Components"), cells, "components")


def _others(runs: Sequence[StepRun]) -> list[Table]:
    """Tabulate the parts without a sure result by the methods compared, and why."""
    rows = tuple(
        (run.method, name, status, text("{reasons:;}", reasons=reasons))
        for run in runs
        for name, status, reasons in zip(
            run.result.components.name, run.result.components.status, run.result.components.reasons, strict=True
        )
        if status != Status.OK or reasons
    )
    header = columns("method", "component", "status", "remark")
    return [Table(text("Components by the methods compared"), header, rows, "components-compared")] if rows else []


def _joints(result: Result, method: str) -> Table:
    return Table(
        text("Joints, method {method}", method=method),
        columns("joint", "left_part", "right_part", "mean_mm", "largest_mm", "at", "verdict"),
        tuple(_joint(result, j) for j in range(len(result.joints))),
        file="joints",
        note=NO_VERDICT if result.adjustment is None else BY_LIMITS,
        units=MM,
    )


def _joint(result: Result, j: int) -> tuple[Any, ...]:
    """Row of the table of joints; a joint without a result has dashes."""
    joints = result.joints
    size = np.abs(joints.gaps[j])
    row = (joints.name[j], joints.left[j], joints.right[j])
    if not np.isfinite(size).any():
        return (*row, NAN, NAN, "", joints.verdict[j])
    point, axis = np.unravel_index(int(np.nanargmax(size)), size.shape)
    where = f"{KEY_POINTS[point]}, {'xyz'[axis]}"
    return (*row, float(np.nanmean(size)), float(np.nanmax(size)), where, joints.verdict[j])


def _gaps(run: StepRun, name: str) -> Table:
    joints, adjustment = run.result.joints, run.result.adjustment
    cells = {
        "joint": [joint for joint in joints.name for _ in KEY_POINTS],
        "point": KEY_POINTS * len(joints),
        "dx_mm dy_mm dz_mm": joints.gaps.reshape(-1, 3),
        "ci95_dx_mm ci95_dy_mm ci95_dz_mm": joints.gap_ci95.reshape(-1, 3),
    }
    if adjustment is not None:  # in the joint's own axes as well
        measures = adjustment.joints.measures
        cells["along_mm left_mm up_mm"] = np.reshape([one.gaps for one in measures], (-1, 3))
        cells["ci95_along_mm ci95_left_mm ci95_up_mm"] = np.reshape([one.gaps_ci95 for one in measures], (-1, 3))
    title = text("Gaps at the joints, method {method}", method=run.method)
    return tabulate(title, cells, name, on_page=False, on_terminal=False)


def _linear(result: Result, method: str) -> Table:
    linear, unknown = result.linear, [NAN] * len(result.linear.edge)
    cells = {
        "edge": linear.edge,
        "chainage_mm": linear.chainage,
        **{
            f"{prefix}{name}_mm": values if len(values) else unknown
            for prefix, of in (("", linear.assembled), ("foot1_best_fit_", linear.best_fit))
            for name, values in (("deviation", of.deviation), ("ci95", of.ci95))
        },
    }
    title = text("Linear error by chainage, method {method}", method=method)
    return tabulate(title, cells, "linear", on_page=False, on_terminal=False)


JOINTS_ABREAST = 4  # drawn size: three columns each fit on A4 across


def _by_point(result: Result, title: Message, values: Floats) -> list[Table]:
    """Lay out (j, 8, 3) as the source paper does (paper 000, tables 4 to 7): point pairs down, joints across."""
    joints, tables = result.joints, []
    for start in range(0, len(joints), JOINTS_ABREAST):
        chosen = range(start, min(start + JOINTS_ABREAST, len(joints)))
        header = columns("point")
        for j in chosen:
            header += under(f"{joints.name[j]}: {joints.left[j]} & {joints.right[j]}", "dx_mm", "dy_mm", "dz_mm")
        rows = tuple((key, *values[chosen, k].ravel().tolist()) for k, key in enumerate(KEY_POINTS))
        tables.append(Table(title, header, rows, note=POINTS if start == 0 else "", units=MM))
    return tables
