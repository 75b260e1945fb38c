"""Tables of balls: their sizes and places, nodes against the design, tubes and stations."""

from __future__ import annotations

import collections
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Message, label, text
from processor.limits.judging import Judged
from processor.model import NORMAL_95, Floats, Scene, Status, StepRun, Verdict
from processor.report.characteristics import with_interval
from processor.report.columns import MM, XYZ, columns, under
from processor.report.sheet.picture import Callout
from processor.report.space_frame import hanger_report
from processor.report.table import NAN, PLUS_MINUS, Table, rows_of, tabulate
from processor.robust_statistics import finite_median
from processor.space_frame.result import Balls, Evidence, Flag, Result
from processor.space_frame.spheres.baselines import SAME

PLACE, SHIFT = (" ".join(pattern.format(axis) for axis in XYZ) for pattern in ("{}_mm", "d{}_mm"))
PLACE_CI95, SHIFT_CI95 = (" ".join(f"ci95_{name}" for name in names.split()) for names in (PLACE, SHIFT))
SIZES = (
    "id", PLACE, "radius_mm", "ci95_radius_mm", "true_radius_mm", "radius_error_mm", "lowest_z_mm", "ci95_lowest_z_mm",
)  # fmt: skip
BRIEF = (
    "id", PLACE, "radius_mm", "ci95_radius_mm", "size_mm", "lowest_z_mm", "ci95_lowest_z_mm", "evidence", "flag",
)  # fmt: skip
MOST_FLAGGED, MOST_MOVED = 4, 3  # named in the picture of the sheet
OF_FRAME: dict[str, Any] = {"units": MM, "on_terminal": False}
OF_FILE: dict[str, Any] = {**OF_FRAME, "on_page": False}


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
        cells = _cells(run.result.balls, true)
        if run.result.has_bounds:
            table = tabulate(_title(run.method), cells, file, **OF_FILE)
        else:  # its intervals are formal
            names = (*SIZES, "points", "flag", "remark")
            cells = {name.replace("ci95_", "formal_ci95_"): cells[name] for name in names}
            note = "" if run is runs[0] else text("{reasons}", reasons=run.result.reasons)
            table = tabulate(_title(run.method), cells, file, note, units=MM, on_terminal=run is runs[0])
        tables.append(table)
    tables += hanger_report.tables(first)
    if whole:
        tables += [_brief(first, runs[0].method), _lowest(first.balls), *_nodes(first), *_tubes(first)]
        tables += [*_stations(first), *_control(first)]
    return tables


def _title(method: str) -> Message:
    return text("Balls, method {method}", method=method)


def _cells(balls: Balls, true: Floats) -> dict[str, Any]:
    """Return all figures of each ball, with the true radii (k,)."""
    half = NORMAL_95 * _sd(balls)
    return {
        "id": balls.names,
        PLACE: balls.centres,
        PLACE_CI95: half[:, :3],
        "radius_mm": balls.radii,
        "ci95_radius_mm": half[:, 3],
        "size_mm": balls.sizes,
        "nominal_radius_mm": balls.nominal_radii,
        "true_radius_mm": true,
        "radius_error_mm": balls.radii - true,
        "lowest_z_mm": balls.lowest[:, 2],
        "ci95_lowest_z_mm": NORMAL_95 * balls.lowest_sd,
        " ".join(f"bound_sd_{name}_mm" for name in (*XYZ, "radius", "lowest_z")): balls.bound_sd,
        " ".join(f"efficiency_{name}" for name in ("centre", "radius", "lowest_z")): balls.efficiency,
        "points": balls.points,
        "visible_fraction": balls.visible_fraction,
        "rms_mm": balls.rms,
        "axes": balls.axes,
        "stations": balls.stations,
        "evidence": balls.evidence,
        "flag": balls.flag,
        "remark": balls.reasons,
    }


def _brief(result: Result, method: str) -> Table:
    """Balls as the page shows them."""
    every = _cells(result.balls, np.full(len(result.balls), NAN))
    cells = {name: every[name] for name in BRIEF}
    note = text("Bounds, efficiencies and all other figures are in balls.csv.")
    # A few targets fit on a terminal, the balls of a frame do not.
    return tabulate(_title(method), cells, note=note, units=MM, on_terminal=not len(result.tubes))


def _flagged(result: Result, method: str) -> list[Table]:
    flagged = ~result.balls.flagged(Flag.OK)
    if not flagged.any():
        return []
    balls = result.balls.take(flagged)
    cells = {
        "id": balls.names, "flag": balls.flag, "remark": balls.reasons, PLACE: balls.centres, "radius_mm": balls.radii,
    }  # fmt: skip
    return [tabulate(text("Flagged balls, method {method}", method=method), cells, units=MM)]


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
    cells = {
        "id": balls.names,
        PLACE: balls.lowest,
        "ci95_z_mm": NORMAL_95 * balls.lowest_sd,
        "radius_mm": balls.radii,
        "flag": balls.flag,
    }
    return tabulate(text("Lowest points"), cells, "lowest", **OF_FILE)


