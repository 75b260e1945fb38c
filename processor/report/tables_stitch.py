"""Tables of stitched scans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.evaluate import ErrorReport
from processor.model import NORMAL_95, StepRun
from processor.report.table import Table
from processor.stitching.result import Result

FRAMES_NOTE = (
    "SOCS: the scanner's own coordinate system, that of a scan's file. PRCS: the project's, in which all scans are put "
    "together: that of the reference scan, or the one its given pose leads to. GLCS: a global one: nothing "
    "leads there without control points, so PRCS stands for it. Each matrix maps SOCS to PRCS, mm."
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
    matrices = tuple(
        (f"T_PRCS_SOCS({name})", *(float(x) for x in row))
        for name, T in zip(result.scans, result.T_project_scan, strict=True)
        if np.isfinite(T).all()
        for row in T[:3]
    )
    return [
        Table(
            f"Scans in the project's frame, method {method}",
            ("scan", "status", "x_mm", "y_mm", "z_mm", "ci95_x_mm", "ci95_y_mm", "ci95_z_mm", "ci95_about_x_mrad",
             "ci95_about_y_mrad", "ci95_about_z_mrad", "rivalry", "message"),
            scans,
            f"stitch-scans{suffix}",
            f"Scanner positions. Half widths of 95 % intervals are relative to {result.reference}, which is held. "
            "Rivalry: what speaks for the next best pose, by what speaks for this one.",
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
            FRAMES_NOTE,
            on_terminal=False,
        ),
    ]  # fmt: skip
