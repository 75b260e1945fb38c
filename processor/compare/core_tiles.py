"""Normals and M3C2 distances at many core points: tiles of core points with the points of the clouds about them.

Core points are given as a grid, so that those of a tile lie side by side, and results come in the order of the grid.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from processor import large_arrays, tiles
from processor.geometry import m3c2, point_grid
from processor.geometry.m3c2 import CloudNormals, Distances
from processor.geometry.point_grid import PointGrid
from processor.large_arrays import Array, allocate
from processor.model import Bools, Floats, Ints
from processor.tiles import Shared

CORE_POINTS = 50_000  # of a tile
CLOUD_POINTS = 1_000_000  # of a cloud about a tile: of more the tile is halved
ROUNDING = 1.0 + 1e-9  # a box never leaves out a point that rounding puts within reach
EQUALLY_NEAR = 4  # points at one place that are distinguished


class Lengths(NamedTuple):
    """The cylinder of a core point, and the registration error."""

    projection_diameter_mm: float
    max_depth_mm: float
    registration_error_mm: float


class _Tile(NamedTuple):
    """Core points (m, 3), values (m, ...) of them where some are needed, and clouds about them."""

    core: Floats
    values: Array
    clouds: tuple[PointGrid, ...]


def normals(reference: PointGrid, core: PointGrid, diameter_mm: float) -> CloudNormals:
    """Fit normals at core points (k, 3) as :func:`processor.geometry.m3c2.normals` does."""
    rows = _rows(core, (reference,), 0.5 * diameter_mm)
    found = CloudNormals(allocate(core.count, 3), allocate(core.count), allocate(core.count, dtype=np.int64))
    given = _tiles(rows, core, core.cells.points, (reference,), 0.5 * diameter_mm)
    for at, part in zip(rows, tiles.mapped(_normals, given, Shared(diameter_mm)), strict=True):
        found.normals[at], found.roughness[at], found.count[at] = part.normals, part.roughness, part.count
    return found


def _normals(tile: _Tile, diameter_mm: float) -> CloudNormals:
    return m3c2.normals(tile.clouds[0], tile.core, diameter_mm)


def distances(
    reference: PointGrid, compared: PointGrid, core: PointGrid, normals: Floats, lengths: Lengths
) -> Distances:
    """Measure at core points (k, 3) with unit normals (k, 3) as :func:`processor.geometry.m3c2.distances` does."""
    clouds = (reference, compared)
    reach = float(np.hypot(0.5 * lengths.projection_diameter_mm, lengths.max_depth_mm))
    rows = _rows(core, clouds, reach)
    parts = tiles.mapped(_distances, _tiles(rows, core, normals, clouds, reach), Shared(lengths))
    types = {"n1": np.int64, "n2": np.int64}
    found = {name: allocate(core.count, dtype=types.get(name, np.float64)) for name in Distances.__dataclass_fields__}
    for at, part in zip(rows, parts, strict=True):
        for name, column in found.items():
            column[at] = getattr(part, name)
    return Distances(**found)


def _distances(tile: _Tile, lengths: Lengths) -> Distances:
    reference, compared = tile.clouds
    return m3c2.distances(
        reference,
        compared,
        tile.core,
        tile.values,
        projection_diameter_mm=lengths.projection_diameter_mm,
        max_depth_mm=lengths.max_depth_mm,
        registration_error_mm=lengths.registration_error_mm,
    )


def nearest(reference: PointGrid, core: PointGrid, wanted: Bools, reach: float) -> Ints:
    """Return the row (k,) of the point of a cloud that is nearest to each core point (k, 3) that is ``wanted`` (k,).

    It is the first of those at the same distance, and -1 where it is farther than ``reach``, or not wanted.
    """
    rows = _rows(core, (reference,), reach)
    found = allocate(core.count, dtype=np.int64)
    given = _tiles(rows, core, wanted, (reference,), reach)
    for at, part in zip(rows, tiles.mapped(_nearest, given, Shared(reach)), strict=True):
        found[at] = part
    return found


def _nearest(tile: _Tile, reach: float) -> Ints:
    (cloud,), rows = tile.clouds, np.flatnonzero(tile.values)
    found = np.full(len(tile.core), -1)
    if len(rows) and cloud.count:
        k = np.arange(1, min(EQUALLY_NEAR, cloud.count) + 1)
        far, index = cKDTree(cloud.cells.points).query(tile.core[rows], k=k, workers=-1)
        first = np.where(far == far[:, :1], cloud.order[index], np.iinfo(np.int64).max).min(axis=1)
        found[rows] = np.where(far[:, 0] <= reach, first, -1)
    return found


def _rows(core: PointGrid, clouds: Iterable[PointGrid], reach: float) -> list[slice]:
    """Return the rows of the core points of each tile."""
    waiting, found = tiles.ranges(core.count, CORE_POINTS)[::-1], list[slice]()
    while waiting:
        rows = waiting.pop()
        low, high = _box(core.cells.points[rows], reach)
        most = max(point_grid.count_within(cloud, low, high) for cloud in clouds)
        if most > CLOUD_POINTS and rows.stop - rows.start > 1:
            middle = (rows.start + rows.stop) // 2
            waiting += [slice(middle, rows.stop), slice(rows.start, middle)]
        else:
            found.append(rows)
            large_arrays.release()
    return found


def _box(core: Floats, reach: float) -> tuple[Floats, Floats]:
    off = reach * ROUNDING
    return core.min(axis=0) - off, core.max(axis=0) + off


def _tiles(
    rows: Sequence[slice], core: PointGrid, values: Array, clouds: tuple[PointGrid, ...], reach: float
) -> Iterator[_Tile] | list[_Tile]:
    """Cut clouds about the core points of each tile; all of them for a single one."""
    if len(rows) == 1 and all(cloud.count <= CLOUD_POINTS for cloud in clouds):
        return [_Tile(core.cells.points, values, clouds)]
    return _cut(rows, core, values, clouds, reach)


def _cut(
    rows: Sequence[slice], core: PointGrid, values: Array, clouds: tuple[PointGrid, ...], reach: float
) -> Iterator[_Tile]:
    for at in rows:
        places = np.array(core.cells.points[at])
        box = _box(places, reach)
        tile = _Tile(places, np.array(values[at]), tuple(point_grid.within(cloud, *box) for cloud in clouds))
        large_arrays.release()
        yield tile
