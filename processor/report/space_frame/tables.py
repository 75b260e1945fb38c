"""Tables of balls: their sizes and places, nodes against the design, tubes and stations."""

from __future__ import annotations

import collections
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Message, text
from processor.model import NORMAL_95, Floats, Status, StepRun, Verdict
from processor.report.columns import MM, XYZ, columns, under
from processor.report.space_frame import hanger_report
from processor.report.table import NAN, Table
from processor.robust_statistics import finite_median
from processor.space_frame.result import Balls, Evidence, Flag, Result
from processor.space_frame.spheres.baselines import SAME

COORDINATES = tuple(f"{axis}_mm" for axis in XYZ)
BY_GAUGE = tuple(
    f"{half}{gauge}_d{axis}_mm" for gauge in ("design", "best_fit") for half in ("", "ci95_") for axis in XYZ
)


def step_tables(runs: Sequence[StepRun], report: ErrorReport) -> list[Table]:
    """Tabulate balls, the flagged ones first; ``runs`` are the result and those of methods compared with it."""
    first = runs[0].result
    whole = first.has_bounds
    tables = [_radius_errors(runs, report)] if report.true_radii else []
    if whole:
        tables.append(_summary(first, runs[0].method))
    tables += _flagged(first, runs[0].method)
    for run in runs:
        true = report.true_radii.get(run.method, np.full(len(run.result.balls), NAN))
        file = "balls" if run is runs[0] else f"balls-{run.method}"
        table = _with_bounds(run, true, file) if run.result.has_bounds else _formal(run, true, file, runs[0])
        tables.append(replace(table, folded=run is not runs[0]))
    tables += hanger_report.tables(first)
    if whole:
        tables += [_brief(first, runs[0].method), _lowest(first.balls), *_nodes(first), *_tubes(first)]
        tables += [*_stations(first), *_control(first)]
    return tables


def _formal(run: StepRun, true: Floats, file: str, first: StepRun) -> Table:
    """Balls by a method whose intervals are formal."""
    balls = run.result.balls
    half = NORMAL_95 * _sd(balls)[:, 3]
    rows = tuple(
        (
            ball,
            *balls.centres[i].tolist(),
            float(balls.radii[i]),
            float(half[i]),
            float(true[i]),
            float(balls.radii[i] - true[i]),
            float(balls.lowest[i, 2]),
            NORMAL_95 * float(balls.lowest_sd[i]),
            int(balls.points[i]),
            balls.flag[i],
            balls.reasons[i],
        )
        for i, ball in enumerate(balls.names)
    )
    header = columns(
        "id", *COORDINATES, "radius_mm", "formal_ci95_radius_mm", "true_radius_mm", "radius_error_mm", "lowest_z_mm",
        "formal_ci95_lowest_z_mm", "points", "flag", "remark",
    )  # fmt: skip
    note = "" if run is first else text("{reasons}", reasons=run.result.reasons)
    return Table(_title(run.method), header, rows, file, note, units=MM, on_terminal=run is first)


def _title(method: str) -> Message:
    return text("Balls, method {method}", method=method)


def _with_bounds(run: StepRun, true: Floats, file: str) -> Table:
    """All figures of each ball, for a CSV file."""
    balls = run.result.balls
    half = NORMAL_95 * _sd(balls)
    rows = tuple(
        (
            ball,
            *balls.centres[i].tolist(),
            *half[i, :3].tolist(),
            float(balls.radii[i]),
            float(half[i, 3]),
            float(balls.sizes[i]),
            float(balls.nominal_radii[i]),
            float(true[i]),
            float(balls.radii[i] - true[i]),
            float(balls.lowest[i, 2]),
            NORMAL_95 * float(balls.lowest_sd[i]),
            *balls.bound_sd[i].tolist(),
            *balls.efficiency[i].tolist(),
            int(balls.points[i]),
            float(balls.visible_fraction[i]),
            float(balls.rms[i]),
            int(balls.axes[i]),
            int(balls.stations[i]),
            balls.evidence[i],
            balls.flag[i],
            balls.reasons[i],
        )
        for i, ball in enumerate(balls.names)
    )
    header = columns(
        "id", *COORDINATES, *(f"ci95_{name}" for name in COORDINATES), "radius_mm", "ci95_radius_mm", "size_mm",
        "nominal_radius_mm", "true_radius_mm", "radius_error_mm", "lowest_z_mm", "ci95_lowest_z_mm",
        *(f"bound_sd_{name}_mm" for name in (*XYZ, "radius", "lowest_z")),
        *(f"efficiency_{name}" for name in ("centre", "radius", "lowest_z")),
        "points", "visible_fraction", "rms_mm", "axes", "stations", "evidence", "flag", "remark",
    )  # fmt: skip
    return Table(_title(run.method), header, rows, file, units=MM, on_page=False, on_terminal=False)


