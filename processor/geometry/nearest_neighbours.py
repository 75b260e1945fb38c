"""Nearest neighbours in a cloud: spacing, outliers, distances to another cloud, crops, equal places."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from functools import partial

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from processor import large_arrays
from processor.distinct_rows import components, distinct_points
from processor.geometry import point_grid
from processor.geometry.point_grid import RUNS, SIDE, Cells, PointGrid, block_at, cells_within, runs_near
from processor.geometry.selection import least_first
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner
from processor.model import Bools, Floats, Ints

SPACING_NEIGHBOURS, SPACING_SAMPLE = 8, 20_000  # by circles of 8; the median is known to 0.2 %
SLICES, SLICE_POINTS, SLICE_SAMPLE = 5, 40_000, 5_000  # work: the pages of five slices of a large cloud are read
CELLS_OF_POINTS = 2.0  # edge of a cell, in spacings
CROWDED, FINER, FINEST = 2e4, 16.0, 1e-6  # points of a block, factor of the edges; least edge by the cloud's diagonal
CROWD_BLOCKS = 1 << 16  # counted at once: their cells take 34 MB
LEAST_RANGE = 512  # places per task of a thread
LEAST_BLOCKS = 64  # per task of a thread
MANY = 64  # points of a block, beyond which its cells are searched about one by one
SEARCHED = 256  # places of a sample at once: their neighbours' pages are given back after that
WIDER = 1.2  # factor of the distance of the k-th neighbour for the search radius about the next point
GROWTH = 1.5  # factor of the search radius where too few points were found
CROP_CHUNK = 1 << 20  # points in memory at once: work, not result
REACHED_CELL = 2.0  # edge of a cell, in reaches: a point's reach meets eight cells at most
LEAST_POINTS = 20_000  # points per task of a thread that marks those within reach
LEAST_SEARCHES = 5_000  # places per task of a thread that searches in a fine grid
FIRST_CELLS = 0.5  # search radius to begin with, in cells


def of_spacing(points: Floats) -> PointGrid:
    """Sort the points (n, 3) of a surface into cells that hold a few points each, whatever the spacing is."""
    if len(points) == 0:
        return point_grid.of_points(points, 1.0)
    low, high = large_arrays.corners(points)
    widest = float(np.linalg.norm(high - low))
    coarse = point_grid.of_points(points, widest / np.sqrt(len(points)))
    while (finer := coarse.cells.size / FINER) > FINEST * widest and _crowd(coarse) > CROWDED:
        coarse = point_grid.of_points(points, finer)  # a point far from the others made the cells large
    wanted = CELLS_OF_POINTS * spacing(coarse)
    return point_grid.of_points(points, wanted) if wanted < 0.5 * coarse.cells.size else coarse


def _crowd(grid: PointGrid) -> float:
    """Return the mean number of points in the block of a point."""
    starts, total = grid.cells.starts, 0.0
    for some in large_arrays.blocks(len(starts), CROWD_BLOCKS):
        number = (starts[some, -1] - starts[some, 0]).astype(np.float64)
        total += float(np.sum(number**2))
    return total / grid.count


def spacing(grid: PointGrid, rows: Ints | None = None) -> float:
    """Spacing d in mm of a cloud on a surface, such that there is one point in d^2; NaN for a single point.

    k neighbours within r cover pi r^2 = k d^2, on regular grids and random samples alike. The median is taken over
    ``rows`` of the grid, without them over an even sample of it.
    """
    rows = np.arange(0, grid.count, max(1, grid.count // SPACING_SAMPLE)) if rows is None else rows
    return spacing_of(*farthest_distances(grid, rows))


def farthest_distances(grid: PointGrid, rows: Ints) -> tuple[Floats, int]:
    """Distance (m,) of ``rows`` of a grid to the k-th neighbour, and k; 0 where there is none."""
    k = min(SPACING_NEIGHBOURS, grid.count - 1)
    if k < 1:
        return np.empty(0), k
    found = np.empty(len(rows))
    for part in large_arrays.blocks(len(rows), SEARCHED):
        found[part] = _distances(grid, grid.cells.points[rows[part]], rows[part], k)[1]
    return found, k


def spacing_of(farthest: Floats, k: int) -> float:
    """Spacing by the distances (m,) of points to the k-th neighbour; NaN without any."""
    return float(np.median(farthest) * np.sqrt(np.pi / k)) if len(farthest) else float("nan")


def surface_spacing(points: Floats) -> float:
    """Spacing in mm as :func:`spacing`, over a sample in the order of the points (n, 3).

    Every k-th of up to 200,000 points is a sample; of more points, every k-th of five slices across the longest axis.
    """
    grid = of_spacing(points)
    if len(points) <= SLICES * SLICE_POINTS:
        sample = np.arange(0, len(points), max(1, len(points) // SLICE_SAMPLE))
    else:
        order = np.argsort(points[:, np.argmax(np.ptp(points, axis=0))], kind="stable")
        starts = (np.arange(SLICES) + 0.5) / SLICES * len(points) - 0.25 * SLICE_POINTS
        step = SLICES * SLICE_POINTS // 2 // SLICE_SAMPLE
        sample = np.concatenate([order[s : s + SLICE_POINTS // 2 : step] for s in starts.astype(np.int64)])
    row = np.empty(grid.count, np.int64)
    row[grid.order] = np.arange(grid.count)
    return spacing(grid, row[sample])


def nearest(grid: PointGrid, places: Floats) -> Floats:
    """Distance (m,) from places (m, 3), all finite, to the nearest point of a grid; infinite for an empty grid."""
    return _distances(grid, np.ascontiguousarray(places), np.full(len(places), -1), 1)[1]


def nearest_rows(cells: Cells, places: Floats, reach: float, count: int = 1) -> tuple[Ints, Floats]:
    """Rows (m, count), in a grid's order, of its points nearest to places (m, 3), and their distances, mm.

    The nearest comes first, of equally near ones the lower row. The row is -1 and the distance infinite where there is
    none nearer than ``reach``, and for a place that is not finite. Places are quick to search in an order in which
    neighbours follow each other.
    """
    found, square = np.full((len(places), count), -1, np.int64), np.full((len(places), count), np.inf)
    places = large_arrays.read_only(np.ascontiguousarray(places, np.float64))
    if len(cells.points) and reach > 0.0:
        over_ranges(
            lambda a, b: _nearest_rows(cells, places, float(reach), found, square, a, b),
            len(places), least=LEAST_SEARCHES,
        )  # fmt: skip
    return found, np.sqrt(square)


def mean_distances(grid: PointGrid, neighbours: int) -> Floats:
    """Mean distance (n,) of each point of a grid, in the grid's order, to its neighbours, itself not among them."""
    k = min(neighbours, grid.count - 1)
    if k < 1:
        return np.zeros(grid.count)
    mean, start = np.full(grid.count, np.inf), CELLS_OF_POINTS * grid.cells.size
    over_ranges(
        lambda a, b: _means_by_block(grid.cells, a, b, k, start, mean), len(grid.cells.keys), least=LEAST_BLOCKS
    )
    few = np.flatnonzero(np.isinf(mean))
    mean[few] = _distances(grid, grid.cells.points[few], few, k)[0]
    return mean


