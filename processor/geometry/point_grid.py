"""A cloud sorted into the cells of a sparse grid: the neighbours of a place lie in few contiguous runs of rows.

Cells form blocks of 4 x 4 x 4, found by a hash table; within a block, cells along z are one run of rows. Rows are
sorted by block, cell and coordinates, so that results computed from them do not depend on the order of the points.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from processor import large_arrays
from processor.geometry.selection import sort_rows
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner
from processor.large_arrays import allocate, blocks
from processor.model import Floats, Ints

SIDE = 4  # cells along a block's edge
FIELD = 19  # bits of a block's number for each axis
EMPTY = -1  # row of a block without points
FREE = np.iinfo(np.int64).min  # key of a free slot of a hash table: no key is as low
HALF_DIAGONAL = 0.5 * SIDE * 3.0**0.5 * (1.0 + 1e-9)  # of a block, in cells
RUNS = 64  # runs of rows that there is room for at first
LOOKED_UP = 64  # blocks of a box, up to which each is looked for in the table
ROOM_SHARE = 8  # cells of the table per point at most: the cells of a finer grid are made larger


class Cells(NamedTuple):
    """Arguments of kernels: points (n, 3) in the grid's order, and the table of its blocks.

    Cell c of block b, c = 16 i + 4 j + k, holds the rows ``starts[b, c]`` to ``starts[b, c + 1]``.
    """

    points: Floats
    slots: Ints  # (slots,) keys of blocks by their hash, FREE = none
    blocks: Ints  # (slots,) row of ``starts``
    keys: Ints  # (b,) of the blocks, ascending
    starts: Ints  # (b, 65)
    lower: Floats  # (3,)
    size: float  # of a cell
    extent: Ints  # (3,) blocks along each axis


@dataclass(frozen=True)
class PointGrid:
    """The cells, and the row (n,) of each of their points in the original cloud."""

    cells: Cells
    order: Ints

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.order)

    def beside(self, places: Floats) -> Ints:
        """Sort places (m, 3): rows (m,) in the grid's order, so that successive searches use the same memory.

        Places outside the grid are sorted as if at its border; places that are not finite come first.
        """
        cells = self.cells
        known = np.where(np.isfinite(places), places, cells.lower)
        inside = np.clip((known - cells.lower) / cells.size, 0.0, SIDE * cells.extent - 1.0)
        return np.argsort(_keys(inside.astype(np.int64)), kind="stable").astype(np.int64)


class _Part(NamedTuple):
    """Points (n, 3) in the grid's order and their rows (n,), the keys (b,) of their blocks and where cells start."""

    points: Floats
    order: Ints
    keys: Ints
    starts: Ints  # (b, 65)


