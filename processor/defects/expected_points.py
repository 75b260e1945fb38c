"""Points that scanners should have on each cell of the design's surface.

A station is expected to see a cell if the incidence is not too oblique, if it saw other parts of the same face, if its
rays in this direction met nothing before the cell, and if no other face of the design hides the cell, as one does where
bodies touch. The number of points follows from the station's density of points by solid angle. On a face that hardly
any point lies on, as of a part that is gone, those points are expected that were measured through it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from processor.defects.observations import CHUNK, Pairs, cells_at
from processor.defects.surface_charts import GRID_SHARE, DesignSurface
from processor.geometry import mesh_distance
from processor.geometry.mesh_distance import FacetGrid
from processor.model import Bools, Floats, Ints
from processor.views import Views

LEAST_COS = 0.34  # of incidence
NEARER_MM = 100.0  # than the surface: an obstacle
THROUGH_MM = 5.0  # behind a face, from which on a point was measured through it: thinner plates are not looked for
SHADE_MM = 5.0  # before a face, from which on a point is not of the face: four standard deviations of a scanner's noise
BEFORE_MM = 1.0  # distance of a face of the design that hides a cell
SEEN_SHARE = 0.5  # of the points expected, up to which a cell may be hidden
LEAST_POINTS = 1e-6  # expected; less is the rounding of sums
LEAST_BIN_RAD = 0.003  # 30 mm at 10 m: wider than a beam, narrower than a plate seen from there
BIN_STEPS = 5.0  # angular steps of a scanner in a bin of directions
FACE_SHARE = 0.2  # of a face's cells seen by a station, from which on the rest is expected
SHADED = 0.2  # of the rays to a place, that ended before it: from which on the rest is no evidence
SHARED_RAYS = 50.0  # of cells together, to know the share of them that is shaded: within 20 %
CHANCE_SDS = 3.0  # of the difference of two Poisson numbers, up to which it may be by chance
FEWEST_CELLS = 10  # with points, to estimate the density of points from
GAP_RAD = 0.5  # of azimuth without returns, that is still within the field of view


@dataclass(frozen=True)
class Expected:
    """Points that each station should have on the cells that it sees, and those measured through cells (cells,).

    ``of_stations`` are the stations' numbers, cells (n,) and numbers of points (n,). ``hidden`` (cells,) are without
    points and behind something that is not of the design.
    """

    of_stations: tuple[tuple[int, Ints, Floats], ...]
    through: Floats
    hidden: Bools

    @property
    def points(self) -> Floats:
        """Return the number of points (cells,) that all stations together should have on each cell."""
        points = np.zeros(len(self.through))
        for _, cell, number in self.of_stations:
            points[cell] += number
        return np.maximum(np.where(points > LEAST_POINTS, points, 0.0), self.through)


def expected(pairs: Pairs, surface: DesignSurface, stations: Views) -> Expected:
    """Return the points expected of each station, of the design as scanned: see the head of this file."""
    cells = len(surface.share)
    parts, behind = list[tuple[int, Ints, Floats]](), list[tuple[int, Ints]]()
    order = np.argsort(pairs.station, kind="stable")
    for k, rows in enumerate(np.split(order, np.searchsorted(pairs.station[order], np.arange(1, len(stations.names))))):
        if np.isfinite(stations.positions[k]).all() and len(rows):
            count = np.zeros(cells)
            count[pairs.cell[rows]] = (pairs.count + pairs.stray)[rows]
            cell, number, obstructed = _of_station(k, stations, count, surface)
            parts.append((k, cell, number))
            behind.append((k, obstructed))
    counted, hidden = np.bincount(pairs.cell, pairs.count + pairs.stray, cells), np.zeros(cells, np.bool_)

    def behind_design(station: int, cell: Ints) -> Ints:
        starts = surface.centres[cell] + BEFORE_MM * surface.outward[cell]
        ends = np.repeat(stations.positions[station : station + 1], len(cell), axis=0)
        return mesh_distance.crossings(surface.sight_grid, starts, ends, True)[0]

    empty = counted < SEEN_SHARE * Expected(tuple(parts), np.zeros(cells), hidden).points
    for k, cell, number in parts:
        rows = np.flatnonzero(empty[cell])
        number[rows[behind_design(k, cell[rows])]] = 0.0
    for k, cell in behind:
        cell = cell[counted[cell] == 0]
        hidden[np.delete(cell, behind_design(k, cell))] = True
    return Expected(tuple(parts), _through(counted, surface, stations), hidden)


def without_shade(of: Expected, places: list[Ints], surface: DesignSurface, stations: Views) -> Expected:
    """Return the points expected less, on ``places`` of cells (n,), the rays that ended on something before them.

    Shade of what stands close to a face and is not of the design, as of a stack beside a column, is found so to the
    ray, where directions in bins would leave a strip of it.
    """
    charts, touched = surface.charts, np.unique(surface.chart[np.concatenate(places)])
    facets = np.flatnonzero(np.isin(surface.chart_of, touched))
    grid, parts = _grid_of(surface, facets), []
    for k, cell, number in of.of_stations:
        rays, shaded = np.zeros(len(of.through)), np.zeros(len(of.through))
        rays[cell] = number
        for crossed in _crossed(k, surface, stations, facets, grid, places):
            shaded += np.bincount(crossed, minlength=len(shaded))
        shaded[rays == 0.0] = 0.0  # hidden already
        # Of what hides a place in part, rays may be lost as well: the station does not see it.
        behind = [one for one in places if shaded[one].sum() > SHADED * rays[one].sum()]
        for chart in touched:
            of_chart = charts.image(rays, chart)
            # Single cells have too few rays for a share of them; what is left by chance is none.
            side = int(np.ceil(np.sqrt(SHARED_RAYS / max(float(of_chart.sum() / max((of_chart > 0.0).sum(), 1)), 1.0))))
            of_both = charts.image(shaded, chart), of_chart
            ends, due = (ndimage.uniform_filter(x, side, mode="constant") * side**2 for x in of_both)
            by_chance = CHANCE_SDS * np.sqrt(np.maximum(due + ends, 0.0))
            left = np.where((ends > 0.5) & (due - ends < by_chance), 0.0, due - ends)
            rays[charts.cells(chart)] *= np.clip(left / np.maximum(due, LEAST_POINTS), 0.0, 1.0).ravel()
        for one in behind:
            rays[one] = 0.0
        parts.append((k, cell, rays[cell]))
    return Expected(tuple(parts), of.through, of.hidden)


def _through(counted: Ints, surface: DesignSurface, stations: Views) -> Floats:
    """Return the number (cells,) of points measured through cells of faces that hardly any point lies on."""
    through = np.zeros(len(surface.share))
    chart, charts = surface.chart, len(surface.charts.kind)
    share = np.bincount(chart, (counted > 0) & (surface.share > 0.5), charts)
    unseen = share < FACE_SHARE * np.maximum(np.bincount(chart, surface.share > 0.5, charts), 1)
    facets = np.flatnonzero(unseen[surface.chart_of])
    if not len(facets):
        return through
    grid = _grid_of(surface, facets)
    for k, position in enumerate(stations.positions):
        if np.isfinite(position).all():
            for crossed in _crossed(k, surface, stations, facets, grid):
                through += np.bincount(crossed, minlength=len(through))
    return through


def _grid_of(surface: DesignSurface, facets: Ints) -> FacetGrid:
    """Return a grid of some of the facets: all stations look at the same ones."""
    faces = surface.faces[facets]
    size = float(np.linalg.norm(np.ptp(surface.vertices[faces].reshape(-1, 3), axis=0)))
    return mesh_distance.facet_grid(surface.vertices, faces, surface.normals[facets], GRID_SHARE * size)


def _crossed(
    station: int, surface: DesignSurface, stations: Views, facets: Ints, grid: FacetGrid, behind: Sequence[Ints] = ()
) -> Iterator[Ints]:
    """Yield the cells of some facets, those of a grid, that rays of a station cross before their points; or beyond.

    Beyond, rays to ``behind``, places of cells (n,), are looked at alone.
    """
    position = stations.positions[station]
    to = [surface.centres[cells] - position for cells in behind]
    for points, _ in stations.blocks(CHUNK, view=station):
        if behind:
            points = points[_towards(points - position, to, surface.charts.cell_mm)]
        ray = position - points
        length = np.linalg.norm(ray, axis=1)[:, None]
        if behind:
            starts, ends = points - SHADE_MM * ray / length, points - surface.size_mm * ray / length
        else:
            starts, ends = points + THROUGH_MM * ray / length, np.repeat(position[None], len(points), axis=0)
        row, crossed, part = mesh_distance.crossings(grid, starts, ends, False)
        steep = np.einsum("ni,ni->n", ray[row], grid.normals[crossed]) > LEAST_COS * length[row, 0]
        row, crossed, part = row[steep], crossed[steep], part[steep]
        places = starts[row] + part[:, None] * (ends[row] - starts[row])
        yield cells_at(surface, surface.chart_of[facets[crossed]], places)


def _towards(rays: Floats, places: list[Floats], cell_mm: float) -> Bools:
    """Mark the rays (n, 3) that are within the cone about cells (m, 3) of a place, as seen from the rays' origin."""
    rays = rays / np.linalg.norm(rays, axis=1)[:, None]
    marked = np.zeros(len(rays), np.bool_)
    for place in places:
        away = np.linalg.norm(place, axis=1)
        to = place / away[:, None]
        axis = to.mean(axis=0) / np.linalg.norm(to.mean(axis=0))
        half_angle = float(np.arccos(np.clip((to @ axis).min(), -1.0, 1.0))) + cell_mm / float(away.min())
        marked |= rays @ axis >= np.cos(min(half_angle, np.pi))
    return marked


