"""The other side of a plate: a dent moves it as well, where a pit takes material from one side alone.

A plate that is dented shows it on both sides where both were seen: that is one defect, not a dent and a bulge.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from processor.defects.deviation_field import Field
from processor.defects.observations import cells_at
from processor.defects.surface_charts import DesignSurface
from processor.geometry import mesh_distance
from processor.model import Floats, Ints

PLATE_MM = 80.0  # largest thickness of a plate, whose other side is compared
OPPOSITE_COS = -0.95  # of the normals of the two sides of a plate
LEAST_SHARE = 0.5  # of a place's cells, whose other side was seen
BORDER_CELLS = 1.6  # about a place, which are too shallow to be significant one by one
FORM_SHARE = 0.25  # of the depth, by which the two sides of a dent may differ in form (one standard deviation)
MOST_EVIDENCE = 20.0  # of the logarithm of a ratio of likelihoods


def stayed(field: Field, cells: Ints) -> float:
    """Return the probability that the other side of a plate did not move with ``cells`` (n,); NaN if it was not seen.

    Either it stayed, or it moved by as much; both are as likely beforehand.
    """
    cells = cells[field.seen[cells] > 0.0]
    other = cells_opposite(field.surface, cells)
    known = (other >= 0) & (field.seen[other] > 0.0)
    if not len(cells) or known.mean() < LEAST_SHARE:
        return float("nan")
    depth = -float(field.deviation[cells[known]].mean())
    moved = float(field.deviation[other[known]].mean())
    noise = float(field.variance[other[known]].mean()) / int(known.sum())
    common = sum(field.stations_sd(side) ** 2 for side in (cells[known], other[known]))
    variance = noise + common + (FORM_SHARE * depth) ** 2
    evidence = np.clip(0.5 * ((moved - depth) ** 2 - moved**2) / variance, -MOST_EVIDENCE, MOST_EVIDENCE)
    return float(1.0 / (1.0 + np.exp(-evidence)))


def is_behind(surface: DesignSurface, cells: Ints, place: Ints) -> bool:
    """Return whether most of ``cells`` (n,) have a ``place`` (m,), or its border, on the other side of their plate."""
    other = cells_opposite(surface, cells)
    away = cKDTree(surface.centres[place]).query(surface.centres[other[other >= 0]])[0]
    near = away < BORDER_CELLS * surface.charts.cell_mm
    return bool(near.sum() >= LEAST_SHARE * len(cells))


def cells_opposite(surface: DesignSurface, cells: Ints) -> Ints:
    """Return the cell (n,) on the other side of the plate at each of ``cells`` (n,); -1 where there is no plate."""
    starts: Floats = surface.centres[cells] - 1e-3 * surface.outward[cells]
    ends = surface.centres[cells] - PLATE_MM * surface.outward[cells]
    row, facet, part = mesh_distance.crossings(surface.sight_grid, starts, ends, False)
    facing = np.einsum("ni,ni->n", surface.normals[facet], surface.outward[cells[row]]) < OPPOSITE_COS
    row, facet, part = row[facing], facet[facing], part[facing]
    order = np.lexsort([part, row])
    row, facet, part = row[order], facet[order], part[order]
    first = np.unique(row, return_index=True)[1]
    row, facet, part = row[first], facet[first], part[first]
    other = np.full(len(cells), -1, np.int64)
    places = starts[row] + part[:, None] * (ends[row] - starts[row])
    other[row] = cells_at(surface, surface.chart_of[facet], places)
    return other
