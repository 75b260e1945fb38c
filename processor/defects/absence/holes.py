"""Holes in plates, by the steel around them: places that must be seen wherever their surroundings are seen.

An empty place on a face may be missing, or in the shadow of something from all stations. Steel of the design cannot
shade it if the place can be seen along every direction along which its seen surroundings can. Something that is not of
the design may: a place counts as missing only where both sides of the plate are empty, which a shadow of one station
does not do. The number of points to be expected follows from the density around.

Cells at a border of their face are no evidence by themselves, as filters of mixed points remove edges. They are
compared with other cells at the same border: a bite has steel beside it along the border at either end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from processor.defects.deviation_field import Field
from processor.defects.places import other_side
from processor.defects.regions import EMPTY_SHARE, Region, chernoff
from processor.defects.scan_statistic import EIGHT_NEIGHBOURS
from processor.defects.surface_charts import PLANE, DesignSurface
from processor.geometry import mesh_distance
from processor.model import Bools, Floats, Ints

BEFORE_MM = 1.0  # start of a line of sight above the face
DIRECTIONS = 400  # about a face, 5 degrees apart
LEAST_COS = 0.2  # of incidence, as of points that are used
LOST_SHARE = 0.05  # of a seen place's directions, that one beside it may lack: 1 of 400 that both sides lie in shade
RING_CELLS = 3  # about an empty region: its surroundings
FEWEST_RING = 4  # cells of the surroundings
ENDS = 2  # of a bite along a border
BORDER_SHARE = 0.25  # of a cell at a border that lies on the face: on less, hardly a point is expected
MOST_RING, MOST_CORE = 24, 60  # cells whose lines of sight are compared
EXPOSED_SHARE = 0.5  # of the surroundings, from which a place can be seen as well
LOW_QUANTILE = 0.25  # of the densities around: what is counted on
SLIM = 4.0  # length of a strip along a border by its width: edges that a filter removed
DEEP_CELLS = 2.0  # width of a place, from which on it is no such strip: borders themselves are not examined
FEWEST_BEYOND = 100  # points beyond a place: where the cloud ends, it may have been cropped
FEWEST_PAIRS = 30  # of cells side by side, to estimate the scatter of numbers of points from


@dataclass(frozen=True)
class _Hole:
    """An empty place on one side of a plate: its cells, those that are examined, and the points expected on these.

    ``bitten``: cells at a border are among them, with steel along the border at either end.
    """

    chart: int
    cells: Ints
    core: Ints
    bitten: bool
    expected: float
    counted: float
    spread: float  # variance of a number of points by that of a Poisson distribution


def holes(field: Field, points: Floats, alarms_per_mm2: float) -> list[Region]:
    """Return the empty places of plates of which both sides must have been seen; ``points`` (n, 3) are of the cloud."""
    surface, count = field.surface, (field.count + field.stray).astype(np.float64)
    opposite: dict[int, int] = {}
    found: list[_Hole] = []
    for chart in np.flatnonzero(surface.charts.kind == PLANE):
        for cells, ring in _empty_regions(field, count, int(chart)):
            hole = _hole(field, count, int(chart), cells, ring)
            if hole is None or not (hole.bitten or _is_beyond(surface, hole, ring, points)):
                continue
            other = other_side.cells_opposite(surface, hole.core)
            if (other < 0).all() or not _is_exposed(surface, hole.core, ring):
                continue
            opposite |= dict(zip(hole.core.tolist(), other.tolist(), strict=True))
            found.append(hole)
    return _both_sides(found, opposite, surface, alarms_per_mm2)


def _both_sides(
    found: list[_Hole], opposite: dict[int, int], surface: DesignSurface, alarms_per_mm2: float
) -> list[Region]:
    """Return the holes that both sides of a plate show, where so few points are improbable on both together."""
    empty = {cell: row for row, hole in enumerate(found) for cell in hole.cells.tolist()}
    regions, cell_mm2 = [], surface.charts.cell_mm**2
    for hole in found:
        behind = np.array([opposite[cell] for cell in hole.core.tolist()])
        rows = np.array([empty.get(cell, -1) for cell in behind.tolist()])
        if np.mean(rows >= 0) < EXPOSED_SHARE:
            continue
        strength = _strength(hole, 1.0)
        for row, number in zip(*np.unique(rows[rows >= 0], return_counts=True), strict=True):
            strength += _strength(found[row], min(1.0, number / len(found[row].core)))
        if strength > -np.log(alarms_per_mm2 * cell_mm2):
            chance = float(np.exp(-strength)) / cell_mm2
            regions.append(Region(hole.chart, hole.cells, 0, float(np.sqrt(2.0 * strength)), chance))
    return regions


def _strength(hole: _Hole, part: float) -> float:
    """Return less the logarithm of the probability of so few points on a part of an empty place."""
    return chernoff(part * hole.expected, part * hole.counted, more=False) / hole.spread


def _empty_regions(field: Field, count: Floats, chart: int) -> list[tuple[Ints, Ints]]:
    """Return connected empty cells of a face, each with the seen cells about them."""
    charts, first = field.surface.charts, int(field.surface.charts.first[chart])
    inner, seen, share = (charts.image(x, chart) for x in (field.inner, field.seen, field.surface.share))
    number = charts.image(count, chart)
    on = (inner > 0.0) & (seen > 0.0)
    if on.sum() < FEWEST_RING:
        return []
    low = float(np.quantile(number[on] / share[on], LOW_QUANTILE))
    empty = (share > 0.0) & (number <= EMPTY_SHARE * low * share)
    label, regions = ndimage.label(empty, EIGHT_NEIGHBOURS)
    found = []
    for k, box in enumerate(ndimage.find_objects(label, regions), start=1):
        if box is None:
            continue
        wide = tuple(slice(max(part.start - RING_CELLS, 0), part.stop + RING_CELLS) for part in box)
        mask = label[wide] == k
        if mask.sum() > on.sum():  # less of the face was seen than is empty here
            continue
        about = ndimage.binary_dilation(mask, EIGHT_NEIGHBOURS, RING_CELLS) & on[wide] & ~mask
        rows = [np.flatnonzero(_placed(part, wide, label.shape)) + first for part in (mask, about)]
        if len(rows[1]) >= FEWEST_RING:
            found.append((rows[0], rows[1]))
    return found


def _placed(mask: Bools, box: tuple[slice, ...], shape: tuple[int, ...]) -> Bools:
    whole = np.zeros(shape, np.bool_)
    whole[box] = mask
    return whole


def _hole(field: Field, count: Floats, chart: int, cells: Ints, ring: Ints) -> _Hole | None:
    """Return an empty place with the points expected there; None for a strip along a border of its face."""
    surface, core = field.surface, cells[field.inner[cells] > 0.0]
    at_border, beside = _at_border(field, chart, cells)
    if not len(at_border):
        if not len(core):
            return None
        grid = np.stack(np.divmod(core - surface.charts.first[chart], surface.charts.shape[chart, 1]), axis=1)
        sides = np.ptp(grid, axis=0) + 1
        width = len(core) / sides.max()
        if width < DEEP_CELLS and sides.max() >= SLIM * width:
            return None
    examined, expected = np.concatenate([core, at_border]), 0.0
    for part, around in ((core, ring), (at_border, beside)):
        if len(part):
            density = float(np.quantile(count[around] / surface.share[around], LOW_QUANTILE))
            expected += density * float(surface.share[part].sum())
    return _Hole(
        chart=chart,
        cells=cells,
        core=examined,
        bitten=len(at_border) > 0,
        expected=expected,
        counted=float(count[examined].sum()),
        spread=_spread(field, count, chart),
    )


def _at_border(field: Field, chart: int, cells: Ints) -> tuple[Ints, Ints]:
    """Return those of a place's ``cells`` (n,) at a border of its face, and the cells along that border about them.

    None where the border does not go on at both ends: at a corner, or where the cloud ends.
    """
    surface, none = field.surface, np.empty(0, np.int64)
    first, shape = int(surface.charts.first[chart]), surface.charts.shape[chart]
    i, j = np.divmod(cells - first, shape[1])
    start = np.maximum([i.min() - RING_CELLS, j.min() - RING_CELLS], 0)
    stop = np.minimum([i.max() + RING_CELLS + 1, j.max() + RING_CELLS + 1], shape)
    rows = first + np.arange(start[0], stop[0])[:, None] * shape[1] + np.arange(start[1], stop[1])
    border = (surface.share[rows] > BORDER_SHARE) & (field.inner[rows] == 0.0)
    mask = np.isin(rows, cells)
    at = np.argwhere(mask & border)
    if not len(at) or np.ptp(at, axis=0).min() >= DEEP_CELLS:  # of several borders
        return none, none
    about = ndimage.binary_dilation(mask & border, EIGHT_NEIGHBOURS, RING_CELLS) & border & ~mask
    if ndimage.label(about, EIGHT_NEIGHBOURS)[1] != ENDS or about.sum() < FEWEST_RING:
        return none, none
    return rows[mask & border], rows[about]


def _spread(field: Field, count: Floats, chart: int) -> float:
    """Return the variance of numbers of points by their mean, from cells side by side; at least 1 (Poisson)."""
    charts = field.surface.charts
    number, seen = charts.image(count, chart), charts.image(field.seen, chart) > 0.0
    square = [
        (a[both] - b[both]) ** 2 / np.maximum(a[both] + b[both], 1.0)
        for a, b, both in (
            (number[1:], number[:-1], seen[1:] & seen[:-1]),
            (number[:, 1:], number[:, :-1], seen[:, 1:] & seen[:, :-1]),
        )
    ]
    pairs = np.concatenate(square)
    return max(float(pairs.mean()), 1.0) if len(pairs) >= FEWEST_PAIRS else 1.0


def _is_beyond(surface: DesignSurface, hole: _Hole, ring: Ints, points: Floats) -> bool:
    """Return whether the cloud goes on beyond a place, as seen from its surroundings: else it may end there."""
    middle = surface.centres[hole.core].mean(axis=0)
    way = middle - surface.centres[ring].mean(axis=0)
    length = float(np.linalg.norm(way))
    if length < 0.5 * surface.charts.cell_mm:  # steel all around
        return True
    return int(((points - middle) @ way > 0.0).sum()) >= FEWEST_BEYOND


def _is_exposed(surface: DesignSurface, core: Ints, ring: Ints) -> bool:
    """Return whether the middle of a place can be seen along the directions of most of its surroundings.

    All of its cells are compared, or an even sample of many.
    """
    core, ring = (x[:: max(1, -(-len(x) // most))] for x, most in ((core, MOST_CORE), (ring, MOST_RING)))
    directions = _directions(surface, int(core[0]))
    of_core, of_ring = (_open(surface, x, directions) for x in (core, ring))
    lost = of_ring[None].astype(float).sum(axis=2) - of_core.astype(float) @ of_ring.T.astype(float)
    exposed = lost <= LOST_SHARE * of_ring.sum(axis=1)[None]
    return bool((exposed.mean(axis=1) >= EXPOSED_SHARE).mean() >= EXPOSED_SHARE)


def _directions(surface: DesignSurface, cell: int) -> Floats:
    """Return directions (d, 3) about the normal of a cell's face, evenly spread (Fibonacci's spiral)."""
    k = np.arange(DIRECTIONS) + 0.5
    height = 1.0 - k / DIRECTIONS * (1.0 - LEAST_COS)
    turn = np.pi * (1.0 + np.sqrt(5.0)) * k
    axes = surface.charts.axes[surface.chart[cell]]
    across = np.sqrt(1.0 - height**2)
    spread: Floats = np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1) @ axes
    return spread


def _open(surface: DesignSurface, cells: Ints, directions: Floats) -> Bools:
    """Return for each of ``cells`` (n,) and directions (d,) whether the design leaves the line of sight open."""
    starts = np.repeat(surface.centres[cells] + BEFORE_MM * surface.outward[cells], len(directions), axis=0)
    ends = starts + 2.0 * surface.size_mm * np.tile(directions, (len(cells), 1))
    clear = np.ones(len(starts), np.bool_)
    clear[mesh_distance.crossings(surface.sight_grid, starts, ends, True)[0]] = False
    return clear.reshape(len(cells), len(directions))
