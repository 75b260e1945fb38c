"""The points of a steel part among what stands about it: ground, walls, trestles, crates.

A scan that is larger than its design holds more than the part. A plane with more area than the part's largest side is
none of its faces: it is ground or a wall, and is left out. What is left is taken whole or as its largest connected
piece, by which comes nearer to the part's sizes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from processor.distinct_rows import components, distinct
from processor.geometry.thinning import thinned, voxel_means
from processor.large_arrays import blocks, corners
from processor.model import Bools, Floats
from processor.registration import principal

VOXELS = (200.0, 140.0, 100.0, 70.0)  # along the scan's diagonal, the most that the points allow
PER_VOXEL = 6  # points of an occupied voxel, on average
FEWEST = 40  # voxels of a part
LARGER = 0.02  # of each size, by which a scan that holds more than its part is larger
LARGER_AREA = 1.3  # of a plane, by the part's largest side: cells at its rim are partly empty
TRIALS, SAMPLE = 1000, 4000  # of random planes, and of points that they are compared with
THIN = 0.25  # voxels by which points on a plane may lie off it
LINK = 3.0  # voxels between points of one piece


def holds_more(points: Floats, sizes: Sequence[Floats]) -> bool:
    """Whether points (n, 3) are larger than a part of any of ``sizes`` (3,), longest first, in mm."""
    step = _voxel_size(points)
    even = voxel_means(points, step, least=2) if step > 0.0 else points[:0]
    largest = np.max(sizes, axis=0) * (1.0 + LARGER)
    return len(even) >= FEWEST and bool((principal.sizes(even) > largest).any())


def of_sizes(points: Floats, sizes: Sequence[Floats]) -> Bools | None:
    """Return which points (n, 3) belong to a part that has one of ``sizes`` (3,), longest first, in mm.

    None if the scan is not larger than the part, or nothing in it is found to be something else.
    """
    step = _voxel_size(points)
    even = voxel_means(points, step, least=2) if step > 0.0 else points[:0]
    if len(even) < FEWEST:
        return None
    largest = np.max(sizes, axis=0) * (1.0 + LARGER)
    side = LARGER_AREA * float(largest[0] * largest[1])
    if (principal.sizes(even) <= largest).all():
        return None
    left = np.ones(len(even), bool)
    while (on := large_plane(even[left], step, side)) is not None:
        left[np.flatnonzero(left)[on]] = False
        if left.sum() < FEWEST:
            return None
        if (principal.sizes(even[left]) <= largest).all():
            break
    piece = np.zeros(len(even), bool)
    # The largest of the connected pieces
    rest = even[left]
    pairs = cKDTree(rest).query_pairs(LINK * step, output_type="ndarray")
    number = components(len(rest), *pairs.T)
    piece[np.flatnonzero(left)[number == np.argmax(np.bincount(number))]] = True
    best = piece if _misfit(even[piece], sizes) <= _misfit(even[left], sizes) else left
    if best.all():
        return None
    tree, of_body, found = cKDTree(even), np.append(best, False), np.empty(len(points), bool)
    for rows in blocks(len(points)):
        found[rows] = of_body[tree.query(points[rows], distance_upper_bound=2.0 * step, workers=-1)[1]]
    return found


def _voxel_size(points: Floats) -> float:
    """Return the size of voxels, mm, so large that those of one surface touch; 0 if no such size divides the scan."""
    low, high = corners(points)
    diagonal = float(np.linalg.norm(high - low))
    for count in VOXELS:
        step = diagonal / count
        if step > 0.0 and len(voxel_means(points, step)) * PER_VOXEL <= len(points):
            return step
    return 0.0


def _misfit(points: Floats, sizes: Sequence[Floats]) -> float:
    """Return the largest difference of the sizes of points from the most similar of ``sizes``, by the longest one."""
    if len(points) < FEWEST:
        return float("inf")
    own = principal.sizes(points)
    return min(float(np.abs(own - size).max() / size.max()) for size in sizes)


def large_plane(points: Floats, step: float, least: float) -> Bools | None:
    """Return which points (n, 3) lie near the plane with most points; None if its area is at most ``least`` mm^2."""
    rng = np.random.default_rng(len(points))
    few = thinned(points, SAMPLE)
    corners = few[rng.integers(len(few), size=(TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    known = length > step**2
    normals, origins = normals[known] / length[known, None], corners[known, 0]
    if not len(normals):
        return None
    on_each = [np.abs((few - at) @ normal) < THIN * step for normal, at in zip(normals, origins, strict=True)]
    best = int(np.argmax([one.sum() for one in on_each]))
    on = np.abs((points - origins[best]) @ normals[best]) < THIN * step
    # The plane of three single points is not that of all of them.
    axes = principal.of_points(points[on])
    off = np.abs((points - axes.centre) @ axes.axes[:, 2])
    cells = np.floor((points[off < THIN * step] - axes.centre) @ axes.axes[:, :2] / step).astype(np.int64)
    near: Bools = off < step
    return near if len(distinct(cells).rows) * step**2 > least else None
