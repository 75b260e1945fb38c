"""The loops of M3C2 and of normals, compiled: each place's answer is its own, whatever thread computes it."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit

from processor.geometry.point_grid import SIDE, block_at

HALF_DIAGONAL = 0.5 * SIDE * 3.0**0.5 * (1.0 + 1e-9)  # of a block, in cells
FEWEST_OF_PLANE = 4
SWEEPS = 12


@njit(cache=True, nogil=True)
def along_normals(cells, places, normals, order, first, last, radius, depth, count, mean, sd):  # type: ignore[no-untyped-def]
    """Count, mean and population sd of the points in the cylinder about each normal, measured along it from its place.

    The cylinder has a ``radius`` and reaches ``depth`` to either side, rims included.
    """
    size, (xl, yl, zl) = cells.size, (cells.lower[0], cells.lower[1], cells.lower[2])
    tops = SIDE * cells.extent - 1
    points, starts = cells.points, cells.starts
    rim, reach = radius * radius, radius + HALF_DIAGONAL * size
    reach2, end = reach * reach, depth + HALF_DIAGONAL * size
    slack = 1e-9 * (radius + depth)
    for at in range(first, last):
        row = order[at]
        x, y, z = places[row, 0], places[row, 1], places[row, 2]
        a, b, c = normals[row, 0], normals[row, 1], normals[row, 2]
        count[row], mean[row], sd[row] = 0, np.nan, np.nan
        if not np.isfinite(a + b + c + x + y + z) or len(points) == 0:
            continue
        ex = depth * abs(a) + radius * np.sqrt(max(0.0, 1.0 - a * a)) + slack
        ey = depth * abs(b) + radius * np.sqrt(max(0.0, 1.0 - b * b)) + slack
        ez = depth * abs(c) + radius * np.sqrt(max(0.0, 1.0 - c * c)) + slack
        if x + ex < xl or y + ey < yl or z + ez < zl:
            continue
        i0, i1 = int(max((x - ex - xl) / size, 0.0)), int(min((x + ex - xl) / size, float(tops[0])))
        j0, j1 = int(max((y - ey - yl) / size, 0.0)), int(min((y + ey - yl) / size, float(tops[1])))
        k0, k1 = int(max((z - ez - zl) / size, 0.0)), int(min((z + ez - zl) / size, float(tops[2])))
        n, shift, total, square = 0, 0.0, 0.0, 0.0
        for bi in range(i0 // SIDE, i1 // SIDE + 1):
            for bj in range(j0 // SIDE, j1 // SIDE + 1):
                for bk in range(k0 // SIDE, k1 // SIDE + 1):
                    u = xl + SIDE * (bi + 0.5) * size - x
                    v = yl + SIDE * (bj + 0.5) * size - y
                    w = zl + SIDE * (bk + 0.5) * size - z
                    t = u * a + v * b + w * c
                    if abs(t) > end or u * u + v * v + w * w - t * t > reach2:
                        continue
                    block = block_at(cells, bi, bj, bk)
                    if block < 0:
                        continue
                    low, high = max(k0 - SIDE * bk, 0), min(k1 - SIDE * bk, SIDE - 1)
                    for i in range(max(i0, SIDE * bi), min(i1, SIDE * bi + SIDE - 1) + 1):
                        for j in range(max(j0, SIDE * bj), min(j1, SIDE * bj + SIDE - 1) + 1):
                            cell = ((i - SIDE * bi) * SIDE + (j - SIDE * bj)) * SIDE
                            for p in range(starts[block, cell + low], starts[block, cell + high + 1]):
                                u, v, w = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                                t = u * a + v * b + w * c
                                if abs(t) > depth:
                                    continue
                                u, v, w = u - t * a, v - t * b, w - t * c
                                if u * u + v * v + w * w > rim:
                                    continue
                                if n == 0:
                                    shift = t  # squares of what is left lose no digits
                                t -= shift
                                n += 1
                                total += t
                                square += t * t
        count[row] = n
        if n > 0:
            mean[row] = shift + total / n
            sd[row] = np.sqrt(max(0.0, (square - total * total / n) / n))


@njit(cache=True, nogil=True)
def normals_at(cells, places, order, first, last, radius, normals, roughness, count):  # type: ignore[no-untyped-def]
    """Fit a plane to the points within ``radius`` of each place: its normal, their sd from it, and their number.

    NaN where fewer than FEWEST_OF_PLANE are there or they lie on a line.
    """
    size, (xl, yl, zl) = cells.size, (cells.lower[0], cells.lower[1], cells.lower[2])
    tops = SIDE * cells.extent - 1
    points, starts = cells.points, cells.starts
    rim, extent = radius * radius, radius * (1.0 + 1e-9)
    A, V = np.empty((3, 3)), np.empty((3, 3))
    for at in range(first, last):
        row = order[at]
        x, y, z = places[row, 0], places[row, 1], places[row, 2]
        normals[row, :], roughness[row], count[row] = np.nan, np.nan, 0
        if not np.isfinite(x + y + z) or len(points) == 0:
            continue
        if x + extent < xl or y + extent < yl or z + extent < zl:
            continue
        i0, i1 = int(max((x - extent - xl) / size, 0.0)), int(min((x + extent - xl) / size, float(tops[0])))
        j0, j1 = int(max((y - extent - yl) / size, 0.0)), int(min((y + extent - yl) / size, float(tops[1])))
        k0, k1 = int(max((z - extent - zl) / size, 0.0)), int(min((z + extent - zl) / size, float(tops[2])))
        n = 0
        su = sv = sw = suu = suv = suw = svv = svw = sww = 0.0
        for bi in range(i0 // SIDE, i1 // SIDE + 1):
            for bj in range(j0 // SIDE, j1 // SIDE + 1):
                for bk in range(k0 // SIDE, k1 // SIDE + 1):
                    block = block_at(cells, bi, bj, bk)
                    if block < 0:
                        continue
                    low, high = max(k0 - SIDE * bk, 0), min(k1 - SIDE * bk, SIDE - 1)
                    for i in range(max(i0, SIDE * bi), min(i1, SIDE * bi + SIDE - 1) + 1):
                        for j in range(max(j0, SIDE * bj), min(j1, SIDE * bj + SIDE - 1) + 1):
                            cell = ((i - SIDE * bi) * SIDE + (j - SIDE * bj)) * SIDE
                            for p in range(starts[block, cell + low], starts[block, cell + high + 1]):
                                u, v, w = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                                if u * u + v * v + w * w > rim:
                                    continue
                                n += 1
                                su, sv, sw = su + u, sv + v, sw + w
                                suu, suv, suw = suu + u * u, suv + u * v, suw + u * w
                                svv, svw, sww = svv + v * v, svw + v * w, sww + w * w
        count[row] = n
        if n < FEWEST_OF_PLANE:
            continue
        mu, mv, mw = su / n, sv / n, sw / n
        A[0, 0], A[1, 1], A[2, 2] = suu / n - mu * mu, svv / n - mv * mv, sww / n - mw * mw
        A[0, 1] = A[1, 0] = suv / n - mu * mv
        A[0, 2] = A[2, 0] = suw / n - mu * mw
        A[1, 2] = A[2, 1] = svw / n - mv * mw
        eigen(A, V)
        least, most = 0, 0
        for k in range(1, 3):
            least = k if A[k, k] < A[least, least] else least
            most = k if A[k, k] >= A[most, most] else most
        between = 3 - least - most
        if least == most or not A[between, between] > 1e-10 * A[most, most]:
            continue
        length = np.sqrt(V[0, least] ** 2 + V[1, least] ** 2 + V[2, least] ** 2)
        for k in range(3):
            normals[row, k] = V[k, least] / length
        roughness[row] = np.sqrt(max(0.0, A[least, least]))


@njit(cache=True, nogil=True)
def eigen(A, V):  # type: ignore[no-untyped-def]
    """Turn a symmetric A (3, 3) into its eigenvalues on the diagonal, V into its vectors as columns (Jacobi)."""
    for i in range(3):
        for j in range(3):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        off = abs(A[0, 1]) + abs(A[0, 2]) + abs(A[1, 2])
        if off <= 1e-18 * (abs(A[0, 0]) + abs(A[1, 1]) + abs(A[2, 2])):
            return
        for p in range(2):
            for q in range(p + 1, 3):
                if A[p, q] == 0.0:
                    continue
                theta = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                h = t * A[p, q]
                A[p, p] -= h
                A[q, q] += h
                A[p, q] = A[q, p] = 0.0
                r = 3 - p - q
                g, h = A[r, p], A[r, q]
                A[r, p] = A[p, r] = c * g - s * h
                A[r, q] = A[q, r] = s * g + c * h
                for k in range(3):
                    g, h = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * g - s * h, s * g + c * h