def _of_station(station: int, stations: Views, count: Floats, surface: DesignSurface) -> tuple[Ints, Floats, Ints]:
    """Return cells (n,) that no scanned obstacle hides from a station, and the numbers (n,) of points expected there.

    Also returns the cells (m,) that one hides. ``count`` (cells,) are the points that the station has on each cell.
    """
    chart, charts = surface.chart, len(surface.charts.kind)
    whole = np.bincount(chart, surface.share > 0.5, charts)
    faces = np.bincount(chart, count > 0, charts) >= FACE_SHARE * np.maximum(whole, 1)
    cell = np.flatnonzero(faces[chart] & (surface.share > 0.05))
    arm = surface.centres[cell] - stations.positions[station]
    distance = np.linalg.norm(arm, axis=1)
    cosine = -np.einsum("ni,ni->n", arm, surface.outward[cell]) / distance
    steep = cosine > LEAST_COS
    cell, arm, distance, cosine = cell[steep], arm[steep], distance[steep], cosine[steep]
    angle = surface.share[cell] * surface.charts.cell_mm**2 * cosine / distance**2
    occupied = count[cell] > 0
    if occupied.sum() < FEWEST_CELLS:
        return np.empty(0, np.int64), np.empty(0), np.empty(0, np.int64)
    density = float(np.median(count[cell][occupied] / angle[occupied]))
    bin_rad = max(LEAST_BIN_RAD, BIN_STEPS / np.sqrt(density))
    nearest, inside = _nearest_ranges(station, stations, bin_rad, arm)
    slack = NEARER_MM + 3.0 * bin_rad * distance * np.sqrt(1.0 - cosine**2) / cosine
    obstructed = nearest < distance - slack
    clear = inside & ~obstructed
    return cell[clear], density * angle[clear], cell[inside & obstructed]


