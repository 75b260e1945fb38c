"""Random scenes of scans on grids, and their export as a scan folder."""

import numpy as np

from designgen.export import folder as export_folder
from processor.model import (
    FrameDesign,
    Scan,
    Scene,
    Stations,
    StructureDesign,
)
from processor.store import store

RNG = np.random.default_rng(3)


def pose(origin):
    R, _ = np.linalg.qr(RNG.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3] = R * np.linalg.det(R)
    T[:3, 3] = origin + RNG.uniform(-5000.0, 5000.0, 3)
    return T


def on_grid(count):
    """Points of a scanner in its own frame, with their places on the grid, no two on one."""
    cells = RNG.permutation(90 * 50)[:count]
    row, column = cells % 50 + 7, cells // 50 + 3
    azimuth, elevation = column * 0.06, (row - 20) * 0.02
    R = RNG.uniform(2000.0, 30_000.0, count)
    level = R * np.cos(elevation)
    points = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), R * np.sin(elevation)], axis=1)
    return points, row.astype(np.int32), column.astype(np.int32)


def stations_apart(origin):
    """A scene of one scan a station, in the scanner's frame."""
    scans = []
    for number in range(3):
        points, row, column = on_grid(400 + number)
        name = ("S1", "二号站", "S 3")[number]
        scans.append(
            Scan(
                name,
                points,
                intensity=RNG.uniform(0.1, 2.0, len(points)),
                grid_row=row,
                grid_column=column,
                station=name,
                position=np.zeros(3),
                T_project_scan=pose(origin),
                sigma_mm=1.5,
            )
        )
    design = FrameDesign([0, 1], np.array([[0.0, 0, 0], [30_000.0, 0, 0]]) + origin, [45.0, 50.0], [0], [1], [60.0])
    poses = np.array([scan.T_project_scan for scan in scans])
    stations = Stations(tuple(scan.name for scan in scans), poses[:, :3, 3], poses)
    return Scene("屋盖 <1>", "space-frame", tuple(scans), frame=design, stations=stations, temperature_C=28.5)


def merged(origin):
    """A scene of one cloud of two stations, in the project's frame."""
    poses = np.array([pose(np.zeros(3)) for _ in range(2)])
    pieces = [on_grid(300), on_grid(200)]
    points = np.vstack([p @ T[:3, :3].T + T[:3, 3] for (p, _, _), T in zip(pieces, poses, strict=True)])
    scan = Scan(
        "scan",
        points,
        origin=origin,
        intensity=RNG.uniform(0.1, 2.0, 500),
        point_station=np.repeat(np.array([0, 1], np.int32), [300, 200]),
        grid_row=np.concatenate([p[1] for p in pieces]),
        grid_column=np.concatenate([p[2] for p in pieces]),
    )
    poses[:, :3, 3] += origin
    mesh = StructureDesign("roof", np.array([[0.0, 0, 0], [1000, 0, 0], [0, 1000, 0]]) + origin, [[0, 1, 2]])
    return Scene("hall", "structure", (scan,), stations=Stations(("S1", "S2"), poses[:, :3, 3], poses), structure=mesh)


def exported(scene, tmp_path, format_, **options):
    store.write_scene(tmp_path / "s.h5", scene, None, {})
    export_folder.export(tmp_path / "s.h5", tmp_path / "out", format_, with_truth=True, **options)
    return store.read_scene(tmp_path / "s.h5"), tmp_path / "out"
