"""Smaller samples of a cloud: every k-th point, an order by cells that makes these even, means of voxels."""

# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import math
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from numba import njit

from processor import large_arrays
from processor.geometry.selection import sort_rows
from processor.model import Floats, Ints

T = TypeVar("T", bound=np.generic)

FEW = 1024  # points of a cell that are sorted by a compiled loop
MOST_EMPTY = 4  # voxels for each point, up to which the empty ones are counted, too


def thinned(points: npt.NDArray[T], count: int) -> npt.NDArray[T]:
    """Every k-th of points (n, ...), with the largest k that leaves ``count`` points or more; a copy of many points."""
    step = max(1, len(points) // count)
    return points[::step] if len(points) <= large_arrays.BLOCK_ROWS else large_arrays.every(points, step)


class Sorted(NamedTuple):
    """Points (n, 3) in another order, and the row (n,) that each had."""

    points: Floats
    row: Ints


def by_cell(points: Floats, size_mm: float) -> Sorted:
    """Sort points (n, 3) by cells of ``size_mm``; more than AT_ONCE through files, if there are any, part by part.

    Queries of a tree for points in this order take a third of the time, and every k-th point is an even sample. Points
    of a cell are sorted by their coordinates: the order does not depend on that of the file.
    """
    points = large_arrays.read_only(np.ascontiguousarray(points, np.float64))
    if not len(points):
        return Sorted(points, np.empty(0, np.int64))
    grid = _grid(points, size_mm)
    if len(points) <= large_arrays.AT_ONCE:
        row = _order(points, grid, size_mm)
        return Sorted(points[row], row)

    # Cells are numbered along x first, then along y: runs of columns along z are parts whose order is that of all.
    columns = int(grid.extent[0] * grid.extent[1])
    along_y = int(grid.extent[1]) if columns <= len(points) else 1

    def column_of(block: tuple[Floats, ...]) -> Ints:
        cell = ((block[0][:, :2] - grid.low[:2]) / size_mm).astype(np.int64)
        column: Ints = cell[:, 0] if along_y == 1 else cell[:, 0] * along_y + cell[:, 1]
        return column

    filled = np.zeros(int(grid.extent[0]) * along_y, np.int64)
    for rows in large_arrays.blocks(len(points)):
        filled += np.bincount(column_of((points[rows],)), minlength=len(filled))
    part_of_column = np.cumsum(filled) // large_arrays.AT_ONCE
    ends = np.cumsum(np.bincount(part_of_column, filled).astype(np.int64))
    passed = ((points[rows], np.arange(rows.start, rows.stop)) for rows in large_arrays.blocks(len(points)))
    placed, row = large_arrays.in_parts(passed, lambda block: part_of_column[column_of(block)], ends)
    for part in large_arrays.parts_of(ends):
        own, among = placed[part], row[part]
        order = _order(large_arrays.read_only(own), grid, size_mm)
        own[:], among[:] = own[order], among[order]
    return Sorted(placed, row)


def _order(points: Floats, grid: _Grid, size_mm: float) -> Ints:
    """Return the rows (n,) of points (n, 3) in the order of their cells and coordinates."""
    if grid.cells > MOST_EMPTY * len(points):
        key = np.empty(len(points), np.int64)
        _number(points, grid.low, size_mm, grid.extent, key)
        order = np.argsort(key, kind="stable").astype(np.int64, copy=False)
        key = key[order]
        bounds = np.flatnonzero(key[1:] != key[:-1]) + 1
        starts = np.concatenate([[0], bounds, [len(key)]]).astype(np.int32)
    else:
        starts, order = np.zeros(grid.cells + 1, np.int32), np.empty(len(points), np.int64)
        _into_cells(points, grid.low, size_mm, grid.extent, starts, order)
    large = _sort_cells(points, starts, order)
    if large:
        of_cell = np.diff(starts)
        cells = np.flatnonzero(of_cell > FEW)
        at = np.repeat(starts[cells] - np.cumsum(of_cell[cells]) + of_cell[cells], of_cell[cells]) + np.arange(large)
        rows = order[at]
        order[at] = rows[_sorted_by_key(points[rows], np.repeat(cells, of_cell[cells]))]
    return order


def _sorted_by_key(points: Floats, key: Ints) -> Ints:
    """Return the rows (n,) of points (n, 3) in the order of their keys (n,), then of x, y, z."""
    # Two sorts, and the few that they leave equal: a third of the time of sorting by four keys.
    order = np.argsort(points[:, 0], kind="stable")
    order = order[np.argsort(key[order], kind="stable")]
    same = (np.diff(key[order]) == 0) & (np.diff(points[order, 0]) == 0.0)
    equal = np.flatnonzero(np.append(same, False) | np.append(False, same))
    rows = order[equal]
    order[equal] = rows[np.lexsort((*points[rows].T[::-1], key[rows]))]
    return order.astype(np.int64, copy=False)


def voxel_means(points: Floats, size_mm: float, least: int = 1) -> Floats:
    """Mean (k, 3) of the points in each occupied voxel that holds at least ``least`` points, in voxel order."""
    points = large_arrays.read_only(np.ascontiguousarray(points, np.float64))
    grid = _grid(points, size_mm)
    if grid.cells > MOST_EMPTY * len(points):  # numbers of the occupied voxels alone: these take a sort
        key = np.empty(len(points), np.int64)
        _number(points, grid.low, size_mm, grid.extent, key)
        key = np.unique(key, return_inverse=True)[1].reshape(-1)
        count = np.bincount(key)
        full = np.flatnonzero(count >= max(least, 1))
        total = np.stack([np.bincount(key, points[:, i])[full] for i in range(3)], axis=1)
        return np.asarray(total / count[full, None], np.float64)
    rank = np.zeros(grid.cells, np.int32)
    for rows in large_arrays.blocks(len(points)):
        _count(points[rows], grid.low, size_mm, grid.extent, rank)
    means = np.zeros((_rank_full(max(least, 1), rank), 3))
    count = np.zeros(len(means), np.int64)
    for rows in large_arrays.blocks(len(points)):
        _add(points[rows], grid.low, size_mm, grid.extent, rank, means, count)
    means /= count[:, None]
    return means


class _Grid(NamedTuple):
    """Corner (3,) of the first cell, cells along each axis (3,), and their number."""

    low: Floats
    extent: Ints
    cells: int


def _grid(points: Floats, size_mm: float) -> _Grid:
    low, high = large_arrays.corners(points)
    extent = np.floor((high - low) / size_mm).astype(np.int64) + 1
    return _Grid(low, extent, math.prod(extent.tolist()))


@njit(cache=True, nogil=True, inline="always")
def _cell_of(points, row, low, size, extent):  # type: ignore[no-untyped-def]
    """Return the number of the cell that a point lies in, in the order of x, y, z."""
    i, j = int((points[row, 0] - low[0]) / size), int((points[row, 1] - low[1]) / size)
    return (i * extent[1] + j) * extent[2] + int((points[row, 2] - low[2]) / size)


@njit(cache=True, nogil=True)
def _number(points, low, size, extent, key):  # type: ignore[no-untyped-def]
    for row in range(len(points)):
        key[row] = _cell_of(points, row, low, size, extent)


@njit(cache=True, nogil=True)
def _into_cells(points, low, size, extent, starts, order):  # type: ignore[no-untyped-def]
    """Write the rows (n,) of points by cells, in order within each; cell c begins at ``starts[c]`` (cells + 1,)."""
    for row in range(len(points)):
        starts[_cell_of(points, row, low, size, extent) + 1] += 1
    for cell in range(1, len(starts)):
        starts[cell] += starts[cell - 1]
    for row in range(len(points)):
        cell = _cell_of(points, row, low, size, extent)
        order[starts[cell]] = row
        starts[cell] += 1
    for cell in range(len(starts) - 1, 0, -1):
        starts[cell] = starts[cell - 1]
    starts[0] = 0


@njit(cache=True, nogil=True)
def _sort_cells(points, starts, order):  # type: ignore[no-untyped-def]
    """Sort the rows of each cell of at most FEW points by x, y, z and row; return how many points the others hold."""
    large = 0
    for cell in range(len(starts) - 1):
        first, last = starts[cell], starts[cell + 1]
        if last - first > FEW:
            large += last - first
            continue
        sort_rows(points, order, first, last)
    return large


@njit(cache=True, nogil=True)
def _count(points, low, size, extent, count):  # type: ignore[no-untyped-def]
    """Add the number of the points in each voxel to ``count`` (cells,)."""
    for row in range(len(points)):
        count[_cell_of(points, row, low, size, extent)] += 1


@njit(cache=True, nogil=True)
def _rank_full(least, rank):  # type: ignore[no-untyped-def]
    """Replace the count of each voxel (cells,) by its rank among those of ``least`` points, or -1; return how many."""
    full = 0
    for cell in range(len(rank)):
        if rank[cell] >= least:
            rank[cell] = full
            full += 1
        else:
            rank[cell] = -1
    return full


@njit(cache=True, nogil=True)
def _add(points, low, size, extent, rank, sums, count):  # type: ignore[no-untyped-def]
    """Add points to the sums (k, 3) and counts (k,) of the voxels that have a rank (cells,)."""
    for row in range(len(points)):
        at = rank[_cell_of(points, row, low, size, extent)]
        if at >= 0:
            count[at] += 1
            for i in range(3):
                sums[at, i] += points[row, i]