def _nearest_ranges(station: int, stations: Views, bin_rad: float, arm: Floats) -> tuple[Floats, Bools]:
    """Return the shortest range about directions arm (n, 3), and whether they are within the station's field of view.

    Bins of azimuth without any return are outside it, except for gaps as wide as structures have. What is lower or
    higher than all returns may be outside it, as the scanner's tripod hides what is below.
    """
    wide, high = int(np.ceil(2.0 * np.pi / bin_rad)), int(np.ceil(np.pi / bin_rad))
    nearest = np.full(wide * high, np.inf)
    lowest, highest = np.inf, -np.inf
    columns = np.zeros(wide, bool)

    def bins(arm: Floats) -> tuple[Ints, Ints, Floats]:
        azimuth, elevation = np.arctan2(arm[:, 1], arm[:, 0]), np.arctan2(arm[:, 2], np.hypot(arm[:, 0], arm[:, 1]))
        i = np.minimum((azimuth + np.pi) / bin_rad, wide - 1).astype(np.int64)
        j = np.minimum((elevation + 0.5 * np.pi) / bin_rad, high - 1).astype(np.int64)
        return i, j, elevation

    for points, _ in stations.blocks(CHUNK, view=station):
        local = points - stations.positions[station]
        i, j, elevation = bins(local)
        np.minimum.at(nearest, i * high + j, np.linalg.norm(local, axis=1))
        columns[i] = True
        lowest, highest = min(lowest, float(elevation.min())), max(highest, float(elevation.max()))
    nearest = ndimage.minimum_filter(nearest.reshape(wide, high), 3, mode=("wrap", "nearest"))
    closing = np.ones(max(1, int(GAP_RAD / bin_rad)))
    columns |= ndimage.binary_closing(np.tile(columns, 3), closing)[wide : 2 * wide]
    i, j, elevation = bins(arm)
    inside = columns[i] & (elevation > lowest) & (elevation < highest)
    return nearest[i, j], inside
