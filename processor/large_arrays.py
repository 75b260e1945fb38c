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
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


class NoRoomError(OSError):
    """The disk has no room for arrays."""


BLOCK_ROWS = 1 << 18
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
    _maps.add(memory)
    return memory


def release() -> None:
    """Give back the pages of all arrays in files; what was written stays in the files."""
    global _touched
    _touched = 0
    for memory in list(_maps):
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


def extremes(array: Array) -> tuple[float, float]:
    """Return the least and the greatest number of an array (n, ...), n > 0; NaN where one is NaN."""
    parts = [(array[rows].min(), array[rows].max()) for rows in blocks(len(array))]
    return float(np.min([low for low, _ in parts])), float(np.max([high for _, high in parts]))


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
