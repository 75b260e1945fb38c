"""Compiled kernels of the stations' self-registration: points of tubes against their axes, and the normal equations.

What an observation tells of, in this order: offsets of a tube's axis along e1 and e2 at the middle of what is seen,
how far the axis leaves it at the end of what is seen (zeta = 1), again along e1 and e2, bow along e1 and e2 as the
factor of zeta^2 - 1/3, radius, and the offset of the ranges; all mm. The last is the station's alone. All sums run over one tube
or one observation in the points' order: no answer depends on the threads.
"""
# Numba infers the types of the arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit, prange

TUBE = 8  # what an observation tells of; a tube has the first seven
STATION = 7  # unknowns of a station: turn about its own place, translation, offset of its ranges
MOVED = (0, 1, 2, 3, 7)  # of what an observation tells of, what follows the station
BLOCKS = 16  # of tubes, that are summed apart and then together
ASIDE = 0.01  # variance of the noise across the ray over that along it


@njit(cache=True, nogil=True)
def grouped(tube_start, station, stations, most):  # type: ignore[no-untyped-def]
    """Order of points (CSR by tube) by tube and station, stable, and where each pair's points start; -1 left out.

    Of the stations that see a tube those ``most`` are taken that have the most points on it.
    """
    tubes = len(tube_start) - 1
    order = np.empty(len(station), np.int64)
    pair_start = np.empty(tubes * stations + 1, np.int64)
    number = np.empty(stations + 1, np.int64)
    at = 0
    for j in range(tubes):
        number[:] = 0
        for i in range(tube_start[j], tube_start[j + 1]):
            if 0 <= station[i] < stations:
                number[station[i] + 1] += 1
        while np.count_nonzero(number) > most:
            fewest = 0
            for s in range(1, stations + 1):
                if number[s] > 0 and (fewest == 0 or number[s] <= number[fewest]):
                    fewest = s
            number[fewest] = 0
        taken = number[1:] > 0
        for s in range(stations):
            number[s + 1] += number[s]
            pair_start[j * stations + s] = at + number[s]
        for i in range(tube_start[j], tube_start[j + 1]):
            if 0 <= station[i] < stations and taken[station[i]]:
                order[at + number[station[i]]] = i
                number[station[i]] += 1
        at += number[stations - 1]  # shifted up by one place: now the end of the last station's
    pair_start[tubes * stations] = at
    return order[:at], pair_start


@njit(cache=True, nogil=True)
def extent(points, start, at, along):  # type: ignore[no-untyped-def]
    """Where along each axis its points (CSR by tube) begin and end; -1 and 1 for a tube without."""
    low, high = np.full(len(at), -1.0), np.full(len(at), 1.0)
    for j in range(len(at)):
        first, last = np.inf, -np.inf
        for i in range(start[j], start[j + 1]):
            t = 0.0
            for k in range(3):
                t += (points[i, k] - at[j, k]) * along[j, k]
            first, last = min(first, t), max(last, t)
        if last > first:
            low[j], high[j] = first, last
    return low, high


