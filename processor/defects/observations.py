"""Observations of the design's surface: points on faces, and their means by cell and station."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from processor.adjustment import mixed_pixels
from processor.defects.surface_charts import CYLINDER, DesignSurface, layout
from processor.geometry import mesh_distance, rigid
from processor.geometry.mesh_distance import FacetGrid
from processor.model import Bools, Floats, InputError, Ints, Scan, Scene
from processor.robust_statistics import MAD_TO_SD

CHUNK = 500_000
BEHIND_MM = 4.0  # a face, from which on a beam must have passed through it as designed
LEAST_COS = 0.2  # of incidence: points at a more oblique one are mostly of beams that hit two surfaces
GATE_SDS = 4.0  # robust standard deviations from the median of a cell, beyond which a point is stray
LEAST_GATE_MM = 1.0
FEWEST_POINTS = 4  # of a cell, for its median to identify stray points
FEWEST_OF_FACE = 40  # points of a station on a face, for their own robust standard deviation


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
    """Points on the design's faces: the chart, place on it, station and deviation (mm, outward positive) of each.

    ``mixed`` marks points whose beams may have hit something before the face as well: they show that something is
    there, but not where.
    """

    chart: Ints
    uv: Floats  # (n, 2)
    station: Ints
    deviation: Floats
    mixed: Bools
    stations: Stations
    points: int  # of the scene


@dataclass(frozen=True)
class Pairs:
    """Deviations by cell and station: mean over ``count`` points, and their sum of squares about it.

    Points that do not agree with the others of their cell, and mixed ones, are left out and counted by ``stray``;
    ``mixed`` counts the latter.
    """

    cell: Ints
    station: Ints
    count: Ints
    stray: Ints
    mean: Floats
    square: Floats
    mixed: Ints


def observe(scene: Scene, T_design_project: Floats, surface: DesignSurface, reach_mm: float) -> Observed:
    """Assign the points of a scene to faces of the design within ``reach_mm`` that their station can see.

    Raises InputError for a scene without points.
    """
    if not any(len(scan.points) for scan in scene.scans):
        raise InputError(f"{scene.name}: expected scans of the structure, found no points")
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, reach_mm)
    names: list[str] = []
    positions: list[Floats] = []
    parts: list[tuple[Ints, Floats, Ints, Floats, Bools]] = []
    for scan in scene.scans:
        T = T_design_project @ scan.pose
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
        parts.append(_of_scan(scan, T, station_of, np.array(positions), surface, grid))
    chart, uv, station, deviation, mixed = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Observed(
        chart=chart,
        uv=uv,
        station=station,
        deviation=deviation,
        mixed=mixed,
        stations=Stations(tuple(names), np.array(positions)),
        points=sum(len(scan.points) for scan in scene.scans),
    )


def _of_scan(
    scan: Scan, T: Floats, station_of: Ints, positions: Floats, surface: DesignSurface, grid: FacetGrid
) -> tuple[Ints, Floats, Ints, Floats, Bools]:
    """Return chart, place, station, deviation and mixed of the points on faces; ``T`` (4, 4) maps them to the design.

    ``station_of`` (n,) are rows of ``positions`` (k, 3).
    """
    known, scanners = np.isfinite(positions.sum(axis=1)), np.nan_to_num(positions)
    facet, deviation = np.full(len(scan.points), -1, np.int64), np.full(len(scan.points), np.nan)
    points = np.empty((len(scan.points), 3))
    for start in range(0, len(station_of), CHUNK):
        rows = slice(start, start + CHUNK)
        points[rows], of_point = rigid.apply(T, scan.points[rows]), station_of[rows]
        station = np.where(known[of_point], of_point, -1)
        facet[rows], deviation[rows] = mesh_distance.nearest_visible(grid, points[rows], scanners, station)
    near = np.flatnonzero(facet >= 0)
    places, outward = _sighted(surface, facet[near], points[near], scanners[station_of[near]], known[station_of[near]])
    arm = scanners[station_of[near]] - points[near]
    cosine = np.einsum("ni,ni->n", arm, outward) / np.linalg.norm(arm, axis=1)
    used = ~known[station_of[near]] | (cosine > LEAST_COS)
    on, places = near[used], places[used]
    mixed = _at_outline(surface, facet[on], points[on], scanners[station_of[on]])
    mixed |= _passed_by(surface, grid, facet[on], points[on], deviation[on], scanners[station_of[on]])
    mixed &= known[station_of[on]]
    smooth, chart = np.where(facet >= 0, surface.part_of[facet], -1), surface.chart_of[facet[on]]
    for k in np.unique(station_of[on]):
        if known[k]:
            rows = station_of[on] == k
            of_face = surface.normals[facet[on[rows]]], deviation[on[rows]], smooth[on[rows]]
            every = points[station_of == k], smooth[station_of == k]
            mixed[rows] |= mixed_pixels.mark(points[on[rows]], positions[k], *of_face, every)
    return chart, layout(surface.charts, chart, places), station_of[on], deviation[on], mixed


def _sighted(
    surface: DesignSurface, facet: Ints, points: Floats, scanners: Floats, known: Bools
) -> tuple[Floats, Floats]:
    """Return places (n, 3) of points (n, 3) on their faces, and the outward normals (n, 3) there.

    On a round face the place is where the line of sight from the scanner (n, 3) meets it, as noise along the line moves
    a point around the face: by the nearest place, what is too far would gather near the outline, where the face ends
    for the scanner, and what is too near would gather away from it. ``known`` (n,) marks scanners with a position.
    """
    charts, chart = surface.charts, surface.chart_of[facet]
    places, outward = points.copy(), surface.normals[facet]
    rows = np.flatnonzero((charts.kind[chart] == CYLINDER) & known)
    axis, radius = charts.axes[chart[rows], 0], charts.radius[chart[rows]]
    arm, sight = points[rows] - charts.origin[chart[rows]], points[rows] - scanners[rows]
    arm, sight = (x - np.einsum("ni,ni->n", x, axis)[:, None] * axis for x in (arm, sight))
    # The line of sight arm + t sight meets the circle about the axis where a t^2 + 2 b t + c = 0.
    a, b = np.einsum("ni,ni->n", sight, sight), np.einsum("ni,ni->n", arm, sight)
    inside = b**2 - a * (np.einsum("ni,ni->n", arm, arm) - radius**2)
    meets = (inside > 0.0) & (a > 0.0)
    rows, arm, sight, axis, a, b, inside = (x[meets] for x in (rows, arm, sight, axis, a, b, inside))
    way = np.where(np.einsum("ni,ni->n", arm, outward[rows]) > 0.0, 1.0, -1.0)  # a hole is seen on its far side
    t = (-b - way * np.sqrt(inside)) / a
    places[rows] += t[:, None] * (points[rows] - scanners[rows])
    out = arm + t[:, None] * sight
    outward[rows] = way[:, None] * out / np.linalg.norm(out, axis=1)[:, None]
    return places, outward


def _at_outline(surface: DesignSurface, facet: Ints, points: Floats, scanners: Floats) -> Bools:
    """Mark points (n, 3) on round faces of which half a beam from the scanners (n, 3) passes by the face.

    What counts is how far the line of sight passes the axis, which does not depend on the range that was measured.
    """
    charts, chart = surface.charts, surface.chart_of[facet]
    marked = np.zeros(len(facet), np.bool_)
    rows = np.flatnonzero(charts.kind[chart] == CYLINDER)
    chart = chart[rows]
    axis, arm = charts.axes[chart, 0], points[rows] - charts.origin[chart]
    sight = scanners[rows] - points[rows]
    across = np.cross(sight, axis)
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-9)[:, None]
    off = np.abs(np.einsum("ni,ni->n", arm, across))
    is_convex = np.einsum("ni,ni->n", arm, surface.normals[facet[rows]]) > 0.0
    half_width = mixed_pixels.half_beam_width(np.linalg.norm(sight, axis=1))
    marked[rows] = is_convex & (off > charts.radius[chart] - half_width)
    return marked


def _passed_by(
    surface: DesignSurface, grid: FacetGrid, facet: Ints, points: Floats, deviation: Floats, scanners: Floats
) -> Bools:
    """Mark points (n, 3) behind their face whose line of sight does not cross it: the beam passed its outline.

    Such a beam met an edge in part and something far behind it. Where the steel lies deeper than designed, the beam
    crosses the face.
    """
    marked = deviation < -BEHIND_MM
    rows = np.flatnonzero(marked)
    arm = scanners[rows] - points[rows]
    depth, rise = -deviation[rows], np.einsum("ni,ni->n", arm, surface.normals[facet[rows]])
    ends = points[rows] + arm * np.minimum(1.0, (depth + BEHIND_MM) / np.maximum(rise, 1e-9))[:, None]
    row, crossed, _ = mesh_distance.crossings(grid, points[rows], ends, False)
    through = surface.chart_of[crossed] == surface.chart_of[facet[rows[row]]]
    marked[rows[row[through]]] = False
    return marked


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
    cell, station, chart = cell[order], observed.station[order], observed.chart[order]
    deviation, mixed = observed.deviation[order], observed.mixed[order]
    sd = _robust_sd(off_median(cell, deviation, mixed), station, chart)
    return Pairs(*pairs(cell, station, deviation, mixed, sd))


def _robust_sd(off: Floats, station: Ints, chart: Ints) -> Floats:
    """Return the robust standard deviation (n,) of the points of each point's station on its face, mm.

    ``off`` (n,) are distances from the medians of cells, NaN where a cell has too few points. The points of one cell
    alone show it badly: of four, the nearest three may agree by chance.
    """
    known = np.flatnonzero(np.isfinite(off))
    of_face, of_station = (
        medians(off[known], group[known], int(group.max(initial=0)) + 1, FEWEST_OF_FACE)
        for group in (station * (int(chart.max(initial=0)) + 1) + chart, station)
    )
    own = of_face[station * (int(chart.max(initial=0)) + 1) + chart]
    sd: Floats = MAD_TO_SD * np.where(np.isfinite(own), own, np.nan_to_num(of_station[station]))
    return sd


def medians(values: Floats, group: Ints, groups: int, fewest: int) -> Floats:
    """Return the median (groups,) of the values (n,) of each group; NaN for a group of fewer than ``fewest``."""
    order = np.lexsort([values, group])
    count = np.bincount(group, minlength=groups)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    enough = np.flatnonzero(count >= fewest)
    median = np.full(groups, np.nan)
    low, high = (values[order[first[enough] + (count[enough] - k) // 2]] for k in (1, 0))
    median[enough] = 0.5 * (low + high)
    return median


@njit(cache=True, nogil=True)
def off_median(cell: Ints, deviation: Floats, mixed: Bools) -> Floats:
    """Return the distances (n,) from the median of the pure points of a cell, of points sorted by cell.

    NaN for mixed points and in a cell of fewer than FEWEST_POINTS. The median is of the points themselves: the distance
    is that from the expected value after multiplication by (n / (n - 1))^(1/2).
    """
    off = np.full(len(cell), np.nan)
    start = 0
    while start < len(cell):
        end = start
        while end < len(cell) and cell[end] == cell[start]:
            end += 1
        pure = deviation[start:end][~mixed[start:end]]
        n = len(pure)
        if n >= FEWEST_POINTS:
            middle = np.median(pure)
            for i in range(start, end):
                if not mixed[i]:
                    off[i] = abs(deviation[i] - middle) * np.sqrt(n / (n - 1.0))
        start = end
    return off


@njit(cache=True, nogil=True)
def pairs(
    cell: Ints, station: Ints, deviation: Floats, mixed: Bools, sd: Floats
) -> tuple[Ints, Ints, Ints, Ints, Floats, Floats, Ints]:
    """Return the columns of :class:`Pairs` of points sorted by cell and station (Welford's algorithm).

    ``sd`` (n,) is the robust standard deviation of a point: what is within GATE_SDS of it is not stray.
    """
    n = len(cell)
    total = 0
    for i in range(n):
        if i == 0 or cell[i] != cell[i - 1] or station[i] != station[i - 1]:
            total += 1
    cells, stations = np.empty(total, np.int64), np.empty(total, np.int64)
    count, stray, beside = np.zeros(total, np.int64), np.zeros(total, np.int64), np.zeros(total, np.int64)
    mean, square = np.zeros(total), np.zeros(total)
    at, start = -1, 0
    while start < n:
        end = start
        while end < n and cell[end] == cell[start]:
            end += 1
        middle, gate = 0.0, np.inf
        pure = deviation[start:end][~mixed[start:end]]
        if len(pure) >= FEWEST_POINTS:
            middle = np.median(pure)
            gate = max(LEAST_GATE_MM, GATE_SDS * MAD_TO_SD * np.median(np.abs(pure - middle)))
        for i in range(start, end):
            if i == start or station[i] != station[i - 1]:
                at += 1
                cells[at], stations[at] = cell[i], station[i]
            value = deviation[i]
            if mixed[i] or abs(value - middle) > max(gate, GATE_SDS * sd[i]):
                stray[at] += 1
                beside[at] += mixed[i]
                continue
            count[at] += 1
            step = value - mean[at]
            mean[at] += step / count[at]
            square[at] += step * (value - mean[at])
        start = end
    return cells, stations, count, stray, mean, square, beside
