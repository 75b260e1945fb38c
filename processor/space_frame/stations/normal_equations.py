"""Compiled kernels of the stations' self-registration: the normal equations, tubes eliminated, and small algebra.

All sums run in one order for any number of threads; those of LAPACK and BLAS do not.
"""
# Numba infers the types of the arguments: they stay without annotations.

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.linalg_small import assign, cholesky, solve
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner
from processor.model import Floats
from processor.space_frame.stations.residual_kernels import LEAST, STATION, TUBE, Axes, Layout

MOVED = (0, 1, 2, 3, 7)  # unknowns of an observation that depend on the station
BLOCKS = 16  # of tubes, that are summed separately and then together


class Equations(NamedTuple):
    """Information N (q, 8, 8) and N y (q, 8) of observations, their weights (q,), and the floor.

    ``floor`` is the variance by which an observation deviates beyond its points' noise along e1 and e2, mm^2.
    """

    N: Floats
    b: Floats
    weight: Floats
    floor: float


class Geometry(NamedTuple):
    """Axes of the tubes, places (s, 3) of the stations, and the prior information (m, 8) on each tube's unknowns."""

    axes: Axes
    places: Floats
    prior: Floats


@njit(cache=True, nogil=True)
def arm(geometry, j, s):  # type: ignore[no-untyped-def]
    """Return the derivatives (8, 7) of the unknowns of an observation of tube ``j`` by those of its station ``s``."""
    axes, place = geometry.axes, geometry.places[s]
    axis, e1, e2, half = axes.line[j], axes.e1[j], axes.e2[j], axes.half[j]
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
    """Information N and N y of an observation that deviates by variance ``floor`` (mm^2) along e1 and e2."""
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