def statistical_inliers(grid: PointGrid, neighbours: int, ratio: float) -> Bools:
    """Mark (n,), in the grid's order, the points that statistical outlier removal keeps.

    The mean distance to their neighbours is at most mean + ratio * sd of all points, as in Open3D and PCL, and in
    paper 002 with 20 neighbours and a ratio of 1.
    """
    mean = mean_distances(grid, neighbours)
    if len(mean) == 0:
        return np.ones(0, bool)
    return np.asarray(mean <= mean.mean() + ratio * mean.std(), bool)


def without_outliers(points: Floats, neighbours: int, ratio: float) -> Floats:
    """Return the points (k, 3) of (n, 3) that statistical outlier removal keeps, in their order."""
    grid = of_spacing(points)
    return points[np.sort(grid.order[statistical_inliers(grid, neighbours, ratio)])]


def within_reach(points: Floats, places: Floats, reach: float) -> tuple[Bools, Bools]:
    """Mark the points (n, 3) that have a place nearer than ``reach``, mm, and the places (m, 3) that have such a point.

    The grid holds the places: points may be many, and in any order.
    """
    of_points, of_places = np.zeros(len(points), bool), np.zeros(len(places), bool)
    if not len(points) or not len(places):
        return of_points, of_places
    grid = point_grid.of_points(places, REACHED_CELL * reach)
    near = np.zeros(len(places), bool)
    for rows in large_arrays.blocks(len(points), large_arrays.AT_ONCE):
        some, marks = large_arrays.read_only(np.ascontiguousarray(points[rows], np.float64)), of_points[rows]
        over_ranges(partial(_mark_within, grid.cells, some, reach, marks, near), len(some), least=LEAST_POINTS)
    of_places[grid.order] = near
    return of_points, of_places


