"""Observations of the design's surface: points on faces, and their means by cell and station."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from processor.defects.surface_charts import DesignSurface, layout
from processor.geometry import mesh_distance, rigid
from processor.model import Floats, InputError, Ints, Scene

CHUNK = 500_000
LEAST_COS = 0.2  # of incidence: points at a more oblique one are mostly of beams that hit two surfaces
GATE_SDS = 4.0  # robust standard deviations from the median of a cell, beyond which a point is stray
LEAST_GATE_MM = 1.0
FEWEST_POINTS = 4  # of a cell, for its median to identify stray points


@dataclass(frozen=True)
class Stations:
    """Names and positions (k, 3) of the scanners of a scene, in the design's frame; NaN = unknown."""

    names: tuple[str, ...]
    positions: Floats

    @property
    def unnamed(self) -> bool:
        """Whether the scan may be merged from several views of which nothing is known."""
        return len(self.names) == 1 and not np.isfinite(self.positions).all()


@dataclass(frozen=True)
class Observed:
    """Points on the design's faces: the chart, place on it, station and deviation (mm, outward positive) of each."""

    chart: Ints
    uv: Floats  # (n, 2)
    station: Ints
    deviation: Floats
    stations: Stations
    points: int  # of the scene


@dataclass(frozen=True)
class Pairs:
    """Deviations by cell and station: mean over ``count`` points, and their sum of squares about it.

    Points that do not agree with the others of their cell are left out and counted by ``stray``.
    """

    cell: Ints
    station: Ints
    count: Ints
    stray: Ints
    mean: Floats
    square: Floats


def observe(scene: Scene, T_design_project: Floats, surface: DesignSurface, reach_mm: float) -> Observed:
    """Assign the points of a scene to faces of the design within ``reach_mm`` that their station can see.

    Raises InputError for a scene without points.
    """
    if not any(len(scan.points) for scan in scene.scans):
        raise InputError(f"{scene.name}: expected scans of the structure, found no points")
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, reach_mm)
    names: list[str] = []
    positions: list[Floats] = []
    parts: list[tuple[Ints, Floats, Ints, Floats]] = []
    for scan in scene.scans:
        T = T_design_project @ (scan.T_project_scan if scan.T_project_scan.size else np.eye(4))
        T = rigid.transform(T[:3, :3], T[:3, :3] @ scan.origin + T[:3, 3])
        station_of = np.full(len(scan.points), len(names), np.int64)
        if scan.position.size:
            names.append(scan.name)
            positions.append(rigid.apply(T, scan.position - scan.origin))
        elif scene.stations is not None and len(scan.point_station):
            row = np.where(scan.point_station < 0, len(scene.stations.ids), scan.point_station)
            station_of = row + len(names)
            names += [*scene.stations.ids, f"{scan.name}, unknown"]
            positions += [*rigid.apply(T_design_project, scene.stations.positions), np.full(3, np.nan)]
        else:
            names.append(scan.name)
            positions.append(np.full(3, np.nan))
        known = np.isfinite(np.array(positions).sum(axis=1))
        scanners = np.nan_to_num(np.array(positions))
        for start in range(0, len(station_of), CHUNK):
            rows = slice(start, start + CHUNK)
            points, of_point = rigid.apply(T, scan.points[rows]), station_of[rows]
            station = np.where(known[of_point], of_point, -1)
            facet, deviation = mesh_distance.nearest_visible(grid, points, scanners, station)
            near = np.flatnonzero(facet >= 0)
            arm = scanners[of_point[near]] - points[near]
            cosine = np.einsum("ni,ni->n", arm, surface.normals[facet[near]]) / np.linalg.norm(arm, axis=1)
            on = near[(station[near] < 0) | (cosine > LEAST_COS)]
            chart = surface.chart_of[facet[on]]
            parts.append((chart, layout(surface.charts, chart, points[on]), of_point[on], deviation[on]))
    chart, uv, station, deviation = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Observed(
        chart=chart,
        uv=uv,
        station=station,
        deviation=deviation,
        stations=Stations(tuple(names), np.array(positions)),
        points=sum(len(scan.points) for scan in scene.scans),
    )


def fitting_cell(observed: Observed, surface: DesignSurface, points: float, bounds: tuple[float, float]) -> float:
    """Return the size of cells in mm that hold so many points on the median over the points."""
    _, count = np.unique(cells_of(observed, surface), return_counts=True)
    if not len(count):
        return bounds[1]
    density = float(np.median(np.repeat(count, count))) / surface.charts.cell_mm**2
    return float(np.clip(np.round(np.sqrt(points / density), 1), *bounds))


def cells_of(observed: Observed, surface: DesignSurface) -> Ints:
    """Return the cell (n,) of each point; points beyond their face's grid are in the nearest cell."""
    return _cells(surface, observed.chart, observed.uv)


def cells_at(surface: DesignSurface, chart: Ints, places: Floats) -> Ints:
    """Return the cell (n,) of places (n, 3) on the faces of charts (n,)."""
    return _cells(surface, chart, layout(surface.charts, chart, places))


def _cells(surface: DesignSurface, chart: Ints, uv: Floats) -> Ints:
    charts = surface.charts
    at = np.floor((uv - charts.low[chart]) / charts.cell_mm).astype(np.int64)
    at = np.clip(at, 0, charts.shape[chart] - 1)
    cell: Ints = charts.first[chart] + at[:, 0] * charts.shape[chart, 1] + at[:, 1]
    return cell


def paired(observed: Observed, surface: DesignSurface) -> Pairs:
    """Sum up the points by cell and station."""
    cell = cells_of(observed, surface)
    order = np.argsort(cell * len(observed.stations.names) + observed.station, kind="stable")
    return Pairs(*pairs(cell[order], observed.station[order], observed.deviation[order]))


@njit(cache=True, nogil=True)
def pairs(cell: Ints, station: Ints, deviation: Floats) -> tuple[Ints, Ints, Ints, Ints, Floats, Floats]:
    """Return the columns of :class:`Pairs` of points sorted by cell and station (Welford's algorithm)."""
    n = len(cell)
    total = 0
    for i in range(n):
        if i == 0 or cell[i] != cell[i - 1] or station[i] != station[i - 1]:
            total += 1
    cells, stations = np.empty(total, np.int64), np.empty(total, np.int64)
    count, stray = np.zeros(total, np.int64), np.zeros(total, np.int64)
    mean, square = np.zeros(total), np.zeros(total)
    at, start = -1, 0
    while start < n:
        end = start
        while end < n and cell[end] == cell[start]:
            end += 1
        middle, gate = 0.0, np.inf
        if end - start >= FEWEST_POINTS:
            middle = np.median(deviation[start:end])
            gate = max(LEAST_GATE_MM, GATE_SDS * 1.4826 * np.median(np.abs(deviation[start:end] - middle)))
        for i in range(start, end):
            if i == start or station[i] != station[i - 1]:
                at += 1
                cells[at], stations[at] = cell[i], station[i]
            value = deviation[i]
            if abs(value - middle) > gate:
                stray[at] += 1
                continue
            count[at] += 1
            step = value - mean[at]
            mean[at] += step / count[at]
            square[at] += step * (value - mean[at])
        start = end
    return cells, stations, count, stray, mean, square
