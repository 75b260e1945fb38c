"""A cloud cut into slabs across its longest axis, so that neighbours are searched with a part of it in memory."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from processor import tiles
from processor.model import Floats
from processor.writers.cloud import BLOCK, Block, Cloud
from processor.writers.ply import records

MOST = 1_500_000  # points of a slab, unless more lie within one bin across the axis
BINS = 1 << 16  # work: 1 mm on 65 m; a slab is cut at one of them
Records = npt.NDArray[np.void]


@dataclass(frozen=True)
class Slabs:
    """Slabs along ``axis``: slab i has the points from ``edges[i]`` to ``edges[i + 1]`` in the order of the cloud.

    ``held`` are the records of a single slab; several lie in the files ``paths``.
    """

    axis: int
    edges: Floats  # (s + 1,)
    dtype: np.dtype[Any]
    paths: tuple[Path, ...] = ()
    held: Records | None = None

    def __len__(self) -> int:
        """Return the number of slabs."""
        return len(self.edges) - 1

    def read(self, number: int) -> Records:
        """Return the records of a slab; none beyond the first and the last."""
        if not 0 <= number < len(self):
            return np.empty(0, self.dtype)
        return self.held if self.held is not None else np.fromfile(self.paths[number], self.dtype)


def points_of(rows: Records) -> Floats:
    """Return the points (n, 3) of records."""
    return np.stack([rows[axis] for axis in "xyz"], axis=1)


def cut(cloud: Cloud, aside: Path, most: int = MOST) -> Slabs:
    """Cut a cloud into slabs of ``most`` points or less, as far as possible, in files below the folder ``aside``."""
    low, high, count = np.full(3, np.inf), np.full(3, -np.inf), 0
    for block in cloud.blocks():
        if len(block.points):
            low, high = np.minimum(low, block.points.min(axis=0)), np.maximum(high, block.points.max(axis=0))
            count += len(block.points)
    rows = _records(cloud)
    if count <= most:
        first = next(rows, None)
        whole = np.concatenate([first, *rows]) if first is not None else np.empty(0, _dtype(cloud))
        return Slabs(0, np.array([-np.inf, np.inf]), whole.dtype, held=whole)
    axis = int(np.argmax(high - low))
    bins = np.linspace(low[axis], high[axis], BINS + 1)
    filled = np.zeros(BINS, np.int64)
    for block in cloud.blocks():
        filled += np.histogram(block.points[:, axis], bins)[0]
    inner = bins[np.flatnonzero(np.diff(tiles.grouped(filled, most))) + 1]
    edges = np.array([-np.inf, *inner, np.inf])
    folder = Path(tempfile.mkdtemp(dir=aside))
    paths = tuple(folder / str(number) for number in range(len(edges) - 1))
    for some in rows:
        slab = np.searchsorted(edges, some["xyz"[axis]], side="right") - 1
        for number in np.unique(slab):
            with paths[number].open("ab") as file:
                file.write(some[slab == number].data)
    return Slabs(axis, edges, _dtype(cloud), paths)


def _dtype(cloud: Cloud) -> np.dtype[Any]:
    return np.dtype([*((axis, "<f8") for axis in "xyz"), *((name, dtype) for name, dtype in cloud.fields.items())])


def _records(cloud: Cloud) -> Iterator[Records]:
    for block in cloud.blocks():
        columns = dict(zip("xyz", block.points.T, strict=True))
        yield records(columns | {name: np.asarray(block.fields[name], dtype) for name, dtype in cloud.fields.items()})


def in_blocks(rows: Records) -> Iterator[Block]:
    """Yield records as blocks of a cloud."""
    names = [name for name in rows.dtype.names or () if name not in "xyz"]
    for start in range(0, len(rows), BLOCK):
        part = rows[start : start + BLOCK]
        yield Block(points_of(part), {name: np.ascontiguousarray(part[name]) for name in names})
