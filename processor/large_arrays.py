"""Arrays of points that need not fit in memory: they lie in files that are mapped, and are passed over block by block.

Within :func:`in_files`, what exceeds a number of bytes is allocated in files without a name, which vanish with the
arrays whatever ends the process. A pass over :func:`blocks` gives the pages of each block back, so that the resident
memory stays small; elsewhere these functions are those of numpy. In the process of ``readers.sandbox`` arrays lie in
memory, or in a file, that it shares.
"""

from __future__ import annotations

import errno
import math
import mmap
import os
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


class NoRoomError(OSError):
    """The disk has no room for arrays."""


BLOCK_ROWS = 1 << 18  # of three float64: 6 MB, which a processor's cache holds in part; work, not result
AT_ONCE = 1 << 20  # rows that are sorted in memory: more are sorted part by part, with the same result
SUMMED = 128  # numbers that numpy adds in a loop
PIVOTS = 255  # numbers of a sample, between which all are counted in one pass: work, not result
MEMORY_BYTES = 1 << 26  # of arrays in memory, about 2 million points
LEAST_BYTES = 1 << 16  # of an array in a file
TOUCHED_BYTES = 1 << 25  # written one after the other before their pages are given back


@dataclass
class _Files:
    """Where arrays are allocated once ``memory`` bytes are in use."""

    folder: Path
    memory: int
    used: int = 0


_files: _Files | None = None
_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
_maps_lock = threading.Lock()  # a set that another thread adds to cannot be passed over
_touched = 0


@contextmanager
def in_files(folder: Path) -> Iterator[None]:
    """Allocate arrays beyond ``MEMORY_BYTES`` in files of ``folder``, as long as the context lasts."""
    global _files
    before, _files = _files, _Files(folder, MEMORY_BYTES)
    try:
        yield
    finally:
        _files = before


def folder_for(size: int) -> Path | None:
    """Return the folder in whose files arrays of ``size`` bytes are to lie; None: they lie in memory, and count."""
    if _files is None:
        return None
    if _files.used + size > _files.memory:
        return _files.folder
    _files.used += size
    return None


def _new(shape: tuple[int, ...], dtype: type) -> Array:
    size = np.dtype(dtype).itemsize * math.prod(shape)
    folder = folder_for(size) if size >= LEAST_BYTES else None
    return np.empty(shape, dtype) if folder is None else _in_file(folder, shape, dtype)


def _in_file(folder: Path, shape: tuple[int, ...], dtype: type) -> Array:
    size = np.dtype(dtype).itemsize * math.prod(shape)
    descriptor = new_file(folder)
    try:
        reserve(descriptor, size, folder)
        return np.frombuffer(mapped(descriptor, size), dtype).reshape(shape)
    finally:
        os.close(descriptor)


_new_array: Callable[[tuple[int, ...], type], Array] = _new


def allocate(*shape: int, dtype: type = np.float64) -> Array:
    """Return an array to be filled; in memory, pages that are never written take none."""
    return _new_array(shape, dtype)


def allocate_with(new_array: Callable[[tuple[int, ...], type], Array] | None) -> None:
    """Replace the function that allocates the arrays of ``allocate``; None restores it."""
    global _new_array
    _new_array = new_array or _new


def new_file(folder: Path) -> int:
    """Return the descriptor of a new file without a name. Raises OSError where none can be made."""
    with tempfile.TemporaryFile(dir=folder, prefix=".points-") as file:
        return os.dup(file.fileno())


def reserve(descriptor: int, size: int, folder: Path) -> None:
    """Reserve the blocks of a file of ``size`` bytes: a mapped page without one would end the process.

    Raises OSError where the disk is too small.
    """
    try:
        os.posix_fallocate(descriptor, 0, size)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT):
            raise
        message = f"the disk of {folder} has no room for its points, {size / 1e9:.2g} GB; free it"
        raise NoRoomError(error.errno, message) from error


def mapped(descriptor: int, size: int, offset: int = 0) -> mmap.mmap:
    """Map a part of a file; its pages are given back by :func:`release`."""
    memory = mmap.mmap(descriptor, size, offset=offset)
    with _maps_lock:
        _maps.add(memory)
    return memory


def release() -> None:
    """Give back the pages of all arrays in files; what was written stays in the files."""
    global _touched
    _touched = 0
    with _maps_lock:
        maps = list(_maps)
    for memory in maps:
        memory.madvise(mmap.MADV_DONTNEED)