def _brief(result: Result, method: str) -> Table:
    """Balls as the page shows them."""
    balls = result.balls
    half = NORMAL_95 * _sd(balls)[:, 3]
    rows = tuple(
        (
            ball,
            *balls.centres[i].tolist(),
            float(balls.radii[i]),
            float(half[i]),
            float(balls.sizes[i]),
            float(balls.lowest[i, 2]),
            NORMAL_95 * float(balls.lowest_sd[i]),
            balls.evidence[i],
            balls.flag[i],
        )
        for i, ball in enumerate(balls.names)
    )
    header = columns(
        "id", *COORDINATES, "radius_mm", "ci95_radius_mm", "size_mm", "lowest_z_mm", "ci95_lowest_z_mm", "evidence",
        "flag",
    )  # fmt: skip
    note = text("Bounds, efficiencies and all other figures are in balls.csv.")
    # A few targets fit on a terminal, the balls of a frame do not.
    return Table(_title(method), header, rows, note=note, units=MM, on_terminal=not len(result.tubes))


def _flagged(result: Result, method: str) -> list[Table]:
    balls = result.balls
    rows = tuple(
        (ball, balls.flag[i], balls.reasons[i], *balls.centres[i].tolist(), float(balls.radii[i]))
        for i, ball in enumerate(balls.names)
        if balls.flag[i] is not Flag.OK
    )
    header = columns("id", "flag", "remark", *COORDINATES, "radius_mm")
    title = text("Flagged balls, method {method}", method=method)
    return [Table(title, header, rows, units=MM)] if rows else []


def _radius_errors(runs: Sequence[StepRun], report: ErrorReport) -> Table:
    rows = []
    for run in runs:
        error = np.abs(run.result.balls.radii - report.true_radii[run.method])
        finite = error[np.isfinite(error)]
        figures = np.quantile(finite, [0.5, 0.95, 1.0]).tolist() if len(finite) else [NAN] * 3
        # Errors of methods are comparable only on the same points.
        points = text("those of ray") if SAME in run.result.reasons else text("all of its crop")
        if run.method == "ray":
            points = text("selected by the method")
        rows.append((run.method, len(finite), len(error), *figures, points))
    header = columns("method", "fitted", "balls", "median_mm", "quantile_95_mm", "largest_mm", "points_used")
    return Table(text("|radius error| by method"), header, tuple(rows), "summary", units=MM)


def _sd(balls: Balls) -> Floats:
    """Return standard deviations (k, 4) of centre and radius; NaN where a variance is negative or NaN."""
    variance = np.einsum("kii->ki", balls.covariance)
    sd: Floats = np.sqrt(np.where(variance >= 0.0, variance, NAN))
    return sd


def _lowest(balls: Balls) -> Table:
    rows = tuple(
        (ball, *balls.lowest[i].tolist(), NORMAL_95 * float(balls.lowest_sd[i]), float(balls.radii[i]), balls.flag[i])
        for i, ball in enumerate(balls.names)
    )
    header = columns("id", *COORDINATES, "ci95_z_mm", "radius_mm", "flag")
    note = text(
        "Lowest point of each ball's sphere, in the input's own frame; a process hole cuts it away. ci95 is the "
        "half-width of the 95 % interval."
    )
    return Table(text("Lowest points"), header, rows, "lowest", note, units=MM, on_page=False, on_terminal=False)


# --- the frame -----------------------------------------------------------------------------------------------------


