"""Tables of balls: their sizes and places, nodes against the design, tubes and stations."""

from __future__ import annotations

import collections
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.model import NORMAL_95, Floats, StepRun
from processor.report.table import NAN, Table
from processor.space_frame import result as space_frame_result
from processor.space_frame.result import Result
from processor.space_frame.spheres.baselines import SAME

XYZ = ("x", "y", "z")
COORDINATES = tuple(f"{axis}_mm" for axis in XYZ)
LOWEST_NOTE = (
    "Lowest point of each ball's sphere, in the input's own frame; a process hole cuts it away. ci95 is the half-width "
    "of the 95 % interval."
)
STATIONS_NOTE = (
    "How each station, as registered, had to be moved to agree with the tubes: at the middle of the balls, and by what "
    "turn; the transforms are in results.json."
)


def of_runs(runs: Sequence[StepRun], report: ErrorReport) -> list[Table]:
    """Tables of balls, what to look at first; ``runs`` are the answer and the methods compared with it."""
    first = runs[0].result
    whole = has_bounds(first)
    tables = [_radius_errors(runs, report)] if report.true_radii else []
    if whole:
        tables.append(_summary(first, runs[0].method))
    tables += _to_look_at(first, runs[0].method)
    for run in runs:
        true = report.true_radii.get(run.method, np.full(len(run.result.ids), NAN))
        file = "balls" if run is runs[0] else f"balls-{run.method}"
        tables.append(_with_bounds(run, true, file) if has_bounds(run.result) else _formal(run, true, file, runs[0]))
    if whole:
        tables += [_brief(first, runs[0].method), _lowest(first), *_nodes(first), *_tubes(first), *_stations(first)]
    return tables


def has_bounds(result: Result) -> bool:
    """Whether balls were found by method ``ray``: with the bounds of their estimates, and members if there are any."""
    return len(result.sizes) > 0


# --- balls ---------------------------------------------------------------------------------------------------------


def _formal(run: StepRun, true: Floats, file: str, first: StepRun) -> Table:
    """Balls by a method whose intervals are formal."""
    result = run.result
    half = NORMAL_95 * _sd(result)[:, 3]
    rows = tuple(
        (
            ball,
            *result.centres[i].tolist(),
            float(result.radii[i]),
            float(half[i]),
            float(true[i]),
            float(result.radii[i] - true[i]),
            float(result.lowest[i, 2]),
            NORMAL_95 * float(result.lowest_sd[i]),
            int(result.points[i]),
            result.flag[i],
            result.reason[i],
        )
        for i, ball in enumerate(result.ids.tolist())
    )
    columns = (
        "id", *COORDINATES, "radius_mm", "formal_ci95_radius_mm", "true_radius_mm", "radius_error_mm", "lowest_z_mm",
        "formal_ci95_lowest_z_mm", "points", "flag", "remark",
    )  # fmt: skip
    note = "" if run is first else result.message
    return Table(f"Balls, method {run.method} (mm)", columns, rows, file, note, on_terminal=run is first)


def _with_bounds(run: StepRun, true: Floats, file: str) -> Table:
    """All that is known of each ball, for a CSV file."""
    result = run.result
    half = NORMAL_95 * _sd(result)
    rows = tuple(
        (
            ball,
            *result.centres[i].tolist(),
            *half[i, :3].tolist(),
            float(result.radii[i]),
            float(half[i, 3]),
            float(result.sizes[i]),
            float(result.nominal_radii[i]),
            float(true[i]),
            float(result.radii[i] - true[i]),
            float(result.lowest[i, 2]),
            NORMAL_95 * float(result.lowest_sd[i]),
            *result.bound_sd[i].tolist(),
            *result.efficiency[i].tolist(),
            int(result.points[i]),
            float(result.visible_fraction[i]),
            float(result.rms[i]),
            int(result.axes[i]),
            int(result.stations[i]),
            result.evidence[i],
            result.flag[i],
            result.reason[i],
        )
        for i, ball in enumerate(result.ids.tolist())
    )
    columns = (
        "id", *COORDINATES, *(f"ci95_{one}" for one in COORDINATES), "radius_mm", "ci95_radius_mm", "size_mm",
        "nominal_radius_mm", "true_radius_mm", "radius_error_mm", "lowest_z_mm", "ci95_lowest_z_mm",
        *(f"bound_sd_{one}_mm" for one in (*XYZ, "radius", "lowest_z")),
        *(f"efficiency_{one}" for one in ("centre", "radius", "lowest_z")),
        "points", "visible_fraction", "rms_mm", "axes", "stations", "evidence", "flag", "remark",
    )  # fmt: skip
    return Table(f"Balls, method {run.method} (mm)", columns, rows, file, on_page=False, on_terminal=False)


