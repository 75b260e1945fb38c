"""Checks of an HDF5 file's structure before any data are read.

HDF5 follows external links, virtual datasets and raw data in other files silently, so a file can show the content of
another file of the disk; and a file of a few bytes can declare any size. An accepted file has only hard links to groups
and to datasets of numbers or text of fixed length, stored in the file itself in at least the bytes they need.

HDF5 crashes on some damaged files while it looks for all this. :func:`of_file` therefore looks at a file in a child
process, which serves all files of this process; only a file that this process has written is looked at here.
"""

from __future__ import annotations

import contextlib
import math
import os
import resource
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

import processor.store.checksums as checksums
from processor.jobs import address_space
from processor.jobs.child import Loss, Lost
from processor.jobs.process import in_process

GZIP_LIMIT = 1032  # deflate's largest possible expansion
CHUNK_LIMIT = 8 * 2**20  # the store's own have at most 1.5 MB; one may expand to GZIP_LIMIT times its stored size
SMALL_DATASET_BYTES = 1 << 16  # cannot fill the memory; may expand by more than GZIP_LIMIT
FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
LINKS = {h5py.h5l.TYPE_SOFT: "SoftLink", h5py.h5l.TYPE_EXTERNAL: "ExternalLink"}
MEMORY_BYTES = 1 << 30  # for a file's structure
LEAST_S, BYTES_PER_S = 6.0, 1_000_000  # a tenth of this is used by files of a hundred thousand datasets
ADVICE = "the file is damaged: copy or make it again"

State = tuple[int, ...]  # of a file: device, number, bytes, time of the last change
_WRITTEN: set[State] = set()  # by this process


@dataclass(frozen=True)
class Structure:
    """What was found of a file's structure: checksums of its datasets by their paths, faults, and its state then.

    ``error`` is what HDF5 says of a file that it cannot open.
    """

    state: State = ()
    known: Mapping[str, str | None] | None = None
    faults: tuple[str, ...] = ()
    error: str = ""


def state_of(status: os.stat_result) -> State:
    """Return what changes when a file is written or replaced."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def remember(path: Path) -> None:
    """Take note that this process has written a file."""
    _WRITTEN.add(state_of(path.stat()))


def of_file(path: Path) -> Structure:
    """Look at a file's structure in another process, or in this one where it has written the file.

    A crash of the library and what takes too much time are faults.
    """
    status = path.stat()
    if state_of(status) in _WRITTEN:
        return look(os.fspath(path))
    limit_s = LEAST_S + status.st_size / BYTES_PER_S
    deadline = time.monotonic() + limit_s
    structure = in_process(look_quietly, os.path.abspath(path), lambda: time.monotonic() > deadline)
    if not isinstance(structure, Lost):
        return structure
    if structure.loss is Loss.DIED:
        fault = f"the library that reads it (HDF5) crashed; {ADVICE}"
    elif structure.loss is Loss.STOPPED:
        fault = f"its structure took more than {limit_s:.0f} s, far more than a file of its size needs; {ADVICE}"
    else:
        fault = f"cannot be read ({structure.error})"
    return Structure(state_of(status), faults=(fault,))


def look(path: str) -> Structure:
    """Look at a file's structure in this process."""
    known: dict[str, str | None] = {}
    with limited_memory():
        try:
            file = h5py.File(path, "r", locking=False)
        except (OSError, RuntimeError, ValueError, MemoryError) as error:
            return Structure(error=(str(error).splitlines() or [type(error).__name__])[0])
        with file:
            state = state_of(os.fstat(file.id.get_vfd_handle()))
            try:
                faults = problems(
                    file, Path(path), lambda place, dataset: known.update({place: checksums.stored(dataset)})
                )
            except (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, MemoryError) as error:
                return Structure(state, error=(str(error).splitlines() or [type(error).__name__])[0])
    return Structure(state, known, tuple(faults))


