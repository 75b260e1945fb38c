"""Observations of the design's surface: points on faces, and their means by cell and station.

Points are passed over in blocks; what is kept of each lies in files beside the results where it is much (see
:mod:`processor.large_arrays`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from processor import large_arrays
from processor.adjustment import mixed_pixels
from processor.adjustment.mixed_pixels import Block
from processor.defects.surface_charts import CYLINDER, DesignSurface, gridded, layout, placed
from processor.geometry import mesh_bodies, mesh_distance
from processor.geometry.mesh_distance import FacetGrid, Samples
from processor.large_arrays import Array, allocate, blocks, in_parts
from processor.model import Bools, Floats, InputError, Ints, Labels, Scene
from processor.registration import surface_layers
from processor.robust_statistics import MAD_TO_SD
from processor.views import Views, views

CHUNK = 500_000  # points in memory at once: work, not result
PART_POINTS = 500_000  # that are sorted by their cells in memory
BEHIND_MM = 4.0  # a face, from which on a beam must have passed through it as designed
LEAST_COS = 0.2  # of incidence: points at a more oblique one are mostly of beams that hit two surfaces
GATE_SDS = 4.0  # robust standard deviations from the median of a cell, beyond which a point is stray
LEAST_GATE_MM = 1.0
FEWEST_POINTS = 4  # of a cell, for its median to identify stray points
LAYER_POINTS, LAYER_CELLS = 1_000_000, 2.0  # work; diameter of the circles that a plane is fitted to: 40 points
PIECE_MM = 150.0  # of faces: half as wide as a board, so that most of those about one are of steel
BESIDE_SHARE = 0.1  # of a cell's points, from which on those before the steel are of something
ROUND_MM = 20.0  # before a round face: of one that moved by less, stations show different distances at one place
FEWEST_OF_FACE = 40  # points of a station on a face, for their own robust standard deviation


@dataclass(frozen=True)
class Observed:
    """Points on the design's faces: the chart, place on it, station and deviation (mm, outward positive) of each.

    ``mixed`` marks points whose beams may have hit something before the face as well: they show that something is
    there, but not where. ``beside`` (cells,) counts those of them that are of what stands against the structure.
    """

    chart: Labels
    uv: Floats  # (n, 2)
    station: Labels
    deviation: Floats
    mixed: Bools
    stations: Views
    points: int  # of the scene
    beside: Ints = field(default_factory=lambda: np.empty(0, np.int64))


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
    seen = views(scene, T_design_project, np.zeros(3))
    if not seen.count:
        raise InputError(f"{scene.name}: expected scans of the structure, found no points")
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, reach_mm)
    room = Observed(
        chart=allocate(seen.count, dtype=np.int32),
        uv=allocate(seen.count, 2),
        station=allocate(seen.count, dtype=np.int32),
        deviation=allocate(seen.count),
        mixed=allocate(seen.count, dtype=np.bool_),
        stations=seen,
        points=seen.count,
    )
    filled = 0
    for scan in range(len(scene.scans)):
        filled = _of_scan(scan, surface, grid, room, filled)
    columns = ("chart", "uv", "station", "deviation", "mixed")
    return replace(room, **{name: getattr(room, name)[:filled] for name in columns})


def _of_scan(scan: int, surface: DesignSurface, grid: FacetGrid, found: Observed, filled: int) -> int:
    """Write the points of a scan that are on faces after those ``filled``; return how many there are then."""
    seen = found.stations
    known, scanners = np.isfinite(seen.positions.sum(axis=1)), np.nan_to_num(seen.positions)
    total = len(seen.scans[scan].points)
    nearest, used = allocate(total, dtype=np.int32), allocate(total, dtype=np.bool_)
    count, any_known = filled, False
    for rows, (points, station) in zip(blocks(total, CHUNK), seen.blocks(CHUNK, scan), strict=True):
        any_known = any_known or bool(known[station].any())
        facet, deviation = mesh_distance.nearest_visible(grid, points, scanners, np.where(known[station], station, -1))
        near = np.flatnonzero(facet >= 0)
        of_near = station[near]
        places, outward = _sighted(surface, facet[near], points[near], scanners[of_near], known[of_near])
        arm = scanners[of_near] - points[near]
        cosine = np.einsum("ni,ni->n", arm, outward) / np.linalg.norm(arm, axis=1)
        steep = ~known[of_near] | (cosine > LEAST_COS)
        on, places = near[steep], places[steep]
        mixed = _at_outline(surface, facet[on], points[on], scanners[station[on]])
        mixed |= _passed_by(surface, grid, facet[on], points[on], deviation[on], scanners[station[on]])
        chart, part = surface.chart_of[facet[on]], slice(count, count + len(on))
        found.chart[part], found.uv[part] = chart, layout(surface.charts, chart, places)
        found.station[part], found.deviation[part] = station[on], deviation[on]
        found.mixed[part] = mixed & known[station[on]]
        nearest[rows], used[rows] = facet, False
        used[rows.start + on] = True
        count = part.stop
    if any_known:
        of_points = _Sights(seen, scan, surface, nearest, used=used, deviation=found.deviation[filled:count])
        beside = mixed_pixels.mark_passes(of_points, seen.positions, surface.normals)
        for rows in blocks(len(beside)):
            found.mixed[filled:count][rows] |= beside[rows]
    return count


@dataclass(frozen=True)
class _Sights:
    """Passes over all points of a scan: ``nearest`` (n,) facets, those ``used`` (n,), and the deviations of these."""

    seen: Views
    scan: int
    surface: DesignSurface
    nearest: Labels
    used: Bools
    deviation: Floats

    def __iter__(self) -> Iterator[Block]:
        """Pass over all points."""
        done = 0
        parts = blocks(len(self.nearest), CHUNK)
        for rows, (points, station) in zip(parts, self.seen.blocks(CHUNK, self.scan), strict=True):
            facet, on = self.nearest[rows], np.flatnonzero(self.used[rows])
            height = np.zeros(len(points))
            height[on] = self.deviation[done : done + len(on)]
            done += len(on)
            smooth = np.where(facet >= 0, self.surface.part_of[facet], -1)
            yield Block(points, station, smooth, np.where(self.used[rows], facet, -1), height)


def without_beside(observed: Observed, surface: DesignSurface) -> Observed:
    """Mark as mixed what stands against the structure, as scaffold and boards do: it hides steel and shows none."""
    step = max(1, -(-len(observed.chart) // LAYER_POINTS))
    net = surface if step == 1 else gridded(surface, float(np.sqrt(step)) * surface.charts.cell_mm)
    on = np.flatnonzero(net.share > 0.0)
    core = Samples(net.centres[on], net.outward[on], on)
    body = np.zeros(len(net.charts.kind), np.int64)
    body[net.chart_of] = mesh_bodies.closed_bodies(net.faces)
    few = np.arange(0, len(observed.chart), step)
    few = few[~observed.mixed[few]]
    feet, normals = placed(net.charts, observed.chart[few], observed.uv[few])
    of_cell, diameter = body[net.chart[on]], LAYER_CELLS * net.charts.cell_mm
    layers = surface_layers.of_points(core, of_cell, feet, observed.deviation[few], normals, diameter, PIECE_MM)
    mixed, beside = allocate(len(observed.chart), dtype=np.bool_), np.zeros(len(surface.share), np.int64)
    for rows in blocks(len(mixed)):
        feet, _ = placed(surface.charts, observed.chart[rows], observed.uv[rows])
        flat, deviation = surface.charts.kind[observed.chart[rows]] != CYLINDER, observed.deviation[rows]
        mixed[rows] = ~layers.of_structure(feet, deviation) & (flat | (deviation > ROUND_MM))
        beside += np.bincount(cells_of(observed, surface, rows)[mixed[rows]], minlength=len(beside))
    # Less is the tail of noise, which is cut on both sides alike.
    beside[beside < BESIDE_SHARE * _counts(observed, surface)] = 0
    for rows in blocks(len(mixed)):
        mixed[rows] &= beside[cells_of(observed, surface, rows)] > 0
        mixed[rows] |= observed.mixed[rows]
    return replace(observed, mixed=mixed, beside=beside)


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
    count = np.sort(_counts(observed, surface))
    ends = np.cumsum(count)
    if not ends[-1]:
        return bounds[1]
    middle = count[np.searchsorted(ends, [(ends[-1] - 1) // 2, ends[-1] // 2], side="right")]
    density = float(middle.mean()) / surface.charts.cell_mm**2
    return float(np.clip(np.round(np.sqrt(points / density), 1), *bounds))


def _counts(observed: Observed, surface: DesignSurface) -> Ints:
    """Return the number of points in each cell (cells,)."""
    charts = surface.charts
    count = np.zeros(int(charts.shape.prod(axis=1).sum()), np.int64)
    for rows in blocks(len(observed.chart)):
        count += np.bincount(_cells(surface, observed.chart[rows], observed.uv[rows]), minlength=len(count))
    return count


def cells_of(observed: Observed, surface: DesignSurface, rows: slice) -> Ints:
    """Return the cell (n,) of some of the points; those beyond their face's grid are in the nearest cell."""
    return _cells(surface, observed.chart[rows], observed.uv[rows])


