"""Deviations of cells with their uncertainty, on images of the faces."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from processor.defects.alignment import Alignment, chart_of_cells, rays_to
from processor.defects.observations import FEW, Pairs, Stations
from processor.defects.surface_charts import CYLINDER, Charts, DesignSurface
from processor.model import Floats, Ints

POOLED_CELLS = 9  # side of the square over which noise is pooled
FEWEST_FREE = 20.0  # degrees of freedom below which the noise of all is used


@dataclass(frozen=True)
class Field:
    """Of each cell (cells,): deviation (mm, outward), its variance from noise, points, points that do not fit.

    ``inner`` are the cells away from their face's border, ``seen`` those of them with enough points to count.
    """

    deviation: Floats
    variance: Floats
    count: Ints
    stray: Ints
    noise: Floats  # standard deviation of one point
    inner: Floats  # 0 or 1
    seen: Floats  # 0 or 1

    def less(self, fitted: Floats) -> Field:
        """Return the field with a shape (cells,) taken off."""
        return dataclasses.replace(self, deviation=self.deviation - fitted)

    def without(self, rows: Ints) -> Field:
        """Return the field with some cells not counted."""
        seen = self.seen.copy()
        seen[rows] = 0.0
        return dataclasses.replace(self, seen=seen)


def of_pairs(pairs: Pairs, surface: DesignSurface, stations: Stations, alignment: Alignment, edge_mm: float) -> Field:
    """Put together what the stations say of each cell, after what they are off was taken off."""
    cells = len(surface.share)
    points, outward = surface.centres[pairs.cell], surface.outward[pairs.cell]
    off = alignment.corrections(points, outward, rays_to(points, stations.positions[pairs.station]), pairs.station)
    count = np.bincount(pairs.cell, pairs.count, cells)
    some = np.maximum(count, 1.0)
    mean = np.bincount(pairs.cell, pairs.count * (pairs.mean - off), cells) / some
    free = np.bincount(pairs.cell, np.maximum(pairs.count - 1, 0), cells)
    square = np.bincount(pairs.cell, pairs.square, cells)
    sums: tuple[Floats, Floats] = (square.astype(np.float64), free.astype(np.float64))
    charts = surface.charts
    noise = np.zeros(cells)
    overall = float(square.sum() / max(free.sum(), 1.0))
    inner = np.zeros(cells)
    for chart in range(len(charts.kind)):
        rows = charts.cells(chart)
        pooled = [_box(charts.image(x, chart), charts, chart) for x in sums]
        known = pooled[1] * POOLED_CELLS**2 > FEWEST_FREE
        noise[rows] = np.where(known, pooled[0] / np.maximum(pooled[1], 1e-9), overall).ravel()
        inner[rows] = _inner(charts.image(surface.share, chart), charts, chart, edge_mm).ravel()
    noise = np.sqrt(np.maximum(noise, 1e-6))
    stray = np.bincount(pairs.cell, pairs.stray, cells)
    return Field(mean, noise**2 / some, count.astype(np.int64), stray.astype(np.int64), noise, inner,
                 inner * (count + stray >= FEW))  # fmt: skip


def _mode(charts: Charts, chart: int) -> tuple[str, str]:
    return ("constant", "wrap" if charts.kind[chart] == CYLINDER else "constant")


def _box(image: Floats, charts: Charts, chart: int) -> Floats:
    found: Floats = ndimage.uniform_filter(image, POOLED_CELLS, mode=_mode(charts, chart))
    return np.maximum(found, 0.0)


def _inner(share: Floats, charts: Charts, chart: int, edge_mm: float) -> Floats:
    """Mark cells that lie wholly on their face and ``edge_mm`` or more from its border."""
    whole = np.pad(share > 0.99, 1)
    if charts.kind[chart] == CYLINDER:  # no border at the seam
        whole[:, 0], whole[:, -1] = whole[:, -2], whole[:, 1]
        whole = np.concatenate([whole, whole, whole], axis=1)
    away = ndimage.distance_transform_edt(whole, sampling=charts.cell_mm) - 0.5 * charts.cell_mm
    if charts.kind[chart] == CYLINDER:
        wide = share.shape[1] + 2
        away = away[:, wide : 2 * wide]
    found: Floats = (away[1:-1, 1:-1] >= edge_mm).astype(float)
    return found


def component_of_cells(surface: DesignSurface) -> Ints:
    """Return the component (cells,) of each cell."""
    found: Ints = surface.charts.component[chart_of_cells(surface)]
    return found
