"""Compiled: the points of a cell summed up station by station."""

from __future__ import annotations

import numpy as np
from numba import njit

from processor.model import Floats, Ints

GATE = 4.0  # robust standard deviations from the median of a cell
LEAST_GATE_MM = 1.0
FEW = 4  # points, from which on a median says what does not fit


@njit(cache=True, nogil=True)
def pairs(cell: Ints, station: Ints, deviation: Floats) -> tuple[Ints, Ints, Ints, Ints, Floats, Floats]:
    """Columns of :class:`processor.defects.observed.Pairs`, of points sorted by cell and station."""
    n = len(cell)
    total = 0
    for i in range(n):
        if i == 0 or cell[i] != cell[i - 1] or station[i] != station[i - 1]:
            total += 1
    own, by = np.empty(total, np.int64), np.empty(total, np.int64)
    count, stray = np.zeros(total, np.int64), np.zeros(total, np.int64)
    mean, square = np.zeros(total), np.zeros(total)
    at, start = -1, 0
    while start < n:
        end = start
        while end < n and cell[end] == cell[start]:
            end += 1
        middle, gate = 0.0, np.inf
        if end - start >= FEW:
            middle = np.median(deviation[start:end])
            gate = max(LEAST_GATE_MM, GATE * 1.4826 * np.median(np.abs(deviation[start:end] - middle)))
        for i in range(start, end):
            if i == start or station[i] != station[i - 1]:
                at += 1
                own[at], by[at] = cell[i], station[i]
            off = deviation[i]
            if abs(off - middle) > gate:
                stray[at] += 1
                continue
            count[at] += 1
            step = off - mean[at]
            mean[at] += step / count[at]
            square[at] += step * (off - mean[at])
        start = end
    return own, by, count, stray, mean, square
