"""Elimination of nuisance unknowns from normal equations (Schur complement), group by group.

Each observation has few unknowns in common with all others, such as its station's, and those of its group: the plane of
a piece, the axis of a tube, the deviation at a place. The latter are eliminated from the sums over all observations.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def eliminate(group, columns, coupling, inverse, gradient, N, g):  # type: ignore[no-untyped-def]
    """Reduce the normal matrix N (m, m) and right side g (m,), in place, by the nuisance unknowns of groups.

    Rows (b,) are sorted by ``group`` (b,). A row has the unknowns ``columns`` (b, u) and p nuisance unknowns, those of
    its group; its block of the normal matrix that couples both is ``coupling`` (b, u, p). ``inverse`` (groups, p, p) is
    that of the nuisance unknowns' own normal matrix, ``gradient`` (groups, p) their right side.
    """
    b, u, p = coupling.shape
    weighted = np.empty((u, p))
    first = 0
    while first < b:
        k = group[first]
        last = first
        while last < b and group[last] == k:
            last += 1
        for x in range(first, last):
            for i in range(u):
                for j in range(p):
                    weighted[i, j] = 0.0
                    for m in range(p):
                        weighted[i, j] += coupling[x, i, m] * inverse[k, m, j]
                for j in range(p):
                    g[columns[x, i]] -= weighted[i, j] * gradient[k, j]
            for y in range(first, last):
                for i in range(u):
                    for j in range(u):
                        total = 0.0
                        for m in range(p):
                            total += weighted[i, m] * coupling[y, j, m]
                        N[columns[x, i], columns[y, j]] -= total
        first = last