MOST_LISTED = 80  # balls on the sheet: two pages
LISTED = (
    "id", "x_m", "y_m", "z_m", "ci95_mm", "radius_mm", "ci95_radius_mm", "lowest_z_m", "ci95_lowest_z_mm",
)  # fmt: skip
LISTED_NOTE = text(
    "Centres and lowest points in the frame of the input, metres; ± is the half-width of the 95 % interval, of a "
    "centre the widest of the three. {movements}"
)


def listed(_: Scene, run: StepRun) -> list[Table]:
    """List the balls for the sheet: coordinates, lowest points, movements; of very many the flagged and most moved."""
    result: Result = run.result
    half, size = NORMAL_95 * _sd(result.balls), result.balls.movement_size
    flagged = ~result.balls.flagged(Flag.OK)
    moved = np.nan_to_num(size) if len(size) else np.zeros(len(result.balls))
    rows = np.sort(np.lexsort((-moved, ~flagged))[:MOST_LISTED])
    balls, half = result.balls.take(rows), half[rows]
    cells: dict[str, Any] = {
        "id": balls.names,
        "x_m y_m z_m": balls.centres / 1000.0,
        "ci95_mm": half[:, :3].max(axis=1),
        "radius_mm": balls.radii,
        "ci95_radius_mm": half[:, 3],
        "lowest_z_m": balls.lowest[:, 2] / 1000.0,
        "ci95_lowest_z_mm": NORMAL_95 * balls.lowest_sd,
    }
    if result.movement_reference is not None:
        cells |= {SHIFT: balls.movement, "movement_mm": balls.movement_size,
                  "ci95_movement_mm": balls.movement_size_ci95}  # fmt: skip
        if set(balls.verdict) - {Verdict.NONE}:
            cells["verdict"] = balls.verdict
    if flagged.any():
        cells["flag"] = ["" if flag is Flag.OK else flag for flag in balls.flag]
    movements = "" if result.movement_reference is None else _nodes_note(result)
    note = text(LISTED_NOTE.template, movements=movements)
    if len(rows) < len(flagged):
        note = text("{note} {count} of {all} balls; the others are in balls.csv.", note=note, count=len(rows),
                    all=len(flagged))  # fmt: skip
    table = tabulate(text("Balls: coordinates, lowest points, movements"), cells, note=note)
    short = {"ci95_mm": PLUS_MINUS, "ci95_lowest_z_mm": PLUS_MINUS}
    return [
        replace(table, columns=tuple(replace(one, heading=short.get(one.name, one.heading)) for one in table.columns))
    ]


def characteristics(_: Scene, run: StepRun) -> list[Judged]:
    """Return the movements of nodes that are compared with the limit of their place."""
    result: Result = run.result
    balls, reference = result.balls, result.movement_reference
    if reference is None:
        return []
    risks = (balls.risk_accept, balls.risk_reject) if len(balls.risk_accept) else 2 * (np.full(len(balls), NAN),)
    return [
        Judged(
            of=text("node {id}", id=name), value=value, ci95=half, high=reference.limit, low=-math.inf, verdict=verdict,
            risk_accept=accept, risk_reject=reject, clause=label(reference.limit_source),
        )
        for name, value, half, verdict, accept, reject in zip(
            balls.names, balls.movement_size, balls.movement_size_ci95, balls.verdict, *risks, strict=False
        )
        if verdict is not Verdict.NONE and math.isfinite(value)
    ]  # fmt: skip