@njit(cache=True, nogil=True, parallel=True)
def residuals(points, start, tube, station, T, offset, scanners, axis, e1, e2, half, radius, steepest):  # type: ignore[no-untyped-def]
    """Residual, cosine, normal along e1 and e2, and zeta of each point of observations ``start`` (q + 1,).

    The residual is the measured range less the one at which the ray meets the tube, and cosine that of its incidence
    there; a ray that meets the tube more steeply than ``steepest``, or not at all, gets the cosine 0. Points and
    scanners are moved by their station's T (s, 4, 4) before, and ranges are less its offset (s,).
    """
    found = np.zeros((len(points), 5))
    for q in prange(len(start) - 1):
        j, s = tube[q], station[q]
        M = T[s]
        ax, ay, az = axis[j, 0], axis[j, 1], axis[j, 2]
        dx, dy, dz = axis[j, 3], axis[j, 4], axis[j, 5]
        r = radius[j]
        cx, cy, cz = scanners[s, 0], scanners[s, 1], scanners[s, 2]
        ox = M[0, 0] * cx + M[0, 1] * cy + M[0, 2] * cz + M[0, 3] - ax
        oy = M[1, 0] * cx + M[1, 1] * cy + M[1, 2] * cz + M[1, 3] - ay
        oz = M[2, 0] * cx + M[2, 1] * cy + M[2, 2] * cz + M[2, 3] - az
        o1 = ox * e1[j, 0] + oy * e1[j, 1] + oz * e1[j, 2]
        o2 = ox * e2[j, 0] + oy * e2[j, 1] + oz * e2[j, 2]
        for i in range(start[q], start[q + 1]):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            px = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3] - ax
            py = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3] - ay
            pz = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3] - az
            p1 = px * e1[j, 0] + py * e1[j, 1] + pz * e1[j, 2]
            p2 = px * e2[j, 0] + py * e2[j, 1] + pz * e2[j, 2]
            zeta = (px * dx + py * dy + pz * dz) / half[j]
            length = np.sqrt((px - ox) ** 2 + (py - oy) ** 2 + (pz - oz) ** 2)
            u1, u2 = (p1 - o1) / length, (p2 - o2) / length
            across = u1 * u1 + u2 * u2
            if across < 1e-6:
                continue
            t0 = -(o1 * u1 + o2 * u2) / across
            f1, f2 = o1 + t0 * u1, o2 + t0 * u2  # the ray's foot by the axis: no difference of large squares
            under = r * r - f1 * f1 - f2 * f2
            if under <= 0.0:
                continue
            t = t0 - np.sqrt(under / across)
            n1, n2 = (o1 + t * u1) / r, (o2 + t * u2) / r
            cosine = -(n1 * u1 + n2 * u2)
            if cosine < steepest:
                continue
            found[i, 0], found[i, 1] = length - offset[s] - t, cosine
            # zeta is the model's, too: the noise of the range must not enter the weights
            found[i, 2], found[i, 3] = n1, n2
            found[i, 4] = zeta + (t - length) / length * ((px - ox) * dx + (py - oy) * dy + (pz - oz) * dz) / half[j]
    return found


@njit(cache=True, nogil=True, parallel=True)
def observations(seen, start, station, scale, cut):  # type: ignore[no-untyped-def]
    """Information N (q, 8, 8) and N y (q, 8) from each observation, and its count of points.

    The normal distance -residual * cosine is a linear function of the unknowns. Noise along the ray moves it by cosine
    times ``scale`` (s,), its station's, and a little more: angles are not exact. Tukey's biweight with ``cut`` scales.
    """
    q_count = len(start) - 1
    N, b = np.zeros((q_count, TUBE, TUBE)), np.zeros((q_count, TUBE))
    count = np.zeros(q_count, np.int64)
    for q in prange(q_count):
        sigma = scale[station[q]]
        f = np.empty(TUBE)
        for i in range(start[q], start[q + 1]):
            cosine, v = seen[i, 1], seen[i, 0] / (cut * sigma)
            if cosine == 0.0 or abs(v) >= 1.0:
                continue
            w = (1.0 - v * v) ** 2 / (sigma * sigma * (cosine * cosine + ASIDE))
            n1, n2, zeta = seen[i, 2], seen[i, 3], seen[i, 4]
            arch = zeta * zeta - 1.0 / 3.0
            f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7] = (
                n1, n2, zeta * n1, zeta * n2, arch * n1, arch * n2, 1.0, cosine,
            )  # fmt: skip
            distance = -seen[i, 0] * cosine
            for a in range(TUBE):
                b[q, a] += w * f[a] * distance
                for c in range(a + 1):
                    N[q, a, c] += w * f[a] * f[c]
            count[q] += 1
        for a in range(TUBE):
            for c in range(a):
                N[q, c, a] = N[q, a, c]
    return N, b, count


