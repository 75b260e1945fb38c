"""Conversion of the result of method ``ray`` to the result of step ``spheres``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from processor.limits import standards
from processor.model import Floats, FrameDesign, Ints, Scene
from processor.space_frame import catalogue
from processor.space_frame.catalogue import Catalogue
from processor.space_frame.extract import Extracted, Options, extract
from processor.space_frame.params import Params
from processor.space_frame.points.scene_source import PointReader, SceneSource, of_scene
from processor.space_frame.result import Result
from processor.space_frame.spheres import baselines
from processor.space_frame.stations.records import Stations
from processor.space_frame.stations.sightings import control_of

REFERENCE_C = 20.0
EXPANSION_PER_K = 12e-6
NOWHERE = "not in the design"
FRAME_ALONE = "balls that no member meets, such as targets beside the frame, are not looked for"
UNUSED = "control points were not used: that takes members that meet, scanner positions, and stations that may be moved"


def of_frame(scene: Scene, params: Params, points: PointReader | None = None) -> Result | None:
    """Find every sphere of a frame's scene; None where the cloud has no members that meet."""
    source = of_scene(scene, points)
    extracted = _extracted(source, scene, params)
    return None if extracted is None else _result(extracted, source, scene)


def of_same_points(scene: Scene, params: Params) -> Result | None:
    """Fit the spheres that method ``ray`` finds by one of the paper's methods to the same points; None as above."""
    extracted = _extracted(of_scene(scene), scene, params)
    if extracted is None:
        return None
    ids, limits = _ids(extracted.design_row, scene.frame), standards.default_for(scene.tolerance)
    return baselines.compared(
        extracted.source, extracted.nodes, extracted.members, extracted.spheres, ids, params, limits
    )


def _extracted(source: SceneSource, scene: Scene, params: Params) -> Extracted | None:
    degrees = scene.temperature_C - REFERENCE_C if np.isfinite(scene.temperature_C) else 0.0
    options = Options(
        members=params.members,
        expansion=1.0 + EXPANSION_PER_K * degrees,
        register_stations=params.register_stations,
        datum_mm=params.datum_mm,
        limits=standards.default_for(scene.tolerance),
    )
    return extract(source, scene.frame, _catalogue(params), options, control_of(scene, source))


def _catalogue(params: Params) -> Catalogue:
    if params.radii_mm:
        return catalogue.of_radii(params.radii_mm)
    return catalogue.of_radii(()) if params.catalogue == "none" else catalogue.load(params.catalogue)


def _result(extracted: Extracted, source: SceneSource, scene: Scene) -> Result:
    spheres = extracted.spheres
    covariance = spheres.covariance.copy()
    covariance[:, :3, :3] += extracted.datum
    ids = _ids(extracted.design_row, scene.frame)
    reason = list(spheres.reason)
    for i in np.flatnonzero(extracted.design_row < 0).tolist() if scene.frame is not None else ():
        reason[i] = "; ".join(filter(None, (reason[i], NOWHERE)))
    missing = np.array([flag == "not-found" for flag in spheres.flag], bool)
    found_only = np.where(missing, np.nan, 1.0)  # of a missing sphere the nominal values are no answer
    result = Result(
        status=_status(missing, extracted),
        method="ray",
        message=_message(extracted, scene),
        ids=ids,
        centres=(spheres.centres + source.origin) * found_only[:, None],
        radii=spheres.radii * found_only,
        lowest=(spheres.lowest + source.origin) * found_only[:, None],
        covariance=covariance * found_only[:, None, None],
        lowest_sd=np.sqrt(spheres.lowest_sd**2 + extracted.datum[:, 2, 2]) * found_only,
        points=spheres.points,
        visible_fraction=spheres.visible_fraction,
        rms=spheres.rms,
        nominal_radii=spheres.expected,
        evidence=spheres.evidence,
        flag=spheres.flag,
        reason=tuple(reason),
        sizes=spheres.sizes,
        axes=spheres.axes,
        stations=spheres.stations,
        bound_sd=np.hstack([np.sqrt(np.einsum("kii->ki", spheres.bound)), spheres.bound_lowest_sd[:, None]]),
        efficiency=np.stack([spheres.efficiency_centre, spheres.efficiency_radius, spheres.efficiency_lowest], axis=1),
    )
    result = _with_members(_with_design(result, extracted, scene), extracted, source.origin)
    return result if extracted.stations is None else _with_stations(result, extracted.stations, source)


def _status(missing: npt.NDArray[np.bool_], extracted: Extracted) -> str:
    if missing.all():
        return "failed"
    matched = extracted.matching
    return "ok" if not missing.any() and (matched is None or matched.status == "ok") else "partial"


def _message(extracted: Extracted, scene: Scene) -> str:
    messages = [*extracted.messages, extracted.spheres.message, FRAME_ALONE]
    if scene.control is not None and (extracted.stations is None or not extracted.stations.control):
        messages.append(UNUSED)
    if extracted.matching is not None:
        messages.append(extracted.matching.message)
    return "; ".join(filter(None, messages))


def _with_design(result: Result, extracted: Extracted, scene: Scene) -> Result:
    """Add the movements of nodes, and the pose of the design."""
    k, matched, movements = len(result.ids), extracted.matching, extracted.movement
    limit = standards.find(standards.default_for(scene.tolerance), standards.NODE_PLACE)
    movement, ci95, covariance = np.full((k, 3), np.nan), np.full((k, 3), np.nan), np.full((k, 3, 3), np.nan)
    if movements is not None:
        rows = movements.found
        movement[rows], ci95[rows], covariance[rows] = movements.vector, movements.ci95, movements.covariance
    return replace(
        result,
        movement=movement,
        movement_ci95=ci95,
        movement_covariance=covariance,
        movement_limit=np.nan if limit is None else limit.high,
        movement_limit_source="" if limit is None else limit.source,
        gauge="" if movements is None else movements.gauge,
        matching="" if matched is None else matched.status,
        T_design_scan=np.empty(0) if matched is None else matched.T_design_scan,
        T_design_scan_covariance=np.empty(0) if matched is None else matched.covariance,
        T_rivals=np.empty((0, 4, 4)) if matched is None else matched.rivals,
    )


def _with_members(result: Result, extracted: Extracted, origin: Floats) -> Result:
    """Add the members' tubes."""
    members = extracted.members
    half = 0.5 * members.lengths[:, None] * members.directions
    return replace(
        result,
        tube_start=members.points - half + origin,
        tube_end=members.points + half + origin,
        tube_radii=members.radii,
        tube_bow=np.hypot(*members.bow.T),
        tube_a=np.where(members.node_a >= 0, result.ids[members.node_a], -1),
        tube_b=np.where(members.node_b >= 0, result.ids[members.node_b], -1),
    )


def _with_stations(result: Result, stations: Stations, source: SceneSource) -> Result:
    """Add the stations' corrections, and the deviations at control points."""
    return replace(
        result,
        station_names=source.names,
        T_station=_in_place(stations.T_project_station, source.origin),
        station_said=stations.weak,
        datum=stations.datum,
        control_names=stations.control,
        control_scan=stations.control_scan,
        control_off=stations.control_off,
        control_used=stations.control_used,
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
