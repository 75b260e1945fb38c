"""The points of a scan in the order of the scanner's grid, for passes over windows of the grid.

Points of a scan are in any order, and those of a large scan lie in files: a window is a band of rows of the grid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from processor import large_arrays
from processor.model import Bools, Floats, Ints, Labels

BAND_PLACES = 1 << 20  # of the grid, in a band


@dataclass(frozen=True)
class Window:
    """A band of the grid with a row beside it on either side, where there is one.

    ``grid`` (r, c) has the index of the point at each place, -1 = none. Of the points: coordinates (n, 3), row of the
    whole grid, column, ``number`` in the scan, ``cell``, and whether the row is the band's own (n,).
    """

    rows: slice  # of the whole grid
    own: slice  # of the window's rows: those of the band
    grid: Ints
    points: Floats
    row: Ints
    column: Ints
    number: Ints
    cell: Ints
    in_band: Bools


@dataclass(frozen=True)
class GridBands:
    """The points on a grid of ``shape`` rows and columns, sorted by their ``place``: row times columns plus column."""

    shape: tuple[int, int]
    points: Floats
    place: Ints
    number: Ints
    cell: Ints

    @classmethod
    def of(cls, points: Floats, row: Labels, column: Labels, cell: Ints) -> GridBands:
        """Sort points (n, 3) with rows and columns (n,) of the grid, -1 = not on it, and the cells (n,) they lie in."""
        shape = (_lines(row), _lines(column))
        places = _band_rows(shape) * shape[1]

        def passed() -> Iterator[tuple[Floats, Ints, Ints, Ints]]:
            for rows in large_arrays.blocks(len(points)):
                on = np.flatnonzero((row[rows] >= 0) & (column[rows] >= 0))
                place = row[rows][on].astype(np.int64) * shape[1] + column[rows][on]
                yield points[rows][on], place, rows.start + on, cell[rows][on]

        filled = np.zeros(-(-shape[0] * shape[1] // places), np.int64)
        for block in passed():
            filled += np.bincount(block[1] // places, minlength=len(filled))
        ends = np.cumsum(filled)
        columns = large_arrays.in_parts(passed(), lambda block: block[1] // places, ends)
        for first, last in zip(ends - filled, ends, strict=True):
            # Of several points at a place the last one is on the grid.
            order = np.argsort(columns[1][first:last], kind="stable")
            for one in columns:
                one[first:last] = one[first:last][order]
            large_arrays.release()
        return cls(shape, *columns)

    def windows(self, backwards: bool = False) -> Iterator[Window]:
        """Yield the window of each band, in the order of rows or from the last one to the first."""
        firsts = range(0, self.shape[0], _band_rows(self.shape))
        for first in reversed(firsts) if backwards else firsts:
            yield self._window(first, min(first + firsts.step, self.shape[0]))
            large_arrays.release()

    def _window(self, first: int, last: int) -> Window:
        """Return the window of the rows ``first`` to ``last`` - 1."""
        rows, columns = slice(max(first - 1, 0), min(last + 1, self.shape[0])), self.shape[1]
        edges = np.array([rows.start, first, last, rows.stop]) * columns
        start, begin, end, stop = np.searchsorted(self.place, edges).tolist()
        place = self.place[start:stop]
        row, column = np.divmod(place, columns)
        grid = np.full((rows.stop - rows.start) * columns, -1, np.int64)
        grid[place - edges[0]] = np.arange(len(place))
        in_band = np.zeros(len(place), np.bool_)
        in_band[begin - start : end - start] = True
        return Window(
            rows=rows, own=slice(first - rows.start, last - rows.start), grid=grid.reshape(-1, columns),
            points=self.points[start:stop], row=row, column=column, number=self.number[start:stop],
            cell=self.cell[start:stop], in_band=in_band,
        )  # fmt: skip


def _band_rows(shape: tuple[int, int]) -> int:
    return max(1, BAND_PLACES // shape[1])


def _lines(numbers: Labels) -> int:
    return max(1, int(large_arrays.extremes(numbers)[1]) + 1)
