"""What method ``ray`` found of a frame, as the result of step ``spheres``."""

from __future__ import annotations

import numpy as np

from processor.limits import standards
from processor.model import Floats, FrameDesign, Ints, Scene
from processor.space_frame import catalogue, extract
from processor.space_frame.catalogue import Catalogue
from processor.space_frame.extract import Extracted
from processor.space_frame.params import Params
from processor.space_frame.points.scene_source import PointReader, SceneSource, control_of, of_scene
from processor.space_frame.result import Result
from processor.space_frame.spheres import baselines

REFERENCE_C = 20.0
EXPANSION_PER_K = 12e-6
NOWHERE = "not in the design"
FRAME_ALONE = "balls that no member meets, such as targets beside the frame, are not looked for"
UNUSED = "control points were not used: that takes members that meet, scanner positions, and stations that may be moved"


def of_frame(scene: Scene, params: Params, points: PointReader | None = None) -> Result | None:
    """Find every ball of a frame's scene; None where the cloud has no members that meet."""
    source = of_scene(scene, points)
    found = _extracted(source, scene, params)
    return None if found is None else _result(found, source, scene)


def of_same_points(scene: Scene, params: Params) -> Result | None:
    """Fit the balls that method ``ray`` finds by one of the paper's methods to the same points; None as above."""
    found = _extracted(of_scene(scene), scene, params)
    if found is None:
        return None
    return baselines.compared(
        found, _ids(found.design_row, scene.frame), params, standards.default_for(scene.tolerance)
    )


def _extracted(source: SceneSource, scene: Scene, params: Params) -> Extracted | None:
    degrees = scene.temperature_C - REFERENCE_C if np.isfinite(scene.temperature_C) else 0.0
    return extract.extract(
        source, scene.frame, _catalogue(params), params.members, 1.0 + EXPANSION_PER_K * degrees,
        control_of(scene, source), params.register_stations, params.datum_mm, standards.default_for(scene.tolerance),
    )  # fmt: skip


def _catalogue(params: Params) -> Catalogue:
    if params.radii_mm:
        return catalogue.of_radii(params.radii_mm)
    return catalogue.of_radii(()) if params.catalogue == "none" else catalogue.load(params.catalogue)


def _result(found: Extracted, source: SceneSource, scene: Scene) -> Result:
    balls, k = found.balls, len(found.balls.radii)
    covariance = balls.covariance.copy()
    covariance[:, :3, :3] += found.datum
    ids = _ids(found.design_row, scene.frame)
    flag, reason = list(balls.flag), list(balls.reason)
    for i in np.flatnonzero(found.design_row < 0).tolist() if scene.frame is not None else ():
        reason[i] = "; ".join(filter(None, (reason[i], NOWHERE)))
    matched, moved = found.matching, found.movement
    movement, movement_ci95 = np.full((k, 3), np.nan), np.full((k, 3), np.nan)
    movement_covariance = np.full((k, 3, 3), np.nan)
    if moved is not None:
        movement[moved.found], movement_ci95[moved.found] = moved.vector, moved.ci95
        movement_covariance[moved.found] = moved.covariance
    limit = standards.find(standards.default_for(scene.tolerance), standards.NODE_PLACE)
    missing = np.array([one == "not-found" for one in flag], bool)
    lost = int(missing.sum())
    tubes, stations = found.tubes, found.stations
    half = 0.5 * tubes.lengths[:, None] * tubes.directions
    said = [*found.said, balls.message, FRAME_ALONE]
    held = stations is not None and stations.control
    said += [UNUSED] if scene.control is not None and not held else []
    said += [] if matched is None else [matched.message]
    sure = matched is None or matched.status == "ok"
    found_only = np.where(missing, np.nan, 1.0)  # of a ball that is not there the design's numbers are no answer
    return Result(
        status="failed" if lost == k else "ok" if not lost and sure else "partial",
        method="ray",
        message="; ".join(filter(None, said)),
        ids=ids,
        centres=(balls.centres + source.origin) * found_only[:, None],
        radii=balls.radii * found_only,
        lowest=(balls.lowest + source.origin) * found_only[:, None],
        covariance=covariance * found_only[:, None, None],
        lowest_sd=np.sqrt(balls.lowest_sd**2 + found.datum[:, 2, 2]) * found_only,
        points=balls.points,
        visible_fraction=balls.visible_fraction,
        rms=balls.rms,
        nominal_radii=balls.expected,
        evidence=balls.evidence,
        flag=tuple(flag),
        reason=tuple(reason),
        sizes=balls.sizes,
        axes=balls.axes,
        stations=balls.stations,
        bound_sd=np.hstack([np.sqrt(np.einsum("kii->ki", balls.bound)), balls.bound_lowest_sd[:, None]]),
        efficiency=np.stack([balls.efficiency_centre, balls.efficiency_radius, balls.efficiency_lowest], axis=1),
        movement=movement,
        movement_ci95=movement_ci95,
        movement_covariance=movement_covariance,
        movement_limit=np.nan if limit is None else limit.high,
        movement_limit_source="" if limit is None else limit.source,
        gauge="" if moved is None else moved.gauge,
        matching="" if matched is None else matched.status,
        T_design_scan=np.empty(0) if matched is None else matched.T_design_scan,
        T_design_scan_covariance=np.empty(0) if matched is None else matched.covariance,
        T_rivals=np.empty((0, 4, 4)) if matched is None else matched.rivals,
        tube_start=tubes.points - half + source.origin,
        tube_end=tubes.points + half + source.origin,
        tube_radii=tubes.radii,
        tube_bow=np.hypot(*tubes.bow.T),
        tube_a=np.where(tubes.node_a >= 0, ids[tubes.node_a], -1),
        tube_b=np.where(tubes.node_b >= 0, ids[tubes.node_b], -1),
        station_names=() if stations is None else source.names,
        T_station=np.empty((0, 4, 4)) if stations is None else _in_place(stations.T_project_station, source.origin),
        station_said=() if stations is None else stations.weak,
        datum="" if stations is None else stations.datum,
        control_names=() if stations is None else stations.control,
        control_scan=() if stations is None else stations.control_scan,
        control_off=np.empty((0, 3)) if stations is None else stations.control_off,
        control_used=np.empty(0, np.int64) if stations is None else stations.control_used,
    )


def _ids(design_row: Ints, design: FrameDesign | None) -> Ints:
    """Ids of the design's nodes, and numbers after the largest of them for others."""
    if design is None:
        return np.arange(len(design_row), dtype=np.int64)
    other = design_row < 0
    found: Ints = np.where(other, 0, design.ids[np.maximum(design_row, 0)])
    found[other] = int(design.ids.max(initial=-1)) + 1 + np.arange(int(other.sum()))
    return found


def _in_place(T: Floats, origin: Floats) -> Floats:
    """Return transforms (s, 4, 4) of places less an origin as those of places with it."""
    found: Floats = T.copy()
    found[:, :3, 3] += origin - T[:, :3, :3] @ origin
    return found
