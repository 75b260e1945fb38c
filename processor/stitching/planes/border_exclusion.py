"""Points next to the border of a face, which may lie on this face or on the adjacent one.

A cube at the border of a face also holds the first millimetres of the adjacent face, which lie behind it. They bias the
plane: bars of a truss come out 0.02 mm too thin, ten times the effect of the point noise. A point is therefore left out
if a neighbour as seen by the scanner lies off the face. This criterion depends on the neighbour's position and not on
the point's own noise, so that it introduces no bias. Neighbours are those on the scanner's grid, or without one those
at the least angles.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from processor import large_arrays
from processor.geometry import nearest_neighbours
from processor.model import Bools, Floats, Ints
from processor.stitching.planes.extraction import Planes
from processor.stitching.planes.grid_bands import GridBands

ON_SIGMAS = 3.0  # a point this close to a plane lies on it
LEAST_SHARE = 0.5  # of a piece's points that must remain
BEYOND = 0.05  # of the range: a point this far behind the plane is not on a side face of the same bar
NEIGHBOURS = 8  # in angle, where there is no grid
ALL_AROUND = 3.0  # more than the distance of opposite directions, 2
CHUNK = 1 << 15  # points whose neighbours are in memory at once: 7 MB


def inside(points: Floats, cell: Ints, bands: GridBands | None, piece_of_cell: Ints, planes: Planes) -> Bools:
    """Return which points (n,) lie clear of the borders of their planar piece.

    ``points`` (n, 3) are in the scanner's frame and lie in ``cell`` (n,), ``bands`` are those of their scan grid, if it
    is known, ``piece_of_cell`` (m,) a row of ``planes`` or -1. On a grid, a piece that would lose most of its points,
    such as a bar hit by few rays, keeps them all: the ends of its faces determine the poses. Without a grid there are
    no ends, and such pieces alone, all biased to one side, would shift a scan by tenths of a millimetre.
    """
    limit = ON_SIGMAS * np.sqrt(planes.variance[:, 0])
    if bands is None:
        return _clear_in_angle(points, cell, piece_of_cell, planes, limit)
    clear = large_arrays.allocate(len(points), dtype=np.bool_)
    whole, left = np.zeros(len(planes.count), np.int64), np.zeros(len(planes.count), np.int64)
    for rows in large_arrays.blocks(len(points)):
        clear[rows] = False
        piece = piece_of_cell[cell[rows]]
        whole += np.bincount(piece[piece >= 0], minlength=len(whole))
    for window in bands.windows():
        piece, found = piece_of_cell[window.cell], np.zeros(len(window.points), np.bool_)
        clear_of_borders(window.grid, window.points, piece, planes.mean, planes.normal, limit, found)
        found &= window.in_band
        clear[window.number[found]] = True
        left += np.bincount(piece[found], minlength=len(left))
    few = left < LEAST_SHARE * whole
    for rows in large_arrays.blocks(len(points)):
        piece = piece_of_cell[cell[rows]]
        clear[rows] |= (piece >= 0) & few[piece]
    return clear


def _clear_in_angle(points: Floats, cell: Ints, piece_of_cell: Ints, planes: Planes, limit: Floats) -> Bools:
    """Mark points (n,) on the plane of their piece whose neighbours in angle lie on it too, or far behind it."""
    rays, clear = large_arrays.allocate(len(points), 3), large_arrays.allocate(len(points), dtype=np.bool_)
    for rows in large_arrays.blocks(len(points)):
        rays[rows] = points[rows] / np.maximum(np.linalg.norm(points[rows], axis=1), 1e-9)[:, None]
    grid = nearest_neighbours.of_spacing(rays)
    ordered = large_arrays.taken(points, grid.order)
    for rows in large_arrays.blocks(len(points), CHUNK):
        number = grid.order[rows]
        f = piece_of_cell[cell[number]]
        clear[number] = False
        on = np.flatnonzero(f >= 0)
        number, f, own = number[on], f[on], rows.start + on
        near = nearest_neighbours.nearest_rows(grid.cells, grid.cells.points[own], ALL_AROUND, NEIGHBOURS + 1)[0]
        there, near = ordered[own], ordered[np.where(near < 0, own[:, None], near)]
        off = np.einsum("nki,ni->nk", near - planes.mean[f][:, None], planes.normal[f])
        on_plane = np.abs(np.einsum("ni,ni->n", there - planes.mean[f], planes.normal[f])) < limit[f]
        behind = BEYOND * np.linalg.norm(there, axis=1)
        good = (np.abs(off) < limit[f][:, None]) | (np.abs(off) > behind[:, None])
        clear[number] = on_plane & good.all(axis=1)
    return clear


@njit(cache=True, nogil=True)
def clear_of_borders(grid, points, piece, mean, normal, limit, clear):  # type: ignore[no-untyped-def]
    """Mark points on the plane of their piece whose grid neighbours lie on the plane too, or far behind it."""
    rows, columns = grid.shape
    for r in range(rows):
        for c in range(columns):
            i = grid[r, c]
            if i < 0 or piece[i] < 0:
                continue
            f = piece[i]
            off, reach = 0.0, 0.0
            for m in range(3):
                off += normal[f, m] * (points[i, m] - mean[f, m])
                reach += points[i, m] * points[i, m]
            good = abs(off) < limit[f]
            reach = BEYOND * np.sqrt(reach)
            for way in range(4):
                u = r + (1 if way == 0 else -1 if way == 1 else 0)
                v = (c + (1 if way == 2 else -1 if way == 3 else 0)) % columns
                if u < 0 or u >= rows:
                    continue
                j = grid[u, v]
                if j < 0:
                    continue
                off = 0.0
                for m in range(3):
                    off += normal[f, m] * (points[j, m] - mean[f, m])
                good &= abs(off) < limit[f] or abs(off) > reach
            clear[i] = good
