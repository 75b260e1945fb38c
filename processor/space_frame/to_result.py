"""Conversion of the result of method ``ray`` to the result of step ``spheres``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from processor.adjustment import thermal
from processor.limits import measurands, standards
from processor.model import NORMAL_95, Floats, FrameDesign, Ints, Reason, Scene, Status, Tolerance, Verdict, reason
from processor.space_frame import ball_catalogue, supports_and_deflections
from processor.space_frame.design import movement
from processor.space_frame.design.matching import FrameRelation, Matching
from processor.space_frame.design.movement import Movement, size_of
from processor.space_frame.extract import Extracted, Options, extract
from processor.space_frame.members.records import Members
from processor.space_frame.params import Params
from processor.space_frame.points.source import SceneSource
from processor.space_frame.result import (
    NAN,
    Balls,
    ControlDeviations,
    DesignPose,
    Evidence,
    Flag,
    GaugeBasis,
    Gauges,
    MovementGauge,
    MovementReference,
    Result,
    StationCorrections,
    Tubes,
)
from processor.space_frame.spheres import baselines
from processor.space_frame.spheres.unnamed_view_errors import of_tubes
from processor.space_frame.stations import station_error_propagation
from processor.space_frame.stations.records import Stations
from processor.space_frame.stations.sightings import control_of
from processor.views import PointReader, views

UNUSED_CONTROL = reason("spheres.unused-control")


def of_frame(scene: Scene, params: Params, points: PointReader | None = None) -> Result | None:
    """Find every sphere of a frame's scene; None where the cloud has no members that meet."""
    source = SceneSource(views(scene, reader=points))
    extracted = _extracted(source, scene, params)
    return None if extracted is None else _result(extracted, source, scene)


def beside_ray(scene: Scene, params: Params) -> Result | None:
    """Fit the spheres that method ``ray`` finds by one of the paper's methods; None as above."""
    extracted = _extracted(SceneSource(views(scene)), scene, params)
    if extracted is None:
        return None
    ids, limits = _ids(extracted.design_row, scene.frame), standards.default_for(scene.tolerance)
    return baselines.fit_beside(
        extracted.source, extracted.nodes, extracted.members, extracted.spheres, ids, params, limits
    )


def _extracted(source: SceneSource, scene: Scene, params: Params) -> Extracted | None:
    options = Options(
        members=params.members,
        expansion=thermal.expansion(scene.temperature_C),
        register_stations=params.register_stations,
        datum_mm=params.datum_mm,
        limits=standards.default_for(scene.tolerance),
    )
    listed = not params.radii_mm and params.catalogue != "none"
    catalogue = ball_catalogue.load(params.catalogue) if listed else ball_catalogue.of_radii(params.radii_mm)
    return extract(source, scene.frame, catalogue, options, control_of(scene, source))


def _result(extracted: Extracted, source: SceneSource, scene: Scene) -> Result:
    balls = _balls(extracted, source.origin, scene)
    matched, movements, stations = extracted.matching, extracted.movement, extracted.stations
    limit = standards.find(standards.default_for(scene.tolerance), measurands.NODE_PLACE)
    reference = pose = judged = gauges = None
    if movements is not None and matched is not None:
        reference = MovementReference(
            gauge=movements.gauge,
            limit=NAN if limit is None else limit.high,
            limit_source="" if limit is None else limit.source,
        )
        of_project = scene.tolerance or Tolerance()
        balls = _with_movements(balls, movements, reference.limit, matched.status is Status.OK, of_project)
        balls = _by_gauge(balls, [movements, extracted.movement_otherwise])
        gauges = _gauges(balls, extracted, scene)
    if scene.frame is not None:
        sure = matched is not None and matched.status is Status.OK
        judged = supports_and_deflections.judge(balls, scene.frame, standards.default_for(scene.tolerance), sure)
    if matched is not None:
        pose = DesignPose(
            status=matched.status,
            T_design_scan=matched.T_design_scan,
            covariance=matched.covariance,
            rivals=matched.rivals,
        )
    return Result(
        status=_status(balls, matched),
        method="ray",
        reasons=(*_reasons(extracted, scene), *_why(gauges)),
        balls=balls,
        movement_reference=reference,
        matching=pose,
        tubes=_tubes(extracted, balls.ids, source.origin),
        stations=StationCorrections()
        if stations is None
        else StationCorrections(
            names=source.names, T=_in_place(stations.T_project_station, source.origin), reasons=stations.reasons
        ),
        datum=() if stations is None else stations.datum,
        control=ControlDeviations() if stations is None else _control(stations),
        limits=judged,
        gauges=gauges,
    )


