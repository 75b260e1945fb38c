"""Small dents and pits: a bump fitted to the points themselves, for cells are too coarse to tell their depth."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from processor.defects.alignment import Alignment, rays_to
from processor.defects.fields import Field
from processor.defects.measures import Measures
from processor.defects.observed import Observed, cells_of
from processor.defects.regions import Region, flat
from processor.defects.surface import DesignSurface
from processor.model import NORMAL_95, Floats, Ints

MARGIN_CELLS = 2
FEWEST_POINTS = 12
ROBUST = 2.0  # standard deviations of a point, from which on it counts less


@dataclass(frozen=True)
class Near:
    """The points of a scene in the order of their cells, to be had by place."""

    seen: Observed
    surface: DesignSurface
    alignment: Alignment
    order: Ints
    cell: Ints  # (n,) sorted

    def of(self, region: Region, shape_values: Floats) -> tuple[Floats, Floats]:
        """Places u, v (n, 2) about a region and deviations (n,), less what stations are off and shapes, mm."""
        charts, chart = self.surface.charts, region.chart
        wide = charts.shape[chart, 1]
        at = region.cells - charts.first[chart]
        i, j = at // wide, at % wide
        rows = np.arange(max(0, i.min() - MARGIN_CELLS), min(charts.shape[chart, 0], i.max() + MARGIN_CELLS + 1))
        start = charts.first[chart] + rows * wide + max(0, j.min() - MARGIN_CELLS)
        stop = charts.first[chart] + rows * wide + min(wide, j.max() + MARGIN_CELLS + 1)
        first, last = np.searchsorted(self.cell, start), np.searchsorted(self.cell, stop)
        own = np.concatenate([[], *(np.arange(a, b) for a, b in zip(first, last, strict=True))]).astype(np.int64)
        points, cell = self.order[own], self.cell[own]
        centres, outward = self.surface.centres[cell], self.surface.outward[cell]
        station = self.seen.station[points]
        rays = rays_to(centres, self.seen.stations.positions[station])
        off = self.alignment.corrections(centres, outward, rays, station)
        return self.seen.uv[points], self.seen.deviation[points] - off - shape_values[cell]


def near_of(seen: Observed, surface: DesignSurface, alignment: Alignment) -> Near:
    """Sort the points of a scene by their cells."""
    cell = cells_of(seen, surface)
    order = np.argsort(cell, kind="stable")
    return Near(seen, surface, alignment, order, cell[order])


def refined(got: Measures, region: Region, near: Near, field: Field, shape_values: Floats) -> Measures:
    """Return measures with the depth of a bump d (1 - r^2 / R^2)^2 fitted to points; as they were where none fits."""
    uv, deviation = near.of(region, shape_values)
    middle = flat(near.surface, region).mean(axis=0)
    radius = max(0.5 * got.diameter, near.surface.charts.cell_mm)
    noise = float(np.median(field.noise[region.cells]))
    use = np.abs(deviation) < 3.0 * abs(got.depth) + 6.0 * noise
    uv, deviation = (uv[use] - middle) / radius, deviation[use]
    if len(deviation) < FEWEST_POINTS:
        return got

    def bump(x: Floats) -> Floats:
        away = ((uv[:, 0] - x[0]) ** 2 + (uv[:, 1] - x[1]) ** 2) / x[2] ** 2
        found: Floats = -x[3] * np.maximum(1.0 - away, 0.0) ** 2
        return found

    low, high = [-1.5, -1.5, 0.3, -np.inf], [1.5, 1.5, 3.0, np.inf]
    fit = least_squares(
        lambda x: (deviation - bump(x)) / noise, [0.0, 0.0, 1.3, got.depth], bounds=(low, high), loss="soft_l1",
        f_scale=ROBUST,
    )  # fmt: skip
    try:
        sd = float(np.sqrt(np.linalg.inv(fit.jac.T @ fit.jac)[3, 3]))
    except np.linalg.LinAlgError:
        return got
    depth = float(fit.x[3])
    if not fit.success or depth * got.depth <= 0.0 or not sd < 0.5 * abs(depth) or abs(depth) > 4.0 * abs(got.depth):
        return got
    curvature = 4.0 * abs(depth) / (fit.x[2] * radius) ** 2 * 1000.0
    return dataclasses.replace(got, depth=depth, depth_ci95=NORMAL_95 * sd, curvature=curvature)