def sorted_by_cell(
    observed: Observed, surface: DesignSurface, count: Ints, of_rows: Callable[[slice], tuple[Array, ...]]
) -> tuple[list[Array], list[slice]]:
    """Return columns of the points by parts that hold whole cells, and the parts' rows; in order within a part.

    ``count`` (cells,) are the points of each cell, ``of_rows`` returns the columns of some points, the first of them
    the cells; of those that it leaves out the ``count`` is less.
    """
    ends = np.cumsum(count)
    part_of_cell = (ends - count) // PART_POINTS  # by the first of a cell's points: a cell is in one part
    stops = np.cumsum(np.bincount(part_of_cell, count, int(part_of_cell.max(initial=0)) + 1)).astype(np.int64)
    passed = (of_rows(rows) for rows in blocks(len(observed.chart)))
    columns = in_parts(passed, lambda block: part_of_cell[block[0]], stops)
    starts = [0, *stops[:-1].tolist()]
    return columns, [slice(start, stop) for start, stop in zip(starts, stops.tolist(), strict=True) if stop > start]


def cells_at(surface: DesignSurface, chart: Ints, places: Floats) -> Ints:
    """Return the cell (n,) of places (n, 3) on the faces of charts (n,)."""
    return _cells(surface, chart, layout(surface.charts, chart, places))