def _summary(result: Result, method: str) -> Table:
    """Summarise the whole frame in a few rows."""
    balls = result.balls
    flags, evidence = collections.Counter(balls.flag), collections.Counter(balls.evidence)
    rows: list[tuple[Any, ...]] = [(text("balls"), len(balls), "")]
    rows += [(text("flag {flag}", flag=flag), flags[flag], "") for flag in Flag]
    rows += [(text("evidence {evidence}", evidence=kind), evidence[kind], "") for kind in Evidence if evidence[kind]]
    for quantity, sd in (
        (text("centre, along an axis"), _sd(balls)[:, :3]),
        (text("radius"), _sd(balls)[:, 3]),
        (text("height of the lowest point"), balls.lowest_sd),
    ):
        name = text("95 % half-width of the {quantity}, median", quantity=quantity)
        rows.append((name, finite_median(NORMAL_95 * sd), "mm"))
    for k, quantity in enumerate((text("centre"), text("radius"), text("lowest point"))):
        name = text("bound over sd of the {quantity}, median", quantity=quantity)
        rows.append((name, finite_median(balls.efficiency[:, k]), ""))
    if result.matching is not None:
        rows.append((text("matching with the design"), result.matching.status, ""))
    if result.movement_reference is not None:
        rows += _movements(balls)
    return Table(text("Balls in short, method {method}", method=method), columns("what", "value", "unit"), tuple(rows))


def _movements(balls: Balls) -> Iterator[tuple[Any, ...]]:
    has_movement = np.isfinite(balls.movement_size)
    known = balls.movement_size[has_movement]
    yield text("movement of a node, median"), finite_median(known), "mm"
    yield text("movement of a node, largest"), float(known.max()) if len(known) else NAN, "mm"
    counts = collections.Counter(verdict for verdict, known in zip(balls.verdict, has_movement, strict=True) if known)
    for verdict in Verdict:
        if counts[verdict]:
            yield text("nodes, verdict {verdict}", verdict=verdict), counts[verdict], ""


def _nodes(result: Result) -> list[Table]:
    """Nodes against the design, in the design's frame."""
    balls, reference = result.balls, result.movement_reference
    if reference is None:
        return []
    rows = tuple(
        (
            ball,
            *balls.movement[i].tolist(),
            *balls.movement_ci95[i].tolist(),
            float(balls.movement_size[i]),
            float(balls.movement_size_ci95[i]),
            reference.limit,
            balls.verdict[i] if np.isfinite(balls.movement_size[i]) else "",
            balls.flag[i],
            balls.reasons[i],
        )
        for i, ball in enumerate(balls.names)
    )
    header = columns(
        "id", "dx_mm", "dy_mm", "dz_mm", "ci95_dx_mm", "ci95_dy_mm", "ci95_dz_mm", "movement_mm", "ci95_movement_mm",
        "limit_mm", "verdict", "flag", "remark",
    )  # fmt: skip
    title, note = text("Nodes against the design"), _nodes_note(result)
    if result.gauges is None:  # of an earlier version
        return [Table(title, header, rows, "nodes", note, units=MM, on_terminal=False)]
    by_gauge = [_by_gauge(result, i) for i in range(len(balls))]
    full = Table(
        title, (*header, *columns("gauge", *BY_GAUGE)),
        tuple((*row, *more) for row, more in zip(rows, by_gauge, strict=True)),
        "nodes", note, units=MM, on_page=False, on_terminal=False,
    )  # fmt: skip
    return [Table(title, header, rows, note=note, units=MM, on_terminal=False), *_gauges(result), full]


def _by_gauge(result: Result, i: int) -> tuple[Any, ...]:
    """Return the gauge of a node's movement, and the movement with its intervals by each gauge."""
    balls = result.balls
    numbers = [
        column[i].tolist() if len(column) else [NAN] * 3
        for column in (balls.design_movement, balls.design_ci95, balls.best_fit_movement, balls.best_fit_ci95)
    ]
    return (balls.movement_gauge[i], *(number for three in numbers for number in three))


def _gauges(result: Result) -> list[Table]:
    """Movements by both gauges beside each other, and how far they differ; none where there is one gauge."""
    balls, gauges = result.balls, result.gauges
    if gauges is None or not len(balls.design_movement):
        return []
    difference = np.linalg.norm(balls.design_movement - balls.best_fit_movement, axis=1)
    rows = tuple(
        (ball, *balls.design_movement[i].tolist(), *balls.best_fit_movement[i].tolist(), float(difference[i]))
        for i, ball in enumerate(balls.names)
        if np.isfinite(difference[i])
    )
    axes = ("dx_mm", "dy_mm", "dz_mm")
    header = (
        *columns("id"),
        *under(text("differences of coordinates"), *axes),
        *under(text("relative to a best fit"), *axes),
        *columns("difference_mm"),
    )
    note = text(
        "The answer is by {gauge}. The two differ by a motion of the whole: {mean:.2f} mm on average, {largest:.2f} mm "
        "at most.",
        gauge=gauges.gauge,
        mean=float(np.linalg.norm(gauges.difference)),
        largest=gauges.largest_difference,
    )
    return [Table(text("Movements by both gauges"), header, rows, note=note, units=MM, on_terminal=False)]


