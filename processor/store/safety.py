"""What an HDF5 file from outside must not contain, found from its structure before any data is read.

HDF5 follows external links, virtual datasets and raw data in other files without a word, so a file can show the
content of another one of the disk; and a file of a few bytes can declare any size. A file that passes here holds only
hard links to groups and to datasets of numbers or fixed text, stored in the file, in at least the bytes they need.
"""

from __future__ import annotations

import math
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

GZIP_LIMIT = 1032  # deflate's largest possible expansion
CHUNK_LIMIT = 64 * 2**20
ROOM = 1 << 16  # bytes of a size that need no proof
FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE}


MEMORY_BYTES = 1 << 30  # for a file's structure


@contextmanager
def limited_memory() -> Iterator[None]:
    """Let this process take no more than ``MEMORY_BYTES`` beyond what it has: a damaged size may ask for any."""
    pages = Path("/proc/self/statm")
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    if not pages.exists():
        yield
        return
    wanted = int(pages.read_text().split()[0]) * resource.getpagesize() + MEMORY_BYTES
    low = soft != resource.RLIM_INFINITY and soft < wanted
    try:
        if not low:
            resource.setrlimit(resource.RLIMIT_AS, (wanted, hard))
        yield
    finally:
        if not low:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def problems(file: Any, path: Path) -> list[str]:
    """List all that is refused in an open file; nothing is read but its structure."""
    found: list[str] = []
    seen: set[int] = {h5py.h5o.get_info(file.id).addr}
    stored = _group(file, found, seen)
    if stored > path.stat().st_size:
        found.append(f"its datasets claim {stored} bytes of a file of {path.stat().st_size}")
    return found


def _group(group: Any, found: list[str], seen: set[int]) -> int:
    stored = 0
    _attributes(group, found)
    for name in group:
        where = f"{group.name.rstrip('/')}/{name}"
        link = group.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            found.append(f"{where}: a link to another place ({type(link).__name__}) is not accepted")
            continue
        item = group[name]
        address = h5py.h5o.get_info(item.id).addr
        if address in seen:
            found.append(f"{where}: is linked a second time")
            continue
        seen.add(address)
        if isinstance(item, h5py.Group):
            stored += _group(item, found, seen)
        elif isinstance(item, h5py.Dataset):
            found += [f"{where}: {what}" for what in _dataset(item)]
            stored += item.id.get_storage_size()
            _attributes(item, found)
        else:
            found.append(f"{where}: neither a group nor a dataset")
    return stored


def _attributes(item: Any, found: list[str]) -> None:
    for name in item.attrs:
        attribute = item.attrs.get_id(name)
        if not _plain(attribute.dtype):
            found.append(f"{item.name}@{name}: type {attribute.dtype} is not accepted")


def _plain(dtype: Any) -> bool:
    return dtype.kind in "iuf" or (dtype.kind == "S" and h5py.check_string_dtype(dtype).length is not None)


def _dataset(dataset: Any) -> list[str]:
    plist = dataset.id.get_create_plist()
    if plist.get_layout() == h5py.h5d.VIRTUAL:
        return ["a virtual dataset is not accepted"]
    if plist.get_external_count():
        return ["data in another file is not accepted"]
    if not _plain(dataset.dtype):
        return [f"type {dataset.dtype} is not accepted"]
    filters = {plist.get_filter(i)[0] for i in range(plist.get_nfilters())}
    if filters - FILTERS:
        return [f"filter {min(filters - FILTERS)} is not accepted (gzip and shuffle are)"]
    if dataset.shape is None:
        return ["has no extent"]
    size = dataset.dtype.itemsize * math.prod(int(length) for length in dataset.shape)
    room = dataset.id.get_storage_size() * (GZIP_LIMIT if filters else 1)
    if size > room and not (filters and size <= ROOM and room):
        return [f"declares {size} bytes but stores {dataset.id.get_storage_size()}"]
    if not dataset.chunks:
        return []
    chunk = dataset.dtype.itemsize * math.prod(int(length) for length in dataset.chunks)
    if chunk > CHUNK_LIMIT:
        return [f"chunks of {chunk} bytes are not accepted (at most {CHUNK_LIMIT})"]
    expected = math.prod(-(-int(n) // int(c)) for n, c in zip(dataset.shape, dataset.chunks, strict=True))
    if dataset.id.get_num_chunks() != expected:
        # HDF5 would read what was never written as zeros.
        return [f"holds {dataset.id.get_num_chunks()} of its {expected} chunks"]
    return []
