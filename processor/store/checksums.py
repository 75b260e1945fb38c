"""Checksums of HDF5 files: what is read is what was written, or an error names the dataset.

Every dataset carries the SHA-256 of its path, type, shape and bytes, as they are before compression, in an attribute.
The root group carries that of its other attributes and of the paths and checksums of all datasets, so none can be
missing; it is a hash of the whole content. Datasets in chunks have the Fletcher-32 of HDF5 as well, for parts of them
that are read alone.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from processor import large_arrays

ATTRIBUTE = "sha256"
NAME = ATTRIBUTE.encode()
PART_ITEMS = 1 << 20  # read at once: 8 MB; work, not result
BLOCK = 1 << 20  # bytes
# Columns found whole by this process. Steps read a column several times; later passes rely on the chunks' checksums.
_WHOLE: set[tuple[object, ...]] = set()
DAMAGED = "is damaged: its checksum is not that of what was written; make or copy the file again"


class ChecksumError(ValueError):
    """A dataset holds something else than was written; the message names it."""


def of_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, read block by block."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(BLOCK):
            digest.update(block)
    return digest.hexdigest()


def begin(path: str, dataset: Any) -> Any:
    """Return the SHA-256 of a dataset's path, type and shape, to be continued with its bytes."""
    return hashlib.sha256(f"{path}:{dataset.dtype.str}{tuple(dataset.shape)};".encode())


def seal(dataset: Any, path: str, array: np.typing.NDArray[Any], parts: Iterable[np.typing.NDArray[Any]]) -> str:
    """Give a low-level dataset the checksum of an array, whose parts are written to it; returns the checksum."""
    digest = begin(path, array)
    for part in parts:
        digest.update(np.ascontiguousarray(part).data if part.size else b"")
    return _write(dataset, digest)


def seal_root(file: Any, known: Mapping[str, str]) -> None:
    """Give the root group the checksum of all that was written: datasets by their paths, with their checksums."""
    _write(file.id, _of_all(file, known))


def _write(item: Any, digest: Any) -> str:
    text: str = digest.hexdigest()
    stored, in_memory, scalar = _of_text()
    attribute = h5py.h5a.create(item, NAME, stored, scalar)
    attribute.write(np.array(text.encode(), "S64"), in_memory)
    attribute.close()
    return text


@cache
def _of_text() -> tuple[Any, Any, Any]:
    """Return the types of a checksum in a file and in memory, and its extent."""
    dtype = h5py.string_dtype("ascii", 64)
    return h5py.h5t.py_create(dtype, logical=True), h5py.h5t.py_create(dtype), h5py.h5s.create(h5py.h5s.SCALAR)


def _of_all(file: Any, known: Mapping[str, str]) -> Any:
    """Return the SHA-256 of the root attributes and of the checksums of all datasets by their paths."""
    digest = hashlib.sha256()
    for name in sorted(file.attrs):
        if name != ATTRIBUTE:
            value = np.asarray(file.attrs[name], file.attrs.get_id(name).dtype)
            digest.update(f"{name}:{value.dtype.str}{value.shape};".encode() + value.tobytes())
    for path in sorted(known):
        digest.update(f"{path}={known[path]};".encode())
    return digest


def stored(item: Any) -> str | None:
    """Return the checksum that a dataset or group, one of h5py's low-level interface, carries; None without one."""
    if not h5py.h5a.exists(item, NAME):
        return None
    attribute = h5py.h5a.open(item, NAME)
    kind = attribute.get_type()  # made a NumPy type by h5py, it takes longer than all the rest
    fixed = isinstance(kind, h5py.h5t.TypeStringID) and not kind.is_variable_str()
    if not fixed or attribute.get_space().get_simple_extent_type() != h5py.h5s.SCALAR:
        return None
    value = np.empty((), f"S{kind.get_size()}")
    attribute.read(value, kind)
    return bytes(value[()]).decode("ascii", "replace")


def has_any(file: Any) -> bool:
    """Whether the root group has a checksum."""
    return ATTRIBUTE in file.attrs


def datasets(group: Any) -> Iterator[tuple[str, Any]]:
    """Yield paths and datasets of a group and of those below it."""
    for name in group:
        item = group[name]
        if isinstance(item, h5py.Group):
            yield from datasets(item)
        else:
            yield item.name, item