@njit(cache=True, nogil=True)
def cholesky(A):  # type: ignore[no-untyped-def]
    """Lower factor of a positive definite matrix, in one thread's fixed order; LAPACK's digits vary with threads."""
    n = len(A)
    L = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    return np.full((n, n), np.nan)
                L[i, i] = np.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return L


@njit(cache=True, nogil=True)
def solve(L, B):  # type: ignore[no-untyped-def]
    """Solve L L' X = B (n, m)."""
    n, m = B.shape
    X = B.copy()
    for i in range(n):
        for k in range(i):
            for c in range(m):
                X[i, c] -= L[i, k] * X[k, c]
        for c in range(m):
            X[i, c] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for c in range(m):
                X[i, c] -= L[k, i] * X[k, c]
        for c in range(m):
            X[i, c] /= L[i, i]
    return X


@njit(cache=True, nogil=True)
def product(A, B):  # type: ignore[no-untyped-def]
    """Multiply A by B, summed in one order; that of a BLAS depends on its threads."""
    found = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                found[i, j] += A[i, k] * B[k, j]
    return found


@njit(cache=True, nogil=True)
def arm(axis, e1, e2, half, place):  # type: ignore[no-untyped-def]
    """How what an observation tells of (8, 7) changes with its station's unknowns, turned about ``place``."""
    G = np.zeros((TUBE, STATION))
    mx, my, mz = axis[0] - place[0], axis[1] - place[1], axis[2] - place[2]
    for k in range(2):
        ex, ey, ez = (e1[0], e1[1], e1[2]) if k == 0 else (e2[0], e2[1], e2[2])
        # e . (w x m) = w . (m x e)
        G[k, 0], G[k, 1], G[k, 2] = my * ez - mz * ey, mz * ex - mx * ez, mx * ey - my * ex
        G[k, 3], G[k, 4], G[k, 5] = ex, ey, ez
        dx, dy, dz = half * axis[3], half * axis[4], half * axis[5]
        G[2 + k, 0], G[2 + k, 1], G[2 + k, 2] = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
    G[7, 6] = 1.0
    return G


@njit(cache=True, nogil=True)
def with_floor(N, b, floor):  # type: ignore[no-untyped-def]
    """Information and its product of an observation that may lie off by ``floor`` (variance, mm^2) along e1 and e2."""
    if floor == 0.0:
        return N.copy(), b.copy()
    a, c, d = N[0, 0] + 1.0 / floor, N[0, 1], N[1, 1] + 1.0 / floor
    det = a * d - c * c
    M, y = N.copy(), b.copy()
    for i in range(TUBE):
        g0, g1 = (d * N[i, 0] - c * N[i, 1]) / det, (a * N[i, 1] - c * N[i, 0]) / det
        y[i] -= g0 * b[0] + g1 * b[1]
        for k in range(TUBE):
            M[i, k] -= g0 * N[0, k] + g1 * N[1, k]
    return M, y