def _nodes_note(result: Result) -> Message:
    reference, matching = result.movement_reference, result.matching
    assert reference is not None
    if math.isnan(reference.limit):
        limit = text("No limit: the standards here have none for a node's place; a project may (node_place_mm).")
    else:
        limit = text(
            "Limit {limit:g} mm by {source}: pass where movement and interval are within it, fail where the movement "
            "exceeds it by more than the interval, else indeterminate.",
            limit=reference.limit,
            source=reference.limit_source,
        )
    doubt: Message | str = ""
    if matching is not None and matching.status is not Status.OK:
        doubt = text(" The assignment of the nodes is not certain (matching {status}).", status=matching.status)
    gauge: Message = reference.gauge
    if result.gauges is not None:
        gauge = text("{gauge} ({basis})", gauge=reference.gauge, basis=result.gauges.basis)
    return text(
        "Found minus nominal, axes of the design; gauge: {gauge}. {limit}{doubt}",
        gauge=gauge,
        limit=limit,
        doubt=doubt,
    )


def _tubes(result: Result) -> list[Table]:
    tubes = result.tubes
    if not len(tubes):
        return []
    length, ends = np.linalg.norm(tubes.end - tubes.start, axis=1), tubes.ends
    rows = tuple(
        (
            i,
            *ends[i],
            *tubes.start[i].tolist(),
            *tubes.end[i].tolist(),
            float(length[i]),
            float(tubes.radii[i]),
            float(tubes.radius_ci95[i]),
            float(max(tubes.start_ci95[i].max(), tubes.end_ci95[i].max())),
            float(tubes.bow[i]),
        )
        for i in range(len(tubes))
    )
    header = columns(
        "tube", "ball_a", "ball_b", *(f"start_{one}" for one in COORDINATES), *(f"end_{one}" for one in COORDINATES),
        "length_mm", "radius_mm", "ci95_radius_mm", "ci95_axis_mm", "bow_mm",
    )  # fmt: skip
    note = text("Axes between the ends of the scanned stretch; bow is the largest deviation from a straight line.")
    return [Table(text("Tubes"), header, rows, "tubes", note, units=MM, on_page=False, on_terminal=False)]


def _stations(result: Result) -> list[Table]:
    stations, balls = result.stations, result.balls
    if not len(stations):
        return []
    middle = balls.centres[balls.placed].mean(axis=0) if balls.placed.any() else np.zeros(3)
    rows = []
    for name, T, reasons in zip(stations.names, stations.T, stations.reasons, strict=True):
        R = T[:3, :3]
        # Of a small turn. Where coordinates are large the translation is not meaningful, the shift at the balls is.
        turn = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        shift = (R - np.eye(3)) @ middle + T[:3, 3]
        rows.append((name, *shift.tolist(), *(1000.0 * turn).tolist(), reasons))
    header = columns(
        "station", "dx_mm", "dy_mm", "dz_mm", "turn_x_mrad", "turn_y_mrad", "turn_z_mrad", "remark",
    )  # fmt: skip
    note = text(
        "Corrections of the stations, as registered, by which they agree with the tubes: shift at the middle of the "
        "balls, and turn; the transforms are in results.json."
    )
    if result.datum:
        note = text("{note} Datum of all stations: {datum}.", note=note, datum=result.datum)
    return [Table(text("Stations against each other"), header, tuple(rows), "stations", note, units=("mm", "mrad"))]


def _control(result: Result) -> list[Table]:
    control = result.control
    rows = tuple(
        (
            name,
            *off.tolist(),
            float(np.linalg.norm(off)),
            text("yes") if used else text("no, contradicts the others"),
            scan,
        )
        for name, off, used, scan in zip(control.points, control.off, control.used, control.scans, strict=True)
    )
    header = columns("control_point", "dx_mm", "dy_mm", "dz_mm", "off_mm", "used", "scan")
    note = text("Known place minus sighting after the corrections of the stations; one row per sighting.")
    return [Table(text("Control points"), header, rows, "control", note, units=MM)] if rows else []
