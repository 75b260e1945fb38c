"""Planar pieces of point clouds by an octree over moments: the largest cubes whose points lie on one plane.

The moments of a cube are the sums of those of its cells: ten numbers, the upper triangle of sum [p; 1][p; 1]^T. They
give the plane, its scatter and, later, the normal equations of an adjustment without another pass over the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.model import Floats, Ints
from processor.stitching.planes.grouped_sums import numbered, summed

BITS = 19  # for each of three coordinates of a cell, and six for a group in an int64
OFFSET = 1 << (BITS - 1)
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3))  # of 4 by 4
_I = np.array([i for i, _ in UPPER])
_J = np.array([j for _, j in UPPER])
LEAST_WIDTH = 0.06  # of a cube's side: least standard deviation of a planar piece's points along its narrower axis
ROWS = 1 << 15  # of moments that are written as matrices at once
FLATNESS = 25.0  # least ratio of the two smaller variances of a planar piece


@dataclass(frozen=True)
class Planes:
    """Planes through moments: mean (n, 3), unit normal (n, 3), variances (n, 3) ascending with their axes (n, 3, 3)."""

    count: Floats
    mean: Floats
    normal: Floats
    variance: Floats
    axes: Floats  # columns, in the order of the variances


def cells_of(points: Floats, size_mm: float) -> Ints:
    """Return the cell indices (n, 3) of points (n, 3)."""
    cells: Ints = np.floor(points / size_mm).astype(np.int64)
    return cells


def packed(cells: Ints, group: Ints | None = None) -> Ints:
    """Pack cell indices (n, 3), and a group of 0 to 31 if given, into one key each (n,)."""
    c = cells + OFFSET
    key: Ints = (c[:, 0] << (2 * BITS)) | (c[:, 1] << BITS) | c[:, 2]
    return key if group is None else key | (group << (3 * BITS))


def unpacked(key: Ints) -> Ints:
    """Return the cell indices (n, 3) of keys (n,) without a group."""
    every = (1 << BITS) - 1
    cells: Ints = np.stack([key >> (2 * BITS), (key >> BITS) & every, key & every], axis=1) - OFFSET
    return cells


def sums_of(points: Floats) -> Floats:
    """Return the moments (n, 10) of single points (n, 3)."""
    x = np.hstack([points, np.ones((len(points), 1))])
    sums: Floats = x[:, _I] * x[:, _J]
    return sums


def square(sums: Floats) -> Floats:
    """Write moments (n, 10) as symmetric matrices (n, 4, 4)."""
    M = np.empty((len(sums), 4, 4))
    M[:, _I, _J] = sums
    M[:, _J, _I] = sums
    return M


def triangle(M: Floats) -> Floats:
    """Write symmetric matrices (n, 4, 4) as moments (n, 10)."""
    sums: Floats = M[:, _I, _J]
    return sums


def transformed(sums: Floats, T: Floats) -> Floats:
    """Return the moments (n, 10) of points transformed by T (4, 4), or by one T each (n, 4, 4)."""
    found = np.empty((len(sums), len(UPPER)))
    for first in range(0, len(sums), ROWS):
        rows = slice(first, first + ROWS)
        own = T if T.ndim == 2 else T[rows]
        found[rows] = triangle(own @ square(sums[rows]) @ np.swapaxes(own, -1, -2))
    return found


def scatter(sums: Floats) -> tuple[Floats, Floats]:
    """Return means (n, 3) and covariances (n, 3, 3) from moments (n, 10)."""
    n = np.maximum(sums[:, 9], 1e-300)
    mean = sums[:, 6:9] / n[:, None]
    C = square(sums)[:, :3, :3] / n[:, None, None] - mean[:, :, None] * mean[:, None, :]
    return mean, C


def planes_of(sums: Floats) -> Planes:
    """Fit a plane to the points of each row of moments (n, 10)."""
    mean, C = scatter(sums)
    variance, axes = np.linalg.eigh(C) if len(C) else (np.empty((0, 3)), np.empty((0, 3, 3)))
    return Planes(count=sums[:, 9], mean=mean, normal=axes[:, :, 0], variance=np.maximum(variance, 0.0), axes=axes)


def flat_pieces(
    cells: Ints,
    sums: Floats,
    size_mm: float,
    limit_mm: float,
    levels: int,
    least: float = 8.0,
    group: Ints | None = None,
    counts: Floats | None = None,
    limit_sigmas: float = 0.0,
) -> tuple[Ints, Ints]:
    """Return for each cell (m,) the number of the largest planar cube around it, -1 = none, and each cube's level (k,).

    ``cells`` (m, 3) of side ``size_mm`` have moments ``sums`` (m, 10); a cube of level l is 2^l cells wide. It is
    planar if it holds ``least`` points, scatters by at most ``limit_mm`` across its plane, and is wide enough to define
    a normal. Cells of different ``group`` (m,) never share a cube. ``counts`` (m,) are the numbers of points if moments
    are weighted by 1 / variance; ``limit_sigmas`` standard deviations are then added to ``limit_mm`` in quadrature.
    """
    n = sums[:, 9] if counts is None else counts
    parent: list[Ints] = []  # of each node of the level below
    flat: list[npt.NDArray[np.bool_]] = []
    where, total, groups = cells, sums, group
    number: Floats = np.asarray(n, np.float64)
    for level in range(levels):
        first, inverse = numbered(packed(where, groups))
        parent.append(inverse)
        total = summed(total, inverse, len(first))
        number = np.asarray(np.bincount(inverse, number, len(first)), np.float64)
        variance = limit_mm**2 + limit_sigmas**2 * number / np.maximum(total[:, 9], 1e-300)
        flat.append(_is_flat(total, number, size_mm * 2**level, variance, least))
        where = where[first] >> 1
        groups = None if groups is None else groups[first]
    # From the top down: a node belongs to the piece of its parent, if that has one.
    piece = np.empty(0, np.int64)
    depth: list[int] = []
    for level in range(levels - 1, -1, -1):
        inherited = np.full(len(flat[level]), -1, np.int64) if level == levels - 1 else piece[parent[level + 1]]
        new = flat[level] & (inherited < 0)
        inherited[new] = len(depth) + np.arange(new.sum())
        depth += [level] * int(new.sum())
        piece = inherited
    return piece[parent[0]], np.array(depth, np.int64)


def _is_flat(sums: Floats, number: Floats, side_mm: float, limit: Floats, least: float) -> npt.NDArray[np.bool_]:
    flat = np.zeros(len(sums), bool)
    enough = np.flatnonzero(number >= least)
    for first in range(0, len(enough), ROWS):
        rows = enough[first : first + ROWS]
        variance = np.linalg.eigvalsh(scatter(sums[rows])[1])
        flat[rows] = (
            (variance[:, 0] <= limit[rows])
            & (variance[:, 1] >= FLATNESS * variance[:, 0])
            & (variance[:, 1] >= (LEAST_WIDTH * side_mm) ** 2)
        )
    return flat
