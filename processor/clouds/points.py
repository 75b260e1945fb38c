"""The points of a scene, read in slices: from memory, from a scene file, or from the files they were put aside in."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from processor import large_arrays
from processor.model import Scan, Scene, per_point_fields
from processor.writers.cloud import BLOCK

NAMES = per_point_fields(Scan)
TYPES = {field.name: np.dtype(field.metadata["dtype"]) for field in dataclasses.fields(Scan) if field.name in NAMES}


class Column(Protocol):
    """One value or row a point, read in slices."""

    def __len__(self) -> int:
        """Return the number of points."""

    def __getitem__(self, rows: slice, /) -> Any:
        """Return the values of some points."""


class Points(Protocol):
    """The per-point columns of the scans of a scene, by the number of the scan and the name of the field."""

    def column(self, scan: int, name: str) -> Column:
        """Return a column; an absent one is empty."""


@dataclass(frozen=True)
class InMemory:
    """Points of a scene that holds them."""

    scene: Scene

    def column(self, scan: int, name: str) -> Column:
        """Return a column; an absent one is empty."""
        column: Column = getattr(self.scene.scans[scan], name)
        return column


@dataclass(frozen=True)
class FileColumn:
    """A column in a file of its own."""

    path: Path
    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    def __len__(self) -> int:
        """Return the number of points."""
        return self.shape[0]

    def __getitem__(self, rows: slice) -> Any:
        """Read the values of some points."""
        start, stop, _ = rows.indices(len(self))
        width = int(np.prod(self.shape[1:], dtype=np.int64))
        size = max(stop - start, 0) * width
        if not size:
            return np.empty((0, *self.shape[1:]), self.dtype)
        values = np.fromfile(self.path, self.dtype, size, offset=start * width * self.dtype.itemsize)
        return values.reshape(-1, *self.shape[1:])


@dataclass(frozen=True)
class Spool:
    """Points that were put aside in files below ``folder``, scan by scan."""

    folder: Path
    columns: list[dict[str, FileColumn]] = field(default_factory=list)

    def keep(self, scan: Scan) -> Scan:
        """Put the points of the next scan aside, and return the scan without them."""
        number = len(self.columns)
        columns: dict[str, FileColumn] = {}
        none: dict[str, Any] = {}
        for name in NAMES:
            values = getattr(scan, name)
            path = self.folder / f"{number}-{name}"
            if values.size:
                values.tofile(path)
            columns[name] = FileColumn(path, values.dtype, values.shape)
            none[name] = np.empty((0, *values.shape[1:]), values.dtype)  # no view, which would keep the memory
        self.columns.append(columns)
        return dataclasses.replace(scan, **none)

    def column(self, scan: int, name: str) -> Column:
        """Return a column; an absent one is empty."""
        return self.columns[scan][name]

    def pieces(self, scan: int, name: str) -> tuple[tuple[int, ...], Iterator[Any]]:
        """Return the shape of a column and an iterator over it; see :func:`processor.store.store.scene_hash`."""
        column = self.columns[scan][name]
        return column.shape, (column[start : start + BLOCK] for start in range(0, len(column), BLOCK))


def blocks(points: Points, scan: int) -> Iterator[dict[str, Any]]:
    """Yield the columns of a scan that there are, block by block, by the names of the fields."""
    columns = {name: points.column(scan, name) for name in NAMES}
    present = {name: column for name, column in columns.items() if len(column)}
    for start in range(0, len(columns["points"]), BLOCK):
        yield {name: column[start : start + BLOCK] for name, column in present.items()}
        large_arrays.release()