def _balls(extracted: Extracted, origin: Floats, scene: Scene) -> Balls:
    spheres = extracted.spheres
    covariance = spheres.covariance.copy()
    covariance[:, :3, :3] += extracted.datum
    reasons = list(spheres.reasons)
    for i in np.flatnonzero(extracted.design_row < 0).tolist() if scene.frame is not None else ():
        reasons[i] += (reason("spheres.not-in-design"),)
    missing = np.array([flag is Flag.NOT_FOUND for flag in spheres.flag], bool)
    found_only = np.where(missing, np.nan, 1.0)  # of a missing sphere the nominal values are no result
    return Balls(
        ids=_ids(extracted.design_row, scene.frame),
        centres=(spheres.centres + origin) * found_only[:, None],
        radii=spheres.radii * found_only,
        lowest=(spheres.lowest + origin) * found_only[:, None],
        lowest_sd=np.sqrt(spheres.lowest_sd**2 + extracted.datum[:, 2, 2]) * found_only,
        covariance=covariance * found_only[:, None, None],
        points=spheres.points,
        visible_fraction=spheres.visible_fraction,
        rms=spheres.rms,
        nominal_radii=spheres.nominal,
        evidence=spheres.evidence,
        flag=spheres.flag,
        reasons=tuple(reasons),
        sizes=spheres.sizes,
        axes=spheres.axes,
        stations=spheres.stations,
        bound_sd=np.hstack([np.sqrt(np.einsum("kii->ki", spheres.bound)), spheres.bound_lowest_sd[:, None]]),
        efficiency=np.stack([spheres.efficiency_centre, spheres.efficiency_radius, spheres.efficiency_lowest], axis=1),
        verdict=(Verdict.NONE,) * len(spheres.flag),
    )


def _status(balls: Balls, matched: Matching | None) -> Status:
    missing = balls.flagged(Flag.NOT_FOUND)
    if missing.all():
        return Status.FAILED
    complete = not missing.any() and balls.flagged(Flag.OK).any() and (matched is None or matched.status is Status.OK)
    return Status.OK if complete else Status.PARTIAL


def _reasons(extracted: Extracted, scene: Scene) -> tuple[Reason, ...]:
    reasons = [*extracted.reasons, *extracted.spheres.messages, reason("spheres.joined-only")]
    if scene.control is not None and (extracted.stations is None or not extracted.stations.control):
        reasons.append(UNUSED_CONTROL)
    return (*reasons, *(() if extracted.matching is None else extracted.matching.reasons))


def _with_movements(balls: Balls, movements: Movement, limit: float, matched: bool, tolerance: Tolerance) -> Balls:
    """Add the movements of nodes, and their verdicts; ``matched`` is False where the matching is not certain."""
    k, rows = len(balls), movements.found
    vector, ci95, covariance = np.full((k, 3), np.nan), np.full((k, 3), np.nan), np.full((k, 3, 3), np.nan)
    vector[rows], ci95[rows], covariance[rows] = movements.vector, movements.ci95, movements.covariance
    size, size_ci95 = size_of(vector, covariance)
    judged = [
        movement.judge(length, half, limit, matched and evidence is not Evidence.AXES, tolerance)
        for length, half, evidence in zip(size.tolist(), size_ci95.tolist(), balls.evidence, strict=True)
    ]
    return replace(
        balls,
        movement=vector,
        movement_ci95=ci95,
        movement_covariance=covariance,
        movement_size=size,
        movement_size_ci95=size_ci95,
        verdict=tuple(one.verdict for one in judged),
        risk_accept=np.array([one.risk_accept for one in judged]),
        risk_reject=np.array([one.risk_reject for one in judged]),
    )


def _by_gauge(balls: Balls, movements: Sequence[Movement | None]) -> Balls:
    """Add the movements of nodes by each gauge, the answer's first."""
    columns: dict[str, Any] = {}
    for one in movements:
        if one is not None:
            name = "design" if one.gauge is MovementGauge.DESIGN else "best_fit"
            for column, values in ((f"{name}_movement", one.vector), (f"{name}_ci95", one.ci95)):
                columns[column] = np.full((len(balls), 3), np.nan)
                columns[column][one.found] = values
            columns.setdefault("movement_gauge", (one.gauge,) * len(balls))
    return replace(balls, **columns)


def _gauges(balls: Balls, extracted: Extracted, scene: Scene) -> Gauges | None:
    """Return which gauge is the answer and why, and how the two differ; None without the movement of a node."""
    if not np.isfinite(balls.movement).any():
        return None
    made: dict[str, Any] = {}
    for name, vector in (("design", balls.design_movement), ("best_fit", balls.best_fit_movement)):
        if len(vector):
            made[f"{name}_mean"] = np.nanmean(vector, axis=0)
            made[f"{name}_largest"] = float(np.nanmax(np.linalg.norm(vector, axis=1)))
    if len(balls.design_movement):
        difference = balls.design_movement - balls.best_fit_movement
        made["difference"] = np.nanmean(difference, axis=0)
        made["largest_difference"] = float(np.nanmax(np.linalg.norm(difference, axis=1)))
        made["georeference_sd"] = extracted.georeference_sd
    return Gauges(gauge=balls.movement_gauge[0], basis=_basis(extracted, scene), **made)


