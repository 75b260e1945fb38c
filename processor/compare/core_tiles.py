"""Normals and M3C2 distances at many core points: tiles of core points with the points of the clouds about them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from processor import tiles
from processor.geometry import m3c2, point_grid
from processor.geometry.m3c2 import CloudNormals, Distances
from processor.geometry.point_grid import PointGrid
from processor.model import Floats, Ints
from processor.tiles import Shared

CORE_POINTS = 50_000  # of a tile
ROUNDING = 1.0 + 1e-9


class Lengths(NamedTuple):
    """The cylinder of a core point, and the registration error."""

    projection_diameter_mm: float
    max_depth_mm: float
    registration_error_mm: float


class _Tile(NamedTuple):
    """Core points (m, 3), their normals (m, 3) where these are known, and clouds about them."""

    core: Floats
    normals: Floats
    clouds: tuple[PointGrid, ...]


def normals(reference: PointGrid, core: Floats, diameter_mm: float) -> CloudNormals:
    """Fit normals at core points (k, 3) as :func:`processor.geometry.m3c2.normals` does."""
    rows = _rows(reference, core)
    parts = tiles.mapped(_normals, _tiles(rows, core, core, (reference,), 0.5 * diameter_mm), Shared(diameter_mm))
    found = CloudNormals(np.empty((len(core), 3)), np.empty(len(core)), np.empty(len(core), np.int64))
    for at, part in zip(rows, parts, strict=True):
        found.normals[at], found.roughness[at], found.count[at] = part.normals, part.roughness, part.count
    return found


def _normals(tile: _Tile, diameter_mm: float) -> CloudNormals:
    return m3c2.normals(tile.clouds[0], tile.core, diameter_mm)


def distances(reference: PointGrid, compared: PointGrid, core: Floats, normals: Floats, lengths: Lengths) -> Distances:
    """Measure at core points (k, 3) with unit normals (k, 3) as :func:`processor.geometry.m3c2.distances` does."""
    rows = _rows(reference, core)
    reach = float(np.hypot(0.5 * lengths.projection_diameter_mm, lengths.max_depth_mm))
    parts = tiles.mapped(_distances, _tiles(rows, core, normals, (reference, compared), reach), Shared(lengths))
    columns = [np.empty(len(core)) for _ in range(4)]
    counts = [np.empty(len(core), np.int64) for _ in range(2)]
    for at, part in zip(rows, parts, strict=True):
        columns[0][at], columns[1][at], columns[2][at], columns[3][at] = part.distance, part.lod95, part.std1, part.std2
        counts[0][at], counts[1][at] = part.n1, part.n2
    return Distances(columns[0], columns[1], counts[0], counts[1], std1=columns[2], std2=columns[3])


def _distances(tile: _Tile, lengths: Lengths) -> Distances:
    reference, compared = tile.clouds
    return m3c2.distances(
        reference,
        compared,
        tile.core,
        tile.normals,
        projection_diameter_mm=lengths.projection_diameter_mm,
        max_depth_mm=lengths.max_depth_mm,
        registration_error_mm=lengths.registration_error_mm,
    )


def _rows(reference: PointGrid, core: Floats) -> list[Ints]:
    """Return the rows of the core points of each tile."""
    if len(core) <= CORE_POINTS:
        return [np.arange(len(core))]
    order = reference.beside(core)
    return [order[part] for part in tiles.ranges(len(core), CORE_POINTS)]


def _tiles(
    rows: Sequence[Ints], core: Floats, normals: Floats, clouds: tuple[PointGrid, ...], reach: float
) -> Iterator[_Tile] | list[_Tile]:
    """Cut clouds about the core points of each tile; all of them for a single one."""
    if len(rows) == 1:
        return [_Tile(core, normals, clouds)]
    return (_tile(core[at], normals[at], clouds, reach) for at in rows)


def _tile(core: Floats, normals: Floats, clouds: tuple[PointGrid, ...], reach: float) -> _Tile:
    known = core[np.isfinite(core).all(axis=1)]
    low, high = (known.min(axis=0), known.max(axis=0)) if len(known) else (np.zeros(3), np.zeros(3))
    off = reach * ROUNDING
    return _Tile(core, normals, tuple(point_grid.within(cloud, low - off, high + off) for cloud in clouds))
