"""Nearest neighbours in a point grid: spacing of a cloud, its outliers, how far another cloud is."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry import point_grid
from processor.geometry.parallel import over_ranges
from processor.geometry.point_grid import SIDE, PointGrid, block_at
from processor.model import Floats, Ints

SPACING_NEIGHBOURS, SPACING_SAMPLE = 8, 20_000
CELLS_OF_POINTS = 2.0  # a cell's edge over the spacing
LEAST_RANGE = 512
GROWTH = 1.5  # of a search that found too few


def of_spacing(points: Floats) -> PointGrid:
    """Sort a cloud (n, 3) of a surface into cells of a few points each, whatever its spacing is."""
    if len(points) == 0:
        return point_grid.of_points(points, 1.0)
    widest = float(np.linalg.norm(np.ptp(points, axis=0)))
    coarse = point_grid.of_points(points, widest / np.sqrt(len(points)))
    around = spacing(coarse)
    wanted = CELLS_OF_POINTS * around
    return point_grid.of_points(points, wanted) if wanted < 0.5 * coarse.cells.size else coarse


def spacing(grid: PointGrid) -> float:
    """Spacing d of a cloud on a surface, such that there is one point in d^2: median over a sample; NaN for one point.

    k neighbours within r cover pi r^2 = k d^2, on grids and random samples alike.
    """
    k = min(SPACING_NEIGHBOURS, grid.count - 1)
    if k < 1:
        return float("nan")
    rows = np.arange(0, grid.count, max(1, grid.count // SPACING_SAMPLE))
    farthest = _distances(grid, grid.cells.points[rows], rows, k)[1]
    return float(np.median(farthest) * np.sqrt(np.pi / k))


def nearest(grid: PointGrid, places: Floats) -> Floats:
    """Distance (m,) of places (m, 3), all finite, to their nearest points; infinite where there are none."""
    return _distances(grid, np.ascontiguousarray(places), np.full(len(places), -1), 1)[1]


def mean_distances(grid: PointGrid, neighbours: int) -> Floats:
    """Mean distance (n,) of each point of a grid, in the grid's order, to its neighbours, itself not among them."""
    k = min(neighbours, grid.count - 1)
    if k < 1:
        return np.zeros(grid.count)
    return _distances(grid, grid.cells.points, np.arange(grid.count), k)[0]


def statistical_inliers(grid: PointGrid, neighbours: int, ratio: float) -> npt.NDArray[np.bool_]:
    """Mark (n,), in the grid's order, the points whose mean distance to their neighbours is no outlier's.

    At most mean + ratio * sd of all, as in Open3D and PCL, and in paper 002 with 20 neighbours and a ratio of 1.
    """
    mean = mean_distances(grid, neighbours)
    if len(mean) == 0:
        return np.ones(0, bool)
    return np.asarray(mean <= mean.mean() + ratio * mean.std(), bool)


def _distances(grid: PointGrid, places: Floats, own: Ints, k: int) -> tuple[Floats, Floats]:
    """Return mean distance (m,) of the k nearest points, and that (m,) of the k-th; row ``own`` (m,) is left out."""
    mean, farthest = np.full(len(places), np.inf), np.full(len(places), np.inf)
    if grid.count >= k:
        order = np.arange(len(places)) if (own >= 0).all() else grid.beside(places)
        over_ranges(
            lambda a, b: _nearest(grid.cells, places, own, order, a, b, k, mean, farthest),
            len(places), least=LEAST_RANGE,
        )  # fmt: skip
    return mean, farthest


@njit(cache=True, nogil=True)
def _nearest(cells, places, own, order, first, last, k, mean, farthest):  # type: ignore[no-untyped-def]
    size, (xl, yl, zl) = cells.size, (cells.lower[0], cells.lower[1], cells.lower[2])
    tops = SIDE * cells.extent - 1
    points, starts = cells.points, cells.starts
    best = np.empty(k)
    edge = SIDE * size
    guess = size
    for at in range(first, last):
        row = order[at]
        skipped = own[row]
        x, y, z = places[row, 0], places[row, 1], places[row, 2]
        # A place beyond the grid starts at the distance of its rim.
        away = max(xl - x, yl - y, zl - z, x - xl - size * (tops[0] + 1), y - yl - size * (tops[1] + 1))
        away = max(away, z - zl - size * (tops[2] + 1), 0.0)
        reach = guess + away
        while True:
            i0, i1 = int(max((x - reach - xl) / size, 0.0)), int(min((x + reach - xl) / size, float(tops[0])))
            j0, j1 = int(max((y - reach - yl) / size, 0.0)), int(min((y + reach - yl) / size, float(tops[1])))
            k0, k1 = int(max((z - reach - zl) / size, 0.0)), int(min((z + reach - zl) / size, float(tops[2])))
            n = 0
            best[:] = np.inf
            for bi in range(i0 // SIDE, i1 // SIDE + 1):
                gx = max(xl + bi * edge - x, x - xl - (bi + 1) * edge, 0.0)
                for bj in range(j0 // SIDE, j1 // SIDE + 1):
                    gy = max(yl + bj * edge - y, y - yl - (bj + 1) * edge, 0.0)
                    for bk in range(k0 // SIDE, k1 // SIDE + 1):
                        gz = max(zl + bk * edge - z, z - zl - (bk + 1) * edge, 0.0)
                        if gx * gx + gy * gy + gz * gz > best[k - 1] * (1.0 + 1e-9):
                            continue
                        block = block_at(cells, bi, bj, bk)
                        if block < 0:
                            continue
                        low, high = max(k0 - SIDE * bk, 0), min(k1 - SIDE * bk, SIDE - 1)
                        for i in range(max(i0, SIDE * bi), min(i1, SIDE * bi + SIDE - 1) + 1):
                            for j in range(max(j0, SIDE * bj), min(j1, SIDE * bj + SIDE - 1) + 1):
                                cell = ((i - SIDE * bi) * SIDE + (j - SIDE * bj)) * SIDE
                                for p in range(starts[block, cell + low], starts[block, cell + high + 1]):
                                    u, v, w = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                                    d = u * u + v * v + w * w
                                    if d >= best[k - 1] or p == skipped:
                                        continue
                                    n += 1
                                    m = k - 1
                                    while m > 0 and best[m - 1] > d:
                                        best[m] = best[m - 1]
                                        m -= 1
                                    best[m] = d
            if best[k - 1] <= reach * reach:
                break
            whole = i0 == 0 and j0 == 0 and k0 == 0 and i1 == tops[0] and j1 == tops[1] and k1 == tops[2]
            if whole:
                break
            # Any k points bound the distance of the k-th: a search as wide as that is the last.
            reach = np.sqrt(best[k - 1]) * (1.0 + 1e-9) if n >= k else GROWTH * reach + size
        total = 0.0
        for m in range(k):
            total += np.sqrt(best[m])
        mean[row] = total / k
        farthest[row] = np.sqrt(best[k - 1])
        if np.isfinite(farthest[row]):
            guess = max(1.2 * (farthest[row] - away), 0.05 * size)