def _cells(surface: DesignSurface, chart: Ints | Labels, uv: Floats) -> Ints:
    charts = surface.charts
    at = np.floor((uv - charts.low[chart]) / charts.cell_mm).astype(np.int64)
    at = np.clip(at, 0, charts.shape[chart] - 1)
    cell: Ints = charts.first[chart] + at[:, 0] * charts.shape[chart, 1] + at[:, 1]
    return cell


def paired(observed: Observed, surface: DesignSurface) -> Pairs:
    """Sum up the points by cell and station."""

    def of_rows(rows: slice) -> tuple[Array, ...]:
        cell = cells_of(observed, surface, rows)
        return cell, observed.station[rows], observed.chart[rows], observed.deviation[rows], observed.mixed[rows]

    columns, parts = sorted_by_cell(observed, surface, _counts(observed, surface), of_rows)
    if not parts:
        return Pairs(*(np.empty(0, dtype) for dtype in (*[np.int64] * 4, *[np.float64] * 2, np.int64)))
    cell, station, chart, deviation, mixed = columns
    off = allocate(len(cell))
    for part in parts:
        order = np.argsort(cell[part] * len(observed.stations.names) + station[part], kind="stable")
        for column in columns:
            column[part] = column[part][order]
        off[part] = off_median(np.array(cell[part]), np.array(deviation[part]), np.array(mixed[part]))
        large_arrays.release()
    stations, charts = len(observed.stations.names), len(surface.charts.kind)
    of_face = _medians(off, lambda rows: station[rows].astype(np.int64) * charts + chart[rows], stations * charts)
    of_station = np.nan_to_num(_medians(off, lambda rows: station[rows], stations))
    found = []
    for part in parts:
        seen_from = station[part].astype(np.int64)
        own = of_face[seen_from * charts + chart[part]]
        sd = MAD_TO_SD * np.where(np.isfinite(own), own, of_station[seen_from])
        found.append(pairs(np.array(cell[part]), seen_from, np.array(deviation[part]), np.array(mixed[part]), sd))
        large_arrays.release()
    return Pairs(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _medians(off: Floats, group_of: Callable[[slice], Array], groups: int) -> Floats:
    """Return the median (groups,) of each group's distances, by which robust standard deviations are known.

    ``off`` (n,) are distances from the medians of cells, NaN where a cell has too few points, ``group_of`` returns the
    groups of some rows. NaN for a group of fewer than FEWEST_OF_FACE. The points of one cell alone show the standard
    deviation badly: of four, the nearest three may agree by chance.
    """

    def known() -> Iterator[tuple[Array, ...]]:
        for rows in blocks(len(off)):
            finite = np.isfinite(off[rows])
            yield off[rows][finite], group_of(rows)[finite]

    count = sum((np.bincount(group, minlength=groups) for _, group in known()), np.zeros(groups, np.int64))
    ends, median = np.cumsum(count), np.full(groups, np.nan)
    values = in_parts(known(), lambda block: block[1], ends)[0]
    for group in np.flatnonzero(count >= FEWEST_OF_FACE):
        median[group] = large_arrays.median(values[ends[group] - count[group] : ends[group]])
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
