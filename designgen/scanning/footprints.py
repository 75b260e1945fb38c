"""Which footprints of a grid's rays may reach over an edge: only those are cut into sub-rays.

A footprint reaches over an edge as far as its outermost sub-rays do at the range of what is there: over several cells
of a grid finer than the beam, and over more columns the higher it looks, where columns lie closer. It is followed over
``MOST_CELLS`` cells, in columns and rows. Rows in which that may not do are cut whole, which takes longer: about the
zenith, and everywhere with a beam as wide as so many steps at the nearest thing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from designgen.scanning.raycast import Grid
from designgen.scanning.surfaces import TRIANGLE, Bools, Surfaces
from processor.model import Floats, Labels

MOST_CELLS = 16
# An edge lies up to a cell beyond the last ray on a surface; all but so much of it need not be looked for.
RESERVE = 0.75


@dataclass(frozen=True)
class Margin:
    """Columns beside a strip, on either side, that have a say in its edges: ``side`` at most, fewer in most rows."""

    side: int
    cast: Labels  # (rows,) columns to be cast
    marked: Labels  # (rows,) of these, those whose edges the strip's footprints may reach
    whole: Bools  # (rows,) rows whose footprints may reach further


def nearest_mm(surfaces: Surfaces, place: Floats) -> float:
    """Range from a place (3,) of the scene that no shape is nearer than, mm; exact for triangles. Infinite of none."""
    away = np.linalg.norm(surfaces.piece_centre - place, axis=1) - surfaces.piece_radius
    flat = surfaces.kind == TRIANGLE
    found = away[~flat[surfaces.piece_shape]].min(initial=np.inf)
    a, b, c = np.moveaxis(surfaces.numbers[flat, :9].reshape(-1, 3, 3) - place, 1, 0)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        share = -np.einsum("ni,ni->n", start, along) / np.maximum(np.einsum("ni,ni->n", along, along), 1e-300)
        points = start + np.clip(share, 0.0, 1.0)[:, None] * along
        found = min(found, np.linalg.norm(points, axis=1).min(initial=np.inf))
    normal = np.cross(b - a, c - a)
    size = np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    foot = (np.einsum("ni,ni->n", a, normal) / size**2)[:, None] * normal
    above = np.ones(len(a), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        above &= np.einsum("ni,ni->n", np.cross(end - start, foot - start), normal) >= 0.0
    return float(max(0.0, min(found, np.linalg.norm(foot[above], axis=1).min(initial=np.inf))))


def margin(grid: Grid, reach: float) -> Margin:
    """Return the margin of a grid's strips if no footprint reaches over an edge further than ``reach``, rad."""
    across = 2.0 * np.pi / grid.columns
    columns = np.array([columns_over(reach, level, across) for level in levels(grid)], np.int32)
    # As columns_over has it, where that is more than MOST_CELLS.
    whole = levels(grid) < reach * np.hypot(1.0, 1.0 / (MOST_CELLS * across))
    rows = cells(reach / grid.step)
    marked = np.array([columns[max(0, i - rows) : i + rows + 1].max() for i in range(grid.rows)], np.int32)
    beside = np.array([marked[max(0, i - 1) : i + 2].max() + 1 for i in range(grid.rows)], np.int32)
    return Margin(int(beside.max()), beside, marked, whole)


def levels(grid: Grid) -> Floats:
    """Cosines (rows,) of the rows' elevations."""
    found: Floats = np.cos(grid.lowest + grid.step * np.arange(grid.rows))
    return found


@njit(cache=True, nogil=True)
def cells(ratio):  # type: ignore[no-untyped-def]
    """Cells that a footprint reaches beyond those at an edge; ``ratio`` is its reach in steps of the grid."""
    return max(0, int(np.ceil(min(ratio, 1.0 * MOST_CELLS) - 1.0 + RESERVE)))


@njit(cache=True, nogil=True)
def columns_over(reach, level, across):  # type: ignore[no-untyped-def]
    """Columns, ``across`` apart, that a footprint reaches beyond an edge at an elevation of cosine ``level``."""
    if level <= reach:
        return MOST_CELLS
    return cells(reach / np.sqrt(level * level - reach * reach) / across)


@njit(cache=True, nogil=True)
def mark(  # type: ignore[no-untyped-def]
    surface,
    t,
    thin,
    side,
    used,
    marked,
    whole,
    level,
    step,
    across,
    least,
    beam,
    offset,
):
    """Mark rays whose footprints may meet several surfaces, and give the nearest range that each may meet.

    ``surface`` and ``t`` (columns, rows) are what the rays meet, -1 and infinite where nothing, and ``thin`` the range
    at which a footprint may touch a thing too thin for the rays; a strip's ``used`` columns have ``side`` columns
    before them, of which ``marked`` (rows,) count in a row, and as many after; ``whole`` (rows,) are marked
    anyhow. The rows' elevations have the cosines
    ``level``. Footprints have the radius ``beam[0] + beam[1] range``, of which ``offset`` is reached; nothing is
    nearer than ``least``. Elsewhere than in the strip the answers are False and infinite.
    """
    columns, rows = surface.shape
    edge, near = np.zeros((columns, rows), np.bool_), np.full((columns, rows), np.inf)
    # Of a ray and those before and after it: the numbers of their surfaces, and the least range.
    low, high, close = np.empty(rows, np.int32), np.empty(rows, np.int32), np.empty(rows)
    for j in range(max(side - MOST_CELLS, 0), min(side + used + MOST_CELLS, columns)):
        beside = side - j if j < side else max(0, j - side - used + 1)
        before, after = max(0, j - 1), min(columns - 1, j + 1)
        for i in range(rows):
            low[i] = min(surface[before, i], surface[j, i], surface[after, i])
            high[i] = max(surface[before, i], surface[j, i], surface[after, i])
            close[i] = min(t[before, i], t[j, i], t[after, i], thin[before, i], thin[j, i], thin[after, i])
        for i in range(rows):
            if beside > marked[i]:
                continue
            below, above = max(0, i - 1), min(rows - 1, i + 1)
            nearest = min(close[below], close[i], close[above])
            differs = min(low[below], low[i], low[above]) != max(high[below], high[i], high[above])
            nearest = max(nearest, least)
            if beside == 0:
                near[j, i] = min(near[j, i], nearest)
                if whole[i] or np.isfinite(thin[j, i]):
                    edge[j, i] = True
            if not differs and i > 0:  # what is below the lowest row is not known
                continue
            reach = offset * (beam[1] + beam[0] / nearest)
            over = cells(reach / step)
            for b in range(max(0, i - over), min(rows, i + over + 1)):
                sideways = columns_over(reach, level[b], across)
                for a in range(max(side, j - sideways), min(side + used, j + sideways + 1)):
                    edge[a, b] = True
                    near[a, b] = min(near[a, b], nearest)
    return edge, near
