"""Spacing of a cloud and its outliers, from distances between neighbours."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.model import Floats, Ints

T = TypeVar("T", bound=np.generic)

SLICES, SLICE_POINTS = 5, 40_000


def surface_spacing(points: Floats, neighbours: int = 8, sample: int = 5000) -> float:
    """Spacing d in mm of points (n, 3) on a surface, such that there is one point in d^2.

    Median over a regular sample of the points: k neighbours within r cover pi r^2 = k d^2, on grids and random
    samples alike. Of a large cloud only slices across its longest axis are looked at: a tree of all would take longer
    than everything that needs the spacing.
    """
    k = min(neighbours, len(points) - 1)
    if k < 1:
        return float("nan")
    if len(points) <= SLICES * SLICE_POINTS:
        slices, margin = [points], 0
    else:
        order = np.argsort(points[:, np.argmax(np.ptp(points, axis=0))], kind="stable")
        starts = (np.arange(SLICES) + 0.5) / SLICES * len(points) - 0.5 * SLICE_POINTS
        slices = [points[order[start : start + SLICE_POINTS]] for start in starts.astype(np.int64)]
        margin = SLICE_POINTS // 4  # at a slice's ends points lack neighbours
    radii = []
    for one in slices:
        inner = one[margin : len(one) - margin]
        query = inner[:: max(1, len(inner) * len(slices) // sample)]
        radii.append(cKDTree(one).query(query, k=[k + 1])[0][:, 0])
    return float(np.median(np.concatenate(radii)) * np.sqrt(np.pi / k))


def statistical_inliers(points: Floats, neighbours: int = 20, ratio: float = 3.0) -> npt.NDArray[np.bool_]:
    """Mark (n,) the points whose mean distance to their neighbours is at most mean + ratio * sd of all.

    Statistical outlier removal as in Open3D and PCL; the point itself is not among its neighbours.
    """
    k = min(neighbours, len(points) - 1)
    if k < 1:
        return np.ones(len(points), bool)
    mean = cKDTree(points).query(points, k=k + 1, workers=-1)[0][:, 1:].mean(axis=1)
    return np.asarray(mean <= mean.mean() + ratio * mean.std(), bool)


def thinned(points: npt.NDArray[T], count: int) -> npt.NDArray[T]:
    """Every k-th of points (n, ...), k as large as leaves ``count`` or more of them."""
    return points[:: max(1, len(points) // count)]


def by_cell(points: Floats, size_mm: float) -> Ints:
    """Rows (n,) of points (n, 3) cell by cell: neighbours one after the other, so that look-ups of them find the same.

    A third of the time of a tree's queries, and every k-th of them lies evenly.
    """
    if not len(points):
        return np.empty(0, np.int64)
    cell = ((points - points.min(axis=0)) / size_mm).astype(np.int64)
    extent = cell.max(axis=0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    return np.argsort(key, kind="stable").astype(np.int64, copy=False)


def voxel_means(points: Floats, size_mm: float, least: int = 1) -> Floats:
    """Mean (k, 3) of the points in each occupied voxel that holds at least ``least`` points, in voxel order."""
    cell = np.floor((points - points.min(axis=0)) / size_mm).astype(np.int64)
    extent = cell.max(axis=0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(inverse, points[:, i], len(count)) for i in range(3)], axis=1)
    return (total / count[:, None])[count >= least]
