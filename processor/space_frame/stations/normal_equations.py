"""Compiled kernels of the stations' self-registration: the normal equations, tubes eliminated.

All sums run in one order, whatever the number of threads.
"""
# Numba infers the types of the arguments: they stay without annotations.

from __future__ import annotations

from functools import partial

import numpy as np
from numba import njit

from processor.geometry.linalg_small import cholesky, solve
from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints
from processor.space_frame.stations.residual_kernels import LEAST, STATION, TUBE

MOVED = (0, 1, 2, 3, 7)  # of what an observation tells of, what follows the station
BLOCKS = 16  # of tubes, that are summed apart and then together


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


@njit(cache=True, nogil=True)
def _reduced(  # type: ignore[no-untyped-def]
    N, b, weight, floor, tube_obs, station, axis, e1, e2, half, places, prior, H, g, first, last
):
    m = len(tube_obs) - 1
    for block in range(first, last):
        for j in range(block * m // BLOCKS, (block + 1) * m // BLOCKS):
            if tube_obs[j + 1] - tube_obs[j] > 1:
                add_tube(
                    N, b, weight, floor, tube_obs[j], tube_obs[j + 1], station, axis[j], e1[j], e2[j], half[j], places,
                    prior[j], H[block], g[block],
                )  # fmt: skip


def reduced(
    N: Floats, b: Floats, weight: Floats, floor: float, tube_obs: Ints, station: Ints, axis: Floats, e1: Floats,
    e2: Floats, half: Floats, places: Floats, prior: Floats, threads: int = 0,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Sum up the stations' normal matrix (7 s, 7 s) and right side (7 s,), tubes eliminated one after another.

    An observation sees the tube's unknowns less the station's motion: y = a_j - G x_s. ``prior`` (m, 8) is the
    information on each tube's own unknowns. The number of blocks is fixed, so that the sum does not vary with threads.
    """
    size = STATION * len(places)
    H, g = np.zeros((BLOCKS, size, size)), np.zeros((BLOCKS, size))
    arguments = (N, b, weight, floor, tube_obs, station, axis, e1, e2, half, places, prior)
    over_ranges(partial(_reduced, *arguments, H, g), BLOCKS, threads)
    upper = H.sum(axis=0)
    return np.triu(upper) + np.triu(upper, 1).T, g.sum(axis=0)


@njit(cache=True, nogil=True)
def _tubes(  # type: ignore[no-untyped-def]
    N, b, weight, floor, tube_obs, station, axis, e1, e2, half, places, prior, x, off, found, differs, begin, end
):
    for j in range(begin, end):
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


def tubes(
    N: Floats, b: Floats, weight: Floats, floor: float, tube_obs: Ints, station: Ints, axis: Floats, e1: Floats,
    e2: Floats, half: Floats, places: Floats, prior: Floats, x: Floats, off: float, threads: int = 0,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Unknowns (m, 8) of the tubes given the stations' x (7 s,), and how each observation differs from them.

    The difference (q, 3) is the score statistic of an observation that lies off by ``off`` (variance, mm^2) along e1
    and e2, u' (N + 1/off)^-1 u of u = N (y - a + G x); what it is on average if none does; and how much this grows
    with each mm^2 by which they do.
    """
    found, differs = np.zeros((len(tube_obs) - 1, TUBE)), np.zeros((len(station), 3))
    arguments = (N, b, weight, floor, tube_obs, station, axis, e1, e2, half, places, prior, x, off)
    over_ranges(partial(_tubes, *arguments, found, differs), len(tube_obs) - 1, threads, LEAST)
    return found, differs
