"""Footprints of rays that may extend over an edge: only those are divided into sub-rays.

A footprint extends over an edge as far as its outermost sub-rays do at the range of the surface there. That may be
several cells of a grid finer than the beam, and more columns at high elevations, where columns converge. Footprints are
followed over ``MOST_CELLS`` columns and rows. Rows in which that may not suffice are divided completely, which takes
longer: near the zenith, and everywhere if the beam is wider than that at the nearest surface.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from designgen.scanning.raycast import Grid
from designgen.scanning.surfaces import TRIANGLE, Surfaces
from processor.model import Bools, Floats, Labels

MOST_CELLS = 32  # work: wider footprints divide whole rows; the range of an edge is handed on as far
# An edge lies up to one cell beyond the last ray on a surface; this fraction of the cell is searched.
RESERVE = 0.75


class Margin(NamedTuple):
    """The columns on either side of a strip that determine its edges: at most ``side``, fewer in most rows."""

    side: int
    cast_columns: Labels  # (rows,) columns to cast
    edge_columns: Labels  # (rows,) columns among these whose edges the strip's footprints may reach
    whole_rows: Bools  # (rows,) rows whose footprints may extend further
    cos_elevation: Floats  # (rows,)


def nearest_mm(surfaces: Surfaces, place: Floats) -> float:
    """Return a lower bound of the range from a place (3,) to any shape, mm; exact for triangles, infinite if none."""
    ranges = np.linalg.norm(surfaces.piece_centre - place, axis=1) - surfaces.piece_radius
    flat = surfaces.kind == TRIANGLE
    nearest = ranges[~flat[surfaces.piece_shape]].min(initial=np.inf)
    # Only triangles that may be nearer than the nearest corner are compared exactly.
    corners = surfaces.numbers[flat, :3] - place
    farthest = np.sqrt(np.einsum("ni,ni->n", corners, corners).min(initial=np.inf)) * (1.0 + 1e-9)
    close = surfaces.piece_shape[flat[surfaces.piece_shape] & (ranges <= farthest)]
    a, b, c = np.moveaxis(surfaces.numbers[np.unique(close), :9].reshape(-1, 3, 3) - place, 1, 0)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        share = -np.einsum("ni,ni->n", start, along) / np.maximum(np.einsum("ni,ni->n", along, along), 1e-300)
        points = start + np.clip(share, 0.0, 1.0)[:, None] * along
        nearest = min(nearest, np.linalg.norm(points, axis=1).min(initial=np.inf))
    normal = np.cross(b - a, c - a)
    size = np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    foot = (np.einsum("ni,ni->n", a, normal) / size**2)[:, None] * normal
    above = np.ones(len(a), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        above &= np.einsum("ni,ni->n", np.cross(end - start, foot - start), normal) >= 0.0
    return float(max(0.0, min(nearest, np.linalg.norm(foot[above], axis=1).min(initial=np.inf))))


def margin(grid: Grid, reach: float) -> Margin:
    """Return the margin of a grid's strips if no footprint extends over an edge by more than ``reach``, rad."""
    across, cosines = 2.0 * np.pi / grid.columns, grid.cos_elevations()
    columns = np.array([columns_over(reach, cosine, across) for cosine in cosines], np.int32)
    rows = cells(reach / grid.step)
    edge_columns = np.array([columns[max(0, i - rows) : i + rows + 1].max() for i in range(grid.rows)], np.int32)
    cast_columns = np.array([edge_columns[max(0, i - 1) : i + 2].max() + 1 for i in range(grid.rows)], np.int32)
    return Margin(
        side=int(cast_columns.max()),
        cast_columns=cast_columns,
        edge_columns=edge_columns,
        # Rows in which columns_over, without its limit, is more than MOST_CELLS.
        whole_rows=cosines < reach * np.hypot(1.0, 1.0 / (MOST_CELLS * across)),
        cos_elevation=cosines,
    )


@njit(cache=True, nogil=True)
def cells(ratio):  # type: ignore[no-untyped-def]
    """Return the cells that a footprint covers beyond those at an edge; ``ratio`` is its reach in steps of the grid."""
    return max(0, int(np.ceil(min(ratio, 1.0 * MOST_CELLS) - 1.0 + RESERVE)))


@njit(cache=True, nogil=True)
def columns_over(reach, cosine, across):  # type: ignore[no-untyped-def]
    """Return the columns, ``across`` rad apart, covered beyond an edge by ``reach``, rad, at an elevation's cosine."""
    if cosine <= reach:
        return MOST_CELLS
    return cells(reach / np.sqrt(cosine * cosine - reach * reach) / across)


@njit(cache=True, nogil=True)
def mark_edges(surface, t, thin, used, margin, grid, beam, least):  # type: ignore[no-untyped-def]
    """Mark the rays (columns, rows) of a strip whose footprints may meet several surfaces; also their least range, mm.

    ``surface`` and ``t`` (columns, rows) are the number and range (mm) of the surface that each ray meets, -1 and
    infinite for none; ``thin`` is the range at which a footprint may touch a shape too thin for the rays. The ``used``
    columns of the strip have ``margin.side`` columns on either side. All sub-rays lie within the ``beam``;
    nothing is nearer than ``least``, mm. Outside of the strip the results are False and infinite.
    """
    side, edge_columns, whole_rows = margin.side, margin.edge_columns, margin.whole_rows
    across = 2.0 * np.pi / grid.columns
    columns, rows = surface.shape
    edge, near = np.zeros((columns, rows), np.bool_), np.full((columns, rows), np.inf)
    # Least and largest number of the surfaces of a ray and its neighbours before and after it, and the least range.
    low, high, close = np.empty(rows, np.int32), np.empty(rows, np.int32), np.empty(rows)
    for j in range(max(side - MOST_CELLS, 0), min(side + used + MOST_CELLS, columns)):
        beside = side - j if j < side else max(0, j - side - used + 1)
        before, after = max(0, j - 1), min(columns - 1, j + 1)
        for i in range(rows):
            low[i] = min(surface[before, i], surface[j, i], surface[after, i])
            high[i] = max(surface[before, i], surface[j, i], surface[after, i])
            close[i] = min(t[before, i], t[j, i], t[after, i], thin[before, i], thin[j, i], thin[after, i])
        for i in range(rows):
            if beside > edge_columns[i]:
                continue
            below, above = max(0, i - 1), min(rows - 1, i + 1)
            nearest = min(close[below], close[i], close[above])
            differs = min(low[below], low[i], low[above]) != max(high[below], high[i], high[above])
            nearest = max(nearest, least)
            if beside == 0:
                near[j, i] = min(near[j, i], nearest)
                if whole_rows[i] or np.isfinite(thin[j, i]):
                    edge[j, i] = True
            if not differs and i > 0:  # the surface below the lowest row is unknown
                continue
            reach = beam.half_divergence + beam.exit_radius / nearest
            over = cells(reach / grid.step)
            for b in range(max(0, i - over), min(rows, i + over + 1)):
                sideways = columns_over(reach, margin.cos_elevation[b], across)
                for a in range(max(side, j - sideways), min(side + used, j + sideways + 1)):
                    edge[a, b] = True
                    near[a, b] = min(near[a, b], nearest)
    return edge, near
