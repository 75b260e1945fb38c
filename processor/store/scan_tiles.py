"""A scan in an HDF5 group: its points in tiles, and its other per-point columns in the same order."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import h5py
import numpy as np

import processor.store.codec as codec
import processor.store.tiles as tiles
from processor import large_arrays
from processor.model import Floats, Ints, Labels, Scan, per_point_fields
from processor.store.codec import DecodeError

AXES = ("x", "y", "z")
NO_STATIONS = np.empty(0, np.int32)


def write_scan(group: Any, scan: Scan) -> Ints:
    """Write a scan into a group; returns the row (n,) of ``scan.points`` at each position of the file."""
    others = {
        name: getattr(scan, name) for name in per_point_fields(Scan) if name != "points" and getattr(scan, name).size
    }
    tiled = tiles.arrange(scan.points, others)
    codec.write_record(group, dataclasses.replace(scan, **tiled.others), skip={"points"})
    points = group.create_group("points")
    for axis, column in zip(AXES, tiled.columns, strict=True):
        codec.write_array(points, axis, column)
    grid = tiled.grid
    numbers = {"steps_per_mm": grid.steps_per_mm, "offset": grid.offset, "lower": grid.lower, "edge": grid.edge}
    for name, value in numbers.items():
        codec.write_array(points, name, np.asarray(value, np.float64))
    for name, index in (("cell", tiled.cell), ("start", tiled.start), ("count", tiled.count)):
        codec.write_array(points, name, index)
    return tiled.order


def read_scan(group: Any) -> Scan:
    """Read a scan. Raises DecodeError also for points that are not finite or lie outside their tile."""
    stored = read_index(group)
    points = large_arrays.allocate(int(stored.counts.sum()), 3)
    ends, wrong = np.cumsum(stored.counts), 0
    for rows in large_arrays.blocks(len(points)):
        x, y, z = (column[rows] for column in stored.columns)
        if not all(np.isfinite(column).all() for column in (x, y, z)):
            raise DecodeError([f"{group.name}/points: holds coordinates that are not finite"])
        tile = np.searchsorted(ends, np.arange(rows.start, rows.stop), side="right")
        wrong += tiles.misplaced(stored.grid, stored.cell[tile], (x, y, z))
        points[rows] = stored.grid.millimetres((x, y, z))
    if wrong:
        raise DecodeError([f"{group.name}/points: {wrong} points lie outside their tile of the index"])
    scan = codec.read_record(group, Scan, given={"points": points})
    if not np.isfinite(scan.origin).all():
        raise DecodeError([f"{group.name}/origin: is not finite"])
    return scan


def read_scan_alone(group: Any) -> Scan:
    """Read a scan with empty per-point columns."""
    read_index(group)
    none = {
        f.name: np.empty(0, f.metadata["dtype"]) for f in dataclasses.fields(Scan) if f.name in per_point_fields(Scan)
    }
    return codec.read_record(group, Scan, given=none)


def extreme_stations(group: Any, size: int = 1 << 20) -> Labels:
    """Return the least and the greatest station (2,) of the points of a scan's group; (0,) where they have none."""
    parts = [np.array([part.min(), part.max()]) for part in pieces(group, "point_station", size)]
    return np.array([np.min(parts), np.max(parts)], np.int32) if parts else NO_STATIONS


@dataclasses.dataclass(frozen=True)
class PointColumn:
    """The points (n, 3) of a scan's group, mm, to be read in slices. DecodeError for points that are not finite."""

    where: str
    stored: StoredTiles

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of points and of coordinates."""
        return len(self.stored.columns[0]), 3

    def __len__(self) -> int:
        """Return the number of points."""
        return self.shape[0]

    def __getitem__(self, rows: slice) -> Floats:
        """Read points."""
        x, y, z = (column[rows] for column in self.stored.columns)
        points = self.stored.grid.millimetres((x, y, z))
        if not np.isfinite(points).all():
            raise DecodeError([f"{self.where}/points: holds coordinates that are not finite"])
        return points


def column(group: Any, name: str) -> Any:
    """Return a per-point column of a scan's group, to be read in slices; one that is absent is empty."""
    if name == "points":
        return PointColumn(group.name, read_index(group))
    declared = next(field.metadata for field in dataclasses.fields(Scan) if field.name == name)
    shape, dtype = declared["shape"], declared["dtype"]
    if declared.get("newer") and name not in group:  # it came to the schema later, and is stored where it is not empty
        return np.empty((0, *shape[1:]), dtype)
    return codec.column(group, name, dtype, len(shape))


