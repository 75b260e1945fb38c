"""The deviations about each defect on a small grid, for a picture, and over the whole surface, for a view in space."""

from __future__ import annotations

from typing import Any

import numpy as np

from processor.defects.alignment import chart_of_cells
from processor.defects.deviation_field import Field
from processor.defects.surface_charts import DesignSurface
from processor.model import NORMAL_95, Floats, Ints

MOST_SIDE = 120  # cells of a picture
MARGIN = 0.6  # of a defect's extent that is shown beside it
LEAST_CELLS = 12
SAME_WAY = 0.5
MOST_PLACES = 50_000  # of the whole surface
SMALL_PLACES, MOST_SMALL_PLACES = 400, 10_000  # of one defect that is not thinned, and of all such


def of_surface(defects: list[Ints], field: Field, surface: DesignSurface, most: int = MOST_PLACES) -> dict[str, Any]:
    """Return the columns of places all over the surface; ``defects`` are the cells of each.

    Of every face each s-th row and column of cells is taken, s the same for all; of small defects every cell.
    """
    charts = surface.charts
    chart = chart_of_cells(surface)
    own = np.full(len(chart), -1, np.int32)
    for row in sorted(range(len(defects)), key=lambda row: -len(defects[row])):  # the small ones lie on the large ones
        own[defects[row]] = row
    seen = (field.count > 0) & (surface.share > 0.3)
    along, across = np.divmod(np.arange(len(chart)) - charts.first[chart], charts.shape[chart, 1])
    step = max(1, int(np.sqrt(seen.sum() / most)))
    while (
        kept := seen & _each(along, charts.shape[chart, 0], step) & _each(across, charts.shape[chart, 1], step)
    ).sum() > most:
        step += 1
    room = MOST_SMALL_PLACES
    for cells in defects:
        if len(cells) <= min(SMALL_PLACES, room):
            room -= len(cells)
            kept[cells] = seen[cells]
    return {
        "surface_at": surface.centres[kept], "surface_mm": field.deviation[kept], "surface_defect": own[kept],
    }  # fmt: skip


def _each(index: Ints, count: Ints, step: int) -> Any:
    """Mark each ``step``-th index; of a face with fewer rows than that, the middle one."""
    return index % step == np.minimum(step, count) // 2


def of_rows(rows: list[tuple[Floats, Ints, Field, int]], surface: DesignSurface, most: int) -> dict[str, Any]:
    """Return the columns of pictures of the first ``most`` defects: centre, cells, field and component of each."""
    shapes, lows, cells, values, parts = [], [], [], [], []
    chart = chart_of_cells(surface)
    component = surface.charts.component[chart]
    for centre, own, field, number in rows[:most]:
        out = surface.outward[own].mean(axis=0)
        near = np.flatnonzero((component == number) & (surface.outward @ out > SAME_WAY) & (surface.share > 0.3))
        # Along the cells of the face that it lies on: a turned grid would leave gaps.
        frame = surface.charts.axes[chart[own[len(own) // 2]]]
        side = np.cross(out / np.linalg.norm(out), frame[0])
        axes = np.stack([frame[0], side])
        here = (surface.centres[own] - centre) @ axes.T
        low, high = here.min(axis=0), here.max(axis=0)
        margin = np.maximum(MARGIN * (high - low), LEAST_CELLS * surface.charts.cell_mm)
        low, high = low - margin, high + margin
        uv = (surface.centres[near] - centre) @ axes.T
        shown = ((uv >= low) & (uv <= high)).all(axis=1)
        near, uv = near[shown], uv[shown]
        cell = surface.charts.cell_mm
        low, high = np.maximum(low, uv.min(axis=0)), np.minimum(high, uv.max(axis=0))
        size = cell * max(1.0, np.ceil(float((high - low).max()) / MOST_SIDE / cell))
        low = uv.min(axis=0) - 0.5 * cell
        shape = np.maximum(np.ceil((high - low) / size).astype(np.int64) + 1, 1)
        at = np.clip(((uv - low) / size).astype(np.int64), 0, shape - 1)
        flat = at[:, 0] * shape[1] + at[:, 1]
        total = int(shape.prod())
        weight = np.where(field.count[near] > 0, 1.0 / field.variance[near], 0.0)
        sums = np.bincount(flat, weight, total)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.bincount(flat, weight * field.deviation[near], total) / sums
        part = np.zeros(total, np.int32)
        part[flat[np.isin(near, own)]] = 1
        shapes.append(shape)
        lows.append(low)
        cells.append(size)
        values.append(mean)
        parts.append(part)
    return {
        "picture_defect": np.arange(len(shapes)),
        "picture_shape": np.array(shapes).reshape(-1, 2),
        "picture_low": np.array(lows).reshape(-1, 2),
        "picture_cell_mm": np.array(cells),
        "picture_mm": np.concatenate([[], *values]),
        "picture_part": np.concatenate([[], *parts]),
    }


# --- The deflection curve of a bent member: by strips along it, and by slopes of sub-regions as in paper 004.


def by_strips(along: Floats, deviation: Floats, variance: Floats, strips: int) -> tuple[Floats, Floats, Floats]:
    """Middles (s,), weighted means (s,) and 95 % half-widths (s,) of deviations by strips of places ``along`` (n,).

    Strips without points are left out.
    """
    edges = np.linspace(along.min(), along.max(), strips + 1)
    index = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, strips - 1)
    w = 1.0 / variance
    total = np.bincount(index, w, strips)
    used = total > 0.0
    some = np.where(used, total, 1.0)
    at, mean = np.bincount(index, w * along, strips) / some, np.bincount(index, w * deviation, strips) / some
    return at[used], mean[used], NORMAL_95 / np.sqrt(some[used])


def by_slopes(along: Floats, deviation: Floats, strips: int) -> tuple[Floats, Floats]:
    """Return ends of sub-regions (s + 1,) and displacement there (s + 1,), zero at the first (paper 004).

    Of each sub-region s the slope tan(theta) of a line through its points is taken, and integrated over its length h:
    mu_s(h) = int tan(theta) dh + mu_(s-1). A sub-region of fewer than two places keeps the slope before it.
    """
    edges = np.linspace(along.min(), along.max(), strips + 1)
    index = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, strips - 1)
    slopes = np.zeros(strips)
    for s in range(strips):
        x, y = along[index == s], deviation[index == s]
        if len(x) >= 2 and np.ptp(x) > 0.0:
            arm = x - x.mean()
            slopes[s] = float(arm @ (y - y.mean()) / (arm @ arm))
        elif s:
            slopes[s] = slopes[s - 1]
    return edges, np.concatenate([[0.0], np.cumsum(slopes * np.diff(edges))])
