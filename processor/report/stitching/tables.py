"""Tables of stitched scans, and their poses as a file for other programs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import text
from processor.model import NORMAL_95, StepRun
from processor.report.columns import MM, columns
from processor.report.table import Table, csv_cell, csv_of_rows, tabulate, yes_no
from processor.stitching.result import ProjectFrame, Result

OF_SCAN = "stitch.of-scan"  # code of reasons that the table of scans has too
TO_PRCS = text(
    "SOCS: the scanner's own coordinate system, that of a scan's file. PRCS: the project's, in which all scans are "
    "registered: that of the reference scan. GLCS: a global one; without control points or a given pose PRCS is used "
    "in its place. Each matrix maps SOCS to PRCS, mm."
)
TO_GLCS_BY_POSE = text(
    "SOCS: the scanner's own coordinate system, that of a scan's file. PRCS: the project's, that of the reference "
    "scan. GLCS: the global one that the given pose of the reference scan leads to. Each matrix maps SOCS, or PRCS "
    "where its name has it, to GLCS, mm."
)
TO_GLCS_BY_CONTROL = text(
    "SOCS: the scanner's own coordinate system, that of a scan's file. PRCS: the project's, that of the reference "
    "scan. GLCS: the global one of the control points' coordinates. Each matrix maps SOCS, or PRCS where its name has "
    "it, to GLCS, mm."
)


def step_tables(runs: Sequence[StepRun], _: ErrorReport) -> list[Table]:
    """Tabulate stitched scans; ``runs`` are the result and those of the methods compared with it."""
    tables: list[Table] = []
    for number, run in enumerate(runs):
        result, suffix = run.result, f"-{run.method}" if number else ""
        tables += [
            scanner_places(result, run.method, suffix),
            _pairs(result, run.method, suffix),
            _loops(result, run.method, suffix),
            _matrices(result, run.method),
            *_control(result, run.method, suffix),
        ]
        # Tabulate the reasons that are of no single scan, for the terminal; the page has all reasons as a paragraph
        if remarks := [single for single in result.reasons if single.code != OF_SCAN]:
            title = text("Remarks, method {method}", method=run.method)
            tables.append(tabulate(title, {"remark": remarks}, on_page=False))
    return tables


def scanner_places(result: Result, method: str, suffix: str = "") -> Table:
    """Tabulate where the scanner stood for each scan."""
    scans = result.scans
    cells = {
        "scan": scans.name,
        "status": scans.status,
        "x_mm y_mm z_mm": scans.position,
        "ci95_x_mm ci95_y_mm ci95_z_mm": NORMAL_95 * scans.position_sd,
        "ci95_about_x_mrad ci95_about_y_mrad ci95_about_z_mrad": 1e3 * NORMAL_95 * scans.rotation_sd,
        "rivalry": scans.rivalry,
        "message": scans.reasons,
    }
    note = text(
        "Scanner positions. Half widths of 95 % intervals include the errors of control points. Rivalry: score of the "
        "next best pose over that of this one."
    )
    if not result.by_control:
        note = text(
            "Scanner positions. Half widths of 95 % intervals are relative to {reference}, whose pose is fixed. "
            "Rivalry: score of the next best pose over that of this one.",
            reference=result.reference,
        )
    title = text("Scans in the project's frame, method {method}", method=method)
    return tabulate(title, cells, f"stitch-scans{suffix}", note)


def _pairs(result: Result, method: str, suffix: str) -> Table:
    pairs = result.pairs
    cells = {
        "a": pairs.a,
        "b": pairs.b,
        "overlap_percent": 100.0 * pairs.overlap,
        "residual_mm": pairs.residual,
        "shared": pairs.shared,
        "used": yes_no(pairs.used),
        "scale_ppm": 1e6 * (pairs.scale - 1.0),
        "scale_ci95_ppm": 1e6 * NORMAL_95 * pairs.scale_sd,
        "message": pairs.reasons,
    }
    note = text(
        "Shared: planar pieces, or picked points, that both scans have. The scale of b in a is a diagnostic "
        "value unless it is free."
    )
    return tabulate(text("Pairs of scans, method {method}", method=method), cells, f"stitch-pairs{suffix}", note)


def _loops(result: Result, method: str, suffix: str) -> Table:
    closures = result.closures
    cells = {
        "loop": [" > ".join(loop) for loop in closures.loop],
        "mm": closures.mm,
        "mrad": closures.mrad,
        "ratio": closures.ratio,
    }
    note = text(
        "By the pairs' own poses. Ratio: squared misclosure over its expected value by the pairs' covariances; "
        "usually about 1."
    )
    return tabulate(text("Misclosures of loops, method {method}", method=method), cells, f"stitch-loops{suffix}", note)


def _matrices(result: Result, method: str) -> Table:
    named = [
        (f"T_{result.frame}_SOCS({name})", T)
        for name, T in zip(result.scans.name, result.scans.T_project_scan, strict=True)
    ]
    note = TO_PRCS
    if result.frame == ProjectFrame.GLCS:
        named.insert(0, ("T_GLCS_PRCS", result.T_GLCS_PRCS))
        note = TO_GLCS_BY_CONTROL if result.by_control else TO_GLCS_BY_POSE
    rows = tuple((name, *row.tolist()) for name, T in named if np.isfinite(T).all() for row in T[:3])
    title = text("Matrices, method {method}", method=method)
    return Table(title, columns("matrix", "x", "y", "z", "shift_mm"), rows, "", note, on_terminal=False)


def _control(result: Result, method: str, suffix: str) -> list[Table]:
    if result.control is None:
        return []
    sightings = result.control.sightings
    cells = {
        "point": sightings.point,
        "scan": sightings.scan,
        "dx_mm dy_mm dz_mm": sightings.off,
        "sd_x_mm sd_y_mm sd_z_mm": sightings.sd,
        "share_percent": 100.0 * sightings.share,
        "used": yes_no(sightings.used),
    }
    note = text(
        "Known minus measured place after the adjustment, one row per sighting. Share: how much of an error of the "
        "sighting is visible here; the poses absorb the rest. The sd of an unused sighting is that of its prediction."
    )
    return [tabulate(text("Control points, method {method}", method=method), cells, f"control{suffix}", note, units=MM)]


def poses_csv(result: Result) -> bytes:
    """Write poses as CSV: a row per scan, the 4 x 4 matrix row by row, mm, and the frames it maps from and to."""
    scans = result.scans
    places = (f"m{i}{j}" for i in range(4) for j in range(4))
    rows = (
        (
            csv_cell(name),
            scans.status[i],
            *(x if np.isfinite(x) else "" for x in scans.T_project_scan[i].ravel().tolist()),
            csv_cell(scans.from_frame[i]),
            csv_cell(scans.to_frame[i]),
        )
        for i, name in enumerate(scans.name)
    )
    return csv_of_rows(columns("scan", "status", *places, "from", "to"), rows, full=True).encode("utf-8")
