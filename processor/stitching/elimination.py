"""Planes eliminated from the normal equations of all scans' poses: compiled sums over the few scans of each piece.

The same sums in the same order whatever the number of threads, which those of a linear algebra's threads are not.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def eliminate(piece, scan, Hsp, inverse, gp, normal, tilt, along, N, g, spurious):  # type: ignore[no-untyped-def]
    """Take Hsp Hpp^-1 Hps off N (6k, 6k) and Hsp Hpp^-1 gp off g (6k,); add what of N is seeming to ``spurious``.

    Rows are sorted by ``piece`` (b,): Hsp (b, 6, 3) of a scan's pose and its piece's plane. ``inverse`` (p, 3, 3) of
    Hpp, gp (p, 3), the planes' ``normal`` (p, 3) and the ``tilt`` (p, 3, 3) of these that is not known; ``along`` (b,)
    is how much a row holds its scan along the normal.
    """
    b = len(piece)
    W, pull = np.empty((6, 3)), np.empty(3)
    start = 0
    while start < b:
        p = piece[start]
        end = start
        while end < b and piece[end] == p:
            end += 1
        for x in range(start, end):
            s = 6 * scan[x]
            for i in range(6):
                for j in range(3):
                    W[i, j] = 0.0
                    for m in range(3):
                        W[i, j] += Hsp[x, i, m] * inverse[p, m, j]
                for j in range(3):
                    g[s + i] -= W[i, j] * gp[p, j]
            for j in range(3):
                pull[j] = normal[p, 0] * W[3, j] + normal[p, 1] * W[4, j] + normal[p, 2] * W[5, j]
            for i in range(3):
                for j in range(3):
                    spurious[s + 3 + i, s + 3 + j] += along[x] * tilt[p, i, j]
            for y in range(start, end):
                t = 6 * scan[y]
                held = 0.0
                for m in range(3):
                    held += pull[m] * (
                        normal[p, 0] * Hsp[y, 3, m] + normal[p, 1] * Hsp[y, 4, m] + normal[p, 2] * Hsp[y, 5, m]
                    )
                for i in range(6):
                    for j in range(6):
                        total = 0.0
                        for m in range(3):
                            total += W[i, m] * Hsp[y, j, m]
                        N[s + i, t + j] -= total
                for i in range(3):
                    for j in range(3):
                        spurious[s + 3 + i, t + 3 + j] -= held * tilt[p, i, j]
        start = end