def nearest_crops(points: Floats, centres: Floats, reaches: Floats) -> list[Ints]:
    """Rows of points (n, 3) within ``reaches`` (k,) of each of centres (k, 3): k arrays in row order; lengths in mm.

    A point within reach of several centres belongs to the nearest. The search tree holds the centres, not the points.
    """
    if len(centres) == 0:
        return []
    tree = cKDTree(centres)
    # A little farther: the tree's upper bound is exclusive, the radius of a crop is inclusive.
    bound = float(reaches.max()) * (1.0 + 1e-9) + 1e-9
    rows, owners = [], []
    for first in range(0, len(points), CROP_CHUNK):
        chunk = points[first : first + CROP_CHUNK]
        inside = np.flatnonzero(np.all((chunk >= tree.mins - bound) & (chunk <= tree.maxes + bound), axis=1))
        distance, owner = tree.query(chunk[inside], distance_upper_bound=bound, workers=-1)
        near = np.flatnonzero(np.isfinite(distance))
        near = near[distance[near] <= reaches[owner[near]]]
        rows.append(first + inside[near])
        owners.append(owner[near])
    row, owner = np.concatenate([np.empty(0, np.int64), *rows]), np.concatenate([np.empty(0, np.int64), *owners])
    order = np.argsort(owner, kind="stable")
    starts = np.searchsorted(owner[order], np.arange(1, len(centres)))
    return [part.astype(np.int64) for part in np.split(row[order], starts)]


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
    """Fill mean distance of the k nearest points and that of the k-th, for places order[first] to order[last - 1]."""
    size, (xl, yl, zl) = cells.size, (cells.lower[0], cells.lower[1], cells.lower[2])
    tops = SIDE * cells.extent * size
    points, runs, squares = cells.points, np.empty((RUNS, 2), np.int64), np.empty(8 * k)
    guess = size
    for at in range(first, last):
        row = order[at]
        skipped = own[row]
        x, y, z = places[row, 0], places[row, 1], places[row, 2]
        # The search about a place outside the grid starts at its distance from the grid.
        away = max(xl - x, yl - y, zl - z, x - xl - tops[0], y - yl - tops[1], z - zl - tops[2], 0.0)
        reach, n = guess + away, 0
        while True:
            runs, found = runs_near(cells, x, y, z, 0.0, 0.0, 0.0, 0.0, reach, runs)
            room = 1
            for run in range(found):
                room += runs[run, 1] - runs[run, 0]
            if room > len(squares):
                squares = np.empty(2 * room)
            n = 0
            for run in range(found):
                for p in range(runs[run, 0], runs[run, 1]):
                    u, v, w = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    squares[n] = u * u + v * v + w * w
                    n += (squares[n] <= reach * reach) & (p != skipped)
            if n >= k:
                break
            reach = GROWTH * reach + size
        mean[row], farthest[row] = _mean_of_least(squares, n, k)
        # One point far from others says nothing of the next one.
        guess = max(WIDER * min(farthest[row] - away, guess), 0.05 * size)


