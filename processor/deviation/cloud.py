"""The scan of a structure, cleaned; its design's surface as points; density-adaptive voxels. Paper 002, section 2."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from processor.geometry import merging, point_neighbors
from processor.model import Floats, InputError, Ints, Scan, Scene, StructureDesign

ORIGIN_STEP_MM = 1000.0
MOST_POINTS = 3_000_000  # of a scan: more are thinned evenly, which no core point's answer needs
FEWEST_POINTS = 100


@dataclass(frozen=True)
class ScanCloud:
    """Points (n, 3) of a scan less ``origin`` (3,), outliers removed, in an order of their own, and scanners."""

    points: Floats
    origin: Floats
    scanner: Floats | None
    spacing_mm: float
    read: int
    kept: int
    unposed: int = 0  # scans without a pose


@dataclass(frozen=True)
class Samples:
    """Points (m, 3) on a mesh with unit normals (m, 3), and the facet (m,) of each."""

    points: Floats
    normals: Floats
    facet: Ints


def of_scene(scene: Scene, neighbours: int, ratio: float, stitched: Any = None) -> ScanCloud:
    """Merge the scans of a scene, with the poses that stitching found, and remove outliers as paper 002 does.

    Raises InputError for too few points.
    """
    if stitched is not None:
        scene = replace(scene, scans=posed(scene, stitched))
    unposed = sum(not scan.T_project_scan.size for scan in scene.scans)
    cloud = merging.merged(scene, with_scanner=True)
    if len(cloud.points) < FEWEST_POINTS:
        raise InputError(f"{scene.name}: expected a scan of {FEWEST_POINTS} points or more, got {len(cloud.points)}")
    grid = point_neighbors.of_spacing(cloud.points)
    spacing = point_neighbors.spacing(grid)
    if not spacing > 0.0:
        raise InputError(f"{scene.name}: most points of the scan lie at the same place; export it again")
    rows = np.arange(grid.count)
    if ratio > 0.0:
        rows = np.flatnonzero(point_neighbors.statistical_inliers(grid, neighbours, ratio))
    kept = len(rows)
    rows = rows[:: max(1, -(-kept // MOST_POINTS))]
    thinner = np.sqrt(kept / len(rows))
    scanner = None if cloud.scanner is None else cloud.scanner[grid.order[rows]]
    return ScanCloud(grid.cells.points[rows], cloud.origin, scanner, spacing * thinner, grid.count, kept, unposed)


def posed(scene: Scene, stitched: Any) -> tuple[Scan, ...]:
    """Return the scans with the poses that stitching found, without those that it could not place."""
    T = dict(zip(stitched.scans.name, stitched.scans.T_project_scan, strict=True))
    return tuple(
        replace(scan, T_project_scan=T[scan.name]) if scan.name in T else scan
        for scan in scene.scans
        if scan.name not in T or np.isfinite(T[scan.name]).all()
    )


def local_design(design: StructureDesign) -> tuple[Floats, Floats]:
    """Vertices (v, 3) less an origin (3,) of whole metres amid them. Raises InputError for a mesh without area."""
    middle = 0.5 * (design.vertices.min(axis=0) + design.vertices.max(axis=0)) if len(design.vertices) else np.zeros(3)
    origin = np.floor(middle / ORIGIN_STEP_MM) * ORIGIN_STEP_MM
    vertices = design.vertices - origin
    if not len(design.faces) or not area(vertices, design.faces) > 0.0:
        raise InputError(f"design {design.name}: expected a mesh with a surface, found none")
    return vertices, origin


def area(vertices: Floats, faces: Ints) -> float:
    """Area of a mesh, mm2."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def sampled(vertices: Floats, faces: Ints, spacing_mm: float) -> Samples:
    """Points on a mesh, one in ``spacing_mm`` squared, on a fixed low-discrepancy pattern."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    double = np.linalg.norm(cross, axis=1)
    cumulative = np.cumsum(double)
    count = max(1, round(0.5 * float(cumulative[-1]) / spacing_mm**2))
    i = np.arange(count)
    facet = np.searchsorted(cumulative, (i + 0.5) / count * cumulative[-1]).astype(np.int64)
    # The R2 sequence (plastic number), folded from the square onto the triangle.
    u, v = (0.5 + i * 0.7548776662466927) % 1.0, (0.5 + i * 0.5698402909980532) % 1.0
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
    at = a[facet]
    points = at + u[:, None] * (b[facet] - at) + v[:, None] * (c[facet] - at)
    return Samples(points, cross[facet] / double[facet, None], facet)


def adaptive_voxels(points: Floats, size_mm: float, least: int) -> Ints:
    """Group (n,) of each point (n, 3): its voxel of ``size_mm``, or of double edges until it holds ``least`` points.

    Density-adaptive down-sampling of paper 002, section 2.2; what never fills a voxel is one last group.
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
        size_mm *= 2.0
    return group


def group_means(values: Floats, group: Ints) -> Floats:
    """Means (g, 3) of values (n, 3) in groups (n,)."""
    count = np.bincount(group)
    found: Floats = np.stack([np.bincount(group, values[:, k]) for k in range(values.shape[1])], axis=1)
    return found / count[:, None]


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
