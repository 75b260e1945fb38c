"""Deviations of cells with their uncertainty, on images of the faces."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from processor import tiles
from processor.adjustment import moderated_variances, scanner_class_errors, view_error_from_opposite_sides
from processor.defects.alignment import PAIRS_AT_ONCE, Alignment, rays_to, station_variance
from processor.defects.observations import FEWEST_POINTS, Pairs
from processor.defects.surface_charts import CYLINDER, PER_SIDE, Charts, DesignSurface
from processor.model import NORMAL_95, Floats, Ints
from processor.robust_statistics import robust_sd_about_median
from processor.views import Views

POOLED_CELLS = 9  # side of the square over which noise is pooled
ABOUT_CELLS, SEEN_SHARE = 3, 0.5  # side of the square about a cell, and the least share of it that was seen
LOCAL_FREE = 20.0  # degrees of freedom by which the noise about a cell is taken to be that of its face
BODY_CELLS, FEWEST_BODIES = 24, 5  # cells of a component that show its level, and components that show a common one
SURE = 3.0  # standard deviations of the median of their levels, beyond which they have it in common
ONE_WAY = 0.5  # share of a surface that faces one way, beyond which an offset of all of it may be a movement
PIECE_CELLS = 6.0  # side of a piece of a face, whose mean is compared with that of the other side


@dataclass(frozen=True)
class Field:
    """Deviation (mm, outward positive) of each cell (cells,) of a surface after an alignment, and its variance.

    ``stray`` counts points that do not agree with the others of the cell, or whose beams may have hit something else.
    ``inner`` are cells away from their face's border, ``seen`` those of them with enough points, and about them as
    well. ``stations`` is the variance by errors of the stations' movements, which neighbouring cells have in common; 0
    in cells without points. ``stations_free`` is that of deviations from the best fit of the whole. ``views`` is the
    standard deviation of what the points of one view have in common, where views are not named, mm. ``dof`` (cells,)
    is of the variance; without it the variance is known. ``drift`` is what the points of a view have in common after
    the alignment, as by a slow drift of its ranges, where views are named, mm: it bends and turns whole faces, while
    the search compares places on them. ``bias`` is what all components lay outward by in common, mm;
    it has been taken off the deviations.
    """

    surface: DesignSurface
    alignment: Alignment
    deviation: Floats
    variance: Floats
    count: Ints
    stray: Ints
    noise: Floats  # standard deviation of one point
    inner: Floats  # 0 or 1
    seen: Floats  # 0 or 1
    stations: Floats
    stations_free: Floats
    views: float = 0.0
    dof: Floats = dataclasses.field(default_factory=lambda: np.empty(0))
    drift: float = 0.0
    bias: float = 0.0

    def stations_sd(self, cells: Ints, free: bool = False) -> float:
        """Return the standard deviation that cells have in common by errors of stations' movements or of views, mm.

        If ``free``, of deviations from the best fit of the whole.
        """
        variance = (self.stations_free if free else self.stations)[cells][self.count[cells] > 0]
        return float(np.sqrt(variance.mean() + self.views**2)) if len(variance) else self.views

    def minus(self, shape: Floats) -> Field:
        """Return the field less a shape (cells,)."""
        return dataclasses.replace(self, deviation=self.deviation - shape)

    def without(self, cells: Ints) -> Field:
        """Return the field with some cells not seen."""
        seen = self.seen.copy()
        seen[cells] = 0.0
        return dataclasses.replace(self, seen=seen)


def of_pairs(pairs: Pairs, surface: DesignSurface, stations: Views, alignment: Alignment, inner: Floats) -> Field:
    """Combine the observations of all stations by cell, corrected by the alignment. ``inner`` (cells,): see Field."""
    cells = len(surface.share)
    correction = np.empty(len(pairs.cell))
    for part in tiles.ranges(len(correction), PAIRS_AT_ONCE):
        cell, station = pairs.cell[part], pairs.station[part]
        points, outward = surface.centres[cell], surface.outward[cell]
        rays = rays_to(points, stations.positions[station])
        correction[part] = alignment.corrections(points, outward, rays, station)
    count = np.bincount(pairs.cell, pairs.count, cells).astype(np.float64)
    divisor = np.maximum(count, 1.0)
    mean = np.bincount(pairs.cell, pairs.count * (pairs.mean - correction), cells) / divisor
    noise, dof = _noise(pairs, surface, count)
    stray, mixed = (np.bincount(pairs.cell, x, cells) for x in (pairs.stray, pairs.mixed))
    charts = surface.charts
    variance, seen = noise**2 / divisor, inner * ((count + stray - mixed >= FEWEST_POINTS) & (count > 0))
    for chart in range(len(charts.kind)):
        rows = charts.cells(chart)
        # What lies alone on a face are beams past its edges: half of the cells about a cell are to be seen.
        images = charts.image(seen, chart), charts.image(inner, chart)
        about, possible = (_pooled(image, charts, chart, ABOUT_CELLS) for image in images)
        seen[rows] *= (about > SEEN_SHARE * possible - 1e-9).ravel()
    used, side = np.flatnonzero(seen * count), PIECE_CELLS * charts.cell_mm
    # What all sides lie outward by, as by a layer of paint, is no difference of views that are named.
    common = 0.0 if stations.unnamed or not len(used) else float(np.median(mean[used]))
    of_views = view_error_from_opposite_sides.view_sd(
        surface.centres[used], surface.outward[used], mean[used] - common, variance[used], side
    )
    of_stations = station_variance(pairs, surface, stations, alignment)
    return Field(
        surface=surface,
        alignment=alignment,
        deviation=mean,
        variance=variance,
        count=count.astype(np.int64),
        stray=stray.astype(np.int64),
        noise=noise,
        inner=inner,
        seen=seen,
        stations=of_stations,
        stations_free=of_stations if alignment.fitted else station_variance(pairs, surface, stations, alignment, True),
        views=of_views if stations.unnamed else 0.0,
        drift=0.0 if stations.unnamed else of_views,
        dof=dof,
    )


def common_bias(field: Field) -> float:
    """Return what all components lie outward of the design by, mm, as by a bias that all surfaces have.

    0 where they do not agree on it, where it is more than the scanners of the class explain, or where most of what was
    seen faces one way: there it is a movement.
    """
    surface, seen = field.surface, np.flatnonzero(field.seen * field.count)
    weight = surface.share[seen]
    if np.linalg.norm(weight @ surface.outward[seen]) > ONE_WAY * weight.sum():
        return 0.0
    component = surface.component[seen]
    bodies = [number for number in np.unique(component) if (component == number).sum() >= BODY_CELLS]
    level = np.array([np.median(field.deviation[seen[component == number]]) for number in bodies])
    if len(level) < FEWEST_BODIES:
        return 0.0
    bias, sd = float(np.median(level)), robust_sd_about_median(level) / float(np.sqrt(len(level)))
    return bias if SURE * sd < abs(bias) < NORMAL_95 * scanner_class_errors.known().incidence_mm else 0.0


def _noise(pairs: Pairs, surface: DesignSurface, count: Floats) -> tuple[Floats, Floats]:
    """Return the standard deviation (cells,) of one point in each cell, mm, and the degrees of freedom of its square.

    Noise differs between stations, by range and incidence: where a near one sees most of a face, and a far one alone a
    cell of it, the noise of the face's points is not that of the cell's. Each station has a variance on each face. What
    the scatter about a cell differs from these is a factor on them.
    """
    charts, of_cell = surface.charts, surface.chart
    chart = of_cell[pairs.cell]
    stations = int(pairs.station.max(initial=0)) + 1
    free = np.maximum(pairs.count - 1, 0).astype(np.float64)
    overall = float(pairs.square.sum() / max(free.sum(), 1.0))  # of a station that hardly shows its own
    variance, dof = np.full(len(free), overall), np.full(len(free), LOCAL_FREE)
    for station in range(stations):
        rows = pairs.station == station
        square_of, free_of = (
            np.bincount(chart[rows], x[rows], len(charts.kind)).astype(np.float64) for x in (pairs.square, free)
        )
        if free_of.sum() > LOCAL_FREE:
            known = moderated_variances.moderated(square_of, free_of)
            variance[rows], dof[rows] = (x[chart[rows]] for x in known)
    cells, part = len(surface.share), pairs.count * variance
    total, observed, expected, local = (
        np.bincount(pairs.cell, x, cells).astype(np.float64) for x in (part, pairs.square, free * variance, free)
    )
    # Satterthwaite's degrees of freedom of a sum of variances.
    spread = np.bincount(pairs.cell, part**2 / np.maximum(dof, 1.0), cells)
    factor = np.ones(cells)
    for k in range(len(charts.kind)):
        squares, wanted, frees = (_pooled(charts.image(x, k), charts, k) for x in (observed, expected, local))
        ratio = squares / np.maximum(wanted, 1e-12)
        weight = frees * POOLED_CELLS**2
        factor[charts.cells(k)] = ((LOCAL_FREE + weight * ratio) / (LOCAL_FREE + weight)).ravel()
    # Of a cell without points it is the noise of its face.
    sums, numbers = (np.bincount(chart, x, len(charts.kind)) for x in (part, pairs.count))
    of_face = np.where(numbers > 0.0, sums / np.maximum(numbers, 1.0), overall)
    mean = np.where(count > 0.0, total / np.maximum(count, 1.0), of_face[of_cell])
    noise = np.sqrt(np.maximum(mean * factor, 1e-6))
    return noise, total**2 / np.maximum(spread, 1e-12)


def _pooled(image: Floats, charts: Charts, chart: int, side: int = POOLED_CELLS) -> Floats:
    """Return the means of an image over squares of ``side`` cells."""
    mode = ("constant", "wrap" if charts.kind[chart] == CYLINDER else "constant")
    mean: Floats = ndimage.uniform_filter(image, side, mode=mode)
    return np.maximum(mean, 0.0)


def inner_cells(surface: DesignSurface, edge_mm: float) -> Floats:
    """Return 1 for cells (cells,) of which all samples lie ``edge_mm`` or more from where their face is no longer seen.

    It ends where another body touches it, too: beams at a contact hit both bodies. Other cells have 0.
    """
    charts, exposed = surface.charts, surface.covered & ~surface.hidden
    inner, sample = np.zeros(len(surface.share)), charts.cell_mm / PER_SIDE
    for chart, (rows, columns) in enumerate(charts.shape):
        whole = exposed[charts.cells(chart)].reshape(rows, columns, PER_SIDE, PER_SIDE).transpose(0, 2, 1, 3)
        whole = np.pad(whole.reshape(rows * PER_SIDE, columns * PER_SIDE), 1)
        closed = charts.kind[chart] == CYLINDER  # no border at the seam
        if closed:
            whole[:, 0], whole[:, -1] = whole[:, -2], whole[:, 1]
            whole = np.concatenate([whole, whole, whole], axis=1)
        distance = ndimage.distance_transform_edt(whole, sampling=sample) - 0.5 * sample
        if closed:
            wide = columns * PER_SIDE + 2
            distance = distance[:, wide : 2 * wide]
        clear = (distance[1:-1, 1:-1] >= edge_mm).reshape(rows, PER_SIDE, columns, PER_SIDE)
        inner[charts.cells(chart)] = clear.all(axis=(1, 3)).ravel()
    return inner
