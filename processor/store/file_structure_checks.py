"""Checks of an HDF5 file's structure before any data are read.

HDF5 follows external links, virtual datasets and raw data in other files silently, so a file can show the content of
another file of the disk; and a file of a few bytes can declare any size. An accepted file has only hard links to groups
and to datasets of numbers or text of fixed length, stored in the file itself in at least the bytes they need.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import h5py

from processor.jobs import address_space

GZIP_LIMIT = 1032  # deflate's largest possible expansion
CHUNK_LIMIT = 64 * 2**20
SMALL_DATASET_BYTES = 1 << 16  # cannot fill the memory; may expand by more than GZIP_LIMIT
FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
LINKS = {h5py.h5l.TYPE_SOFT: "SoftLink", h5py.h5l.TYPE_EXTERNAL: "ExternalLink"}
MEMORY_BYTES = 1 << 30  # for a file's structure


def limited_memory() -> AbstractContextManager[None]:
    """Limit this process to ``MEMORY_BYTES`` beyond its present size: HDF5 allocates what a damaged file declares."""
    return address_space.limited(MEMORY_BYTES)


def problems(file: Any, path: Path, visit: Callable[[str, Any], None]) -> list[str]:
    """List all faults of an open file; only its structure is read.

    ``visit`` is called with the path of every dataset and the dataset, a low-level one, until the first fault.
    """
    faults: list[str] = []
    seen: set[int] = {h5py.h5o.get_info(file.id).addr}
    stored = _group(file.id, "", faults, seen, visit)
    if stored > path.stat().st_size:
        faults.append(f"its datasets have {stored} bytes in a file of {path.stat().st_size}")
    return faults


def _group(group: Any, place: str, faults: list[str], seen: set[int], visit: Callable[[str, Any], None]) -> int:
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
            stored += _group(h5py.h5g.open(group, name), where, faults, seen, visit)
        elif info.type == h5py.h5o.TYPE_DATASET:
            item = h5py.h5d.open(group, name)
            faults += [f"{where}: {fault}" for fault in _dataset(item)]
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


def _dataset(dataset: Any) -> list[str]:
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
    return []
