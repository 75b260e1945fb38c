"""Flat pieces of clouds by an octree over sums of points: the largest cubes whose points lie on one plane.

Sums of a cube are those of its cells: ten numbers, the upper triangle of sum [p; 1][p; 1]^T. From them come a plane,
its scatter and, later, the normal equations of an adjustment, without going back to the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.model import Floats, Ints
from processor.stitching.planes.hashing import numbered, summed

BITS = 19
OFFSET = 1 << (BITS - 1)
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3))
_I = np.array([i for i, _ in UPPER])
_J = np.array([j for _, j in UPPER])
LEAST_WIDTH = 0.06  # of a cube's side: the root mean square width of a flat piece across its length
FLATNESS = 25.0  # least ratio of the two smaller variances of a flat piece


def cells_of(points: Floats, size_mm: float) -> Ints:
    """Cell numbers (n, 3) of points (n, 3)."""
    found: Ints = np.floor(points / size_mm).astype(np.int64)
    return found


def packed(cells: Ints, group: Ints | None = None) -> Ints:
    """Pack cell numbers (n, 3), and a group of 0 to 31 where given, in one number each (n,)."""
    c = cells + OFFSET
    key: Ints = (c[:, 0] << (2 * BITS)) | (c[:, 1] << BITS) | c[:, 2]
    return key if group is None else key | (group << (3 * BITS))


def sums_of(points: Floats) -> Floats:
    """Write single points (n, 3) as sums (n, 10)."""
    x = np.hstack([points, np.ones((len(points), 1))])
    found: Floats = x[:, _I] * x[:, _J]
    return found


def square(sums: Floats) -> Floats:
    """Write sums (n, 10) as symmetric matrices (n, 4, 4)."""
    M = np.empty((len(sums), 4, 4))
    M[:, _I, _J] = sums
    M[:, _J, _I] = sums
    return M


def triangle(M: Floats) -> Floats:
    """Write symmetric matrices (n, 4, 4) as sums (n, 10)."""
    found: Floats = M[:, _I, _J]
    return found


def moved(sums: Floats, T: Floats) -> Floats:
    """Return sums (n, 10) of points moved by T (4, 4) or by one each (n, 4, 4)."""
    return triangle(T @ square(sums) @ np.swapaxes(T, -1, -2))


@dataclass(frozen=True)
class Planes:
    """Planes through sums: mean (n, 3), unit normal (n, 3), variances (n, 3) ascending with their axes (n, 3, 3)."""

    count: Floats
    mean: Floats
    normal: Floats
    variance: Floats
    axes: Floats  # columns, as of the variances


def scatter(sums: Floats) -> tuple[Floats, Floats]:
    """Return means (n, 3) and covariances (n, 3, 3) of sums (n, 10)."""
    n = np.maximum(sums[:, 9], 1e-300)
    mean = sums[:, 6:9] / n[:, None]
    C = square(sums)[:, :3, :3] / n[:, None, None] - mean[:, :, None] * mean[:, None, :]
    return mean, C


def planes_of(sums: Floats) -> Planes:
    """Fit a plane to each of sums (n, 10)."""
    mean, C = scatter(sums)
    variance, axes = np.linalg.eigh(C) if len(C) else (np.empty((0, 3)), np.empty((0, 3, 3)))
    return Planes(sums[:, 9], mean, axes[:, :, 0], np.maximum(variance, 0.0), axes)


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
    """Return for each cell (m,) the number of the largest flat cube around it, -1 = none, and each cube's level (k,).

    ``cells`` (m, 3) of side ``size_mm`` with ``sums`` (m, 10); a cube of level l is 2^l cells wide. Flat: a scatter
    across of at most ``limit_mm``, and wide enough to say where it looks. Cells of another ``group`` (m,) never share a
    cube. ``counts`` (m,) stand for numbers of points where sums are weighted by 1 / variance: then the limits are
    ``limit_sigmas`` of that, and ``limit_mm`` besides.
    """
    n = sums[:, 9] if counts is None else counts
    up: list[Ints] = []  # from the nodes below to the nodes of a level
    flat: list[npt.NDArray[np.bool_]] = []
    where, total, groups = cells, sums, group
    number: Floats = np.asarray(n, np.float64)
    for level in range(levels):
        key = packed(where, groups)
        first, inverse = numbered(key)
        up.append(inverse)
        total = summed(total, up[-1], len(first))
        number = np.asarray(np.bincount(up[-1], number, len(first)), np.float64)
        variance = limit_mm**2 + limit_sigmas**2 * number / np.maximum(total[:, 9], 1e-300)
        flat.append(_is_flat(total, number, size_mm * 2**level, variance, least))
        where = where[first] >> 1
        groups = None if groups is None else groups[first]
    # From the top: a node belongs to the piece of its parent, where that has one.
    piece = np.empty(0, np.int64)
    depth: list[int] = []
    for level in range(levels - 1, -1, -1):
        own = np.full(len(flat[level]), -1, np.int64) if level == levels - 1 else piece[up[level + 1]]
        new = flat[level] & (own < 0)
        own[new] = len(depth) + np.arange(new.sum())
        depth += [level] * int(new.sum())
        piece = own
    return piece[up[0]], np.array(depth, np.int64)


def _is_flat(sums: Floats, number: Floats, side_mm: float, limit: Floats, least: float) -> npt.NDArray[np.bool_]:
    found = np.zeros(len(sums), bool)
    there = np.flatnonzero(number >= least)
    if len(there):
        variance = np.linalg.eigvalsh(scatter(sums[there])[1])
        found[there] = (
            (variance[:, 0] <= limit[there])
            & (variance[:, 1] >= FLATNESS * variance[:, 0])
            & (variance[:, 1] >= (LEAST_WIDTH * side_mm) ** 2)
        )
    return found