def callouts(scene: Scene, run: StepRun) -> list[Callout]:
    """Say at balls of the design what is flagged, and how far those moved most did; without a design name the balls."""
    result: Result = run.result
    balls = result.balls
    if scene.frame is None:
        return [
            Callout(place, text("{name}", name=name)) for name, place in zip(balls.names, balls.centres, strict=True)
        ]
    place_of = dict(zip(scene.frame.ids.tolist(), scene.frame.centres, strict=True))
    moved = rows_of(balls.movement_size, balls.movement_size_ci95)
    order = np.argsort(-np.nan_to_num(balls.movement_size), kind="stable").tolist() if len(balls.movement_size) else []
    found, half = [], NORMAL_95 * _sd(balls)[:, 3]
    for k in dict.fromkeys([*np.flatnonzero(~balls.flagged(Flag.OK)).tolist()[:MOST_FLAGGED], *order[:MOST_MOVED]]):
        flag, place = balls.flag[k], place_of.get(int(balls.ids[k]))
        if place is None:
            continue
        verdict, said = Verdict.NONE if flag is Flag.OK else Verdict.INDETERMINATE, [balls.names[k]]
        if flag is not Flag.OK:
            said += [flag, text("radius {size}", size=with_interval(balls.radii[k], half[k], "mm", ""))]
        if len(order) and np.isfinite(balls.movement_size[k]):
            said.append(text("moved {by}", by=with_interval(moved[k][0], moved[k][1], "mm", "")))
            verdict = balls.verdict[k] if balls.verdict[k] is Verdict.FAIL else verdict
        found.append(Callout(place, text("{said}", said=said), verdict))
    return found


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
    cells = {
        "id": balls.names,
        SHIFT: balls.movement,
        SHIFT_CI95: balls.movement_ci95,
        "movement_mm": balls.movement_size,
        "ci95_movement_mm": balls.movement_size_ci95,
        "limit_mm": [reference.limit] * len(balls),
        "verdict": ["" if math.isnan(size) else verdict
                    for size, verdict in zip(balls.movement_size, balls.verdict, strict=True)],
        "flag": balls.flag,
        "remark": balls.reasons,
    }  # fmt: skip
    title, note = text("Nodes against the design"), _nodes_note(result)
    if result.gauges is None:  # of an earlier version
        return [tabulate(title, cells, "nodes", note, **OF_FRAME)]
    by_gauge = {
        f"{half}{gauge}_d{axis}_mm": values[:, k] if len(values) else [NAN] * len(balls)
        for gauge, half, values in (
            ("design", "", balls.design_movement), ("design", "ci95_", balls.design_ci95),
            ("best_fit", "", balls.best_fit_movement), ("best_fit", "ci95_", balls.best_fit_ci95),
        )
        for k, axis in enumerate(XYZ)
    }  # fmt: skip
    full = tabulate(title, {**cells, "gauge": balls.movement_gauge, **by_gauge}, "nodes", note, **OF_FILE)
    return [tabulate(title, cells, note=note, **OF_FRAME), *_gauges(result), full]


def _gauges(result: Result) -> list[Table]:
    """Movements by both gauges beside each other, and how far they differ; none where there is one gauge."""
    balls, gauges = result.balls, result.gauges
    if gauges is None or not len(balls.design_movement):
        return []
    difference = np.linalg.norm(balls.design_movement - balls.best_fit_movement, axis=1)
    known = np.isfinite(difference)
    moved = balls.take(known)
    rows = rows_of(moved.names, moved.design_movement, moved.best_fit_movement, difference[known])
    header = (
        *columns("id"),
        *under(text("differences of coordinates"), *SHIFT.split()),
        *under(text("relative to a best fit"), *SHIFT.split()),
        *columns("difference_mm"),
    )
    note = text(
        "The answer is by {gauge}. The two differ by a motion of the whole: {mean:.2f} mm on average, {largest:.2f} mm "
        "at most.",
        gauge=gauges.gauge,
        mean=float(np.linalg.norm(gauges.difference)),
        largest=gauges.largest_difference,
    )
    return [Table(text("Movements by both gauges"), header, rows, note=note, **OF_FRAME)]


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
    ball_a, ball_b = zip(*tubes.ends, strict=True)
    start, end = tubes.start_ci95.max(axis=1), tubes.end_ci95.max(axis=1)
    cells = {
        "tube": range(len(tubes)),
        "ball_a": ball_a,
        "ball_b": ball_b,
        "start_x_mm start_y_mm start_z_mm": tubes.start,
        "end_x_mm end_y_mm end_z_mm": tubes.end,
        "length_mm": np.linalg.norm(tubes.end - tubes.start, axis=1),
        "radius_mm": tubes.radii,
        "ci95_radius_mm": tubes.radius_ci95,
        "ci95_axis_mm": np.where(end > start, end, start),
        "bow_mm": tubes.bow,
    }
    return [tabulate(text("Tubes"), cells, "tubes", **OF_FILE)]


def _stations(result: Result) -> list[Table]:
    stations, balls = result.stations, result.balls
    if not len(stations):
        return []
    middle = balls.centres[balls.placed].mean(axis=0) if balls.placed.any() else np.zeros(3)
    R = stations.T[:, :3, :3]
    # Of a small turn. Where coordinates are large the translation is not meaningful, the shift at the balls is.
    turn = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    cells = {
        "station": stations.names,
        SHIFT: (R - np.eye(3)) @ middle + stations.T[:, :3, 3],
        "turn_x_mrad turn_y_mrad turn_z_mrad": 1000.0 * turn,
        "remark": stations.reasons,
    }
    note = text(
        "Corrections of the stations, as registered, by which they agree with the tubes: shift at the middle of the "
        "balls, and turn; the transforms are in results.json."
    )
    if result.datum:
        note = text("{note} Datum of all stations: {datum}.", note=note, datum=result.datum)
    return [tabulate(text("Stations against each other"), cells, "stations", note, units=("mm", "mrad"))]


def _control(result: Result) -> list[Table]:
    control = result.control
    if not len(control):
        return []
    cells = {
        "control_point": control.points,
        SHIFT: control.off,
        "off_mm": np.linalg.norm(control.off, axis=1),
        "used": [text("yes") if used else text("no, contradicts the others") for used in control.used],
        "scan": control.scans,
    }
    note = text("Known place minus sighting after the corrections of the stations; one row per sighting.")
    return [tabulate(text("Control points"), cells, "control", note, units=MM)]