@inner
def add_tube(j, equations, layout, geometry, H, g):  # type: ignore[no-untyped-def]
    """Add to the upper half of H, and to g, the stations' equations by the observations of tube ``j``, eliminated."""
    N, b, weight, floor = equations
    first, station = layout.of_tube[j], layout.station
    number = layout.of_tube[j + 1] - first
    width = STATION * number
    A, total = np.diag(geometry.prior[j]), np.zeros(TUBE)
    K = np.zeros((TUBE, width))
    local, right = np.zeros((width, width)), np.zeros(width)
    for o in range(number):
        q = first + o
        M, y = with_floor(N[q], b[q], floor)
        G = arm(geometry, j, station[q])
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
    for k in range(TUBE):
        assign(S[k], K[k])
        S[k, width] = total[k]
    S = solve(L, S)
    for c in range(width):
        for k in range(TUBE):
            value = K[k, c]
            right[c] += value * S[k, width]
            for d in range(STATION * (c // STATION), width):
                local[c, d] -= value * S[k, d]
    for o in range(number):  # observations are sorted by station
        at = STATION * station[first + o]
        for c in range(STATION):
            g[at + c] += right[STATION * o + c]
        for p in range(o, number):
            to = STATION * station[first + p]
            for c in range(STATION):
                for d in range(STATION):
                    H[at + c, to + d] += local[STATION * o + c, STATION * p + d]


@njit(cache=True, nogil=True)
def _reduced(equations, layout, geometry, H, g, first, last):  # type: ignore[no-untyped-def]
    m = len(layout.of_tube) - 1
    for block in range(first, last):
        for j in range(block * m // BLOCKS, (block + 1) * m // BLOCKS):
            if layout.of_tube[j + 1] - layout.of_tube[j] > 1:
                add_tube(j, equations, layout, geometry, H[block], g[block])


def reduced(equations: Equations, layout: Layout, geometry: Geometry, threads: int = 0) -> tuple[Floats, Floats]:
    """Sum up the stations' normal matrix (7 s, 7 s) and right side (7 s,), tubes eliminated one after another.

    An observation measures the tube's unknowns less the station's motion: y = a_j - G x_s. The number of blocks is
    fixed, so that the sum does not vary with threads.
    """
    size = STATION * len(geometry.places)
    H, g = np.zeros((BLOCKS, size, size)), np.zeros((BLOCKS, size))
    over_ranges(partial(_reduced, equations, layout, geometry, H, g), BLOCKS, threads)
    upper = H.sum(axis=0)
    return np.triu(upper) + np.triu(upper, 1).T, g.sum(axis=0)


@njit(cache=True, nogil=True)
def _tubes(equations, layout, geometry, x, off, unknowns, scores, begin, end):  # type: ignore[no-untyped-def]
    N, b, weight, floor = equations
    station = layout.station
    for j in range(begin, end):
        first, last = layout.of_tube[j], layout.of_tube[j + 1]
        if last == first:
            continue
        A, total = np.diag(geometry.prior[j]), np.zeros(TUBE)
        for q in range(first, last):
            M, y = with_floor(N[q], b[q], floor)
            G = arm(geometry, j, station[q])
            A += weight[q] * M
            motion = np.zeros(TUBE)
            for k in MOVED:
                for c in range(STATION):
                    motion[k] += G[k, c] * x[STATION * station[q] + c]
            for a in range(TUBE):
                for k in MOVED:
                    y[a] += M[a, k] * motion[k]
            total += weight[q] * y
        L = cholesky(A)
        if np.isnan(L[0, 0]):
            continue
        a = solve(L, total.reshape(-1, 1))[:, 0]
        assign(unknowns[j], a)
        for q in range(first, last):
            M, y = with_floor(N[q], b[q], floor)
            G = arm(geometry, j, station[q])
            rest = -a
            for k in MOVED:
                for c in range(STATION):
                    rest[k] += G[k, c] * x[STATION * station[q] + c]
            _score(M, y, rest, L, weight[q], off, scores[q])


@njit(cache=True, nogil=True)
def _score(M, y, rest, L, weight, off, score):  # type: ignore[no-untyped-def]
    """Fill the score (3,) of one observation; see :func:`tubes`."""
    u0, u1 = y[0], y[1]
    for k in range(TUBE):
        u0 += M[0, k] * rest[k]
        u1 += M[1, k] * rest[k]
    # the variance of u is N - N A^-1 N, because the observation has a part in the tube's unknowns
    S = solve(L, np.ascontiguousarray(M[:, :2]))
    v00, v01, v11 = M[0, 0], M[0, 1], M[1, 1]
    for k in range(TUBE):
        v00 -= weight * M[0, k] * S[k, 0]
        v01 -= weight * M[0, k] * S[k, 1]
        v11 -= weight * M[1, k] * S[k, 1]
    c00, c01, c11 = M[0, 0] + 1.0 / off, M[0, 1], M[1, 1] + 1.0 / off
    det = c00 * c11 - c01 * c01
    score[0] = (c11 * u0 * u0 - 2.0 * c01 * u0 * u1 + c00 * u1 * u1) / det
    score[1] = (c11 * v00 - 2.0 * c01 * v01 + c00 * v11) / det
    s00, s01, s11 = v00 * v00 + v01 * v01, v01 * (v00 + v11), v01 * v01 + v11 * v11
    score[2] = (c11 * s00 - 2.0 * c01 * s01 + c00 * s11) / det


def tubes(
    equations: Equations, layout: Layout, geometry: Geometry, x: Floats, off: float, threads: int = 0
) -> tuple[Floats, Floats]:
    """Unknowns (m, 8) of the tubes given the stations' x (7 s,), and the score (q, 3) of each observation.

    The score statistic tests for a deviation of variance ``off`` (mm^2) of an observation along e1 and e2:
    u' (N + 1/off)^-1 u of u = N (y - a + G x). With it come its expectation without deviations, and the growth of the
    expectation with each mm^2 of their variance.
    """
    count = len(layout.of_tube) - 1
    unknowns, scores = np.zeros((count, TUBE)), np.zeros((len(layout.station), 3))
    kernel = partial(_tubes, equations, layout, geometry, np.ascontiguousarray(x), off, unknowns, scores)
    over_ranges(kernel, count, threads, LEAST)
    return unknowns, scores
