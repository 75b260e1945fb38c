"""The stations of a scanner, and scans of a scene from all of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from designgen.low_discrepancy import in_square, on_sphere
from designgen.randomness import generator, small_motion
from designgen.rigid import perpendicular, rigid, translation
from designgen.scanning import returns, scanner
from designgen.scanning.surfaces import Surfaces
from designgen.scanning.surroundings import ABOVE_FLOOR_MM, SCANNER_MM, Box
from processor.model import Floats, PointLabels, Scan, Shorts, Stations, StationTruth

OF_ONE_MM = 4_000.0  # width of the area on which stations stand below a ball or a row of balls
LABELS = ("part", "source", "surface", "range_error_mm", "incidence_cos")  # columns of Returns and PointLabels


def stations_below_box(low: Floats, high: Floats, params: scanner.Params, seed: int) -> dict[str, Floats]:
    """Return poses T_scene_station of levelled scanners on the ground below a box, by name.

    ``low`` and ``high`` (3,) are corners of the box, mm; the ground is at z = 0. Two numbers of ``stations`` give a
    grid, which covers the area best. One number gives as many places of a sequence: more stations leave the first
    unchanged. Below a box without width, as of one ball, they stand on an area of OF_ONE_MM.
    """
    grid = params.stations if len(params.stations) == 2 else None
    poses = {}
    wider = np.where(high > low, 0.0, 0.5 * OF_ONE_MM)
    low, high = low - wider, high + wider
    for i in range(math.prod(params.stations)):
        name = f"S{i + 1}"
        rng = generator(seed, f"place {name}")
        if grid:
            fraction = (np.array(divmod(i, grid[1])) + 0.5 + rng.uniform(-0.15, 0.15, 2)) / grid
        else:
            fraction = np.clip(in_square(i) + rng.uniform(-0.03, 0.03, 2), 0.0, 1.0)
        position = np.array([*(low[:2] + fraction * (high - low)[:2]), params.height_mm])
        poses[name] = levelled_pose(position, rng.uniform(0.0, 2.0 * np.pi))
    return poses


def stations_around_box(
    box: Box, params: scanner.Params, seed: int, prefix: str, *, on_floor: bool = False
) -> dict[str, Floats]:
    """Return poses T_scene_station around a box, by name.

    The stations lie on an ellipsoid ``distance_mm`` outside of the box, the first two near the ends of its first axis.
    The middle of the box is on the horizon of each scanner. More stations leave the first unchanged. Those ``on_floor``
    stand above the floor on which a part lies on trestles.
    """
    lowest = SCANNER_MM - ABOVE_FLOOR_MM - box.half[2] if on_floor else -np.inf
    poses = {}
    for i in range(math.prod(params.stations)):
        name = f"{prefix}S{i + 1}"
        rng = generator(seed, f"place {name}")
        local = on_sphere(i) * (box.half + params.distance_mm) * rng.uniform(0.9, 1.1)
        position = box.at(np.append(local[:2], max(local[2], lowest)))
        ahead = (box.middle - position) / np.linalg.norm(box.middle - position)
        up = perpendicular(ahead)
        T = rigid(np.stack([ahead, np.cross(up, ahead), up], axis=1), position)
        poses[name] = T @ levelled_pose(np.zeros(3), rng.uniform(0.0, 2.0 * np.pi))
    return poses


def levelled_pose(position: Floats, heading_rad: float) -> Floats:
    """Return the pose (4, 4) of an upright scanner at a position (3,), mm."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    return rigid(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), position)


@dataclass(frozen=True)
class Survey:
    """A scan of each station in its scanner's frame, its labels, and the registered poses."""

    scans: tuple[Scan, ...]
    labels: tuple[PointLabels, ...]
    registered: Floats  # (k, 4, 4) T_scene_station with registration errors
    truth: StationTruth  # T_project_station is T_scene_station here, until the caller changes it