def _brief(result: Result, method: str) -> Table:
    """Balls as the page shows them."""
    half = NORMAL_95 * _sd(result)[:, 3]
    rows = tuple(
        (
            ball,
            *result.centres[i].tolist(),
            float(result.radii[i]),
            float(half[i]),
            float(result.sizes[i]),
            float(result.lowest[i, 2]),
            NORMAL_95 * float(result.lowest_sd[i]),
            result.evidence[i],
            result.flag[i],
        )
        for i, ball in enumerate(result.ids.tolist())
    )
    columns = (
        "id", *COORDINATES, "radius_mm", "ci95_radius_mm", "size_mm", "lowest_z_mm", "ci95_lowest_z_mm", "evidence",
        "flag",
    )  # fmt: skip
    note = "Bounds, efficiencies and all else are in balls.csv."
    # of a few targets the answer is their places; of a frame that is too long to be looked through
    return Table(f"Balls, method {method} (mm)", columns, rows, note=note, on_terminal=not len(result.tube_radii))


def _to_look_at(result: Result, method: str) -> list[Table]:
    rows = tuple(
        (ball, result.flag[i], result.reason[i], *result.centres[i].tolist(), float(result.radii[i]))
        for i, ball in enumerate(result.ids.tolist())
        if result.flag[i] != "ok"
    )
    columns = ("id", "flag", "remark", *COORDINATES, "radius_mm")
    return [Table(f"Balls to look at, method {method} (mm)", columns, rows)] if rows else []


def _radius_errors(runs: Sequence[StepRun], report: ErrorReport) -> Table:
    rows = []
    for run in runs:
        error = np.abs(run.result.radii - report.true_radii[run.method])
        known = error[np.isfinite(error)]
        figures = np.quantile(known, [0.5, 0.95, 1.0]).tolist() if len(known) else [NAN] * 3
        rows.append((run.method, len(known), len(error), *figures, _points_used(run)))
    columns = ("method", "fitted", "balls", "median_mm", "quantile_95_mm", "largest_mm", "points_used")
    return Table("|radius error| by method (mm)", columns, tuple(rows), "summary")


def _points_used(run: StepRun) -> str:
    """Which points a method fitted: errors of methods compare only on the same ones."""
    if run.method == "ray":
        return "its own choice"
    return "those of ray" if SAME in run.result.message else "all of its crop"


def _sd(result: Result) -> Floats:
    """Return standard deviations (k, 4) of centre and radius; NaN where a variance is none."""
    variance = np.einsum("kii->ki", result.covariance)
    found: Floats = np.sqrt(np.where(variance >= 0.0, variance, NAN))
    return found


def _lowest(result: Result) -> Table:
    rows = tuple(
        (
            ball,
            *result.lowest[i].tolist(),
            NORMAL_95 * float(result.lowest_sd[i]),
            float(result.radii[i]),
            result.flag[i],
        )
        for i, ball in enumerate(result.ids.tolist())
    )
    columns = ("id", *COORDINATES, "ci95_z_mm", "radius_mm", "flag")
    return Table("Lowest points (mm)", columns, rows, "lowest", LOWEST_NOTE, on_page=False, on_terminal=False)


# --- the frame -----------------------------------------------------------------------------------------------------


def _summary(result: Result, method: str) -> Table:
    """Sum up the whole frame in a few lines."""
    flags, evidence = collections.Counter(result.flag), collections.Counter(result.evidence)
    rows: list[tuple[Any, ...]] = [("balls", len(result.ids), "")]
    rows += [(f"flag {name}", flags[name], "") for name in ("ok", "low-confidence", "wrong-size", "not-found")]
    rows += [(f"evidence {name}", evidence[name], "") for name in ("ball", "fused", "axes") if evidence[name]]
    for what, sd in (
        ("centre, along an axis", _sd(result)[:, :3]),
        ("radius", _sd(result)[:, 3]),
        ("height of the lowest point", result.lowest_sd),
    ):
        rows.append((f"95 % half-width of the {what}, median", _median(NORMAL_95 * sd), "mm"))
    rows += [(f"bound over sd of the {what}, median", _median(result.efficiency[:, k]), "")
             for k, what in enumerate(("centre", "radius", "lowest point"))]  # fmt: skip
    if result.matching:
        rows.append(("design matched", result.matching, ""))
    if result.gauge:
        rows += _moved(result)
    return Table(f"Balls in short, method {method}", ("what", "value", "unit"), tuple(rows))


