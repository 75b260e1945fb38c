"""Points where a face ends and the next one begins: they may lie on either.

A cube that holds a face's border holds the first millimetres of the next face too, and these lie behind: the bars of
a truss would look 0.02 mm thinner than they are, ten times what the points' noise makes of a face. So where a
neighbour on the scanner's grid lies off the face, a point of it is left out: it alone cannot be told from the next
face's. Whether that is so depends on the neighbour's place, not on the point's own noise, and so nothing is preferred.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.model import Floats, Ints
from processor.stitching.planes.extraction import Planes

ON_SIGMAS = 3.0
LEAST_SHARE = 0.5  # of a piece's points
BEYOND = 0.05  # of the range: what lies so far behind is no side of the same bar


@njit(cache=True, nogil=True)
def clear_of_borders(grid, points, piece, mean, normal, limit, clear):  # type: ignore[no-untyped-def]
    """Mark points on their piece's plane, mean and normal (k, 3), whose neighbours on the grid lie on it or far off."""
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


def inside(points: Floats, grid: Ints, piece: Ints, planes: Planes) -> npt.NDArray[np.bool_]:
    """Whether points (n, 3), seen from the origin on a ``grid`` of rows, are to stand for their ``piece`` (n,) or -1.

    A piece that would lose most of its points, as a bar that few rays met, keeps them all.
    """
    limit = ON_SIGMAS * np.sqrt(planes.variance[:, 0])
    clear = np.zeros(len(points), np.bool_)
    clear_of_borders(grid, np.ascontiguousarray(points), piece, planes.mean, planes.normal, limit, clear)
    count = len(planes.count)
    held = piece >= 0
    whole = np.bincount(piece[held], minlength=count)
    few = np.bincount(piece[clear], minlength=count) < LEAST_SHARE * whole
    found: npt.NDArray[np.bool_] = clear | (held & few[piece])
    return found
