"""Points in spatial tiles: cubes of equal size, so that the points of a box lie in a few ranges of a file.

Coordinates are stored as int32 multiples of 0.0001 mm, or of 0.001 mm for larger extents, relative to an offset; beyond
the range of int32 as float64 mm. The tiles depend on the set of points and not on their order, so points that were read
back and are arranged again keep their order.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from processor import large_arrays
from processor.model import Floats, Ints

POINTS_PER_TILE = 16_384  # chosen: 200 KB compressed at once; fewer make many tiles, more are read in vain
MOST_LEVELS = 8  # the finest grid has up to 2**MOST_LEVELS cells along the longest side
STEPS_PER_MM = (10_000.0, 1_000.0)  # 0.1 um, far below noise, where the extent allows it in int32 (429 m); else 1 um
INT32_REACH = 2**31 - 16  # with some steps for rounding

Column = npt.NDArray[np.generic]
Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Grid:
    """The grid of the tiles, and the scale of the stored columns: ``(column + offset) / steps_per_mm`` is in mm."""

    steps_per_mm: float  # 1 where the columns are float64 mm
    offset: Floats  # (3,) steps
    lower: Floats  # (3,) corner of the first tile, steps of the stored columns
    edge: float  # of a tile, steps

    def columns(self, points: Floats) -> tuple[Column, Column, Column]:
        """Return the stored columns of points (n, 3) in mm."""
        if self.steps_per_mm == 1.0:
            x, y, z = (np.ascontiguousarray(points[:, i]) for i in range(3))
            return x, y, z
        x, y, z = ((np.rint(points[:, i] * self.steps_per_mm) - self.offset[i]).astype(np.int32) for i in range(3))
        return x, y, z

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
    others: dict[str, Any]  # further columns


def arrange(points: Floats, others: Mapping[str, Array] = types.MappingProxyType({})) -> Tiles:
    """Arrange finite points (n, 3) in mm in tiles of about POINTS_PER_TILE points, stable within a tile.

    ``others`` are further columns (n, ...), arranged alike. Memory holds a block of points at a time, where they lie
    in files (:mod:`processor.large_arrays`).
    """
    if not len(points):
        grid = Grid(STEPS_PER_MM[0], np.zeros(3), np.zeros(3), 1.0)
        none = np.empty(0, np.int32)
        empty = np.empty(0, np.int64)
        cell = np.empty((0, 3), np.int64)
        return Tiles(
            grid, cell=cell, start=empty, count=empty, columns=(none, none, none), order=empty, others=dict(others)
        )
    # Enough levels of the finest grid for points on a line, and two more for gaps
    levels = int(np.clip(np.ceil(np.log2(len(points) / POINTS_PER_TILE)) + 2, 0, MOST_LEVELS))
    grid = _finest(points, _scale(points), levels)
    finest = np.zeros(2 ** (3 * levels), np.int32)
    for rows in large_arrays.blocks(len(points)):
        np.add.at(finest, _numbers(grid.cells(grid.columns(points[rows])), levels), 1)
    level, counts = _level(finest.reshape((2**levels,) * 3), len(points), levels)
    shift = levels - level
    keys = np.flatnonzero(counts)
    count = counts.reshape(-1)[keys].astype(np.int64)
    start = np.cumsum(count) - count
    columns, sorted_others, order = _in_tiles(points, others, grid, (keys, start, level, shift))
    mask = 2**level - 1
    return Tiles(
        grid=replace(grid, edge=grid.edge * 2**shift),
        cell=np.stack([keys >> 2 * level, (keys >> level) & mask, keys & mask], axis=1).astype(np.int64),
        start=start,
        count=count,
        columns=columns,
        order=order,
        others=sorted_others,
    )


def _in_tiles(
    points: Floats, others: Mapping[str, Array], grid: Grid, tiles: tuple[Ints, Ints, int, int]
) -> tuple[tuple[Column, Column, Column], dict[str, Array], Ints]:
    """Return the columns of points and of what else there is of each, and the rows they are from, by their tiles.

    A counting sort, block by block: of each tile (numbers of cells of a level, first rows) the next row is known.
    """
    keys, start, level, shift = tiles
    n, dtype = len(points), np.int32 if grid.steps_per_mm > 1.0 else np.float64
    x, y, z = (large_arrays.allocate(n, dtype=dtype) for _ in range(3))
    order = large_arrays.allocate(n, dtype=np.int64)
    found = {name: large_arrays.allocate(n, *a.shape[1:], dtype=a.dtype.type) for name, a in others.items()}
    rank = np.empty(2 ** (3 * level), np.int32)
    rank[keys] = np.arange(len(keys), dtype=np.int32)
    after = start.copy()
    # numpy sorts 16-bit numbers by radix sort, which is several times faster.
    kind = np.uint16 if len(keys) < 2**16 else np.uint32
    for rows in large_arrays.blocks(n):
        stored = grid.columns(points[rows])
        cells = grid.cells(stored) >> shift
        tile = rank[_numbers(cells, level)].astype(kind)
        sort = np.argsort(tile, kind="stable")
        tile = tile[sort].astype(np.int64)
        first = np.flatnonzero(np.diff(tile, prepend=-1))
        length = np.diff(first, append=len(tile))
        place = after[tile] + (np.arange(len(tile)) - np.repeat(first, length))
        after[tile[first]] += length
        order[place] = rows.start + sort
        for column, values in zip((x, y, z), stored, strict=True):
            column[place] = values[sort]
        for name, column in found.items():
            column[place] = others[name][rows][sort]
            large_arrays.release()
    return (x, y, z), found, order


def _numbers(cells: Ints, level: int) -> Ints:
    """Return one number for each of cells (n, 3) of a level, in lexicographic order."""
    numbers: Ints = (cells[:, 0] << 2 * level) | (cells[:, 1] << level) | cells[:, 2]
    return numbers


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


def misplaced(grid: Grid, cell: Ints, columns: tuple[Column, Column, Column]) -> int:
    """Count the points that lie outside their tile, whose cell (n, 3) the index gives."""
    return int((grid.cells(columns) != cell).any(axis=1).sum())


def _scale(points: Floats) -> Grid:
    """Return one cell that says how points are stored: in whole steps, less an offset, or as float64 mm."""
    corners = [(points[rows].min(axis=0), points[rows].max(axis=0)) for rows in large_arrays.blocks(len(points))]
    low, high = np.min([low for low, _ in corners], axis=0), np.max([high for _, high in corners], axis=0)
    for steps in STEPS_PER_MM:
        first, last = np.rint(low * steps), np.rint(high * steps)
        if (last - first).max() < 2 * INT32_REACH and max(np.abs(first).max(), np.abs(last).max()) < 2.0**52:
            return Grid(steps, np.floor((first + last) / 2.0), np.zeros(3), 1.0)
    return Grid(1.0, np.zeros(3), np.zeros(3), 1.0)


def _finest(points: Floats, scale: Grid, levels: int) -> Grid:
    """Return the finest grid of points."""
    corners = []
    for rows in large_arrays.blocks(len(points)):
        columns = scale.columns(points[rows])
        corners.append([[float(column.min()), float(column.max())] for column in columns])
    lower, upper = np.min(corners, axis=0)[:, 0], np.max(corners, axis=0)[:, 1]
    extent = float((upper - lower).max())
    # A cell size of whole steps makes cell numbers of integers exact. For float64 the size is slightly enlarged, so
    # that the last point lies inside the grid.
    edge = float(np.ceil((extent + 1.0) / 2**levels))
    if scale.steps_per_mm == 1.0:
        edge = (extent or 1.0) / 2.0**levels * (1.0 + 1e-9)
    return replace(scale, lower=lower, edge=edge)


def _level(counts: Array, n: int, levels: int) -> tuple[int, Array]:
    """Return the level whose occupied cells have a number of points nearest to POINTS_PER_TILE on average, and theirs.

    ``counts`` are those of the cells of the finest level.
    """
    best, chosen, least = 0, counts, np.inf
    for level in range(levels, -1, -1):
        distance = abs(np.log(n / np.count_nonzero(counts) / POINTS_PER_TILE))
        if distance < least:
            best, chosen, least = level, counts, distance
        if level:
            side = len(counts) // 2
            counts = counts.reshape(side, 2, side, 2, side, 2).sum(axis=(1, 3, 5), dtype=np.int64)
    return best, chosen