@njit(cache=True, nogil=True)
def _means_by_block(cells, first, last, k, reach, mean):  # type: ignore[no-untyped-def]
    """Fill the mean distance of points in blocks first to last - 1 to the k nearest others, if within a search radius.

    The points about all points of a block, or of a cell of a dense one, are gathered at once: most are near each of
    them. The radius is that of the points before, ``reach`` at first.
    """
    runs, near, squares = np.empty((RUNS, 2), np.int64), np.empty((3, 8 * k)), np.empty(8 * k)
    for block in range(first, last):
        starts = cells.starts[block]
        step = SIDE**3 if starts[-1] - starts[0] <= MANY else 1
        for cell in range(0, SIDE**3, step):
            begin, end = starts[cell], starts[cell + step]
            if begin == end:
                continue
            runs, near, count = _gathered(cells, begin, end, reach, runs, near)
            if count > len(squares):
                squares = np.empty(2 * count)
            xs, ys, zs = near[0], near[1], near[2]
            total, known = 0.0, 0
            for row in range(begin, end):
                x, y, z = cells.points[row, 0], cells.points[row, 1], cells.points[row, 2]
                for i in range(count):
                    u, v, w = xs[i] - x, ys[i] - y, zs[i] - z
                    squares[i] = u * u + v * v + w * w
                n = 0
                for i in range(count):
                    squares[n] = squares[i]
                    n += squares[i] <= reach * reach
                if n > k:  # the point itself is one of them
                    squares[_first_zero(squares)] = np.inf
                    mean[row], farthest = _mean_of_least(squares, n, k)
                    total, known = total + farthest, known + 1
            if 2 * known > end - begin:
                reach = WIDER * total / known
            elif end - begin > 3:  # one point far from others says nothing of the next ones
                reach *= GROWTH


@njit(cache=True, nogil=True, inline="always")
def _first_zero(squares):  # type: ignore[no-untyped-def]
    """Return where the first zero is."""
    at = 0
    while squares[at] > 0.0:
        at += 1
    return at


@inner
def _gathered(cells, begin, end, reach, runs, near):  # type: ignore[no-untyped-def]
    """Write the points within ``reach`` of the box about rows begin to end - 1 to ``near`` (3, m); their number."""
    points, low, high = cells.points, np.empty(3), np.empty(3)
    for axis in range(3):
        low[axis], high[axis] = points[begin, axis], points[begin, axis]
        for row in range(begin + 1, end):
            low[axis], high[axis] = min(low[axis], points[row, axis]), max(high[axis], points[row, axis])
    x, y, z = 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), 0.5 * (low[2] + high[2])
    half = np.sqrt((high[0] - x) ** 2 + (high[1] - y) ** 2 + (high[2] - z) ** 2)
    runs, found = runs_near(cells, x, y, z, 0.0, 0.0, 0.0, 0.0, (reach + half) * (1.0 + 1e-9), runs)
    room = 1
    for run in range(found):
        room += runs[run, 1] - runs[run, 0]
    if room > near.shape[1]:
        near = np.empty((3, 2 * room))
    count = 0
    for run in range(found):
        for p in range(runs[run, 0], runs[run, 1]):
            square = 0.0
            for axis in range(3):
                at = points[p, axis]
                away = max(low[axis] - at, at - high[axis], 0.0)
                square += away * away
                near[axis, count] = at
            count += square <= reach * reach * (1.0 + 1e-9)
    return runs, near, count


@inner
def _mean_of_least(squares, n, k):  # type: ignore[no-untyped-def]
    """Return the mean root of the ``k`` least of ``n`` squares, which are reordered, and the root of the k-th."""
    if n > 2 * k:
        least_first(squares, n, k - 1)
    for i in range(1, k if n > 2 * k else n):
        square = squares[i]
        while i > 0 and squares[i - 1] > square:
            squares[i] = squares[i - 1]
            i -= 1
        squares[i] = square
    total = 0.0
    for i in range(k):
        total += np.sqrt(squares[i])
    return total / k, np.sqrt(squares[k - 1])


