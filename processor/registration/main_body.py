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
from processor.model import Bools, Floats, Ints
from processor.registration import principal

VOXELS = (200.0, 140.0, 100.0, 70.0)  # along the scan's diagonal, the most that the points allow
PER_VOXEL = 6  # points of an occupied voxel, on average
FEWEST = 40  # voxels of a part
LARGER = 0.02  # of each size, by which a scan that holds more than its part is larger
LARGER_AREA = 1.3  # of a plane, by the part's largest side: cells at its rim are partly empty
TRIALS, SAMPLE = 1000, 4000  # of random planes, and of points that they are compared with
THIN = 0.25  # voxels by which points on a plane may lie off it
MOST_VOXELS = 1e12  # whose numbers are exact in 64 bits by far
LINK = 3.0  # voxels between points of one piece


def holds_more(points: Floats, sizes: Sequence[Floats]) -> bool:
    """Whether points (n, 3) are larger than a part of any of ``sizes`` (3,), longest first, in mm."""
    step = _voxel_size(points)
    even = voxel_means(points, step, least=2) if step > 0.0 else points[:0]
    return len(even) >= FEWEST and bool((principal.sizes(even) > _largest(sizes)).any())


def of_sizes(points: Floats, sizes: Sequence[Floats]) -> Bools | None:
    """Return which points (n, 3) belong to a part that has one of ``sizes`` (3,), longest first, in mm.

    None if the scan is not larger than the part, or nothing in it is found to be something else.
    """
    step = _voxel_size(points)
    even = voxel_means(points, step, least=2) if step > 0.0 else points[:0]
    if len(even) < FEWEST:
        return None
    if not (principal.sizes(even) > _largest(sizes)).any():
        return None
    left = without_planes(even, step, sizes)
    if left.sum() < FEWEST:
        return None
    piece = np.zeros(len(even), bool)
    piece[np.flatnonzero(left)[connected(even[left], LINK * step)[0]]] = True
    best = piece if _misfit(even[piece], sizes) <= _misfit(even[left], sizes) else left
    if best.all():
        return None
    tree, of_body, found = cKDTree(even), np.append(best, False), np.empty(len(points), bool)
    for rows in blocks(len(points)):
        found[rows] = of_body[tree.query(points[rows], distance_upper_bound=2.0 * step, workers=-1)[1]]
    return found


def without_planes(points: Floats, step: float, sizes: Sequence[Floats]) -> Bools:
    """Mark points (n, 3), one in each voxel of size ``step``, that are not of ground and walls about parts of sizes."""
    left = np.ones(len(points), bool)
    side = LARGER_AREA * float(np.prod(_largest(sizes)[:2]))
    while left.sum() >= FEWEST and (on := large_plane(points[left], step, side)) is not None:
        left[np.flatnonzero(left)[on]] = False
        if left.sum() >= FEWEST and (principal.sizes(points[left]) <= _largest(sizes)).all():
            break
    return left


def connected(points: Floats, link: float) -> list[Ints]:
    """Return the rows of each piece of points (n, 3), linked by distances up to ``link``, the largest piece first."""
    number = components(len(points), *cKDTree(points).query_pairs(link, output_type="ndarray").T)
    count = np.bincount(number)
    return [np.flatnonzero(number == piece) for piece in np.argsort(-count, kind="stable") if count[piece] >= FEWEST]


def voxel_size(points: Floats, length: float, counts: Sequence[float], per_voxel: int) -> float:
    """Return the size of voxels, mm, so large that those of one surface touch; 0 if none of the counts divides so.

    They are ``counts`` on a ``length``, and have ``per_voxel`` points on average.
    """
    low, high = corners(points)
    for step in (length / count for count in counts):
        few_enough = step > 0.0 and np.prod(np.ceil((high - low) / step)) < MOST_VOXELS
        if few_enough and len(voxel_means(points, step)) * per_voxel <= len(points):
            return step
    return 0.0


def _voxel_size(points: Floats) -> float:
    return voxel_size(points, float(np.linalg.norm(np.subtract(*corners(points)))), VOXELS, PER_VOXEL)


def _largest(sizes: Sequence[Floats]) -> Floats:
    largest: Floats = np.max(sizes, axis=0) * (1.0 + LARGER)
    return largest


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
    drawn = few[rng.integers(len(few), size=(TRIALS, 3))]
    normals = np.cross(drawn[:, 1] - drawn[:, 0], drawn[:, 2] - drawn[:, 0])
    length = np.linalg.norm(normals, axis=1)
    known = length > step**2
    normals, origins = normals[known] / length[known, None], drawn[known, 0]
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
