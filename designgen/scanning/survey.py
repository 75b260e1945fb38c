"""The stations of a scanner, and scans of a scene from all of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from designgen.frames import perpendicular, rigid, translation
from designgen.randomness import generator, small_motion
from designgen.scanning import returns, scanner
from designgen.scanning.surfaces import Surfaces
from designgen.sequences import in_square, on_sphere
from processor.model import Floats, PointLabels, Scan, Stations, StationTruth


def below(low: Floats, high: Floats, params: scanner.Params, seed: int) -> dict[str, Floats]:
    """Return poses T_scene_station of levelled scanners on the ground below a box, by name.

    ``low`` and ``high`` (3,) are corners of the box, mm; the ground is at z = 0. Two numbers of ``stations`` give a
    grid, which covers the area best. One number gives as many places of a sequence: more stations leave the first
    unchanged.
    """
    size = (high - low)[:2]
    grid = params.stations if len(params.stations) == 2 else None
    poses = {}
    for i in range(int(np.prod(params.stations))):
        name = f"S{i + 1}"
        rng = generator(seed, f"place {name}")
        if grid:
            fraction = (np.array(divmod(i, grid[1])) + 0.5 + rng.uniform(-0.15, 0.15, 2)) / grid
        else:
            fraction = np.clip(in_square(i) + rng.uniform(-0.03, 0.03, 2), 0.0, 1.0)
        at = low[:2] + fraction * size
        poses[name] = levelled(np.array([*at, params.height_mm]), rng.uniform(0.0, 2.0 * np.pi))
    return poses


def around(
    axes: Floats, middle: Floats, half: Floats, params: scanner.Params, seed: int, prefix: str
) -> dict[str, Floats]:
    """Return poses T_scene_station around a box of ``axes`` (3, 3, rows), ``middle`` (3,), half sizes (3,), by name.

    The stations lie on an ellipsoid ``distance_mm`` outside of the box, the first two near the ends of its first axis.
    The middle of the box is on the horizon of each scanner. More stations leave the first unchanged.
    """
    poses = {}
    for i in range(int(np.prod(params.stations))):
        name = f"{prefix}S{i + 1}"
        rng = generator(seed, f"place {name}")
        at = middle + (on_sphere(i) * (half + params.distance_mm) * rng.uniform(0.9, 1.1)) @ axes
        ahead = (middle - at) / np.linalg.norm(middle - at)
        up = perpendicular(ahead)
        T = rigid(np.stack([ahead, np.cross(up, ahead), up], axis=1), at)
        poses[name] = T @ levelled(np.zeros(3), rng.uniform(0.0, 2.0 * np.pi))
    return poses


def levelled(position: Floats, heading_rad: float) -> Floats:
    """Return the pose (4, 4) of an upright scanner."""
    T = np.eye(4)
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], position
    return T


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
        station = returns.scan(surfaces, T, device, params, seed, name)
        seen = station.returns
        motion = small_motion(
            generator(seed, f"registration {name}"), 1e-3 * params.registration_mrad, params.registration_mm
        )
        # A rotation about the station, not about the origin of the scene.
        registered.append(translation(T[:3, 3]) @ motion @ translation(-T[:3, 3]) @ T)
        scans.append(
            Scan(
                name,
                seen.points,
                intensity=seen.intensity.astype(np.float64),
                grid_row=seen.row,
                grid_column=seen.column,
                station=name,
                position=np.zeros(3),
                T_project_scan=registered[-1],
                sigma_mm=float(np.median(seen.sigma_mm)) if len(seen.sigma_mm) else float("nan"),
            )
        )
        labels.append(
            PointLabels(
                scan=name,
                part_names=part_names,
                part=seen.part,
                source=seen.source,
                surface_names=surfaces.surface_names,
                surface=seen.surface,
                range_error_mm=seen.range_error_mm,
                incidence_cos=seen.incidence_cos,
            )
        )
        systematic.append(station.systematic)
    terms = np.array(systematic).reshape(-1, 4)
    truth = StationTruth(tuple(poses), np.array(list(poses.values())), terms[:, 0], terms[:, 1], terms[:, 2:])
    return Survey(tuple(scans), tuple(labels), np.array(registered), truth)


def merged(
    surveyed: Survey, name: str, T_frame_scene: Floats, first_station: int, component: str = ""
) -> tuple[Scan, PointLabels]:
    """Join all scans into one cloud by their registered poses; station rows start at ``first_station``."""
    counts = [len(scan.points) for scan in surveyed.scans]
    points = np.empty((sum(counts), 3))
    at = 0
    for scan, T_scene_station in zip(surveyed.scans, surveyed.registered, strict=True):
        T = T_frame_scene @ T_scene_station
        points[at : at + len(scan.points)] = scan.points @ T[:3, :3].T + T[:3, 3]
        at += len(scan.points)

    def joined(records: tuple[object, ...], column: str) -> np.ndarray:
        return np.concatenate([getattr(record, column) for record in records])

    sigmas = [scan.sigma_mm for scan in surveyed.scans if np.isfinite(scan.sigma_mm)]
    scan = Scan(
        name,
        points,
        intensity=joined(surveyed.scans, "intensity"),
        point_station=np.repeat(np.arange(first_station, first_station + len(counts), dtype=np.int32), counts),
        grid_row=joined(surveyed.scans, "grid_row"),
        grid_column=joined(surveyed.scans, "grid_column"),
        component=component,
        sigma_mm=float(np.median(sigmas)) if sigmas else float("nan"),
    )
    columns = ("part", "source", "surface", "range_error_mm", "incidence_cos")
    first = surveyed.labels[0]
    labels = PointLabels(
        name, first.part_names, surface_names=first.surface_names, **{c: joined(surveyed.labels, c) for c in columns}
    )
    return scan, labels


def in_project(
    surveyed: Survey, origin: Floats, merge: bool
) -> tuple[tuple[Scan, ...], tuple[PointLabels, ...], Stations, StationTruth]:
    """Return a survey in the project's frame, in which the scene has its ``origin`` (3,); ``merge``: as one cloud."""
    T_project_scene = translation(origin)
    registered = T_project_scene @ surveyed.registered
    truth = dataclasses.replace(surveyed.truth, T_project_station=T_project_scene @ surveyed.truth.T_project_station)
    stations = with_stations(None, surveyed.truth.ids, registered)
    if merge:
        scan, labels = merged(surveyed, "scan", np.eye(4), 0)
        return (dataclasses.replace(scan, origin=origin),), (labels,), stations, truth
    scans = [dataclasses.replace(scan, T_project_scan=T) for scan, T in zip(surveyed.scans, registered, strict=True)]
    return tuple(scans), surveyed.labels, stations, truth


def with_stations(stations: Stations | None, ids: tuple[str, ...], poses: Floats) -> Stations:
    """Return the stations with those of poses T_frame_station (k, 4, 4) added."""
    if stations is None:
        return Stations(ids, poses[:, :3, 3], poses)
    return Stations(
        (*stations.ids, *ids),
        np.vstack([stations.positions, poses[:, :3, 3]]),
        np.concatenate([stations.T_project_station, poses]),
    )


def joined_truth(truths: Sequence[StationTruth]) -> StationTruth | None:
    """Return the stations' truths of several surveys as one; None without any."""
    if not truths:
        return None
    columns = ("T_project_station", "zero_offset_mm", "scale_ppm", "tilt")
    return StationTruth(
        tuple(name for truth in truths for name in truth.ids),
        *(np.concatenate([getattr(truth, column) for truth in truths]) for column in columns),
    )