def survey(
    surfaces: Surfaces,
    part_names: tuple[str, ...],
    poses: Mapping[str, Floats],
    device: scanner.Scanner,
    params: scanner.Params,
    seed: int,
) -> Survey:
    """Scan from every station. A station's noise depends on its name and the seed, not on the other stations."""
    scans, labels, registered, systematic = [], [], [], []
    for name, T in poses.items():
        station = returns.scan_station(surfaces, T, device, params, seed, name)
        measured = station.returns
        rng = generator(seed, f"registration {name}")
        motion = small_motion(rng, 1e-3 * params.registration_mrad, params.registration_mm)
        # A rotation about the station, not about the origin of the scene.
        registered.append(translation(T[:3, 3]) @ motion @ translation(-T[:3, 3]) @ T)
        scans.append(
            Scan(
                name,
                measured.points,
                intensity=measured.intensity.astype(np.float64),
                grid_row=measured.row,
                grid_column=measured.column,
                station=name,
                position=np.zeros(3),
                T_project_scan=registered[-1],
                sigma_mm=_median(measured.sigma_mm),
            )
        )
        columns = {column: getattr(measured, column) for column in LABELS}
        labels.append(PointLabels(name, part_names, surface_names=surfaces.surface_names, **columns))
        systematic.append(station.systematic)
    terms = np.array(systematic).reshape(-1, 4)
    truth = StationTruth(tuple(poses), np.array(list(poses.values())), terms[:, 0], terms[:, 1], terms[:, 2:])
    return Survey(tuple(scans), tuple(labels), np.array(registered), truth)


def moved(surveyed: Survey, T: Floats) -> Survey:
    """Return a survey with the poses of its stations, registered and true, moved by T (4, 4)."""
    truth = dataclasses.replace(surveyed.truth, T_project_station=T @ surveyed.truth.T_project_station)
    return dataclasses.replace(surveyed, registered=T @ surveyed.registered, truth=truth)


def _median(sigmas_mm: Sequence[float] | Shorts) -> float:
    return float(np.median(sigmas_mm)) if len(sigmas_mm) else float("nan")


def merged(
    surveyed: Survey, name: str, T_frame_scene: Floats, first_station: int, component: str = ""
) -> tuple[Scan, PointLabels]:
    """Join all scans into one cloud by their registered poses; station rows start at ``first_station``."""
    poses = T_frame_scene @ surveyed.registered
    # In place, as a station's points may take a large part of the memory.
    points = np.empty((sum(len(scan.points) for scan in surveyed.scans), 3))
    end = 0
    for scan, T in zip(surveyed.scans, poses, strict=True):
        start, end = end, end + len(scan.points)
        points[start:end] = scan.points @ T[:3, :3].T + T[:3, 3]

    def join(records: Sequence[object], columns: Sequence[str]) -> dict[str, Any]:
        return {column: np.concatenate([getattr(record, column) for record in records]) for column in columns}

    stations = np.arange(first_station, first_station + len(poses), dtype=np.int32)
    scan = Scan(
        name,
        points,
        point_station=np.repeat(stations, [len(scan.points) for scan in surveyed.scans]),
        component=component,
        sigma_mm=_median([scan.sigma_mm for scan in surveyed.scans if np.isfinite(scan.sigma_mm)]),
        **join(surveyed.scans, ("intensity", "grid_row", "grid_column")),
    )
    first = surveyed.labels[0]
    columns = join(surveyed.labels, (*LABELS, "defect") if len(first.defect) else LABELS)
    return scan, PointLabels(name, first.part_names, surface_names=first.surface_names, **columns)


def in_project(
    surveyed: Survey, params: scanner.Params, *, registered: bool
) -> tuple[tuple[Scan, ...], tuple[PointLabels, ...], Stations | None, StationTruth]:
    """Return a survey in the project's frame, as one cloud if ``params.merged``; poses only if it is ``registered``."""
    placed = moved(surveyed, translation(np.array(params.origin_mm)))
    stations = stations_of(placed.truth.ids, placed.registered) if registered else None
    if params.merged:
        scan, labels = merged(surveyed, "scan", np.eye(4), 0)
        return (dataclasses.replace(scan, origin=np.array(params.origin_mm)),), (labels,), stations, placed.truth
    poses = placed.registered if registered else [np.empty(0)] * len(placed.scans)
    scans = [dataclasses.replace(scan, T_project_scan=T) for scan, T in zip(placed.scans, poses, strict=True)]
    return tuple(scans), placed.labels, stations, placed.truth


def stations_of(ids: tuple[str, ...], poses: Floats) -> Stations:
    """Return the stations of poses T_frame_station (k, 4, 4)."""
    return Stations(ids, poses[:, :3, 3], poses)
