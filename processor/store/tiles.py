"""Points in spatial tiles: cubes of equal size, so that the points of a box lie in a few ranges of a file.

Coordinates are stored as int32 multiples of 0.0001 mm, or of 0.001 mm for larger extents, relative to an offset; beyond
the range of int32 as float64 mm. The tiles depend on the set of points and not on their order, so points that were read
back and are arranged again keep their order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.model import Floats, Ints

POINTS_PER_TILE = 16_384
MOST_LEVELS = 8  # the finest grid has up to 2**MOST_LEVELS cells along the longest side
STEPS_PER_MM = (10_000.0, 1_000.0)
INT32_REACH = 2**31 - 16

Column = npt.NDArray[np.generic]


@dataclass(frozen=True)
class Grid:
    """The grid of the tiles, and the scale of the stored columns: ``(column + offset) / steps_per_mm`` is in mm."""

    steps_per_mm: float  # 1 where the columns are float64 mm
    offset: Floats  # (3,) steps
    lower: Floats  # (3,) corner of the first tile, steps of the stored columns
    edge: float  # of a tile, steps

    def cells(self, columns: tuple[Column, Column, Column]) -> Ints:
        """Return the cell numbers (n, 3) of stored columns."""
        return np.stack([np.floor((columns[i] - self.lower[i]) / self.edge) for i in range(3)], axis=1).astype(np.int64)

    def millimetres(self, columns: tuple[Column, Column, Column]) -> Floats:
        """Return points (n, 3) in mm of stored columns."""
        points = np.empty((len(columns[0]), 3))
        for i in range(3):
            # A division gives the float64 nearest to the decimal number; a product with 0.0001 does not.
            np.divide(columns[i] + self.offset[i], self.steps_per_mm, out=points[:, i])
        return points

    def cell_range(self, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
        """Return the first and last cell (3,) that a box in mm touches, with a margin of one step for rounding."""
        low = np.floor((lower * self.steps_per_mm - self.offset - 1.0 - self.lower) / self.edge)
        high = np.floor((upper * self.steps_per_mm - self.offset + 1.0 - self.lower) / self.edge)
        return low, high


@dataclass(frozen=True)
class Tiles:
    """Points arranged in tiles. The points of a tile are rows ``start`` to ``start + count`` of the columns."""

    grid: Grid
    cell: Ints  # (t, 3), in lexicographic order
    start: Ints  # (t,)
    count: Ints  # (t,)
    columns: tuple[Column, Column, Column]
    order: Ints  # (n,) row of the given points at each position


def arrange(points: Floats) -> Tiles:
    """Arrange finite points (n, 3) in mm in tiles of about POINTS_PER_TILE points, stable within a tile."""
    if not len(points):
        grid = Grid(STEPS_PER_MM[0], np.zeros(3), np.zeros(3), 1.0)
        none = np.empty(0, np.int32)
        empty = np.empty(0, np.int64)
        cell = np.empty((0, 3), np.int64)
        return Tiles(grid, cell=cell, start=empty, count=empty, columns=(none, none, none), order=empty)
    columns, steps, offset = _stored(points)
    lower = np.array([float(column.min()) for column in columns])
    extent = max(float(column.max()) - low for column, low in zip(columns, lower, strict=True))
    # A cell size of whole steps makes cell numbers of integers exact. For float64 the size is slightly enlarged, so
    # that the last point lies inside the grid.
    levels = _levels(len(points))
    finest = float(np.ceil((extent + 1.0) / 2**levels))
    if columns[0].dtype != np.int32:
        finest = (extent or 1.0) / 2.0**levels * (1.0 + 1e-9)
    cells = Grid(steps, offset, lower, finest).cells(columns)
    shift = levels - _level(cells, len(points), levels)
    cells >>= shift
    key = (cells[:, 0] << 2 * levels) | (cells[:, 1] << levels) | cells[:, 2]
    del cells
    occupied = np.zeros(2 ** (3 * levels), bool)
    occupied[key] = True
    keys = np.flatnonzero(occupied)
    rank = np.empty(2 ** (3 * levels), np.int32)
    rank[keys] = np.arange(len(keys), dtype=np.int32)
    # numpy sorts 16-bit numbers by radix sort, which is several times faster.
    tile = rank[key].astype(np.uint16 if len(keys) < 2**16 else np.uint32)
    order = np.argsort(tile, kind="stable")
    count = np.bincount(tile, minlength=len(keys)).astype(np.int64)
    mask = 2**levels - 1
    return Tiles(
        grid=Grid(steps, offset, lower, finest * 2**shift),
        cell=np.stack([keys >> 2 * levels, (keys >> levels) & mask, keys & mask], axis=1).astype(np.int64),
        start=np.cumsum(count) - count,
        count=count,
        columns=(columns[0][order], columns[1][order], columns[2][order]),
        order=order.astype(np.int64),
    )


def problems(grid: Grid, cell: Ints, start: Ints, count: Ints, n: int) -> list[str]:
    """List the faults of an index of ``n`` points; without a fault its tiles are contiguous and in order."""
    faults = []
    numbers = np.array([grid.steps_per_mm, grid.edge, *grid.offset, *grid.lower])
    if not np.isfinite(numbers).all() or grid.edge <= 0 or grid.steps_per_mm <= 0:
        faults.append("the grid of the tiles has numbers that are not finite or not above 0")
    if not len(cell) == len(start) == len(count):
        faults.append("the columns of the tile index differ in length")
    elif (count < 1).any() or (count > n).any() or count.sum() != n or (start != np.cumsum(count) - count).any():
        faults.append(f"the tile index does not cover the {n} points")
    return faults


def misplaced(grid: Grid, cell: Ints, count: Ints, columns: tuple[Column, Column, Column]) -> int:
    """Count the points that lie outside their tile of the index."""
    return int((grid.cells(columns) != np.repeat(cell, count, axis=0)).any(axis=1).sum())


def _stored(points: Floats) -> tuple[tuple[Column, Column, Column], float, Floats]:
    low, high = points.min(axis=0), points.max(axis=0)
    for steps in STEPS_PER_MM:
        first, last = np.rint(low * steps), np.rint(high * steps)
        if (last - first).max() < 2 * INT32_REACH and max(np.abs(first).max(), np.abs(last).max()) < 2.0**52:
            offset = np.floor((first + last) / 2.0)
            x, y, z = ((np.rint(points[:, i] * steps) - offset[i]).astype(np.int32) for i in range(3))
            return (x, y, z), steps, offset
    x, y, z = (np.ascontiguousarray(points[:, i]) for i in range(3))
    return (x, y, z), 1.0, np.zeros(3)


def _levels(n: int) -> int:
    """Return the levels of the finest grid for ``n`` points: enough for points on a line, and two more for gaps."""
    return int(np.clip(np.ceil(np.log2(n / POINTS_PER_TILE)) + 2, 0, MOST_LEVELS))


def _level(cells: Ints, n: int, levels: int) -> int:
    """Return the level whose occupied cells have, on average, a number of points nearest to POINTS_PER_TILE."""
    side = 2**levels
    occupied: npt.NDArray[np.bool_] = np.zeros((side, side, side), bool)
    occupied[cells[:, 0], cells[:, 1], cells[:, 2]] = True
    best, least = 0, np.inf
    for level in range(levels, -1, -1):
        distance = abs(np.log(n / np.count_nonzero(occupied) / POINTS_PER_TILE))
        if distance < least:
            best, least = level, distance
        side = max(side // 2, 1)
        if level:
            occupied = np.asarray(occupied.reshape(side, 2, side, 2, side, 2).any(axis=(1, 3, 5)))
    return best