@njit(cache=True, nogil=True)
def _nearest_rows(cells, places, reach, found, square, first, last):  # type: ignore[no-untyped-def]
    """Fill the rows (n, k) of the nearest points and the squares of their distances, for places first to last - 1.

    The radius of a search grows until it holds k points. That of one point begins at the one found for the last place.
    """
    size, xl, yl, tops = cells.size, cells.lower[0], cells.lower[1], SIDE * cells.extent - 1
    points, starts = cells.points, cells.starts
    k, previous = found.shape[1], -1
    for row in range(first, last):
        x, y, z = places[row, 0], places[row, 1], places[row, 2]
        if not np.isfinite(x + y + z):
            continue
        rows, squares, limit = found[row], square[row], reach * reach
        if k == 1 and previous >= 0:
            d = _square(points, previous, x, y, z)
            if d < limit:
                rows[0], squares[0], limit = previous, d, d
        radius = min(FIRST_CELLS * size, np.sqrt(limit))
        while True:
            i0, i1, j0, j1, k0, k1 = cells_within(cells, x, y, z, radius, radius, radius)
            for i in range(i0, i1 + 1):
                gx = max(abs(xl + (i + 0.5) * size - x) - 0.5 * size, 0.0)
                for j in range(j0, j1 + 1):
                    gy = max(abs(yl + (j + 0.5) * size - y) - 0.5 * size, 0.0)
                    if gx * gx + gy * gy > limit * (1.0 + 1e-9):
                        continue
                    cell = (i % SIDE * SIDE + j % SIDE) * SIDE
                    for bk in range(k0 // SIDE, k1 // SIDE + 1):
                        block = block_at(cells, i // SIDE, j // SIDE, bk)
                        if block < 0:
                            continue
                        low, high = max(k0 - SIDE * bk, 0), min(k1 - SIDE * bk, SIDE - 1)
                        for p in range(starts[block, cell + low], starts[block, cell + high + 1]):
                            d = _square(points, p, x, y, z)
                            if d > limit or (d == limit and p >= rows[k - 1]):
                                continue
                            m = k - 1
                            while m > 0 and (squares[m - 1] > d or (squares[m - 1] == d and rows[m - 1] > p)):
                                squares[m], rows[m] = squares[m - 1], rows[m - 1]
                                m -= 1
                            squares[m], rows[m] = d, p
                            limit = min(limit, squares[k - 1])
            whole = i0 == j0 == k0 == 0 and i1 == tops[0] and j1 == tops[1] and k1 == tops[2]
            if whole or limit <= radius * radius:
                break
            radius = min(2.0 * radius, np.sqrt(limit) * (1.0 + 1e-9))
            if k > 1:  # they are found again
                limit = reach * reach
                for m in range(k):
                    rows[m], squares[m] = -1, np.inf
        previous = rows[0]


@njit(cache=True, nogil=True, inline="always")
def _square(points, row, x, y, z):  # type: ignore[no-untyped-def]
    u, v, w = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
    return u * u + v * v + w * w


@njit(cache=True, nogil=True)
def _mark_within(cells, points, reach, of_points, of_places, first, last):  # type: ignore[no-untyped-def]
    """Mark points first to last - 1 with a place of the grid within reach, and the places, in the grid's order."""
    places, starts = cells.points, cells.starts
    for row in range(first, last):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        i0, i1, j0, j1, k0, k1 = cells_within(cells, x, y, z, reach, reach, reach)
        for bi in range(i0 // SIDE, i1 // SIDE + 1):
            for bj in range(j0 // SIDE, j1 // SIDE + 1):
                for bk in range(k0 // SIDE, k1 // SIDE + 1):
                    block = block_at(cells, bi, bj, bk)
                    if block < 0:
                        continue
                    low, high = max(k0 - SIDE * bk, 0), min(k1 - SIDE * bk, SIDE - 1)
                    for i in range(max(i0, SIDE * bi), min(i1, SIDE * bi + SIDE - 1) + 1):
                        for j in range(max(j0, SIDE * bj), min(j1, SIDE * bj + SIDE - 1) + 1):
                            cell = ((i - SIDE * bi) * SIDE + (j - SIDE * bj)) * SIDE
                            for p in range(starts[block, cell + low], starts[block, cell + high + 1]):
                                u, v, w = places[p, 0] - x, places[p, 1] - y, places[p, 2] - z
                                if u * u + v * v + w * w < reach * reach:
                                    of_points[row] = of_places[p] = True


def same_places(points: Floats, within_mm: float) -> Ints:
    """Return the number (n,), from 0, of the place of each point (n, 3); points no farther apart have the same one."""
    distinct, place = distinct_points(points)
    if not len(distinct):
        return place
    return components(len(distinct), *cKDTree(distinct).query_pairs(within_mm, output_type="ndarray").T)[place]
