"""The scan of a structure without outliers, and density-adaptive voxels (paper 002, section 2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from processor import scene_cloud
from processor.deviation import large_cloud
from processor.deviation.large_cloud import LargeCloud
from processor.distinct_rows import distinct
from processor.geometry import nearest_neighbours
from processor.model import Floats, InputError, Ints, Scene
from processor.views import views

MOST_POINTS = 3_000_000  # of a scan that are held at once; of more an even sample is held
SAMPLE_POINTS = 1_000_000  # work: points from which the spacing of a large scan is taken


@dataclass(frozen=True)
class ScanCloud:
    """Points (n, 3) of a scan less ``origin`` (3,), without outliers, in a grid's order.

    ``view`` (n + m,) is the view of each of these points, and then of those ``removed`` (m, 3) as outliers: a row of
    the names ``views``, and of ``scanners`` (v, 3), which is None where any is unknown. With ``unnamed_views`` the scan
    may be merged from several views of which nothing is known. Scans that stitching did not place are not in it:
    ``unplaced`` names them. Of a scan too large for memory the points are a sample, and ``large`` has all of them.
    """

    points: Floats
    origin: Floats
    removed: Floats
    spacing_mm: float
    read: int
    kept: int
    view: Ints
    views: tuple[str, ...]
    scanners: Floats | None
    unnamed_views: bool
    unposed: int = 0  # scans without a pose
    unplaced: tuple[str, ...] = ()
    large: LargeCloud | None = None

    @property
    def resolved_mm(self) -> float:
        """Spacing of the points by which core points are chosen: of a large cloud that of MOST_POINTS of them.

        No more core points are placed than these distinguish, so all other points make each of them more certain.
        """
        if self.large is None:
            return self.spacing_mm
        return self.large.spacing_mm * max(1.0, float(np.sqrt(self.kept / MOST_POINTS)))

    def scanner(self, rows: slice) -> Floats | None:
        """Return the positions (k, 3) that some of the points were seen from; None where they are unknown."""
        return None if self.scanners is None else self.scanners[self.view[: len(self.points)][rows]]

    def of(self, numbers: Ints) -> ScanCloud:
        """Return the points of some views alone."""
        used = np.isin(self.view, numbers)
        rows, out = np.flatnonzero(used[: len(self.points)]), np.flatnonzero(used[len(self.points) :])
        large = None if self.large is None else self.large.of(numbers)
        return replace(
            self,
            points=self.points[rows],
            removed=self.removed[out],
            view=self.view[used],
            kept=len(rows) if large is None else large.kept,
            large=large,
        )


def of_scene(scene: Scene, neighbours: int, ratio: float, stitched: Any = None, most: int = 0) -> ScanCloud:
    """Merge the scans of a scene, with the poses that stitching found, and remove outliers as paper 002 does.

    Of ``most`` points or fewer, if that is not 0, every k-th is left. Raises InputError for too few points.
    """
    whole, scene = scene, scene_cloud.stitched(scene, stitched)
    count = sum(len(scan.points) for scan in scene.scans)
    if count < scene_cloud.FEWEST_POINTS:
        raise InputError(f"{scene.name}: expected a scan of {scene_cloud.FEWEST_POINTS} points or more, got {count}")
    merged = _sample if count > MOST_POINTS else _held
    cloud = merged(scene, neighbours, ratio, most)
    return replace(
        cloud,
        unposed=sum(not scan.T_project_scan.size for scan in scene.scans),
        unplaced=tuple(scan.name for scan in whole.scans if all(scan.name != used.name for used in scene.scans)),
    )


def _sample(scene: Scene, neighbours: int, ratio: float, most: int) -> ScanCloud:
    """Sort the scans of a scene into a large cloud, and return a sample of it.

    If there are more than ``most`` points, and that is not 0, the sample of as many replaces the large cloud.
    """
    seen = views(scene)
    large = large_cloud.of_views(seen, neighbours, ratio)
    if not large.spacing_mm > 0.0:
        raise InputError(f"{scene.name}: most points of the scan lie at the same place; export it again")
    kept = large.kept
    replaced = 0 < most < kept
    step = -(-kept // (most if replaced else SAMPLE_POINTS))
    points, view = large.thinned(True, step)
    removed, removed_view = large.thinned(False, step)
    return ScanCloud(
        points=points,
        origin=seen.origin,
        removed=removed,
        spacing_mm=large.spacing_mm * np.sqrt(kept / len(points)),
        read=len(large.points),
        kept=kept,
        view=np.concatenate([view, removed_view]),
        views=seen.names,
        scanners=large.scanners,
        unnamed_views=seen.unnamed,
        large=None if replaced else large,
    )


def _held(scene: Scene, neighbours: int, ratio: float, most: int) -> ScanCloud:
    """Merge the scans of a scene in memory; of ``most`` points or fewer, if that is not 0, every k-th is left."""
    seen = views(scene)
    placed = seen.placed()
    grid = nearest_neighbours.of_spacing(placed.points)
    spacing = nearest_neighbours.spacing(grid)
    if not spacing > 0.0:
        raise InputError(f"{scene.name}: most points of the scan lie at the same place; export it again")
    inlier = np.ones(grid.count, bool)
    if ratio > 0.0:
        inlier = nearest_neighbours.statistical_inliers(grid, neighbours, ratio)
    step = max(1, -(-int(inlier.sum()) // most)) if most else 1
    rows, out = np.flatnonzero(inlier)[::step], np.flatnonzero(~inlier)[::step]
    kept = int(inlier.sum())
    return ScanCloud(
        points=grid.cells.points[rows],
        origin=seen.origin,
        removed=grid.cells.points[out],
        spacing_mm=spacing * np.sqrt(kept / len(rows)),
        read=grid.count,
        kept=kept,
        view=placed.view[grid.order[np.concatenate([rows, out])]].astype(np.int64),
        views=seen.names,
        scanners=seen.scanners(placed.view),
        unnamed_views=seen.unnamed,
    )


def adaptive_voxels(points: Floats, size_mm: float, least: int, growth: float) -> Ints:
    """Group (n,) of each point (n, 3): its voxel of ``size_mm``, ``growth`` times as wide until it holds ``least``.

    Density-adaptive down-sampling of paper 002, section 2.2; points that never fill a voxel are one last group.
    """
    group = np.full(len(points), -1, np.int64)
    left, groups = np.arange(len(points)), 0
    lower = points.min(axis=0)
    widest = float((points.max(axis=0) - lower).max())
    while len(left):
        cell = np.floor((points[left] - lower) / size_mm).astype(np.int64)
        voxels = distinct(cell)
        number, count = voxels.number, voxels.count
        full = (count >= least) | (size_mm > widest)
        new = np.cumsum(full) - 1 + groups
        done = full[number]
        group[left[done]] = new[number[done]]
        groups += int(full.sum())
        left = left[~done]
        size_mm *= growth
    return group
