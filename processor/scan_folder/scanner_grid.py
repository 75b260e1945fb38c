"""Whether the rows and columns that a file gives are a scanner's grid: step ``stitch`` takes rays from them."""

from __future__ import annotations

import numpy as np
from numba import njit

from processor.geometry import scanner_rays
from processor.model import Floats, Labels

SAMPLE = 50_000  # points that the rays are found from; by chance, as every k-th may be of one row
OFF = 0.03  # of the spread of the directions: how far rays may pass their points on average
CELLS, CELLS_PER_POINT = 1 << 24, 32  # of a grid in memory; scans of the open sky have few returns

Grid = tuple[Labels, Labels]
NO_GRID: Grid = (np.empty(0, np.int32), np.empty(0, np.int32))


def of_scanner(points: Floats, row: Labels, column: Labels, scanner: Floats) -> Grid:
    """Return rows and columns (n,) of points (n, 3) seen from ``scanner`` (3,); none where they are not a scanner's.

    A row must keep its height and a column its direction about one axis, and no two points may be in one cell: clouds
    without a grid are written in made-up rows, merged ones with each scan's own, and depth cameras have other grids.
    """
    if not len(row):
        return NO_GRID
    if not _fits(row, column):
        row, column = row - row.min(), column - column.min()  # a piece that was cut out
        if not _fits(row, column):
            return NO_GRID
    rows, columns = int(row.max()) + 1, int(column.max()) + 1
    if _is_swept(points, row, column, scanner) and not _any_twice(row, column, rows, columns):
        return row, column
    return NO_GRID


def _fits(row: Labels, column: Labels) -> bool:
    return (int(row.max()) + 1) * (int(column.max()) + 1) <= CELLS + CELLS_PER_POINT * len(row)


def _is_swept(points: Floats, row: Labels, column: Labels, scanner: Floats) -> bool:
    """Whether the rays that rows and columns stand for lead to the points."""
    count = len(points)
    some = np.arange(count) if count <= SAMPLE else np.random.default_rng(0).integers(0, count, SAMPLE)
    r, c = row[some].astype(np.int64), column[some].astype(np.int64)
    seen = points[some] - scanner
    found = scanner_rays.fitted(seen, r, c)
    if found is None:
        return False
    u = seen / np.maximum(np.linalg.norm(seen, axis=1), 1e-9)[:, None]
    off = np.linalg.norm(found.of(r, c) - u, axis=1).mean()
    return bool(off < OFF * np.linalg.norm(u - u.mean(axis=0), axis=1).mean())


@njit(cache=True, nogil=True)
def _any_twice(row: Labels, column: Labels, rows: int, columns: int) -> bool:
    """Whether two points are in one cell; a bit a cell."""
    seen = np.zeros((rows * columns >> 3) + 1, np.uint8)
    for i in range(len(row)):
        cell = np.int64(column[i]) * rows + row[i]
        bit = np.uint8(1 << (cell & 7))
        if seen[cell >> 3] & bit:
            return True
        seen[cell >> 3] |= bit
    return False