def root_problems(file: Any, known: Mapping[str, str | None]) -> list[str]:
    """List what the root group's checksum and those ``known`` of all datasets contradict; no data are read."""
    missing = [f"{path}: has no checksum, as every dataset of this version has" for path in known if not known[path]]
    if not has_any(file):
        missing.append("/: has no checksum, as every file of this version has")
    if missing or stored(file.id) == _of_all(file, {path: text or "" for path, text in known.items()}).hexdigest():
        return missing
    return [
        "/: is damaged: its attributes, or the names of what it holds, are not those written; make or copy it again"
    ]


def problems(file: Any) -> list[str]:
    """List the datasets that hold something else than was written; all data are read, a part at a time."""
    faults = []
    for _, dataset in datasets(file):
        try:
            column = Column(dataset, again=True)
            rows = max(1, PART_ITEMS // max(1, math.prod(column.shape[1:])))
            for start in range(0, len(column) if column.shape and dataset.chunks else 0, rows):
                column[start : start + rows]
        except ChecksumError as error:
            faults.append(str(error))
    return faults


def whole(dataset: Any) -> np.typing.NDArray[Any]:
    """Read a dataset as an array of its type, without a check."""
    array = np.empty(dataset.shape, dataset.dtype)
    if array.size:
        with _damage(dataset):
            dataset.id.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
    return array


@contextmanager
def _damage(dataset: Any) -> Iterator[None]:
    """Raise ChecksumError for data that HDF5 finds damaged."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise ChecksumError(f"{dataset.name}: is damaged ({error}); make or copy the file again") from error


def read(dataset: Any) -> np.typing.NDArray[Any]:
    """Read a dataset, with a check where it has a checksum; one in chunks part by part. Raises ChecksumError."""
    known, digest = stored(dataset.id), begin(dataset.name, dataset)
    if dataset.chunks is None:
        array = whole(dataset)
        digest.update(array.data if array.size else b"")
    else:
        array = large_arrays.allocate(*dataset.shape, dtype=dataset.dtype)
        rows = max(1, PART_ITEMS // max(1, math.prod(dataset.shape[1:])))
        for part in large_arrays.blocks(len(array), rows):
            with _damage(dataset):
                dataset.read_direct(array, part, part)
            digest.update(array[part].data)
    if known is not None and digest.hexdigest() != known:
        raise ChecksumError(f"{dataset.name}: {DAMAGED}")
    return array


class Column:
    """A dataset to be read in slices of rows.

    Slices from the first row to the last, one after the other, are checked as a whole when the last one is read; others
    by the checksums of their chunks. This is done once a process, with ``again`` also for a column found whole before.
    A dataset in one piece is read and checked at once. Raises ChecksumError.
    """

    def __init__(self, dataset: Any, again: bool = False) -> None:
        self.dataset = dataset
        self.shape: tuple[int, ...] = dataset.shape
        self.dtype = dataset.dtype
        self.ndim: int = dataset.ndim
        self._known, self._place = stored(dataset.id), (object(),) if again else _place(dataset)
        self._digest: Any = None
        self._next = 0
        self._all = None if dataset.chunks else read(dataset)

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.shape[0]

    def __getitem__(self, rows: Any) -> np.typing.NDArray[Any]:
        """Read a slice of rows, or all by ``[()]``."""
        data: np.typing.NDArray[Any]
        if self._all is not None or not isinstance(rows, slice):
            data = (read(self.dataset) if self._all is None else self._all)[rows]
            return data
        with _damage(self.dataset):
            data = self.dataset[rows]
        if self._known is not None and self._place not in _WHOLE and rows.step in (None, 1):
            self._continue(rows.indices(len(self))[0], data)
        return data

    def _continue(self, start: int, data: np.typing.NDArray[Any]) -> None:
        if start == 0:
            self._digest, self._next = begin(self.dataset.name, self.dataset), 0
        if self._digest is None or start != self._next:
            return
        self._digest.update(np.ascontiguousarray(data).data if data.size else b"")
        self._next += len(data)
        if self._next < len(self):
            return
        if self._digest.hexdigest() != self._known:
            raise ChecksumError(f"{self.dataset.name}: {DAMAGED}")
        _WHOLE.add(self._place)


def _place(dataset: Any) -> tuple[object, ...]:
    """Return what names a dataset of a file as the file is now."""
    try:
        status = os.stat(dataset.file.filename)
    except OSError:
        return (object(),)
    return (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, dataset.name)