def release_after(size: int) -> None:
    """Give the pages back once some were touched, ``size`` bytes more than before."""
    global _touched
    _touched += size
    if _touched > TOUCHED_BYTES:
        release()


# --- passes that read and write block by block ------------------------------------------------------------------------


def blocks(count: int, rows: int = 0) -> Iterator[slice]:
    """Yield slices of ``rows`` rows, up to ``count``, and give pages back after each."""
    rows = rows or BLOCK_ROWS
    for start in range(0, count, rows):
        yield slice(start, min(start + rows, count))
        release()


def contiguous(array: npt.ArrayLike, dtype: type) -> Array:
    """Return an array as a contiguous one of a type: itself where it is one."""
    given = np.asarray(array)
    if given.dtype == dtype and given.flags.c_contiguous:
        return given
    copy = allocate(*given.shape, dtype=dtype)
    for rows in blocks(len(given)):
        copy[rows] = given[rows]
    return copy


def read_only(array: Array) -> Array:
    """Return a view that cannot be written: a kernel that takes no other arrays is compiled once."""
    view: Array = array.view()
    view.flags.writeable = False
    return view


def extremes(array: Array) -> tuple[float, float]:
    """Return the least and the greatest number of an array (n, ...), n > 0; NaN where one is NaN."""
    parts = [(array[rows].min(), array[rows].max()) for rows in blocks(len(array))]
    return float(np.min([low for low, _ in parts])), float(np.max([high for _, high in parts]))


def corners(points: Array) -> tuple[Array, Array]:
    """Return the least and the greatest number of each column (m,) of an array (n, m), n > 0.

    Column by column: numpy takes eight times as long along the rows of an array where these are short.
    """
    parts = [[(column.min(), column.max()) for column in points[rows].T] for rows in blocks(len(points))]
    return np.min(parts, axis=0)[:, 0], np.max(parts, axis=0)[:, 1]


def span(points: Array) -> Array:
    """Return the extent (m,) of an array (n, m), n > 0, along each axis."""
    low, high = corners(points)
    return high - low


def centroid(points: Array) -> Array:
    """Return the mean (m,) of the rows of an array (n, m), n > 0, to the bit of np.mean: rows are added one by one."""
    sums = np.zeros(points.shape[1:])
    for rows in blocks(len(points)):
        sums = np.add.reduce(np.concatenate([sums[None], points[rows]]), axis=0)
    return sums / len(points)


def total(array: Array, of: Callable[[Array], Array] = np.asarray) -> float:
    """Return the sum of ``of(array)`` (n,), where ``of`` computes a number of each row alone, to the bit of np.sum.

    numpy halves what is more than SUMMED numbers, at a multiple of eight, and adds the sums of the halves.
    """
    if len(array) <= max(BLOCK_ROWS, SUMMED):
        release()
        return float(np.sum(of(array)))
    half = len(array) // 2 // 8 * 8
    return total(array[:half], of) + total(array[half:], of)


