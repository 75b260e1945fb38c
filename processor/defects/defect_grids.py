"""Deviations about each defect on a small grid, over the whole surface thinned, and along bent members."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.defects.deviation_field import Field
from processor.defects.result import Curve, Picture, SurfacePlaces
from processor.model import NORMAL_95, Floats, Ints

MOST_SIDE = 120  # cells of a picture
MARGIN = 0.6  # of a defect's extent, shown beside it
LEAST_MARGIN_CELLS = 12  # of a picture: a small defect is seen with what is about it
SAME_SIDE_COS = 0.5  # between the defect's mean normal and that of a cell shown
LEAST_SHARE = 0.3  # of a cell that the face covers
MOST_PLACES = 50_000  # of the whole surface
SMALL_PLACES, MOST_SMALL_PLACES = 400, 10_000  # of one defect that is not thinned, and of all such


def of_surface(defects: Sequence[Ints], field: Field, origin: Floats, most: int = MOST_PLACES) -> SurfacePlaces:
    """Return places all over the surface, shifted by ``origin`` (3,); ``defects`` are the cells of each defect.

    Of every face each s-th row and column of cells is taken, s the same for all; of small defects every cell.
    """
    surface, charts, chart = field.surface, field.surface.charts, field.surface.chart
    defect_of = np.full(len(chart), -1, np.int32)
    for row in sorted(range(len(defects)), key=lambda row: -len(defects[row])):  # small ones on top of large ones
        defect_of[defects[row]] = row
    measured = (field.count > 0) & (surface.share > LEAST_SHARE)
    along, across = np.divmod(np.arange(len(chart)) - charts.first[chart], charts.shape[chart, 1])
    step = max(1, int(np.sqrt(measured.sum() / most)))
    while (
        drawn := measured & _each(along, charts.shape[chart, 0], step) & _each(across, charts.shape[chart, 1], step)
    ).sum() > most:
        step += 1
    room = MOST_SMALL_PLACES
    for cells in defects:
        if len(cells) <= min(SMALL_PLACES, room):
            room -= len(cells)
            drawn[cells] = measured[cells]
    return SurfacePlaces(
        points=surface.centres[drawn] + origin, deviation=field.deviation[drawn], defect=defect_of[drawn]
    )


def _each(index: Ints, count: Ints, step: int) -> Any:
    """Mark each ``step``-th index; of a face with fewer rows than that, the middle one."""
    return index % step == np.minimum(step, count) // 2


def of_defects(defects: Sequence[tuple[Floats, Ints, Field, int]]) -> tuple[Picture, ...]:
    """Return a picture of each defect, given by its centre (3,), cells, deviations and component.

    A picture is empty if no cell of the component faces the way that the defect's cells do on average.
    """
    pictures = []
    for centre, cells, field, number in defects:
        surface = field.surface
        outward = surface.outward[cells].mean(axis=0)
        same_side = (surface.component == number) & (surface.outward @ outward > SAME_SIDE_COS)
        # Along the cells of the defect's face: a rotated grid would have gaps.
        along = surface.charts.axes[surface.chart[cells[len(cells) // 2]], 0]
        shown = np.flatnonzero(same_side & (surface.share > LEAST_SHARE))
        pictures.append(_picture(centre, cells, shown, along, outward, field) if len(shown) else Picture())
    return tuple(pictures)


def _picture(centre: Floats, cells: Ints, facing: Ints, along: Floats, outward: Floats, field: Field) -> Picture:
    surface = field.surface
    axes = np.stack([along, np.cross(outward / np.linalg.norm(outward), along)])
    extent = (surface.centres[cells] - centre) @ axes.T
    low, high = extent.min(axis=0), extent.max(axis=0)
    cell = surface.charts.cell_mm
    margin = np.maximum(MARGIN * (high - low), LEAST_MARGIN_CELLS * cell)
    low, high = low - margin, high + margin
    uv = (surface.centres[facing] - centre) @ axes.T
    inside = ((uv >= low) & (uv <= high)).all(axis=1)
    if not inside.any():
        return Picture()
    facing, uv = facing[inside], uv[inside]
    low, high = np.maximum(low, uv.min(axis=0)), np.minimum(high, uv.max(axis=0))
    size = cell * max(1.0, np.ceil(float((high - low).max()) / MOST_SIDE / cell))
    low = uv.min(axis=0) - 0.5 * cell
    shape = np.maximum(np.ceil((high - low) / size).astype(np.int64) + 1, 1)
    index = np.clip(((uv - low) / size).astype(np.int64), 0, shape - 1)
    flat = index[:, 0] * shape[1] + index[:, 1]
    total = int(shape.prod())
    weight = np.where(field.count[facing] > 0, 1.0 / field.variance[facing], 0.0)
    sums = np.bincount(flat, weight, total)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(flat, weight * field.deviation[facing], total) / sums
    part = np.zeros(total, np.uint8)
    part[flat[np.isin(facing, cells)]] = 1
    return Picture(low=low, cell=float(size), deviation=mean.reshape(shape), part=part.reshape(shape))


# --- The deflection curve of a bent member: by strips along it, and by slopes of sub-regions as in paper 004.


def by_strips(along: Floats, deviation: Floats, variance: Floats, strips: int) -> Curve:
    """Return the weighted means of deviations by strips of positions ``along`` (n,), mm, with 95 % half-widths.

    Strips without points are left out.
    """
    index = _strip_of(along, strips)[1]
    weight = 1.0 / variance
    total = np.bincount(index, weight, strips)
    used = total > 0.0
    divisor = np.where(used, total, 1.0)
    middle = np.bincount(index, weight * along, strips) / divisor
    mean = np.bincount(index, weight * deviation, strips) / divisor
    return Curve(along=middle[used], displacement=mean[used], ci95=NORMAL_95 / np.sqrt(divisor[used]))


def by_slopes(along: Floats, deviation: Floats, strips: int) -> Curve:
    """Return the displacement at the ends of sub-regions, zero at the first (paper 004); no intervals.

    The slope tan(theta) of a line through the points of each sub-region s is integrated over its length h:
    mu_s(h) = int tan(theta) dh + mu_(s-1). A sub-region of fewer than two positions keeps the slope before it.
    """
    edges, index = _strip_of(along, strips)
    slopes = np.zeros(strips)
    for s in range(strips):
        x, y = along[index == s], deviation[index == s]
        if len(x) >= 2 and np.ptp(x) > 0.0:
            arm = x - x.mean()
            slopes[s] = float(arm @ (y - y.mean()) / (arm @ arm))
        elif s:
            slopes[s] = slopes[s - 1]
    displacement = np.concatenate([[0.0], np.cumsum(slopes * np.diff(edges))])
    return Curve(along=edges, displacement=displacement, ci95=np.full(len(edges), np.nan))


def _strip_of(along: Floats, strips: int) -> tuple[Floats, Ints]:
    """Return the edges (s + 1,) of strips of equal width, and the strip (n,) of each position."""
    edges = np.linspace(along.min(), along.max(), strips + 1)
    index: Ints = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, strips - 1)
    return edges, index