def _basis(extracted: Extracted, scene: Scene) -> GaugeBasis:
    """Return why the scan is in the design's coordinates, or that only the pattern of the nodes relates them."""
    matched, stations = extracted.matching, extracted.stations
    if scene.frame is not None and scene.frame.coordinates:
        return GaugeBasis.STATED
    if matched is None or matched.relation is FrameRelation.REGISTERED:
        return GaugeBasis.PATTERN
    if stations is not None and stations.control_used.any():
        return GaugeBasis.CONTROL
    posed = any(scan.T_project_scan.size or scan.position.size for scan in scene.scans)
    return GaugeBasis.STATIONS if posed or scene.stations is not None else GaugeBasis.AGREEMENT


def _why(gauges: Gauges | None) -> Iterator[Reason]:
    """Yield why movements are by their gauge, and how far the other gauge is from it."""
    if gauges is None:
        return
    if gauges.gauge is MovementGauge.DESIGN:
        sd = gauges.georeference_sd
        yield {
            GaugeBasis.STATED: reason("spheres.design-coordinates-stated", sd=sd),
            GaugeBasis.CONTROL: reason("spheres.design-coordinates-control", sd=sd),
            GaugeBasis.STATIONS: reason("spheres.design-coordinates-stations", sd=sd),
            GaugeBasis.AGREEMENT: reason("spheres.design-coordinates-agreement", sd=sd),
        }[gauges.basis]
        yield reason("spheres.best-fit-differs", largest=gauges.largest_difference)
        return
    stated = gauges.basis is GaugeBasis.STATED
    yield reason("spheres.best-fit-stated") if stated else reason("spheres.best-fit-pattern")
    if len(gauges.difference):
        size = float(np.linalg.norm(gauges.difference))
        yield reason("spheres.coordinates-differ", largest=gauges.largest_difference, mean=size)


def _tubes(extracted: Extracted, ids: Ints, origin: Floats) -> Tubes:
    """Convert members; errors of unnamed views and of stations are part of the intervals."""
    members, views, stations = extracted.members, extracted.spheres.views, extracted.stations
    half = 0.5 * members.lengths[:, None] * members.directions
    common = np.zeros((len(half), 3, 3)) if views is None else of_tubes(views, members)
    at_start, at_end, of_radius = common[:, :2, :2], common[:, :2, :2], common[:, 2, 2]
    if stations is not None and np.isfinite(stations.covariance).all():
        at_start = at_start + station_error_propagation.of_axes(members, stations, -0.5 * members.lengths)
        at_end = at_end + station_error_propagation.of_axes(members, stations, 0.5 * members.lengths)
        of_radius = of_radius + station_error_propagation.of_radii(members, stations)
    # The standard deviation (m,) of each bow is along its own direction; of a tube without bow the larger one
    size = np.hypot(*members.bow.T)
    along = members.bow / np.maximum(size, 1e-9)[:, None]
    variance = np.einsum("mi,mij,mj->m", along, members.bow_covariance, along)
    sd: Floats = np.sqrt(np.where(size > 1e-9, variance, np.einsum("mii->mi", members.bow_covariance).max(axis=1)))
    return Tubes(
        a=np.where(members.node_a >= 0, ids[members.node_a], -1),
        b=np.where(members.node_b >= 0, ids[members.node_b], -1),
        start=members.points - half + origin,
        end=members.points + half + origin,
        radii=members.radii,
        bow=np.hypot(*members.bow.T),
        radius_ci95=NORMAL_95 * np.sqrt(members.covariance[:, 4, 4] + of_radius),
        start_ci95=_across(members, -0.5 * members.lengths, at_start),
        end_ci95=_across(members, 0.5 * members.lengths, at_end),
        bow_ci95=NORMAL_95 * sd,
    )


def _across(members: Members, t: Floats, common: Floats) -> Floats:
    """Half-widths (m, 3) of the 95 % intervals of axes across, at ``t`` (m,) along them from their middles.

    ``common`` (m, 2, 2) is a further covariance along side and other.
    """
    basis = np.stack([members.side, members.other], axis=2)
    J = np.zeros((len(t), 2, 4))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2] = J[:, 1, 3] = t
    C = J @ members.covariance[:, :4, :4] @ np.swapaxes(J, 1, 2) + common
    half: Floats = NORMAL_95 * np.sqrt(np.maximum(np.einsum("mia,mab,mib->mi", basis, C, basis), 0.0))
    return half


def _control(stations: Stations) -> ControlDeviations:
    return ControlDeviations(
        points=stations.control,
        scans=stations.control_scan,
        off=stations.control_off,
        used=stations.control_used.astype(bool),
    )


def _ids(design_row: Ints, design: FrameDesign | None) -> Ints:
    """Ids of the design's nodes; others get numbers after the largest of them."""
    if design is None:
        return np.arange(len(design_row), dtype=np.int64)
    other = design_row < 0
    ids: Ints = np.where(other, 0, design.ids[np.maximum(design_row, 0)])
    ids[other] = int(design.ids.max(initial=-1)) + 1 + np.arange(int(other.sum()))
    return ids


def _in_place(T: Floats, origin: Floats) -> Floats:
    """Convert transforms (s, 4, 4) of places less an origin to those of full coordinates."""
    full: Floats = T.copy()
    full[:, :3, 3] += origin - T[:, :3, :3] @ origin
    return full