def median(array: Array) -> float:
    """Return the median of an array (n,), n > 0, of finite numbers."""
    if len(array) <= AT_ONCE:
        return float(np.median(array))
    return 0.5 * (_of_rank(array, (len(array) - 1) // 2) + _of_rank(array, len(array) // 2))


def quantile(array: Array, share: float) -> float:
    """Return a quantile of an array (n,), n > 0, of finite numbers, to the bit of np.quantile."""
    if len(array) <= AT_ONCE:
        return float(np.quantile(array, share))
    rank = share * (len(array) - 1)
    below = int(rank)
    part, low, high = rank - below, _of_rank(array, below), _of_rank(array, min(below + 1, len(array) - 1))
    return low + (high - low) * part if part < 0.5 else high - (high - low) * (1.0 - part)


def _of_rank(array: Array, rank: int) -> float:
    """Return the number of a rank, from 0, by counting the numbers between some of those that may be it."""
    (low, high), below = extremes(array), 0
    while low < high:
        # Copies: a view would keep the part that it is of.
        samples = [part[:: max(1, len(part) // 8)].copy() for part in _between(array, low, high)]
        sample = np.sort(np.concatenate(samples))
        pivots = np.unique(sample[:: max(1, len(sample) // PIVOTS)])
        count = np.zeros(2 * len(pivots) + 1, np.int64)  # of numbers less than the first, equal to it, between two, ...
        for part in _between(array, low, high):
            place = np.searchsorted(pivots, part) + np.searchsorted(pivots, part, "right")
            count += np.bincount(place, minlength=len(count))
        before = below + np.cumsum(count) - count
        found = int(np.searchsorted(before, rank, "right")) - 1
        if found % 2:
            return float(pivots[found // 2])
        below = int(before[found])
        low = np.nextafter(pivots[found // 2 - 1], np.inf) if found else low
        high = np.nextafter(pivots[found // 2], -np.inf) if found < 2 * len(pivots) else high
    return low


def _between(array: Array, low: float, high: float) -> Iterator[Array]:
    for rows in blocks(len(array)):
        yield array[rows][(array[rows] >= low) & (array[rows] <= high)]


def first_of(array: Array, value: float) -> int:
    """Return the first row of an array (n,) that has a value, which one has."""
    found = (rows.start + np.flatnonzero(array[rows] == value) for rows in blocks(len(array)))
    return int(next(rows[0] for rows in found if len(rows)))


def every(array: Array, step: int) -> Array:
    """Return a copy of every k-th row."""
    parts = [array[-(-rows.start // step) * step : rows.stop : step].copy() for rows in blocks(len(array))]
    return np.concatenate(parts) if parts else array[:0].copy()


def taken(array: Array, rows: npt.NDArray[np.int64]) -> Array:
    """Return the rows of an array (n, ...) in the order given."""
    order = np.argsort(rows, kind="stable")
    found = np.empty((len(rows), *array.shape[1:]), array.dtype)
    for part in blocks(len(array)):
        start, stop = np.searchsorted(rows, (part.start, part.stop), sorter=order)
        found[order[start:stop]] = array[rows[order[start:stop]]]
    return found


def put_aside(array: Array) -> Array:
    """Return an array, or a copy of it in a file where arrays of its size are allocated there."""
    folder = folder_for(array.nbytes) if array.nbytes >= LEAST_BYTES else None
    if folder is None:
        return array
    aside = _in_file(folder, array.shape, array.dtype.type)
    aside[:] = array
    return aside


def chosen(array: Array, kept: npt.NDArray[np.bool_]) -> Array:
    """Return the rows of an array (n, ...) that are marked."""
    found, count = allocate(int(np.count_nonzero(kept)), *array.shape[1:], dtype=array.dtype.type), 0
    for rows in blocks(len(array)):
        part = array[rows][kept[rows]]
        found[count : count + len(part)] = part
        count += len(part)
    return found


# --- rows sorted through files ----------------------------------------------------------------------------------------


def in_parts(
    passed: Iterable[tuple[Array, ...]],
    part_of: Callable[[tuple[Array, ...]], npt.NDArray[np.int64]],
    ends: npt.NDArray[np.int64],
) -> list[Array]:
    """Return columns (n, ...), which are ``passed`` block by block, sorted by the part of each row, in order within it.

    ``part_of`` is called for each block and returns the part (m,) of its rows; part k ends before row ``ends[k]``.
    """
    found: list[Array] = []
    place = ends - np.diff(ends, prepend=0)
    for block in passed:
        found = found or [allocate(int(ends[-1]), *one.shape[1:], dtype=one.dtype.type) for one in block]
        part = part_of(block)
        order, count = np.argsort(part, kind="stable"), np.bincount(part, minlength=len(place))
        rows = np.repeat(place - (np.cumsum(count) - count), count) + np.arange(len(part))
        for column, one in zip(found, block, strict=True):
            column[rows] = one[order]
        place = place + count
    return found


def parts_of(ends: npt.NDArray[np.int64]) -> Iterator[slice]:
    """Yield the rows of each part of :func:`in_parts` that has any, and give pages back after each."""
    for start, end in pairwise([0, *ends.tolist()]):
        if start < end:
            yield slice(start, end)
            release()


def put_back(values: Array, rows: npt.NDArray[np.int64]) -> Array:
    """Return the array (n, ...) whose ``rows`` (n,), each of which is there once, are ``values`` (n, ...)."""
    if len(rows) <= AT_ONCE:
        found = allocate(*values.shape, dtype=values.dtype.type)
        found[rows] = values
        return found
    ends = np.array([part.stop for part in blocks(len(rows), AT_ONCE)])
    passed = ((values[part], rows[part]) for part in blocks(len(rows)))
    found, row = in_parts(passed, lambda block: block[1] // AT_ONCE, ends)
    for part in blocks(len(rows), AT_ONCE):
        own = found[part].copy()
        found[part][row[part] - part.start] = own
    return found
