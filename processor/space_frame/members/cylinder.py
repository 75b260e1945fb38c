"""One tube fitted to the points about its line: a round cylinder whose axis may be bowed.

In a frame along the line, z from the tube's middle and h half of its length, the axis is at

    x = a + c z / h + e (1 - (z / h)^2),    y = b + d z / h + f (1 - (z / h)^2),    |z| <= h

with no bow beyond the ends. Where the scanner is known a residual is the range measured less the range at which the
ray meets the cylinder: noise runs along the ray, and this residual has neither the bias nor the loss of an orthogonal
one. Where it is unknown it is the distance from the surface.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit

from processor.geometry.linalg_small import DEFINITE, factorise, substitute

NP = 7  # a, b, c, d, r, e, f; mm
GRAZING_COS = 0.2  # of incidence by the model: rays that graze more tell of mixed pixels, not of the tube
ACROSS_MM = 0.4  # noise across the ray: angles and footprint of the beam


@njit(cache=True, nogil=True, inline="always")
def residual(p, h, px, py, pz, ux, uy, uz, by_ray, J):  # type: ignore[no-untyped-def]
    """Residual of a point seen along the unit vector u, and the cosine of incidence; J (7,) gets the derivatives.

    The cosine is 0 for a ray that passes the cylinder by.
    """
    s = pz / h
    bend = 1.0 - s * s if -1.0 < s < 1.0 else 0.0
    qx, qy = px - p[0] - p[2] * s - p[5] * bend, py - p[1] - p[3] * s - p[6] * bend
    if by_ray:
        slope = -2.0 * s if -1.0 < s < 1.0 else 0.0
        tx, ty = (p[2] + p[5] * slope) / h, (p[3] + p[6] * slope) / h
        wx, wy = ux - tx * uz, uy - ty * uz
        w2 = wx * wx + wy * wy
        b = qx * wx + qy * wy
        inside = b * b - w2 * (qx * qx + qy * qy - p[4] * p[4])
        if inside <= 0.0 or w2 <= 0.0:
            return 0.0, 0.0
        root = np.sqrt(inside)
        move = -(b + root) / w2
        gx, gy, gr = (qx + move * wx) / root, (qy + move * wy) / root, p[4] / root
        value, cos = -move, root / p[4]
    else:
        d = np.sqrt(qx * qx + qy * qy)
        if d == 0.0:
            return 0.0, 0.0
        gx, gy, gr = -qx / d, -qy / d, -1.0
        value, cos = d - p[4], 1.0
    J[0], J[1], J[2], J[3], J[4], J[5], J[6] = gx, gy, gx * s, gy * s, gr, gx * bend, gy * bend
    return value, cos


@njit(cache=True, nogil=True)
def solve(A, y, n, x, inverse, want_inverse):  # type: ignore[no-untyped-def]
    """Cholesky solution x of the leading n by n block; False where it is not positive definite."""
    L = np.zeros((n, n))
    if not factorise(A, n, DEFINITE, L):
        return False
    if want_inverse:
        for column in range(n):
            for i in range(n):
                x[i] = 1.0 if i == column else 0.0
            substitute(L, n, x)
            for i in range(n):
                inverse[i, column] = x[i]
    for i in range(n):
        x[i] = y[i]
    substitute(L, n, x)
    return True


@njit(cache=True, nogil=True)
def spread_of(values, n):  # type: ignore[no-untyped-def]
    """Estimate the standard deviation of normal values by their median absolute size."""
    return 1.4826 * np.median(np.abs(values[:n]))


@njit(cache=True, nogil=True)
def step(  # type: ignore[no-untyped-def]
    p, h, P, U, seen, bounds, shifts, free, least_cos, cut, sigma, bow_sd, station_sd, sizes, inverse, response,
):  # fmt: skip
    """One Gauss-Newton step of the first ``free`` parameters over points with |z| <= h and |residual| <= cut mm.

    Group g, the points of one station, is rows ``bounds[g]`` to ``bounds[g + 1]``. Where its ``station_sd`` (g,) is
    above 0 a station is moved across the tube by ``shifts`` (g, 2), which are estimated too and have that standard
    deviation; they are eliminated, and the inverse of the normal equations knows of them. ``response`` (g, 7, 2) gets
    how the parameters move with a movement of each station, ``sizes`` the weighted residuals.
    Returns (points used, sum of squared weighted residuals, largest movement, whether it could be solved).
    """
    groups = len(bounds) - 1
    A, y, J, x = np.zeros((groups, NP, NP)), np.zeros((groups, NP)), np.zeros(NP), np.zeros(NP)
    n, total = 0, 0.0
    k2 = (ACROSS_MM / sigma) ** 2
    q = p.copy()
    for g in range(groups):
        q[0], q[1] = p[0] + shifts[g, 0], p[1] + shifts[g, 1]
        for i in range(bounds[g], bounds[g + 1]):
            if abs(P[i, 2]) > h:
                continue
            v, cos = residual(q, h, P[i, 0], P[i, 1], P[i, 2], U[i, 0], U[i, 1], U[i, 2], seen[i], J)
            if cos < least_cos:
                continue
            w = 1.0 / (1.0 + k2 * (1.0 - cos * cos) / (cos * cos)) if seen[i] else 1.0
            if w * v * v > cut * cut:
                continue
            sizes[n] = np.sqrt(w) * v
            n += 1
            total += w * v * v
            for a in range(free):
                weighted = w * J[a]
                y[g, a] -= weighted * v
                for b in range(a + 1):
                    A[g, a, b] += weighted * J[b]
    if n < 2 * free:
        return n, total, 0.0, False
    N, right = np.zeros((NP, NP)), np.zeros(NP)
    for g in range(groups):
        for a in range(free):
            right[a] += y[g, a]
            for b in range(a + 1):
                N[a, b] += A[g, a, b]
    if free == NP:
        for a in range(5, NP):
            N[a, a] += (sigma / bow_sd) ** 2
            right[a] -= (sigma / bow_sd) ** 2 * p[a]
    moving = station_sd.max() > 0.0
    if moving:
        for g in range(groups):
            ratio = (sigma / station_sd[g]) ** 2
            d00, d11, d10 = A[g, 0, 0] + ratio, A[g, 1, 1] + ratio, A[g, 1, 0]
            det = d00 * d11 - d10 * d10
            r0, r1 = y[g, 0] - ratio * shifts[g, 0], y[g, 1] - ratio * shifts[g, 1]
            for a in range(free):
                a0, a1 = column(A[g], a, 0), column(A[g], a, 1)
                e0, e1 = (d11 * a0 - d10 * a1) / det, (d00 * a1 - d10 * a0) / det
                right[a] -= e0 * r0 + e1 * r1
                for b in range(a + 1):
                    N[a, b] -= e0 * column(A[g], b, 0) + e1 * column(A[g], b, 1)
    if not solve(N, right, free, x, inverse, True):
        return n, total, 0.0, False
    if moving:
        for g in range(groups):
            ratio = (sigma / station_sd[g]) ** 2
            d00, d11, d10 = A[g, 0, 0] + ratio, A[g, 1, 1] + ratio, A[g, 1, 0]
            det = d00 * d11 - d10 * d10
            r0, r1 = y[g, 0] - ratio * shifts[g, 0], y[g, 1] - ratio * shifts[g, 1]
            for a in range(free):
                r0 -= column(A[g], a, 0) * x[a]
                r1 -= column(A[g], a, 1) * x[a]
            shifts[g, 0] += (d11 * r0 - d10 * r1) / det
            shifts[g, 1] += (d00 * r1 - d10 * r0) / det
            for a in range(free):
                response[g, a, 0] = response[g, a, 1] = 0.0
                for b in range(free):
                    b0, b1 = column(A[g], b, 0), column(A[g], b, 1)
                    response[g, a, 0] += inverse[a, b] * ratio * (d11 * b0 - d10 * b1) / det
                    response[g, a, 1] += inverse[a, b] * ratio * (d00 * b1 - d10 * b0) / det
    moved = 0.0
    for a in range(free):
        p[a] += x[a]
        moved = max(moved, abs(x[a]))
    return n, total, moved, True


@njit(cache=True, nogil=True, inline="always")
def column(A, a, k):  # type: ignore[no-untyped-def]
    """Element (a, k) of a symmetric matrix whose lower half is filled."""
    return A[a, k] if a >= k else A[k, a]


@njit(cache=True, nogil=True)
def roughly(P, low, high, reach, p, h):  # type: ignore[no-untyped-def]
    """Start from an algebraic circle whose centre runs along a line: linear in (a, b, c, d, and the constant)."""
    A, y, x, inverse = np.zeros((5, 5)), np.zeros(5), np.zeros(5), np.zeros((5, 5))
    J = np.empty(5)
    for turn in range(3):
        A[:], y[:] = 0.0, 0.0
        n = 0
        cut = (40.0, 20.0, 12.0)[turn]
        for i in range(len(P)):
            z = P[i, 2]
            if z < low or z > high:
                continue
            s, px, py = z / h, P[i, 0], P[i, 1]
            if turn > 0:
                d = np.sqrt((px - p[0] - p[2] * s) ** 2 + (py - p[1] - p[3] * s) ** 2)
                if abs(d - p[4]) > cut:
                    continue
            elif px * px + py * py > reach * reach:
                continue
            J[0], J[1], J[2], J[3], J[4] = 2.0 * px, 2.0 * py, 2.0 * px * s, 2.0 * py * s, 1.0
            v = px * px + py * py
            for a in range(5):
                y[a] += J[a] * v
                for b in range(a + 1):
                    A[a, b] += J[a] * J[b]
            n += 1
        if n < 12 or not solve(A, y, 5, x, inverse, False):
            return False
        mean2 = x[0] * x[0] + x[1] * x[1] + (x[2] * x[2] + x[3] * x[3]) / 3.0
        r2 = x[4] + mean2
        if not r2 > 0.0:
            return False
        p[0], p[1], p[2], p[3], p[4] = x[0], x[1], x[2], x[3], np.sqrt(r2)
    return True


@njit(cache=True, nogil=True)
def reach_of(p, h, P, U, seen, bounds, shifts, sigma, bins, width, span):  # type: ignore[no-untyped-def]
    """Find the ends of the stretch that lies on the cylinder, by bins of ``width`` over +-span about the middle.

    Stations are moved by ``shifts`` as in :func:`step`.

    Outward from the middle every point on the surface adds to a sum and every other one takes away from it: a point's
    part is 2 less its squared residual in standard deviations, which counts for 6 at most: one mixed pixel in five
    points does no harm. The end is where the sum is largest.
    """
    J = np.zeros(NP)
    bins[:] = 0.0
    count = len(bins)
    q = p.copy()
    for g in range(len(bounds) - 1):
        q[0], q[1] = p[0] + shifts[g, 0], p[1] + shifts[g, 1]
        for i in range(bounds[g], bounds[g + 1]):
            at = int(np.floor((P[i, 2] + span) / width))
            if at < 0 or at >= count:
                continue
            v, cos = residual(q, h, P[i, 0], P[i, 1], P[i, 2], U[i, 0], U[i, 1], U[i, 2], seen[i], J)
            if cos >= GRAZING_COS:
                bins[at] += 2.0 - min(6.0, (v * cos / sigma) ** 2)
                continue
            # A ray that grazes or passes by says something only where its point is far off the surface.
            dx, dy = P[i, 0] - q[0] - q[2] * P[i, 2] / h, P[i, 1] - q[1] - q[3] * P[i, 2] / h
            if np.sqrt(dx * dx + dy * dy) - p[4] > max(5.0 * sigma, 12.0):
                bins[at] -= 4.0
    middle = count // 2
    high, total, best = 0.0, 0.0, 0.0
    for k in range(middle, count):
        total += bins[k]
        if total > best:
            best, high = total, (k + 1) * width - span
    low, total, best = 0.0, 0.0, 0.0
    for k in range(middle - 1, -1, -1):
        total += bins[k]
        if total > best:
            best, low = total, k * width - span
    return low, high
