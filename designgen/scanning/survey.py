"""Where scanners stand, and a scene scanned from all of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from designgen import sequences
from designgen.randomness import generator, small_motion
from designgen.scanning import returns, scanner
from designgen.scanning.surfaces import Surfaces
from processor.model import Floats, PointLabels, Scan, Stations, StationTruth


def below(low: Floats, high: Floats, params: scanner.Params, seed: int) -> dict[str, Floats]:
    """Poses T_scene_station on the ground below a box; levelled, each near its place.

    ``low`` and ``high`` (3,) are corners of what is scanned; the ground is at z = 0. Two numbers of ``stations`` are a
    grid: it covers the area best, and another grid moves all stations. One number takes that many places of a
    sequence: a station more leaves the others where they are.
    """
    size = (high - low)[:2]
    grid = params.stations if len(params.stations) == 2 else None
    poses = {}
    for i in range(int(np.prod(params.stations))):
        name = f"S{i + 1}"
        rng = generator(seed, f"place {name}")
        if grid:
            share = (np.array(divmod(i, grid[1])) + 0.5 + rng.uniform(-0.15, 0.15, 2)) / grid
        else:
            share = np.clip(sequences.in_square(i) + rng.uniform(-0.03, 0.03, 2), 0.0, 1.0)
        at = low[:2] + share * size
        poses[name] = levelled(np.array([*at, params.height_mm]), rng.uniform(0.0, 2.0 * np.pi))
    return poses


def around(
    axes: Floats, middle: Floats, half: Floats, params: scanner.Params, seed: int, prefix: str
) -> dict[str, Floats]:
    """Poses T_scene_station about a box with unit ``axes`` (3, 3, rows), ``middle`` (3,) and half sizes (3,).

    The stations lie on an ellipsoid ``distance_mm`` outside of the box, the first two near the ends of its first axis;
    each looks level at the middle. A station more leaves the others where they are.
    """
    poses = {}
    for i in range(int(np.prod(params.stations))):
        name = f"{prefix}S{i + 1}"
        rng = generator(seed, f"place {name}")
        at = middle + (sequences.on_sphere(i) * (half + params.distance_mm) * rng.uniform(0.9, 1.1)) @ axes
        ahead = (middle - at) / np.linalg.norm(middle - at)
        up = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
        up /= np.linalg.norm(up)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([ahead, np.cross(up, ahead), up], axis=1), at
        poses[name] = T @ levelled(np.zeros(3), rng.uniform(0.0, 2.0 * np.pi))
    return poses


def levelled(position: Floats, heading_rad: float) -> Floats:
    """Pose (4, 4) of a scanner that stands upright."""
    T = np.eye(4)
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], position
    return T


@dataclass(frozen=True)
class Survey:
    """What all stations saw: a scan a station in its scanner's frame, its labels, and the registered poses."""

    scans: tuple[Scan, ...]
    labels: tuple[PointLabels, ...]
    registered: Floats  # (k, 4, 4) T_scene_station as the project believes
    truth: StationTruth  # T_project_station here is T_scene_station; the caller moves it


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
        found = returns.scan(surfaces, T, device, params, seed, name)
        seen = found.returns
        motion = small_motion(
            generator(seed, f"registration {name}"), 1e-3 * params.registration_mrad, params.registration_mm
        )
        about = np.eye(4)
        about[:3, 3] = T[:3, 3]
        back = np.eye(4)
        back[:3, 3] = -T[:3, 3]
        registered.append(about @ motion @ back @ T)  # turned about the station itself
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
                name,
                part_names,
                seen.part,
                seen.source,
                surfaces.surface_names,
                seen.surface,
                seen.range_error_mm,
                seen.incidence_cos,
            )
        )
        systematic.append(found.systematic)
    terms = np.array(systematic).reshape(-1, 4)
    truth = StationTruth(tuple(poses), np.array(list(poses.values())), terms[:, 0], terms[:, 1], terms[:, 2:])
    return Survey(tuple(scans), tuple(labels), np.array(registered), truth)


def merged(
    found: Survey, name: str, T_frame_scene: Floats, first_station: int, component: str = ""
) -> tuple[Scan, PointLabels]:
    """Put all scans into one cloud in a frame, by their registered poses; stations count from ``first_station``."""
    count = sum(len(scan.points) for scan in found.scans)
    points = np.empty((count, 3))
    at = 0
    for scan, T_scene_station in zip(found.scans, found.registered, strict=True):
        T = T_frame_scene @ T_scene_station
        points[at : at + len(scan.points)] = scan.points @ T[:3, :3].T + T[:3, 3]
        at += len(scan.points)

    def joined(records: tuple[object, ...], column: str) -> np.ndarray:
        return np.concatenate([getattr(record, column) for record in records])

    counts = [len(scan.points) for scan in found.scans]
    sigmas = [scan.sigma_mm for scan in found.scans if np.isfinite(scan.sigma_mm)]
    scan = Scan(
        name,
        points,
        intensity=joined(found.scans, "intensity"),
        point_station=np.repeat(np.arange(first_station, first_station + len(counts), dtype=np.int32), counts),
        grid_row=joined(found.scans, "grid_row"),
        grid_column=joined(found.scans, "grid_column"),
        component=component,
        sigma_mm=float(np.median(sigmas)) if sigmas else float("nan"),
    )
    columns = ("part", "source", "surface", "range_error_mm", "incidence_cos")
    first = found.labels[0]
    labels = PointLabels(
        name, first.part_names, surface_names=first.surface_names, **{c: joined(found.labels, c) for c in columns}
    )
    return scan, labels


def in_project(
    found: Survey, origin: Floats, merge: bool
) -> tuple[tuple[Scan, ...], tuple[PointLabels, ...], Stations, StationTruth]:
    """Return a survey in the project's frame: scene coordinates moved by ``origin`` (3,), scans apart or merged."""
    T_project_scene = np.eye(4)
    T_project_scene[:3, 3] = origin
    registered = T_project_scene @ found.registered
    truth = dataclasses.replace(found.truth, T_project_station=T_project_scene @ found.truth.T_project_station)
    stations = with_stations(None, found.truth.ids, registered)
    if merge:
        scan, labels = merged(found, "scan", np.eye(4), 0)
        return (dataclasses.replace(scan, origin=origin),), (labels,), stations, truth
    scans = [dataclasses.replace(scan, T_project_scan=T) for scan, T in zip(found.scans, registered, strict=True)]
    return tuple(scans), found.labels, stations, truth


def with_stations(stations: Stations | None, ids: tuple[str, ...], poses: Floats) -> Stations:
    """Add stations of poses T_frame_station (k, 4, 4) to those there are."""
    if stations is None:
        return Stations(ids, poses[:, :3, 3], poses)
    return Stations(
        (*stations.ids, *ids),
        np.vstack([stations.positions, poses[:, :3, 3]]),
        np.concatenate([stations.T_project_station, poses]),
    )


def joined_truth(truths: Sequence[StationTruth]) -> StationTruth | None:
    """Join the stations' truths of several surveys; None of none."""
    if not truths:
        return None
    columns = ("T_project_station", "zero_offset_mm", "scale_ppm", "tilt")
    return StationTruth(
        tuple(name for truth in truths for name in truth.ids),
        *(np.concatenate([getattr(truth, column) for truth in truths]) for column in columns),
    )