@njit(cache=True, nogil=True, parallel=True)
def reduced(N, b, weight, floor, tube_obs, station, axis, e1, e2, half, places, prior):  # type: ignore[no-untyped-def]
    """Sum up the stations' normal matrix (7 s, 7 s) and right side (7 s,), tubes eliminated one after another.

    An observation sees the tube's unknowns less the station's motion: y = a_j - G x_s. ``prior`` (m, 8) is the
    information on each tube's own unknowns. The number of blocks is fixed, so that the sum does not vary with threads.
    """
    size, m = STATION * len(places), len(tube_obs) - 1
    H, g = np.zeros((BLOCKS, size, size)), np.zeros((BLOCKS, size))
    for block in prange(BLOCKS):
        for j in range(block * m // BLOCKS, (block + 1) * m // BLOCKS):
            if tube_obs[j + 1] - tube_obs[j] > 1:
                add_tube(
                    N, b, weight, floor, tube_obs[j], tube_obs[j + 1], station, axis[j], e1[j], e2[j], half[j], places,
                    prior[j], H[block], g[block],
                )  # fmt: skip
    for block in range(1, BLOCKS):
        H[0] += H[block]
        g[0] += g[block]
    for i in range(size):
        for k in range(i):
            H[0, i, k] = H[0, k, i]
    return H[0], g[0]


@njit(cache=True, nogil=True)
def add_tube(N, b, weight, floor, first, last, station, axis, e1, e2, half, places, prior, H, g):  # type: ignore[no-untyped-def]
    """Add to the upper half of H, and to g, what the observations first..last of one tube tell of their stations."""
    number = last - first
    width = STATION * number
    A, total = np.diag(prior), np.zeros(TUBE)
    K = np.zeros((TUBE, width))
    local, right = np.zeros((width, width)), np.zeros(width)
    for o in range(number):
        q = first + o
        M, y = with_floor(N[q], b[q], floor)
        G = arm(axis, e1, e2, half, places[station[q]])
        at = STATION * o
        for a in range(TUBE):
            y[a] *= weight[q]
            total[a] += y[a]
            for k in range(TUBE):
                M[a, k] *= weight[q]
                A[a, k] += M[a, k]
            for k in MOVED:
                for c in range(STATION):
                    K[a, at + c] += M[a, k] * G[k, c]
        for k in MOVED:
            for c in range(STATION):
                right[at + c] -= G[k, c] * y[k]
                for d in range(STATION):
                    local[at + c, at + d] += G[k, c] * K[k, at + d]
    L = cholesky(A)
    if np.isnan(L[0, 0]):
        return
    S = np.empty((TUBE, width + 1))
    S[:, :-1], S[:, -1] = K, total
    S = solve(L, S)
    for c in range(width):
        for k in range(TUBE):
            value = K[k, c]
            right[c] += value * S[k, width]
            for d in range(STATION * (c // STATION), width):
                local[c, d] -= value * S[k, d]
    for o in range(number):  # observations are in the order of their stations
        at = STATION * station[first + o]
        for c in range(STATION):
            g[at + c] += right[STATION * o + c]
        for p in range(o, number):
            to = STATION * station[first + p]
            for c in range(STATION):
                for d in range(STATION):
                    H[at + c, to + d] += local[STATION * o + c, STATION * p + d]


@njit(cache=True, nogil=True, parallel=True)
def tubes(N, b, weight, floor, tube_obs, station, axis, e1, e2, half, places, prior, x, off):  # type: ignore[no-untyped-def]
    """Unknowns (m, 8) of the tubes given the stations' x (7 s,), and how each observation differs from them.

    The difference (q, 3) is the score statistic of an observation that lies off by ``off`` (variance, mm^2) along e1
    and e2, u' (N + 1/off)^-1 u of u = N (y - a + G x); what it is on average if none does; and how much this grows
    with each mm^2 by which they do.
    """
    found, differs = np.zeros((len(tube_obs) - 1, TUBE)), np.zeros((len(station), 3))
    for j in prange(len(tube_obs) - 1):
        first, last = tube_obs[j], tube_obs[j + 1]
        if last == first:
            continue
        A, total = np.diag(prior[j]), np.zeros(TUBE)
        for q in range(first, last):
            M, y = with_floor(N[q], b[q], floor)
            G = arm(axis[j], e1[j], e2[j], half[j], places[station[q]])
            A += weight[q] * M
            moved = np.zeros(TUBE)
            for k in MOVED:
                for c in range(STATION):
                    moved[k] += G[k, c] * x[STATION * station[q] + c]
            for a in range(TUBE):
                for k in MOVED:
                    y[a] += M[a, k] * moved[k]
            total += weight[q] * y
        L = cholesky(A)
        if np.isnan(L[0, 0]):
            continue
        a = solve(L, total.reshape(-1, 1))[:, 0]
        found[j] = a
        for q in range(first, last):
            M, y = with_floor(N[q], b[q], floor)
            G = arm(axis[j], e1[j], e2[j], half[j], places[station[q]])
            rest = -a
            for k in MOVED:
                for c in range(STATION):
                    rest[k] += G[k, c] * x[STATION * station[q] + c]
            u0, u1 = y[0], y[1]
            for k in range(TUBE):
                u0 += M[0, k] * rest[k]
                u1 += M[1, k] * rest[k]
            # variance of u is N - N A^-1 N, where the observation has its part in the tube's unknowns
            S = solve(L, np.ascontiguousarray(M[:, :2]))
            v00, v01, v11 = M[0, 0], M[0, 1], M[1, 1]
            for k in range(TUBE):
                v00 -= weight[q] * M[0, k] * S[k, 0]
                v01 -= weight[q] * M[0, k] * S[k, 1]
                v11 -= weight[q] * M[1, k] * S[k, 1]
            c00, c01, c11 = M[0, 0] + 1.0 / off, M[0, 1], M[1, 1] + 1.0 / off
            det = c00 * c11 - c01 * c01
            differs[q, 0] = (c11 * u0 * u0 - 2.0 * c01 * u0 * u1 + c00 * u1 * u1) / det
            differs[q, 1] = (c11 * v00 - 2.0 * c01 * v01 + c00 * v11) / det
            s00, s01, s11 = v00 * v00 + v01 * v01, v01 * (v00 + v11), v01 * v01 + v11 * v11
            differs[q, 2] = (c11 * s00 - 2.0 * c01 * s01 + c00 * s11) / det
    return found, differs


@njit(cache=True, nogil=True, parallel=True)
def effect(points, influence, places, covariance):  # type: ignore[no-untyped-def]
    """Covariance (k, d, d) of estimates near points (k, 3) that follow the stations by ``influence`` (k, s, d, 3)."""
    k_count, s_count, d_count = influence.shape[0], influence.shape[1], influence.shape[2]
    found = np.zeros((k_count, d_count, d_count))
    for k in prange(k_count):
        rows, stations = np.zeros((s_count, d_count, STATION)), np.empty(s_count, np.int64)
        number = 0
        for s in range(s_count):
            J = influence[k, s]
            if not np.any(J != 0.0):
                continue
            x, y, z = points[k, 0] - places[s, 0], points[k, 1] - places[s, 1], points[k, 2] - places[s, 2]
            for d in range(d_count):
                a, b, c = J[d, 0], J[d, 1], J[d, 2]
                # a . (w x p) = w . (p x a)
                rows[number, d, 0], rows[number, d, 1], rows[number, d, 2] = y * c - z * b, z * a - x * c, x * b - y * a
                rows[number, d, 3], rows[number, d, 4], rows[number, d, 5] = a, b, c
                rows[number, d, 6] = (x * a + y * b + z * c) / max(np.sqrt(x * x + y * y + z * z), 1e-300)
            stations[number] = s
            number += 1
        for p in range(number):
            for q in range(number):
                block = covariance[
                    STATION * stations[p] : STATION * stations[p] + STATION,
                    STATION * stations[q] : STATION * stations[q] + STATION,
                ]
                for d in range(d_count):
                    for e in range(d_count):
                        value = 0.0
                        for i in range(STATION):
                            for j in range(STATION):
                                value += rows[p, d, i] * block[i, j] * rows[q, e, j]
                        found[k, d, e] += value
    return found


@njit(cache=True, nogil=True, parallel=True)
def corrected(points, station, places, offset, T):  # type: ignore[no-untyped-def]
    """Take their station's range offset off points (n, 3), and move them by its T; in sums a coordinate."""
    found = points.copy()
    for i in prange(len(points)):
        s = station[i]
        if s < 0 or s >= len(places):
            continue
        x, y, z = points[i, 0] - places[s, 0], points[i, 1] - places[s, 1], points[i, 2] - places[s, 2]
        shorter = offset[s] / max(np.sqrt(x * x + y * y + z * z), 1e-300)
        x, y, z = points[i, 0] - shorter * x, points[i, 1] - shorter * y, points[i, 2] - shorter * z
        for k in range(3):
            found[i, k] = T[s, k, 0] * x + T[s, k, 1] * y + T[s, k, 2] * z + T[s, k, 3]
    return found