def _moved(result: Result) -> Iterator[tuple[Any, ...]]:
    judged = space_frame_result.of_result(result)
    known = judged.size[np.isfinite(judged.size)]
    yield ("movement of a node, median", _median(known), "mm")
    yield ("movement of a node, largest", float(known.max()) if len(known) else NAN, "mm")
    counts = collections.Counter(judged.verdict)
    for name in (
        space_frame_result.PASS,
        space_frame_result.FAIL,
        space_frame_result.INDETERMINATE,
        space_frame_result.NO_LIMIT,
    ):
        if counts[name]:
            yield (f"nodes, verdict {name}", counts[name], "")


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else NAN


def _nodes(result: Result) -> list[Table]:
    """Nodes against the design, in the design's frame."""
    if not result.gauge:
        return []
    judged = space_frame_result.of_result(result)
    rows = tuple(
        (
            ball,
            *result.movement[i].tolist(),
            *result.movement_ci95[i].tolist(),
            float(judged.size[i]),
            float(judged.ci95[i]),
            result.movement_limit,
            judged.verdict[i],
            result.flag[i],
            result.reason[i],
        )
        for i, ball in enumerate(result.ids.tolist())
    )
    columns = (
        "id", "dx_mm", "dy_mm", "dz_mm", "ci95_dx_mm", "ci95_dy_mm", "ci95_dz_mm", "movement_mm", "ci95_movement_mm",
        "limit_mm", "verdict", "flag", "remark",
    )  # fmt: skip
    note = f"Found minus nominal, axes of the design; relative to: {result.gauge}. "
    if math.isnan(result.movement_limit):
        note += "No limit: the standards here set none for a node's place; a project may (node_place_mm)."
    else:
        note += (
            f"Limit {result.movement_limit:g} mm by {result.movement_limit_source}: pass where movement and interval "
            "keep within it, fail where it is beyond by more than the interval, else indeterminate."
        )
    if result.matching != "ok":
        note += f" Which node is which is not certain (matching {result.matching})."
    return [Table("Nodes against the design (mm)", columns, rows, "nodes", note, on_terminal=False)]


def _tubes(result: Result) -> list[Table]:
    if not len(result.tube_radii):
        return []
    length = np.linalg.norm(result.tube_end - result.tube_start, axis=1)
    rows = tuple(
        (
            i,
            int(result.tube_a[i]) if result.tube_a[i] >= 0 else "",
            int(result.tube_b[i]) if result.tube_b[i] >= 0 else "",
            *result.tube_start[i].tolist(),
            *result.tube_end[i].tolist(),
            float(length[i]),
            float(result.tube_radii[i]),
            float(result.tube_bow[i]),
        )
        for i in range(len(length))
    )
    columns = (
        "tube", "ball_a", "ball_b", *(f"start_{one}" for one in COORDINATES), *(f"end_{one}" for one in COORDINATES),
        "length_mm", "radius_mm", "bow_mm",
    )  # fmt: skip
    note = "Axes from where a tube is seen first to where it is seen last; bow is the largest departure from straight."
    return [Table("Tubes (mm)", columns, rows, "tubes", note, on_page=False, on_terminal=False)]


def _stations(result: Result) -> list[Table]:
    if not result.station_names:
        return _control(result)
    known = np.isfinite(result.centres).all(axis=1)
    middle = result.centres[known].mean(axis=0) if known.any() else np.zeros(3)
    rows = []
    for name, T, said in zip(result.station_names, result.T_station, result.station_said, strict=True):
        R = T[:3, :3]
        # Of a small turn: where coordinates are large a translation means nothing, the shift at the balls does.
        turn = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        shift = (R - np.eye(3)) @ middle + T[:3, 3]
        rows.append((name, *shift.tolist(), *(1000.0 * turn).tolist(), said))
    columns = (
        "station", "dx_mm", "dy_mm", "dz_mm", "turn_x_mrad", "turn_y_mrad", "turn_z_mrad", "remark",
    )  # fmt: skip
    note = f"{STATIONS_NOTE} What holds all of them: {result.datum}." if result.datum else STATIONS_NOTE
    return [Table("Stations against each other (mm, mrad)", columns, tuple(rows), "stations", note), *_control(result)]


def _control(result: Result) -> list[Table]:
    sightings = zip(result.control_names, result.control_off, result.control_used, result.control_scan, strict=True)
    rows = tuple(
        (name, *off.tolist(), float(np.linalg.norm(off)), "yes" if used else "no, the others speak against it", scan)
        for name, off, used, scan in sightings
    )
    columns = ("control_point", "dx_mm", "dy_mm", "dz_mm", "off_mm", "used", "scan")
    note = "Known place minus where the scans have it after the stations were moved; a row a sighting."
    return [Table("Control points (mm)", columns, rows, "control", note)] if rows else []
