"""Cells of a scanner's grid that had a return, sorted out of all: compiled."""

from __future__ import annotations

from numba import njit

from processor.model import Floats, Labels


@njit(cache=True, nogil=True)
def keep(
    cells: Floats,
    first: int,
    lines: int,
    found: int,
    points: Floats,
    intensity: Floats,
    row: Labels,
    column: Labels,
) -> int:
    """Copy those of cells (n, 3 or 4) that are not ``0 0 0`` behind the ``found`` returns that there are already.

    Cells come column by column of ``lines`` cells each, the first of these being cell ``first``. ``points`` (m, 3),
    ``intensity``, ``row`` and ``column`` (m,) are filled, but those that are empty. Returns the count of all returns.
    """
    c, r = divmod(first, lines)
    for i in range(len(cells)):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        if x != 0.0 or y != 0.0 or z != 0.0:
            points[found, 0], points[found, 1], points[found, 2] = x, y, z
            if len(intensity):
                intensity[found] = cells[i, 3]
            if len(row):
                row[found], column[found] = r, c
            found += 1
        r += 1
        if r == lines:
            r, c = 0, c + 1
    return found
