"""Tables of stitched scans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.model import NORMAL_95, StepRun
from processor.report.table import Table
from processor.stitching.result import GLCS, Held, Result

SOCS_NOTE = "SOCS: the scanner's own coordinate system, that of a scan's file."
PRCS_NOTE = "PRCS: the project's, in which all scans are put together: that of the reference scan."
TO_PRCS = (
    f"{SOCS_NOTE} {PRCS_NOTE} GLCS: a global one: nothing leads there without control points or a given pose, so PRCS "
    "stands for it. Each matrix maps SOCS to PRCS, mm."
)
BY_POSE = "GLCS: the one from outside that the given pose of the reference scan leads to."
BY_CONTROL = "GLCS: the one from outside that the coordinates of the control points are in."
TO_GLCS = "Each matrix maps SOCS, or PRCS where it says so, to GLCS, mm."
CONTROL_NOTE = (
    "Known place minus where the scans have it, once all is adjusted; a row a sighting. Share: how much of an error "
    "of a sighting shows here, the rest goes into the poses. Of what is not used, sd is that of its prediction."
)


def of_runs(runs: Sequence[StepRun], _: ErrorReport) -> list[Table]:
    """Tables of stitched scans; ``runs`` are the answer and the methods compared with it."""
    found: list[Table] = []
    for number, run in enumerate(runs):
        found += _of_result(run.result, run.method, f"-{run.method}" if number else "")
    return found


def _of_result(result: Result, method: str, suffix: str) -> list[Table]:
    ci, turn = NORMAL_95 * result.position_sd, 1e3 * NORMAL_95 * result.rotation_sd
    scans = tuple(
        (
            name,
            result.scan_status[i],
            *result.position[i].tolist(),
            *ci[i].tolist(),
            *turn[i].tolist(),
            float(result.rivalry[i]),
            result.scan_message[i],
        )
        for i, name in enumerate(result.scans)
    )
    pairs = tuple(
        (
            a,
            result.pair_b[i],
            100.0 * float(result.overlap[i]),
            float(result.residual[i]),
            int(result.pair_pieces[i]),
            "yes" if result.used[i] else "no",
            1e6 * float(result.scale[i] - 1.0),
            1e6 * NORMAL_95 * float(result.scale_sd[i]),
            result.pair_message[i],
        )
        for i, a in enumerate(result.pair_a)
    )
    loops = tuple(
        zip(
            result.loops,
            result.closure_mm.tolist(),
            result.closure_mrad.tolist(),
            result.closure_ratio.tolist(),
            strict=True,
        )
    )
    own = [(f"T_{result.frame}_SOCS({name})", T) for name, T in zip(result.scans, result.T_project_scan, strict=True)]
    # The project's own frame is that of the reference scan: a frame from outside stands beside it.
    whole = [("T_GLCS_PRCS", result.reference_pose)] if result.frame == GLCS else []
    matrices = tuple(
        (name, *(float(x) for x in row)) for name, T in [*whole, *own] if np.isfinite(T).all() for row in T[:3]
    )
    held = (
        "Half widths of 95 % intervals hold the errors of control points too."
        if result.by_control
        else f"Half widths of 95 % intervals are relative to {result.reference}, which is held."
    )
    note = f"{SOCS_NOTE} {PRCS_NOTE} {BY_CONTROL if result.by_control else BY_POSE} {TO_GLCS}"
    return [
        Table(
            f"Scans in the project's frame, method {method}",
            ("scan", "status", "x_mm", "y_mm", "z_mm", "ci95_x_mm", "ci95_y_mm", "ci95_z_mm", "ci95_about_x_mrad",
             "ci95_about_y_mrad", "ci95_about_z_mrad", "rivalry", "message"),
            scans,
            f"stitch-scans{suffix}",
            f"Scanner positions. {held} Rivalry: what speaks for the next best pose, by what speaks for this one.",
        ),
        Table(
            f"Pairs of scans, method {method}",
            ("a", "b", "overlap_percent", "residual_mm", "shared", "used", "scale_ppm", "scale_ci95_ppm", "message"),
            pairs,
            f"stitch-pairs{suffix}",
            "Shared: flat pieces, or picked points, that both scans saw. Scale of b in a is a diagnostic.",
        ),
        Table(
            f"Misclosures of loops, method {method}",
            ("loop", "mm", "mrad", "ratio"),
            loops,
            f"stitch-loops{suffix}",
            "By the pairs' own poses. Ratio: squared misclosure by what the pairs' covariances let expect; 1 is usual.",
        ),
        Table(
            f"Matrices, method {method}",
            ("matrix", "x", "y", "z", "shift_mm"),
            matrices,
            "",
            note if result.frame == GLCS else TO_PRCS,
            on_terminal=False,
        ),
        *_control(result.control, method, suffix),
        *_remarks(result, method),
    ]  # fmt: skip


def _control(held: Held | None, method: str, suffix: str) -> list[Table]:
    if held is None:
        return []
    rows = tuple(
        (
            name,
            held.scans[i],
            *held.off[i].tolist(),
            *held.sd[i].tolist(),
            100.0 * float(held.share[i]),
            "yes" if held.used[i] else "no",
        )
        for i, name in enumerate(held.points)
    )
    columns = ("point", "scan", "dx_mm", "dy_mm", "dz_mm", "sd_x_mm", "sd_y_mm", "sd_z_mm", "share_percent", "used")
    return [Table(f"Control points (mm), method {method}", columns, rows, f"control{suffix}", CONTROL_NOTE)]


def _remarks(result: Result, method: str) -> list[Table]:
    """Table what is said of the whole: the page has it as its message, a terminal has tables alone."""
    of_scans = {f"{name}: {said}" for name, said in zip(result.scans, result.scan_message, strict=True)}
    rows = tuple((one,) for one in result.message.split("; ") if one and one not in of_scans)
    return [Table(f"Remarks, method {method}", ("remark",), rows, on_page=False)] if rows else []
