"""Nearest neighbours in angle of the points of a scan without a grid.

The points need not fit in memory: they are sorted into bands of the polar angle, and a band is searched together with
what lies beside it in angle.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from processor import large_arrays
from processor.model import Floats, Ints

ROWS = 8192  # of equal polar angle, of which bands are made
BAND_POINTS = 1 << 19  # of a band, but that it has one row at least
HALO_STEPS = 10.0  # mean distances of a band's points, by which it is searched beyond its edges at first
CHUNK = 1 << 15


class Neighbourhoods(NamedTuple):
    """Some points (m, 3), their numbers and pieces (m,), and the points nearest in angle (m, k, 3), itself included."""

    number: Ints
    piece: Ints
    points: Floats
    near: Floats


class _Bands(NamedTuple):
    """Points (n, 3) sorted by bands of the polar angle, their polar angles, pieces and numbers (n,).

    Band k ends before row ``ends[k]``, and lies between the polar angles ``edges[k]`` and ``edges[k + 1]``.
    """

    points: Floats
    polar: Floats
    piece: Ints
    number: Ints
    ends: Ints
    edges: Floats

    def rows(self, band: int) -> slice:
        """Return the rows of a band."""
        return slice(int(self.ends[band - 1]) if band else 0, int(self.ends[band]))

    def between(self, low: float, high: float) -> Floats:
        """Return the points (m, 3) of polar angles from ``low`` to ``high``."""
        found = []
        for band in range(len(self.ends)):
            if self.edges[band] <= high and self.edges[band + 1] >= low:
                rows = self.rows(band)
                polar = self.polar[rows]
                found.append(self.points[rows][(polar >= low) & (polar <= high)])
        return np.concatenate(found)


def neighbourhoods(points: Floats, cell: Ints, piece_of_cell: Ints, count: int) -> Iterator[Neighbourhoods]:
    """Pass over the points (n, 3), seen from the origin, whose ``cell`` (n,) is of a piece.

    ``piece_of_cell`` (m,) is -1 for none. With each point come ``count`` neighbours; where the scan has fewer points,
    one of them is repeated.
    """
    bands = _sorted(points, cell, piece_of_cell)
    for band in range(len(bands.ends)):
        rows = bands.rows(band)
        on = np.flatnonzero(bands.piece[rows] >= 0) + rows.start
        search = _Search(bands, band)
        for start in range(0, len(on), CHUNK):
            part = on[start : start + CHUNK]
            there = bands.points[part]
            yield Neighbourhoods(bands.number[part], bands.piece[part], there, search.nearest(there, count))
        large_arrays.release()


def _sorted(points: Floats, cell: Ints, piece_of_cell: Ints) -> _Bands:
    """Sort the points into bands of about ``BAND_POINTS``."""
    filled = np.zeros(ROWS, np.int64)
    for rows in large_arrays.blocks(len(points)):
        filled += np.bincount(_row(_polar(points[rows])), minlength=ROWS)
    band_of_row = np.maximum(np.cumsum(filled) - 1, 0) // BAND_POINTS
    band_of_row = np.unique(band_of_row, return_inverse=True)[1].astype(np.int64)
    ends = np.cumsum(np.bincount(band_of_row, filled)).astype(np.int64)

    def passed() -> Iterator[tuple[large_arrays.Array, ...]]:
        for rows in large_arrays.blocks(len(points)):
            polar = _polar(points[rows])
            yield points[rows], polar, piece_of_cell[cell[rows]], np.arange(rows.start, rows.start + len(polar))

    def band_of(block: tuple[large_arrays.Array, ...]) -> Ints:
        return band_of_row[_row(block[1])]

    there, polar, piece, number = large_arrays.in_parts(passed(), band_of, ends)
    first = np.flatnonzero(np.diff(band_of_row, prepend=-1))
    edges = np.append(first, ROWS) * np.pi / ROWS
    return _Bands(there, polar, piece, number=number, ends=ends, edges=edges)


class _Search:
    """The points of a band and of what lies beside it, as far as neighbours have been asked for."""

    def __init__(self, bands: _Bands, band: int) -> None:
        self._bands = bands
        self._edges = bands.edges[band], bands.edges[band + 1]
        low, high = self._edges
        rows = bands.rows(band)
        sphere = 2.0 * np.pi * (np.cos(low) - np.cos(high))
        self._widen(HALO_STEPS * np.sqrt(sphere / max(rows.stop - rows.start, 1)))

    def _widen(self, halo: float) -> None:
        self._halo = halo
        self._low, self._high = self._edges[0] - halo, self._edges[1] + halo
        self._points = self._bands.between(self._low, self._high)
        self._tree = cKDTree(_rays(self._points))

    def nearest(self, points: Floats, count: int) -> Floats:
        """Return the points (m, count, 3) nearest in angle to points (m, 3) of the band."""
        rays = _rays(points)
        distance, found = self._tree.query(rays, count)
        near: Floats = self._points[np.minimum(found, len(self._points) - 1)]
        # what lies beyond the searched angles is farther away than their edges
        polar = _polar(points)
        low = np.inf if self._low <= 0.0 else polar - self._low
        high = np.inf if self._high >= np.pi else self._high - polar
        beside = np.minimum(low, high)
        unsure = distance[:, -1] > np.where(beside < np.pi, 2.0 * np.sin(0.5 * np.minimum(beside, np.pi)), np.inf)
        if unsure.any():
            self._widen(4.0 * self._halo)
            near[unsure] = self.nearest(points[unsure], count)
        return near


def _rays(points: Floats) -> Floats:
    """Return the directions (n, 3) of points seen from the origin."""
    rays: Floats = points / np.maximum(np.linalg.norm(points, axis=1), 1e-9)[:, None]
    return rays


def _polar(points: Floats) -> Floats:
    """Return the polar angles (n,) of points seen from the origin."""
    polar: Floats = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    return polar


def _row(polar: Floats) -> Ints:
    """Return the row (n,) of polar angles."""
    return np.minimum((polar * (ROWS / np.pi)).astype(np.int64), ROWS - 1)
