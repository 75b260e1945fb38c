"""Compiled: how much a bump at many places explains."""

from __future__ import annotations

import numpy as np
from numba import njit

from processor.model import Floats


@njit(cache=True, nogil=True)
def bump_gains(a: Floats, b: Floats, n: Floats, weight: Floats, left: Floats, places: Floats) -> Floats:
    """Return by how much bumps at places (k, 3) = a, b, radius make the weighted sum of squares of left (m,) less.

    ``a``, ``b`` (m,) are where the values are, ``n`` (m,) how much of a movement outward shows there.
    """
    found = np.zeros(len(places))
    for k in range(len(places)):
        square = places[k, 2] ** 2
        top, below = 0.0, 1e-12
        for i in range(len(a)):
            away = ((a[i] - places[k, 0]) ** 2 + (b[i] - places[k, 1]) ** 2) / square
            if away < 1.0:
                high = (1.0 - away) ** 2 * n[i]
                top += weight[i] * high * left[i]
                below += weight[i] * high * high
        found[k] = top * top / below
    return found
