"""Check that the rows and columns in a file are a scanner's grid: step ``stitch`` derives rays from them."""

from __future__ import annotations

import numpy as np
from numba import njit

from processor import large_arrays
from processor.geometry import scan_grid_directions
from processor.model import Floats, Labels

SAMPLE = 50_000  # points that rays are fitted to; random, as every k-th point may be of the same row
RAY_TOLERANCE = 0.03  # mean difference of rays from directions, relative to the spread of the directions
CELLS, CELLS_PER_POINT = 1 << 24, 32  # largest grid; scans of the open sky have few returns

Grid = tuple[Labels, Labels]
NO_GRID: Grid = (np.empty(0, np.int32), np.empty(0, np.int32))


def of_scanner(points: Floats, row: Labels, column: Labels, scanner: Floats) -> Grid:
    """Return rows and columns (n,) of points (n, 3) seen from ``scanner`` (3,); none if they are not a scanner's.

    Points of a row must have the same elevation and points of a column the same azimuth about one axis, and no two
    points may be in one cell. Clouds without a grid are written in arbitrary rows, merged clouds in those of each scan,
    and depth cameras have other grids.
    """
    if not len(row):
        return NO_GRID
    if not _fits(row, column):
        row, column = _from_least(row), _from_least(column)  # a part of a larger grid
        if not _fits(row, column):
            return NO_GRID
    rows, columns = _lines(row), _lines(column)
    if not _is_swept(points, row, column, scanner):
        return NO_GRID
    seen = np.zeros((rows * columns >> 3) + 1, np.uint8)  # one bit a cell
    if any(_seen_before(row[part], column[part], rows, seen) for part in large_arrays.blocks(len(row))):
        return NO_GRID
    return row, column


def _fits(row: Labels, column: Labels) -> bool:
    return _lines(row) * _lines(column) <= CELLS + CELLS_PER_POINT * len(row)


def _lines(numbers: Labels) -> int:
    return int(large_arrays.extremes(numbers)[1]) + 1


def _from_least(numbers: Labels) -> Labels:
    least, shifted = int(large_arrays.extremes(numbers)[0]), large_arrays.allocate(len(numbers), dtype=np.int32)
    for rows in large_arrays.blocks(len(numbers)):
        shifted[rows] = numbers[rows] - least
    return shifted


def _is_swept(points: Floats, row: Labels, column: Labels, scanner: Floats) -> bool:
    """Whether the rays of rows and columns lead to the points."""
    count = len(points)
    sample = np.arange(count) if count <= SAMPLE else np.random.default_rng(0).integers(0, count, SAMPLE)
    r, c = (large_arrays.taken(numbers, sample).astype(np.int64) for numbers in (row, column))
    local = large_arrays.taken(points, sample) - scanner
    rays = scan_grid_directions.fitted(local, r, c)
    if rays is None:
        return False
    u = local / np.maximum(np.linalg.norm(local, axis=1), 1e-9)[:, None]
    difference = np.linalg.norm(rays.of(r, c) - u, axis=1).mean()
    return bool(difference < RAY_TOLERANCE * np.linalg.norm(u - u.mean(axis=0), axis=1).mean())


@njit(cache=True, nogil=True)
def _seen_before(row, column, rows, seen):  # type: ignore[no-untyped-def]
    """Whether a point is in a cell that has one already, by its bit in ``seen``."""
    for i in range(len(row)):
        cell = np.int64(column[i]) * rows + row[i]
        bit = np.uint8(1 << (cell & 7))
        if seen[cell >> 3] & bit:
            return True
        seen[cell >> 3] |= bit
    return False
