"""A scene with a bit of all that the store keeps."""

import dataclasses

import numpy as np

from processor.model import ArchDesign, ArchTruth, DesignPart, PointLabels, Scan, Scene, Stations, Truth, reason


def surface_points(n, seed=0, size=(20_000.0, 2_000.0, 3_000.0)):
    """Points on three faces of a box, with noise."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(size=(n, 3)) * size
    face = rng.integers(0, 3, n)
    points[np.arange(n), face] = rng.normal(0.0, 2.0, n)
    return points


def a_scene(n=50_000):
    points = surface_points(n)
    part = DesignPart("肋1", np.eye(3) * 7.5, [[0, 1, 2]], np.zeros((2, 3)), np.ones((4, 3)))
    arch = ArchDesign((part, dataclasses.replace(part, name="b")), ("J1",), ("肋1",), ("b",), np.ones((1, 8, 3)))
    scans = (
        # Columns that tell from which point a row came, whatever place it takes.
        Scan(
            "s1", points, origin=[5e8, 4e8, 0], intensity=points[:, 0] * 2.0, component="肋1", sigma_mm=2.0,
            point_station=np.clip(np.floor(points[:, 1]), -1, 2_000).astype(np.int64),
            T_project_scan=np.diag([-1.0, -1.0, 1.0, 1.0]),
        ),
        Scan("s2", points[:10] + 1.0),
    )  # fmt: skip
    stations = Stations(
        tuple(f"S{k}" for k in range(2_001)), np.arange(6_003.0).reshape(-1, 3) - np.array([5e8, 4e8, 0.0])
    )
    scene = Scene("桥", "arch-bridge", scans, arch, None, stations, 21.5, "m", (reason("units.by-option"),))
    labels = PointLabels("s1", ("肋1", "b"), np.floor(np.abs(points[:, 2])).astype(np.int64) % 2, np.arange(n) % 3)
    ends, edges = np.full((1, 2, 8, 3), np.nan), np.zeros((1, 2, 5, 3))
    truth = Truth((labels,), ArchTruth(("肋1",), [np.eye(4)], ends, np.zeros((1, 2, 8, 3)), edges))
    return scene, truth
