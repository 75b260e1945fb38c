"""Compiled: how much of each cell of a chart its facets cover."""

from __future__ import annotations

from numba import njit

from processor.model import Floats, Ints

PER_SIDE = 4  # samples of a cell along each axis


@njit(cache=True, nogil=True)
def rasterise(
    a: Floats,
    b: Floats,
    c: Floats,
    chart_of: Ints,
    low: Floats,
    shape: Ints,
    first: Ints,
    cell_mm: float,
    share: Floats,
) -> None:
    """Add to ``share`` (cells,) what triangles with corners a, b, c (f, 2) cover of the cells of their charts."""
    step = cell_mm / PER_SIDE
    for f in range(len(a)):
        k = chart_of[f]
        nu, nv = shape[k, 0] * PER_SIDE, shape[k, 1] * PER_SIDE
        au, av = (a[f, 0] - low[k, 0]) / step, (a[f, 1] - low[k, 1]) / step
        bu, bv = (b[f, 0] - low[k, 0]) / step, (b[f, 1] - low[k, 1]) / step
        cu, cv = (c[f, 0] - low[k, 0]) / step, (c[f, 1] - low[k, 1]) / step
        turn = (bu - au) * (cv - av) - (bv - av) * (cu - au)
        if turn == 0.0:
            continue
        i0, i1 = max(0, int(min(au, bu, cu))), min(nu - 1, int(max(au, bu, cu)))
        j0, j1 = int(min(av, bv, cv)) - 1, int(max(av, bv, cv))
        for i in range(i0, i1 + 1):
            u = i + 0.5
            for j in range(j0, j1 + 1):
                v = j + 0.5
                # Samples on a common side count for one triangle alone: half-open by a shift that no side has.
                p = ((bu - u) * (cv - v) - (bv - v) * (cu - u)) / turn
                q = ((cu - u) * (av - v) - (cv - v) * (au - u)) / turn
                if p >= -1e-9 and q >= -1e-9 and p + q <= 1.0 + 1e-9:
                    row, column = i // PER_SIDE, (j % nv) // PER_SIDE
                    share[first[k] + row * shape[k, 1] + column] += 1.0 / (PER_SIDE * PER_SIDE)
