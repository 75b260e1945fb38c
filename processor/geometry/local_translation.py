"""How a surface moved about a place: a small translation fitted to the distances of points from where it should be.

On a plane this is the mean distance, as in M3C2. On a tube points about the place look elsewhere than the place does,
so their mean would be too small; distances s_i = n_i u of a common movement u are solved for u instead.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.special import stdtrit

from processor.geometry.linalg_small import eigen
from processor.geometry.m3c2 import FEWEST_FOR_LOD, HALF_DIAGONAL, LEAST_RANGE, Z95
from processor.geometry.parallel import over_ranges
from processor.geometry.point_grid import SIDE, PointGrid, block_at
from processor.model import Floats, Ints

SEEN = 0.05  # least eigenvalue of the mean of n n': a direction along which points look less is not held


@dataclass(frozen=True)
class Movement:
    """At each place (k,): movement along its normal, how many points tell it, and the sd of one point's worth.

    ``vector`` (k, 3) is the movement itself, without what the points do not hold.

    The movement's standard error is sd / sqrt(count); sd holds what the fit costs and, for few points, Student's
    factor, so that 1.96 standard errors are 95 %. NaN below FEWEST_FOR_LOD points.
    """

    along: Floats
    count: Ints
    sd: Floats
    vector: Floats


def movement(
    feet: PointGrid,
    distance: Floats,
    normals: Floats,
    places: Floats,
    directions: Floats,
    *,
    diameter_mm: float,
    least_cos: float,
) -> Movement:
    """Movement of a surface at places (k, 3) on it, along unit normals ``directions`` (k, 3).

    ``feet`` are points on the surface, with the signed ``distance`` (n,) of what was measured there and the unit
    ``normals`` (n, 3), both in the grid's order. Feet count within half ``diameter_mm`` where the surface looks the
    way of the place's normal, by ``least_cos`` at least.
    """
    places, directions = np.ascontiguousarray(places), np.ascontiguousarray(directions)
    along, variance, vector = np.empty(len(places)), np.empty(len(places)), np.empty((len(places), 3))
    count, free = np.empty(len(places), np.int64), np.empty(len(places), np.int64)
    order = feet.beside(places)
    over_ranges(
        lambda a, b: _movement(
            feet.cells, distance, normals, places, directions, order, a, b, 0.5 * diameter_mm, least_cos, along,
            variance, count, free, vector,
        ),
        len(places), least=LEAST_RANGE,
    )  # fmt: skip
    table = stdtrit(np.arange(1.0, 401.0), 0.975) / Z95
    factor = np.where(free > 0, table[np.clip(free, 1, 400) - 1], np.nan)
    return Movement(along, count, np.sqrt(variance) * factor, vector)


@njit(cache=True, nogil=True)
def _movement(  # type: ignore[no-untyped-def]
    cells,
    distance,
    normals,
    places,
    directions,
    order,
    first,
    last,
    radius,
    least_cos,
    along,
    variance,
    count,
    free,
    vector,
):
    size, (xl, yl, zl) = cells.size, (cells.lower[0], cells.lower[1], cells.lower[2])
    tops = SIDE * cells.extent - 1
    points, starts = cells.points, cells.starts
    rim, extent = radius * radius, radius * (1.0 + 1e-9)
    reach2 = (radius + HALF_DIAGONAL * size) ** 2
    A, V, g, w = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for at in range(first, last):
        row = order[at]
        x, y, z = places[row, 0], places[row, 1], places[row, 2]
        a, b, c = directions[row, 0], directions[row, 1], directions[row, 2]
        along[row], variance[row], count[row], free[row], vector[row, :] = np.nan, np.nan, 0, 0, np.nan
        if not np.isfinite(a + b + c + x + y + z) or len(points) == 0:
            continue
        if x + extent < xl or y + extent < yl or z + extent < zl:
            continue
        i0, i1 = int(max((x - extent - xl) / size, 0.0)), int(min((x + extent - xl) / size, float(tops[0])))
        j0, j1 = int(max((y - extent - yl) / size, 0.0)), int(min((y + extent - yl) / size, float(tops[1])))
        k0, k1 = int(max((z - extent - zl) / size, 0.0)), int(min((z + extent - zl) / size, float(tops[2])))
        n, square = 0, 0.0
        A[:, :], g[:] = 0.0, 0.0
        for bi in range(i0 // SIDE, i1 // SIDE + 1):
            for bj in range(j0 // SIDE, j1 // SIDE + 1):
                for bk in range(k0 // SIDE, k1 // SIDE + 1):
                    u = xl + SIDE * (bi + 0.5) * size - x
                    v = yl + SIDE * (bj + 0.5) * size - y
                    t = zl + SIDE * (bk + 0.5) * size - z
                    if u * u + v * v + t * t > reach2:
                        continue
                    block = block_at(cells, bi, bj, bk)
                    if block < 0:
                        continue
                    low, high = max(k0 - SIDE * bk, 0), min(k1 - SIDE * bk, SIDE - 1)
                    for i in range(max(i0, SIDE * bi), min(i1, SIDE * bi + SIDE - 1) + 1):
                        for j in range(max(j0, SIDE * bj), min(j1, SIDE * bj + SIDE - 1) + 1):
                            cell = ((i - SIDE * bi) * SIDE + (j - SIDE * bj)) * SIDE
                            for p in range(starts[block, cell + low], starts[block, cell + high + 1]):
                                u, v, t = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                                if u * u + v * v + t * t > rim:
                                    continue
                                e, m, o = normals[p, 0], normals[p, 1], normals[p, 2]
                                if e * a + m * b + o * c < least_cos:
                                    continue
                                s = distance[p]
                                n += 1
                                square += s * s
                                A[0, 0] += e * e
                                A[0, 1] += e * m
                                A[0, 2] += e * o
                                A[1, 1] += m * m
                                A[1, 2] += m * o
                                A[2, 2] += o * o
                                g[0] += e * s
                                g[1] += m * s
                                g[2] += o * s
        count[row] = n
        if n < FEWEST_FOR_LOD:
            continue
        for i in range(3):
            g[i] /= n
            for j in range(i, 3):
                A[i, j] /= n
                A[j, i] = A[i, j]
        eigen(A, V)
        # n u and its variance over that of one distance: sums over the directions that are held, strongest first.
        total, cost, explained, held = 0.0, 0.0, 0.0, 0
        for k in range(3):
            w[k], vector[row, k] = A[k, k], 0.0
        for _ in range(3):
            k = 0
            for i in range(1, 3):
                k = i if w[i] > w[k] else k
            if w[k] < SEEN or (held > 0 and n - held < FEWEST_FOR_LOD):
                break
            e = V[0, k] * a + V[1, k] * b + V[2, k] * c
            f = V[0, k] * g[0] + V[1, k] * g[1] + V[2, k] * g[2]
            total += e * f / w[k]
            for i in range(3):
                vector[row, i] += V[i, k] * f / w[k]
            cost += e * e / w[k]
            explained += f * f / w[k]
            held += 1
            w[k] = -1.0
        along[row] = total
        free[row] = n - held
        variance[row] = max(0.0, square / n - explained) * n / (n - held) * cost
