"""What the scans say of each cell of the design's surface, station by station."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from processor.defects.surface_charts import DesignSurface, layout
from processor.geometry import mesh_distance, rigid
from processor.model import Floats, InputError, Ints, Scene

CHUNK = 500_000
LEAST_COS = 0.2  # of incidence: what is seen more from its edge is mostly beams that hit two things


@dataclass(frozen=True)
class Stations:
    """Where the points of a scene were seen from, in the design's frame; NaN = unknown."""

    names: tuple[str, ...]
    positions: Floats  # (k, 3)


@dataclass(frozen=True)
class Observed:
    """Points on the design's faces: the chart, place on it, station and deviation (mm, outward) of each."""

    chart: Ints
    uv: Floats  # (n, 2)
    station: Ints
    deviation: Floats
    stations: Stations
    offered: int  # points of the scene


@dataclass(frozen=True)
class Pairs:
    """What a station says of a cell: mean deviation of ``count`` points, and their sum of squares about it.

    Points that do not fit to the others of their cell are left out; ``stray`` counts those.
    """

    cell: Ints
    station: Ints
    count: Ints
    stray: Ints
    mean: Floats
    square: Floats


def observe(scene: Scene, T_design_project: Floats, surface: DesignSurface, reach_mm: float) -> Observed:
    """Put all points of a scene onto the faces of the design that they belong to.

    Raises InputError for a scene without scans.
    """
    if not scene.scans or not any(len(scan.points) for scan in scene.scans):
        raise InputError(f"{scene.name}: expected scans of the structure, found no points")
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, reach_mm)
    names: list[str] = []
    positions: list[Floats] = []
    parts: list[tuple[Ints, Floats, Ints, Floats]] = []
    for scan in scene.scans:
        T = T_design_project @ (scan.T_project_scan if scan.T_project_scan.size else np.eye(4))
        T = rigid.transform(T[:3, :3], T[:3, :3] @ scan.origin + T[:3, 3])
        own = np.full(len(scan.points), len(names), np.int64)
        if scan.position.size:
            names.append(scan.name)
            positions.append(rigid.apply(T, scan.position - scan.origin))
        elif scene.stations is not None and len(scan.point_station):
            own = np.where(scan.point_station < 0, len(scene.stations.ids), scan.point_station) + len(names)
            names += [*scene.stations.ids, f"{scan.name}, unknown"]
            positions += [*rigid.apply(T_design_project, scene.stations.positions), np.full(3, np.nan)]
        else:
            names.append(scan.name)
            positions.append(np.full(3, np.nan))
        known = np.isfinite(np.array(positions).sum(axis=1))
        for start in range(0, len(own), CHUNK):
            rows = slice(start, start + CHUNK)
            points = rigid.apply(T, scan.points[rows])
            station = np.where(known[own[rows]], own[rows], -1)
            facet, deviation = mesh_distance.nearest_visible(grid, points, np.nan_to_num(np.array(positions)), station)
            near = np.flatnonzero(facet >= 0)
            arm = np.nan_to_num(np.array(positions))[own[rows][near]] - points[near]
            cosine = np.einsum("ni,ni->n", arm, surface.normals[facet[near]]) / np.linalg.norm(arm, axis=1)
            on = near[(station[near] < 0) | (cosine > LEAST_COS)]
            chart = surface.chart_of[facet[on]]
            parts.append((chart, layout(surface.charts, chart, points[on]), own[rows][on], deviation[on]))
    chart, uv, own, deviation = (np.concatenate(column) for column in zip(*parts, strict=True))
    offered = sum(len(scan.points) for scan in scene.scans)
    return Observed(chart, uv, own, deviation, Stations(tuple(names), np.array(positions)), offered)


def fitting_cell(seen: Observed, surface: DesignSurface, points: float, bounds: tuple[float, float]) -> float:
    """Return the size of cells in mm that hold so many points on the median of what was seen."""
    _, count = np.unique(cells_of(seen, surface), return_counts=True)
    if not len(count):
        return bounds[1]
    dense = float(np.median(np.repeat(count, count))) / surface.charts.cell_mm**2
    return float(np.clip(np.round(np.sqrt(points / dense), 1), *bounds))


def cells_of(seen: Observed, surface: DesignSurface) -> Ints:
    """Return the row (n,) of the cell that each point is in; those beyond their face's net are in the nearest."""
    charts = surface.charts
    at = np.floor((seen.uv - charts.low[seen.chart]) / charts.cell_mm).astype(np.int64)
    at = np.clip(at, 0, charts.shape[seen.chart] - 1)
    found: Ints = charts.first[seen.chart] + at[:, 0] * charts.shape[seen.chart, 1] + at[:, 1]
    return found


def paired(seen: Observed, surface: DesignSurface) -> Pairs:
    """Sum up the points by cell and station, without those that do not fit to the others of the cell."""
    cell = cells_of(seen, surface)
    stations = len(seen.stations.names)
    order = np.argsort(cell * stations + seen.station, kind="stable")
    columns = pairs(cell[order], seen.station[order], seen.deviation[order])
    return Pairs(*columns)


# --- Compiled: the points of a cell summed up station by station.


GATE = 4.0  # robust standard deviations from the median of a cell
LEAST_GATE_MM = 1.0
FEW = 4  # points, from which on a median says what does not fit


@njit(cache=True, nogil=True)
def pairs(cell: Ints, station: Ints, deviation: Floats) -> tuple[Ints, Ints, Ints, Ints, Floats, Floats]:
    """Columns of :class:`processor.defects.observations.Pairs`, of points sorted by cell and station."""
    n = len(cell)
    total = 0
    for i in range(n):
        if i == 0 or cell[i] != cell[i - 1] or station[i] != station[i - 1]:
            total += 1
    own, by = np.empty(total, np.int64), np.empty(total, np.int64)
    count, stray = np.zeros(total, np.int64), np.zeros(total, np.int64)
    mean, square = np.zeros(total), np.zeros(total)
    at, start = -1, 0
    while start < n:
        end = start
        while end < n and cell[end] == cell[start]:
            end += 1
        middle, gate = 0.0, np.inf
        if end - start >= FEW:
            middle = np.median(deviation[start:end])
            gate = max(LEAST_GATE_MM, GATE * 1.4826 * np.median(np.abs(deviation[start:end] - middle)))
        for i in range(start, end):
            if i == start or station[i] != station[i - 1]:
                at += 1
                own[at], by[at] = cell[i], station[i]
            off = deviation[i]
            if abs(off - middle) > gate:
                stray[at] += 1
                continue
            count[at] += 1
            step = off - mean[at]
            mean[at] += step / count[at]
            square[at] += step * (off - mean[at])
        start = end
    return own, by, count, stray, mean, square
