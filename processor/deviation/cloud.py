"""The scan of a structure without outliers, and density-adaptive voxels (paper 002, section 2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from processor import scene_cloud
from processor.geometry import neighbors
from processor.model import Floats, InputError, Ints, Scene

MOST_POINTS = 3_000_000  # of a scan; more are thinned evenly


@dataclass(frozen=True)
class ScanCloud:
    """Points (n, 3) of a scan less ``origin`` (3,), without outliers, in a grid's order, and scanners (n, 3).

    The points ``removed`` (m, 3) as outliers have the scanners ``removed_scanner`` (m, 3). ``source`` (n + m,) is the
    row in ``sources`` of the scan that a point is from, or of the station if the scene is one scan. Scans that
    stitching did not place are not in it: ``unplaced`` names them.
    """

    points: Floats
    origin: Floats
    scanner: Floats | None
    removed: Floats
    removed_scanner: Floats | None
    spacing_mm: float
    read: int
    kept: int
    source: Ints
    sources: tuple[str, ...]
    unposed: int = 0  # scans without a pose
    unplaced: tuple[str, ...] = ()

    @property
    def unnamed_views(self) -> bool:
        """Whether the scan may be merged from several views of which nothing is known."""
        return self.scanner is None and len(self.sources) == 1

    def of(self, sources: Ints) -> ScanCloud:
        """Return the points of some sources alone."""
        used = np.isin(self.source, sources)
        rows, out = np.flatnonzero(used[: len(self.points)]), np.flatnonzero(used[len(self.points) :])
        return replace(
            self,
            points=self.points[rows],
            scanner=None if self.scanner is None else self.scanner[rows],
            removed=self.removed[out],
            removed_scanner=None if self.removed_scanner is None else self.removed_scanner[out],
            source=self.source[used],
            kept=len(rows),
        )


def of_scene(scene: Scene, neighbours: int, ratio: float, stitched: Any = None) -> ScanCloud:
    """Merge the scans of a scene, with the poses that stitching found, and remove outliers as paper 002 does.

    Raises InputError for too few points.
    """
    whole, scene = scene, scene_cloud.stitched(scene, stitched)
    unposed = sum(not scan.T_project_scan.size for scan in scene.scans)
    cloud = scene_cloud.merged(scene, with_scanner=True)
    if len(cloud.points) < scene_cloud.FEWEST_POINTS:
        raise InputError(
            f"{scene.name}: expected a scan of {scene_cloud.FEWEST_POINTS} points or more, got {len(cloud.points)}"
        )
    grid = neighbors.of_spacing(cloud.points)
    spacing = neighbors.spacing(grid)
    if not spacing > 0.0:
        raise InputError(f"{scene.name}: most points of the scan lie at the same place; export it again")
    inlier = np.ones(grid.count, bool)
    if ratio > 0.0:
        inlier = neighbors.statistical_inliers(grid, neighbours, ratio)
    step = max(1, -(-int(inlier.sum()) // MOST_POINTS))
    rows, out = np.flatnonzero(inlier)[::step], np.flatnonzero(~inlier)[::step]
    kept = int(inlier.sum())

    source, sources = _sources(scene)

    def scanner(at: Ints) -> Floats | None:
        return None if cloud.scanner is None else cloud.scanner[grid.order[at]]

    return ScanCloud(
        points=grid.cells.points[rows],
        origin=cloud.origin,
        scanner=scanner(rows),
        removed=grid.cells.points[out],
        removed_scanner=scanner(out),
        spacing_mm=spacing * np.sqrt(kept / len(rows)),
        read=grid.count,
        kept=kept,
        source=source[grid.order[np.concatenate([rows, out])]],
        sources=sources,
        unposed=unposed,
        unplaced=tuple(scan.name for scan in whole.scans if all(scan.name != used.name for used in scene.scans)),
    )


def _sources(scene: Scene) -> tuple[Ints, tuple[str, ...]]:
    """Return the scan (n,) of each point in the order of the scans, or its station in a single one, and their names."""
    scans = scene.scans
    if len(scans) == 1 and len(scans[0].point_station) and scene.stations is not None:
        station = scans[0].point_station.astype(np.int64)
        return np.where(station < 0, len(scene.stations.ids), station), (*scene.stations.ids, "-")
    return np.repeat(np.arange(len(scans)), [len(scan.points) for scan in scans]), tuple(scan.name for scan in scans)


def adaptive_voxels(points: Floats, size_mm: float, least: int, growth: float) -> Ints:
    """Group (n,) of each point (n, 3): its voxel of ``size_mm``, ``growth`` times as wide until it holds ``least``.

    Density-adaptive down-sampling of paper 002, section 2.2; points that never fill a voxel are one last group.
    """
    group = np.full(len(points), -1, np.int64)
    left, groups = np.arange(len(points)), 0
    lower = points.min(axis=0)
    widest = float((points.max(axis=0) - lower).max())
    while len(left):
        number, count = _voxels(points[left] - lower, size_mm)
        full = (count >= least) | (size_mm > widest)
        new = np.cumsum(full) - 1 + groups
        done = full[number]
        group[left[done]] = new[number[done]]
        groups += int(full.sum())
        left = left[~done]
        size_mm *= growth
    return group


def _voxels(points: Floats, size: float) -> tuple[Ints, Ints]:
    """Return the number (n,) of each point's voxel, and points (v,) in each."""
    cell = np.floor(points / size).astype(np.int64)
    extent = cell.max(axis=0) + 1
    key = cell[:, 0].astype(np.float64) * extent[1] * extent[2] + cell[:, 1] * extent[2] + cell[:, 2]
    if float(extent[0]) * float(extent[1]) * float(extent[2]) < 2.0**62:
        key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
        _, number, count = np.unique(key, return_inverse=True, return_counts=True)
    else:
        _, number, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    return number.reshape(-1), count