def look_quietly(path: str) -> Structure:
    """Look at a file's structure in this process, in which a crash leaves neither a message nor a core file."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with _silent_errors():
        return look(path)


@contextmanager
def _silent_errors() -> Iterator[None]:
    kept = os.dup(2)
    with contextlib.ExitStack() as stack:
        stack.callback(os.close, kept)
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 2)
        os.close(nothing)
        stack.callback(os.dup2, kept, 2)
        yield


def limited_memory() -> AbstractContextManager[None]:
    """Limit this process to ``MEMORY_BYTES`` beyond its present size: HDF5 allocates what a damaged file declares."""
    return address_space.limited(MEMORY_BYTES)


def problems(file: Any, path: Path, visit: Callable[[str, Any], None]) -> list[str]:
    """List all faults of an open file; only its structure is read.

    ``visit`` is called with the path of every dataset and the dataset, a low-level one, until the first fault.
    """
    faults: list[str] = []
    seen: set[int] = {h5py.h5o.get_info(file.id).addr}
    size = path.stat().st_size
    stored = _group(file.id, "", faults, seen, visit, size)
    if stored > size:
        faults.append(f"its datasets have {stored} bytes in a file of {size}")
    return faults


def _group(
    group: Any, place: str, faults: list[str], seen: set[int], visit: Callable[[str, Any], None], file_bytes: int
) -> int:
    """Append the faults of a group at a place and of all below it; returns the bytes stored by its datasets.

    Groups and datasets are the low-level ones of h5py: a scene has hundreds, and is opened several times in a run.
    """
    stored, links = 0, group.links
    _attributes(group, place or "/", faults)
    for name in group:
        where = f"{place}/{name.decode('utf-8', 'surrogateescape')}"
        link = links.get_info(name).type
        if link != h5py.h5l.TYPE_HARD:
            kind = LINKS.get(link, f"link of type {link}")
            faults.append(f"{where}: a link to another place ({kind}) is not accepted")
            continue
        info = h5py.h5o.get_info(group, name)
        if info.addr in seen:
            faults.append(f"{where}: is linked a second time")
            continue
        seen.add(info.addr)
        # Opened by its kind: an object of any kind takes twice as long.
        if info.type == h5py.h5o.TYPE_GROUP:
            stored += _group(h5py.h5g.open(group, name), where, faults, seen, visit, file_bytes)
        elif info.type == h5py.h5o.TYPE_DATASET:
            item = h5py.h5d.open(group, name)
            faults += [f"{where}: {fault}" for fault in _dataset(item, file_bytes)]
            stored += item.get_storage_size()
            _attributes(item, where, faults)
            if not faults:
                visit(where, item)
        else:
            faults.append(f"{where}: neither a group nor a dataset")
    return stored


def _attributes(item: Any, where: str, faults: list[str]) -> None:
    for number in range(h5py.h5a.get_num_attrs(item)):
        attribute = h5py.h5a.open(item, index=number)
        kind = attribute.get_type()
        if isinstance(kind, h5py.h5t.TypeStringID) and not kind.is_variable_str():
            continue
        if not _plain(attribute.dtype):
            name = attribute.name.decode("utf-8", "surrogateescape")
            faults.append(f"{where}@{name}: type {attribute.dtype} is not accepted")


def _plain(dtype: Any) -> bool:
    return dtype.kind in "iuf" or (dtype.kind == "S" and h5py.check_string_dtype(dtype).length is not None)


def _dataset(dataset: Any, file_bytes: int) -> list[str]:
    plist, dtype, shape = dataset.get_create_plist(), dataset.dtype, dataset.shape
    layout = plist.get_layout()
    if layout == h5py.h5d.VIRTUAL:
        return ["a virtual dataset is not accepted"]
    if plist.get_external_count():
        return ["data in another file is not accepted"]
    if not _plain(dtype):
        return [f"type {dtype} is not accepted"]
    filters = {plist.get_filter(i)[0] for i in range(plist.get_nfilters())}
    if filters - FILTERS:
        return [f"filter {min(filters - FILTERS)} is not accepted (gzip, shuffle and fletcher32 are)"]
    if shape is None:
        return ["has no extent"]
    size = dtype.itemsize * math.prod(int(length) for length in shape)
    room = dataset.get_storage_size() * (GZIP_LIMIT if h5py.h5z.FILTER_DEFLATE in filters else 1)
    if size > room and not (filters and size <= SMALL_DATASET_BYTES and room):
        return [f"declares {size} bytes but stores {dataset.get_storage_size()}"]
    if layout != h5py.h5d.CHUNKED:
        return []
    chunks = plist.get_chunk()
    chunk = dtype.itemsize * math.prod(int(length) for length in chunks)
    if chunk > CHUNK_LIMIT:
        return [f"chunks of {chunk} bytes are not accepted (at most {CHUNK_LIMIT})"]
    expected = math.prod(-(-int(n) // int(c)) for n, c in zip(shape, chunks, strict=True))
    if dataset.get_num_chunks() != expected:
        # HDF5 reads a chunk that was never written as zeros.
        return [f"holds {dataset.get_num_chunks()} of its {expected} chunks"]
    return _chunks(dataset, chunk, file_bytes)


def _chunks(dataset: Any, size: int, file_bytes: int) -> list[str]:
    """List a chunk, of ``size`` bytes when it is expanded, whose place or stored size cannot be that of one."""
    faults: list[str] = []

    def look_at(chunk: Any) -> bool | None:
        # Deflate adds 5 bytes to each 16 kB that it cannot compress, and its frame; Fletcher-32 adds 4 bytes.
        if not 0 < chunk.size <= size + size // 1_000 + 64 or chunk.byte_offset + chunk.size > file_bytes:
            faults.append(
                f"expected a chunk of at most {size} bytes in the file of {file_bytes}, "
                f"found {chunk.size} at {chunk.byte_offset}"
            )
        return True if faults else None

    dataset.chunk_iter(look_at)
    return faults
