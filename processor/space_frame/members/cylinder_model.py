"""Model of one tube: a round cylinder whose axis may be bowed, its residuals and one Gauss-Newton step.

In a frame along the line, z from the tube's middle and h half of its length, the axis is at

    x = a + c z / h + e (1 - (z / h)^2),    y = b + d z / h + f (1 - (z / h)^2),    |z| <= h

with no bow beyond the ends. Where the scanner is known a residual is the measured range less the range at which the ray
meets the cylinder: noise runs along the ray, and this residual has neither the bias nor the loss of efficiency of an
orthogonal distance. Where it is unknown the residual is the distance from the surface.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry.linalg_small import DEFINITE, factorise, substitute
from processor.inner_kernels import inner
from processor.model import Floats, Ints
from processor.robust_statistics import MAD_TO_SD

NP = 7  # a, b, c, d, r, e, f; mm
STRAIGHT = 5  # of them without bow
GRAZING_COS = 0.2  # of incidence by the model: rays that graze more are often mixed pixels
ACROSS_MM = 0.4  # noise across the ray: angles and footprint of the beam


class Observations(NamedTuple):
    """Points near one tube in its frame, sorted by station: those of group g are rows bounds[g] to bounds[g + 1]."""

    points: Floats  # (n, 3)
    rays: Floats  # (n, 3) unit vectors from the scanner
    known: npt.NDArray[np.bool_]  # (n,) the scanner is known
    bounds: Ints  # (g + 1,)


class Shifts(NamedTuple):
    """Shifts (g, 2) of the stations across the tube, and their standard deviations (g,); 0 = fixed. mm."""

    values: Floats
    sd: Floats


class Weighting(NamedTuple):
    """Least cosine of incidence, largest weighted residual, standard deviations of a range and of the bow. mm."""

    least_cos: float
    cut: float
    sigma: float
    bow_sd: float


class Solution(NamedTuple):
    """Inverse of the normal equations (7, 7), and the change (g, 7, 2) of the parameters by each station's shift."""

    inverse: Floats
    response: Floats