def of_points(points: Floats, cell: float) -> PointGrid:
    """Sort points (n, 3), all finite, into cells of the edge ``cell``, or larger where the table would be too large.

    More than AT_ONCE points are sorted through files, if there are any, part by part (:mod:`processor.large_arrays`).
    """
    if len(points) == 0:
        none = np.zeros((0, SIDE**3 + 1), np.int64)
        slots, rows = empty_table(0)
        cells = Cells(
            points=np.zeros((0, 3)), slots=slots, blocks=rows, keys=np.empty(0, np.int64), starts=none,
            lower=np.zeros(3), size=1.0, extent=np.ones(3, np.int64),
        )  # fmt: skip
        return PointGrid(cells, np.empty(0, np.int64))
    lower, upper = large_arrays.corners(points)
    extent = float((upper - lower).max())
    size = max(float(cell), extent / (SIDE * (1 << FIELD) - 2 * SIDE), 1e-300)
    while (whole := _sorted(points, lower, size, (ROOM_SHARE * len(points)) // SIDE**3 + 1)) is None:
        size *= 2.0
    slots, rows = hash_table(whole.keys, large=len(points) > large_arrays.AT_ONCE)
    reach = ((upper - lower) / size).astype(np.int64) // SIDE + 1
    cells = Cells(
        points=whole.points, slots=slots, blocks=rows, keys=whole.keys, starts=whole.starts, lower=lower, size=size,
        extent=reach,
    )  # fmt: skip
    return PointGrid(cells, whole.order)


def _sorted(points: Floats, lower: Floats, size: float, most: int) -> _Part | None:
    """Sort points (n, 3) into cells; None if they fill more than ``most`` blocks.

    More than AT_ONCE points are put apart by the keys of their blocks first, and sorted part by part.
    """
    if len(points) <= large_arrays.AT_ONCE:
        return _part(points, np.arange(len(points)), lower, size, most)

    def key_of(places: Floats) -> Ints:
        return _keys(((places - lower) / size).astype(np.int64)) >> 6

    count = -(-2 * len(points) // large_arrays.AT_ONCE)
    sample = np.sort(key_of(large_arrays.every(points, -(-len(points) // large_arrays.AT_ONCE))))
    bounds = np.unique(sample[np.arange(1, count) * len(sample) // count])

    def part_of(block: tuple[Floats, ...]) -> Ints:
        return np.searchsorted(bounds, key_of(block[0]), side="right").astype(np.int64)

    filled = np.zeros(len(bounds) + 1, np.int64)
    for rows in blocks(len(points)):
        filled += np.bincount(part_of((points[rows],)), minlength=len(filled))
    passed = ((points[rows], np.arange(rows.start, rows.stop)) for rows in blocks(len(points)))
    ends = np.cumsum(filled)
    placed, order = large_arrays.in_parts(passed, part_of, ends)
    keys, starts = list[Ints](), list[Ints]()
    for own in large_arrays.parts_of(ends):
        if (part := _part(placed[own], order[own], lower, size, most)) is None:
            return None
        placed[own], order[own] = part.points, part.order
        keys.append(part.keys)
        starts.append(large_arrays.put_aside(part.starts + own.start))
        most -= len(part.keys)
    return _Part(placed, order, np.concatenate(keys), _stacked(starts))


def _part(points: Floats, order: Ints, lower: Floats, size: float, most: int) -> _Part | None:
    """Sort points (n, 3), rows ``order`` (n,) of a cloud, by blocks and in cells; None beyond ``most`` blocks."""
    points, order = (large_arrays.read_only(np.ascontiguousarray(one)) for one in (points, order))
    block, cell = np.empty(len(points), np.int32), np.empty(len(points), np.uint8)
    most = min(most, len(points))
    found = _into_blocks(points, lower, size, most, empty_table(most), block, cell)
    if found is None:
        return None
    keys, count = found
    by_key = np.argsort(keys)
    first = np.zeros(len(keys) + 1, np.int64)
    np.cumsum(count[by_key], out=first[1:])
    place = np.empty(len(keys), np.int64)
    place[by_key] = first[:-1]
    rows = np.empty(len(points), np.int32)
    _place(block, place, rows)
    part = _Part(
        points=np.empty((len(points), 3)), order=np.empty(len(points), np.int64), keys=keys[by_key],
        starts=np.empty((len(keys), SIDE**3 + 1), np.int64),
    )  # fmt: skip
    over_ranges(lambda a, b: _into_cells(points, order, rows, cell, first, part, a, b), len(keys), least=64)
    return part


def _stacked(parts: Sequence[Ints]) -> Ints:
    """Stack arrays (b, m) of parts."""
    found, at = allocate(sum(map(len, parts)), *parts[0].shape[1:], dtype=np.int64), 0
    for part in parts:
        found[at : at + len(part)] = part
        at += len(part)
        large_arrays.release()
    return found


def count_within(grid: PointGrid, low: Floats, high: Floats) -> int:
    """Return the number of points of the blocks that a box from ``low`` (3,) to ``high`` (3,) meets."""
    starts = grid.cells.starts[_blocks_within(grid.cells, low, high)]
    return int((starts[:, -1] - starts[:, 0]).sum())


def within(grid: PointGrid, low: Floats, high: Floats) -> PointGrid:
    """Return the blocks that a box from ``low`` (3,) to ``high`` (3,) meets, with the same cells.

    Searches that do not leave the box find the same points in the same order as in the whole grid.
    """
    cells, kept = grid.cells, _blocks_within(grid.cells, low, high)
    starts = cells.starts[kept]
    rows, begin = _rows_of(starts)
    slots, numbers = hash_table(cells.keys[kept])
    table = cells._replace(
        points=cells.points[rows], slots=slots, blocks=numbers, keys=cells.keys[kept],
        starts=starts + (begin - starts[:, 0])[:, None],
    )  # fmt: skip
    return PointGrid(table, grid.order[rows])


def rows_within(cells: Cells, low: Floats, high: Floats) -> Iterator[Ints]:
    """Yield the rows, in the grid's order, of the points of the blocks that a box from ``low`` to ``high`` meets.

    Rows of whole blocks come together, about BLOCK_ROWS at a time.
    """
    starts = cells.starts[_blocks_within(cells, low, high)]
    number = np.cumsum(starts[:, -1] - starts[:, 0]) // large_arrays.BLOCK_ROWS
    for part in large_arrays.parts_of(np.flatnonzero(np.diff(number, append=-1)) + 1):
        yield _rows_of(starts[part])[0]


def _rows_of(starts: Ints) -> tuple[Ints, Ints]:
    """Return the rows (n,) of blocks by the starts (b, 65) of their cells, and where each block's rows begin (b,)."""
    count = starts[:, -1] - starts[:, 0]
    begin = np.cumsum(count) - count
    rows = np.repeat(starts[:, 0] - begin, count)
    rows += np.arange(len(rows))
    return rows, begin


def _blocks_within(cells: Cells, low: Floats, high: Floats) -> Ints:
    """Return the rows of the blocks that a box meets: along x and y they are searched for, along z compared."""
    edge = SIDE * cells.size
    # A block more on each side, for the rounding.
    first, last = (np.floor((corner - cells.lower) / edge) for corner in (low, high))
    first = np.clip(first - 1.0, 0.0, cells.extent).astype(np.int64)
    last = np.clip(last + 1.0, -1.0, cells.extent - 1.0).astype(np.int64)
    along = np.arange(first[0], last[0] + 1)
    begin = np.searchsorted(cells.keys, ((along << FIELD) + first[1]) << FIELD)
    end = np.searchsorted(cells.keys, ((along << FIELD) + last[1] + 1) << FIELD)
    count = np.maximum(end - begin, 0)
    rows = np.repeat(begin - (np.cumsum(count) - count), count) + np.arange(int(count.sum()))
    level = cells.keys[rows] & ((1 << FIELD) - 1)
    found: Ints = rows[(level >= first[2]) & (level <= last[2])]
    return found


def hash_table(block_keys: Ints, large: bool = False) -> tuple[Ints, Ints]:
    """Return a hash table of keys (b,) that differ: keys (slots,), FREE = none, and the row (slots,) of each."""
    keys, rows = empty_table(len(block_keys), large)
    _fill(keys, rows, np.ascontiguousarray(block_keys))
    return keys, rows


def empty_table(count: int, large: bool = False) -> tuple[Ints, Ints]:
    """Return an empty hash table for ``count`` keys: a power of two of slots, twice as many as keys or more."""
    slots = 1 << max(4, (2 * count).bit_length())
    keys, rows = (allocate(slots, dtype=np.int64) if large else np.empty(slots, np.int64) for _ in range(2))
    keys[:], rows[:] = FREE, EMPTY
    return keys, rows


def _keys(cell: Ints) -> Ints:
    """Return a number for each cell (n, 3): that of its block, then that within the block."""
    block = (cell[:, 0] // SIDE << FIELD | cell[:, 1] // SIDE) << FIELD | cell[:, 2] // SIDE
    inner = (cell & (SIDE - 1)) @ np.array([16, 4, 1])
    key: Ints = block << 6 | inner
    return key


@njit(cache=True, nogil=True, inline="always")
def slot_of(keys, key):  # type: ignore[no-untyped-def]
    """Find where a key is in a hash table of a power of two of slots, or the free slot where it would be.

    Multiplicative hashing by the golden ratio: consecutive keys would fill the table in runs otherwise.
    """
    mask = np.uint64(len(keys) - 1)
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    at = (h ^ (h >> np.uint64(32))) & mask
    while keys[at] != FREE and keys[at] != key:
        at = (at + np.uint64(1)) & mask
    return at


@njit(cache=True, nogil=True, inline="always")
def block_at(cells, i, j, k):  # type: ignore[no-untyped-def]
    """Find the row of a block by its indices along the axes; EMPTY where it holds no point."""
    return cells.blocks[slot_of(cells.slots, ((i << FIELD) | j) << FIELD | k)]


@njit(cache=True, nogil=True, inline="always")
def cells_within(cells, x, y, z, ex, ey, ez):  # type: ignore[no-untyped-def]
    """Find the first and last cell along each axis of the box about (x, y, z) with half edges ex, ey, ez.

    Of a box below the grid the last cell along z is -1, so that a loop over the cells is empty.
    """
    size, xl, yl, zl = cells.size, cells.lower[0], cells.lower[1], cells.lower[2]
    i0, i1 = int(max((x - ex - xl) / size, 0.0)), int(min((x + ex - xl) / size, SIDE * cells.extent[0] - 1.0))
    j0, j1 = int(max((y - ey - yl) / size, 0.0)), int(min((y + ey - yl) / size, SIDE * cells.extent[1] - 1.0))
    k0, k1 = int(max((z - ez - zl) / size, 0.0)), int(min((z + ez - zl) / size, SIDE * cells.extent[2] - 1.0))
    if x + ex < xl or y + ey < yl or z + ez < zl:
        k1 = -1
    return i0, i1, j0, j1, k0, k1


@inner
def runs_near(cells, x, y, z, a, b, c, half, radius, runs):  # type: ignore[no-untyped-def]
    """Find the runs of rows whose cells come within ``radius`` of a segment, and their number.

    The segment reaches ``half`` to either side of (x, y, z) along the unit vector (a, b, c). The runs (first row, row
    after the last), ascending, are written to ``runs`` (r, 2), or to a larger array: that which is returned.
    """
    box = cells_within(cells, x, y, z, half * abs(a) + radius, half * abs(b) + radius, half * abs(c) + radius)
    i0, i1, j0, j1 = box[0] // SIDE, box[1] // SIDE, box[2] // SIDE, box[3] // SIDE
    k0, k1 = box[4] // SIDE, box[5] // SIDE
    corner, segment = (cells.lower[0] - x, cells.lower[1] - y, cells.lower[2] - z), (a, b, c, half)
    if (i1 - i0 + 1) * (j1 - j0 + 1) * (k1 - k0 + 1) > LOOKED_UP:
        return _runs_of_many(cells, box, corner, segment, radius, runs)
    found, edge, reach = 0, SIDE * cells.size, radius + HALF_DIAGONAL * cells.size
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                if _square_from(segment, corner, edge, i + 0.5, j + 0.5, k + 0.5) <= reach * reach:
                    block = block_at(cells, i, j, k)
                    if block >= 0:
                        runs, found = _add_runs(cells, block, (i, j, k), box, corner, segment, radius, runs, found)
    return runs, found


@inner
def _runs_of_many(cells, box, corner, segment, radius, runs):  # type: ignore[no-untyped-def]
    """Find the runs of a large box of cells, of which most blocks are empty: the others are passed in their order."""
    keys, mask = cells.keys, (1 << FIELD) - 1
    i0, i1, j0, j1 = box[0] // SIDE, box[1] // SIDE, box[2] // SIDE, box[3] // SIDE
    k0, k1 = box[4] // SIDE, box[5] // SIDE
    found, edge, reach = 0, SIDE * cells.size, radius + HALF_DIAGONAL * cells.size
    block = _at_or_after(keys, 0, (i0 << FIELD | j0) << FIELD | k0)
    while block < len(keys) and k0 <= k1:
        i, j, k = keys[block] >> (2 * FIELD), keys[block] >> FIELD & mask, keys[block] & mask
        if i > i1:
            break
        if j < j0 or (j <= j1 and k < k0):
            block = _at_or_after(keys, block, (i << FIELD | max(j, j0)) << FIELD | k0)
        elif j > j1:
            block = _at_or_after(keys, block, ((i + 1) << FIELD | j0) << FIELD | k0)
        elif k > k1:
            block = _at_or_after(keys, block, (i << FIELD | (j + 1)) << FIELD | k0)
        else:
            if _square_from(segment, corner, edge, i + 0.5, j + 0.5, k + 0.5) <= reach * reach:
                runs, found = _add_runs(cells, block, (i, j, k), box, corner, segment, radius, runs, found)
            block += 1
    return runs, found


@njit(cache=True, nogil=True, inline="always")
def _add_runs(cells, block, place, box, corner, segment, radius, runs, found):  # type: ignore[no-untyped-def]
    """Add the runs of the block at ``place``; the grid's ``corner`` is relative to the segment's middle."""
    size, starts, end = cells.size, cells.starts, -1
    i0, j0, k0 = SIDE * place[0], SIDE * place[1], SIDE * place[2]
    low, high = max(box[4] - k0, 0), min(box[5] - k0, SIDE - 1)
    k, tall = k0 + 0.5 * (low + high + 1), 0.5 * (high - low + 1)
    reach = radius + np.sqrt(0.5 + tall * tall) * (1.0 + 1e-9) * size
    for i in range(max(box[0], i0), min(box[1], i0 + SIDE - 1) + 1):
        for j in range(max(box[2], j0), min(box[3], j0 + SIDE - 1) + 1):
            cell = ((i - i0) * SIDE + (j - j0)) * SIDE
            first, last = starts[block, cell + low], starts[block, cell + high + 1]
            if first == last or _square_from(segment, corner, size, i + 0.5, j + 0.5, k) > reach * reach:
                continue
            if first == end:
                runs[found - 1, 1] = last
            else:
                if found == len(runs):
                    more = np.empty((2 * found, 2), np.int64)
                    more[:found] = runs
                    runs = more
                runs[found, 0], runs[found, 1] = first, last
                found += 1
            end = last
    return runs, found


@njit(cache=True, nogil=True, inline="always")
def _square_from(segment, corner, edge, i, j, k):  # type: ignore[no-untyped-def]
    """Return the square of the distance of a place, (i, j, k) edges from the grid's corner, from a segment."""
    u, v, w = corner[0] + i * edge, corner[1] + j * edge, corner[2] + k * edge
    t = abs(u * segment[0] + v * segment[1] + w * segment[2])
    beyond = max(t - segment[3], 0.0)
    return u * u + v * v + w * w - t * t + beyond * beyond


@njit(cache=True, nogil=True, inline="always")
def _at_or_after(keys, first, key):  # type: ignore[no-untyped-def]
    """Return the first row of ascending keys, from row ``first`` on, that is not less than ``key``."""
    step = 1
    while first + step <= len(keys) and keys[first + step - 1] < key:
        first, step = first + step, 2 * step
    last = min(first + step, len(keys))
    while first < last:
        middle = (first + last) // 2
        if keys[middle] < key:
            first = middle + 1
        else:
            last = middle
    return first


@njit(cache=True, nogil=True)
def _fill(keys, blocks, block_keys):  # type: ignore[no-untyped-def]
    """Enter the rows of blocks with ``block_keys`` (b,) into the hash table."""
    for row in range(len(block_keys)):
        at = slot_of(keys, block_keys[row])
        keys[at], blocks[at] = block_keys[row], row


@njit(cache=True, nogil=True)
def _into_blocks(points, lower, size, most, table, block, cell):  # type: ignore[no-untyped-def]
    """Write the block (n,), numbered as they come, and the cell in it (n,) of each point.

    Return the blocks' keys and numbers of points; None where there are more than ``most``. The ``table`` is empty.
    """
    slots, rows = table
    keys, count = np.empty(most, np.int64), np.zeros(most, np.int64)
    xl, yl, zl = lower[0], lower[1], lower[2]
    found, last, number = 0, EMPTY, 0
    for row in range(len(points)):
        i, j = int((points[row, 0] - xl) / size), int((points[row, 1] - yl) / size)
        k = int((points[row, 2] - zl) / size)
        key = ((i // SIDE << FIELD) | j // SIDE) << FIELD | k // SIDE
        if key != last:  # neighbours in a scan are often in the same block
            slot = slot_of(slots, key)
            if slots[slot] == FREE:
                if found == most:
                    return None
                slots[slot], rows[slot], keys[found] = key, found, key
                found += 1
            last, number = key, rows[slot]
        block[row], cell[row] = number, ((i % SIDE) * SIDE + j % SIDE) * SIDE + k % SIDE
        count[number] += 1
    return keys[:found], count[:found]


@njit(cache=True, nogil=True)
def _place(block, place, rows):  # type: ignore[no-untyped-def]
    """Write the rows (n,) of points by their ``block`` (n,): block b begins at ``place[b]``, which moves to its end."""
    for row in range(len(block)):
        rows[place[block[row]]] = row
        place[block[row]] += 1


@njit(cache=True, nogil=True)
def _into_cells(points, order, rows, cell, first, part, start, stop):  # type: ignore[no-untyped-def]
    """Write the points of blocks ``start`` to ``stop`` - 1 to the part, by cells, in each of them sorted by x, y, z."""
    place = np.empty(SIDE**3 + 1, np.int64)
    for block in range(start, stop):
        place[:] = 0
        for at in range(first[block], first[block + 1]):
            place[cell[rows[at]] + 1] += 1
        place[0] = first[block]
        for c in range(SIDE**3):
            place[c + 1] += place[c]
        part.starts[block] = place
        for at in range(first[block], first[block + 1]):
            row = rows[at]
            part.order[place[cell[row]]] = row
            place[cell[row]] += 1
        for c in range(SIDE**3):
            sort_rows(points, part.order, part.starts[block, c], part.starts[block, c + 1])
        for to in range(first[block], first[block + 1]):
            row = part.order[to]
            part.order[to] = order[row]
            for axis in range(3):
                part.points[to, axis] = points[row, axis]