def pieces(group: Any, name: str, size: int) -> Iterator[Any]:
    """Yield a per-point column of a scan's group, ``size`` rows at a time. DecodeError for points not finite."""
    stored = column(group, name)
    for start in range(0, len(stored), size):
        yield stored[start : start + size]


class StoredTiles(NamedTuple):
    """Index (:mod:`processor.store.tiles`) and coordinate datasets x, y, z of a scan's group."""

    grid: tiles.Grid
    cell: Ints
    start: Ints
    counts: Ints
    columns: list[Any]


def read_index(group: Any) -> StoredTiles:
    """Return the index and the coordinates of a scan's group. Raises DecodeError for damage."""
    points = group.get("points")
    where = f"{group.name}/points"
    if not isinstance(points, h5py.Group):
        raise DecodeError([f"{where}: missing"])
    names = (*AXES, "steps_per_mm", "offset", "lower", "edge", "cell", "start", "count")
    if sorted(points) != sorted(names):
        raise DecodeError([f"{where}: expected {', '.join(sorted(names))}, found {', '.join(sorted(points))}"])
    steps, edge = (float(codec.read_array(points, name, np.float64, 0)) for name in ("steps_per_mm", "edge"))
    offset, lower = (codec.read_array(points, name, np.float64, 1) for name in ("offset", "lower"))
    cell = codec.read_array(points, "cell", np.int64, 2)
    start, count = (codec.read_array(points, name, np.int64, 1) for name in ("start", "count"))
    columns = [points[axis] for axis in AXES]
    types = {column.dtype.str for column in columns if isinstance(column, h5py.Dataset) and column.ndim == 1}
    if len(types) != 1 or not types <= {"<i4", "<f8"} or not all(isinstance(c, h5py.Dataset) for c in columns):
        raise DecodeError([f"{where}: expected x, y, z as columns of int32 or of float64"])
    lengths = {len(column) for column in columns}
    if len(lengths) != 1 or offset.shape != (3,) or lower.shape != (3,) or cell.shape[1:] != (3,):
        raise DecodeError([f"{where}: its columns differ in length or shape"])
    columns = [codec.sliced(column) for column in columns]
    grid = tiles.Grid(steps, offset, lower, edge)
    faults = tiles.problems(grid, cell, start, count, lengths.pop())
    if faults:
        raise DecodeError([f"{where}: {fault}" for fault in faults])
    return StoredTiles(grid, cell, start, count, columns)


def some_tiles(group: Any, count: int) -> Floats:
    """Return the points (n, 3) of ``count`` tiles of a scan's group, every k-th of them."""
    grid, _, start, counts, columns = read_index(group)
    parts = [np.empty((0, 3))]
    for tile in range(0, len(start), max(1, len(start) // count)):
        x, y, z = (column[int(start[tile]) : int(start[tile] + counts[tile])] for column in columns)
        parts.append(grid.millimetres((x, y, z)))
    return np.concatenate(parts)


def near_boxes(group: Any, lower: Floats, upper: Floats, size: int) -> Iterator[Floats]:
    """Yield the points (n, 3) of the tiles of a scan's group that boxes touch: corners (k, 3), mm; no other is read.

    These hold all points with ``lower <= p <= upper`` of any box, and others.
    """
    grid, cell, start, counts, columns = read_index(group)
    touched = np.zeros(len(cell), np.bool_)
    for low, high in zip(lower, upper, strict=True):
        first, last = grid.cell_range(low, high)
        touched |= ((cell >= first) & (cell <= last)).all(axis=1)
    rows = np.flatnonzero(touched)
    for run in filter(len, np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)):
        end = int(start[run[-1]] + counts[run[-1]])
        for begin in range(int(start[run[0]]), end, size):
            x, y, z = (column[begin : min(begin + size, end)] for column in columns)
            yield grid.millimetres((x, y, z))