@njit(cache=True, nogil=True, inline="always")
def residual(p, h, px, py, pz, ux, uy, uz, by_ray, J):  # type: ignore[no-untyped-def]
    """Residual of a point seen along the unit vector u, and the cosine of incidence; J (7,) gets the derivatives.

    The cosine is 0 for a ray that misses the cylinder.
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
def solve(A, y, n, x, inverse):  # type: ignore[no-untyped-def]
    """Cholesky solution x of the leading n by n block, with its ``inverse`` unless that has no rows.

    False where the block is not positive definite.
    """
    L = np.zeros((n, n))
    if not factorise(A, n, DEFINITE, L):
        return False
    if len(inverse):
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
def step(p, h, observations, shifts, free, weighting, sizes, solution):  # type: ignore[no-untyped-def]
    """One Gauss-Newton step of the first ``free`` parameters over points with |z| <= h and |residual| <= cut.

    Where stations' standard deviations are above 0 their shifts are estimated too; they are eliminated, and the inverse
    of the normal equations includes them. ``sizes`` (n,) gets the weighted residuals.
    Returns (points used, sum of squared weighted residuals, largest change, whether it could be solved).
    """
    _, _, sigma, bow_sd = weighting
    inverse, response = solution
    groups = len(observations.bounds) - 1
    A, y, x = np.zeros((groups, NP, NP)), np.zeros((groups, NP)), np.zeros(NP)
    n, total = _sum_up(p, h, observations, shifts.values, free, weighting, sizes, A, y)
    if n < 2 * free:
        return n, total, 0.0, False
    N, right = np.zeros((NP, NP)), np.zeros(NP)
    for g in range(groups):
        for a in range(free):
            right[a] += y[g, a]
            for b in range(a + 1):
                N[a, b] += A[g, a, b]
    if free == NP:
        for a in range(STRAIGHT, NP):
            N[a, a] += (sigma / bow_sd) ** 2
            right[a] -= (sigma / bow_sd) ** 2 * p[a]
    moving = shifts.sd.max() > 0.0
    if moving:
        for g in range(groups):
            ratio, d00, d11, d10, det, r0, r1 = _shift_equations(A[g], y[g], shifts.values[g], sigma / shifts.sd[g])
            for a in range(free):
                a0, a1 = element(A[g], a, 0), element(A[g], a, 1)
                e0, e1 = (d11 * a0 - d10 * a1) / det, (d00 * a1 - d10 * a0) / det
                right[a] -= e0 * r0 + e1 * r1
                for b in range(a + 1):
                    N[a, b] -= e0 * element(A[g], b, 0) + e1 * element(A[g], b, 1)
    if not solve(N, right, free, x, inverse):
        return n, total, 0.0, False
    if moving:
        for g in range(groups):
            ratio, d00, d11, d10, det, r0, r1 = _shift_equations(A[g], y[g], shifts.values[g], sigma / shifts.sd[g])
            for a in range(free):
                r0 -= element(A[g], a, 0) * x[a]
                r1 -= element(A[g], a, 1) * x[a]
            shifts.values[g, 0] += (d11 * r0 - d10 * r1) / det
            shifts.values[g, 1] += (d00 * r1 - d10 * r0) / det
            for a in range(free):
                response[g, a, 0] = response[g, a, 1] = 0.0
                for b in range(free):
                    b0, b1 = element(A[g], b, 0), element(A[g], b, 1)
                    response[g, a, 0] += inverse[a, b] * ratio * (d11 * b0 - d10 * b1) / det
                    response[g, a, 1] += inverse[a, b] * ratio * (d00 * b1 - d10 * b0) / det
    largest = 0.0
    for a in range(free):
        p[a] += x[a]
        largest = max(largest, abs(x[a]))
    return n, total, largest, True


@inner
def _sum_up(p, h, observations, shifts, free, weighting, sizes, A, y):  # type: ignore[no-untyped-def]
    """Add each group's points to its normal equations A (g, 7, 7), lower half, and y (g, 7); fill their ``sizes``.

    Returns the number of points and the sum of their squared weighted residuals.
    """
    P, U, known, bounds = observations
    least_cos, cut, sigma, _ = weighting
    J = np.zeros(NP)
    n, total = 0, 0.0
    k2 = (ACROSS_MM / sigma) ** 2
    q = p.copy()
    for g in range(len(bounds) - 1):
        q[0], q[1] = p[0] + shifts[g, 0], p[1] + shifts[g, 1]
        for i in range(bounds[g], bounds[g + 1]):
            if abs(P[i, 2]) > h:
                continue
            v, cos = residual(q, h, P[i, 0], P[i, 1], P[i, 2], U[i, 0], U[i, 1], U[i, 2], known[i], J)
            if cos < least_cos:
                continue
            w = 1.0 / (1.0 + k2 * (1.0 - cos * cos) / (cos * cos)) if known[i] else 1.0
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
    return n, total


@njit(cache=True, nogil=True, inline="always")
def _shift_equations(A, y, shift, relative_sd):  # type: ignore[no-untyped-def]
    """Return the equations of a station's shift: prior's ratio, matrix (3 elements), determinant and right side."""
    ratio = relative_sd**2
    d00, d11, d10 = A[0, 0] + ratio, A[1, 1] + ratio, A[1, 0]
    return ratio, d00, d11, d10, d00 * d11 - d10 * d10, y[0] - ratio * shift[0], y[1] - ratio * shift[1]


@njit(cache=True, nogil=True, inline="always")
def element(A, a, k):  # type: ignore[no-untyped-def]
    """Element (a, k) of a symmetric matrix whose lower half is filled."""
    return A[a, k] if a >= k else A[k, a]


@inner
def spread_of(values, n):  # type: ignore[no-untyped-def]
    """Estimate the standard deviation of normal values by their median absolute size."""
    return MAD_TO_SD * np.median(np.abs(values[:n]))


@inner
def circle_along(P, low, high, reach, p, h):  # type: ignore[no-untyped-def]
    """Start ``p`` from an algebraic circle whose centre runs along a line: linear in (a, b, c, d, and the constant)."""
    A, y, x, none = np.zeros((5, 5)), np.zeros(5), np.zeros(5), np.zeros((0, 0))
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
        if n < 12 or not solve(A, y, len(y), x, none):
            return False
        mean2 = x[0] * x[0] + x[1] * x[1] + (x[2] * x[2] + x[3] * x[3]) / 3.0
        r2 = x[4] + mean2
        if not r2 > 0.0:
            return False
        p[0], p[1], p[2], p[3], p[4] = x[0], x[1], x[2], x[3], np.sqrt(r2)
    return True


@njit(cache=True, nogil=True)
def extent_of(p, h, observations, shifts, sigma, bins, width):  # type: ignore[no-untyped-def]
    """Find the ends of the stretch of points on the cylinder, by bins of ``width`` to both sides of the middle.

    Stations are shifted as in :func:`step`. Outward from the middle each point contributes 2 less its squared residual
    in standard deviations, limited to 6, to a sum: points on the surface raise it, others lower it, and one mixed pixel
    in five points does no harm. The end is where the sum is largest.
    """
    P, U, known, bounds = observations
    J = np.zeros(NP)
    bins[:] = 0.0
    count = len(bins)
    span = 0.5 * width * count
    q = p.copy()
    for g in range(len(bounds) - 1):
        q[0], q[1] = p[0] + shifts[g, 0], p[1] + shifts[g, 1]
        for i in range(bounds[g], bounds[g + 1]):
            at = int(np.floor((P[i, 2] + span) / width))
            if at < 0 or at >= count:
                continue
            v, cos = residual(q, h, P[i, 0], P[i, 1], P[i, 2], U[i, 0], U[i, 1], U[i, 2], known[i], J)
            if cos >= GRAZING_COS:
                bins[at] += 2.0 - min(6.0, (v * cos / sigma) ** 2)
                continue
            # A ray that grazes or misses is evidence only where its point is far off the surface.
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
