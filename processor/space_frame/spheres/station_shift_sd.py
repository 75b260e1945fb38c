"""Standard deviation of the stations' shifts, estimated from spheres that several stations saw.

Each station's points on one sphere may be shifted together. Shifts are taken to be normal with the same standard
deviation along each axis, and independent between stations; the most likely standard deviation is returned.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from functools import partial

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry.linalg_small import inverse_of, log_det
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner_ieee
from processor.model import Floats
from processor.space_frame.spheres.gauss_newton import residual, variance
from processor.space_frame.spheres.records import CropsWithRays, Priors

# In mm. The others must beat the first by EVIDENCE in chi-square.
GRID = np.array([0.0, 0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8, 1.1, 1.6, 2.2, 3.2, 4.5, 6.4])
EVIDENCE = 10.0
LEAST_SPHERES = 5


def shift_sd(
    crops: CropsWithRays,
    weights: Floats,
    states: Floats,
    usable: npt.NDArray[np.bool_],
    noise: Floats,
    priors: Priors,
    threads: int = 0,
) -> float:
    """Return the most likely sd (mm) of a station's shift along each axis; 0 where the spheres do not require one.

    ``weights`` (n,) of points and ``states`` (k, 4) are those of fits with fixed stations.
    """
    nodes = len(states)
    costs, several = np.zeros((nodes, len(GRID))), np.zeros(nodes, np.uint8)
    cost_range = partial(_cost_range, crops, weights, states, usable, noise, priors, costs, several)
    over_ranges(cost_range, nodes, threads)
    if int(several.sum()) < LEAST_SPHERES:
        return 0.0
    total = costs.sum(axis=0)
    best = int(np.argmin(total))
    if not total[best] < total[0] - EVIDENCE:
        return 0.0
    if 1 < best < len(GRID) - 1:  # the vertex of the parabola through the three, in the logarithm
        x = np.log(GRID[best - 1 : best + 2])
        a, b, _ = np.polyfit(x - x[1], total[best - 1 : best + 2], 2)
        if a > 0.0:
            return float(np.exp(x[1] + np.clip(-0.5 * b / a, x[0] - x[1], x[2] - x[1])))
    return float(GRID[best])


@njit(cache=True, nogil=True, error_model="numpy")
def _cost_range(crops, weights, states, usable, noise, priors, costs, several, first, last):  # type: ignore[no-untyped-def]
    """Fill minus twice the log likelihood (k, m) of each sd, and whether several stations saw the sphere."""
    for k in range(first, last):
        if not usable[k]:
            continue
        A, b, count = _by_station(k, crops, weights, states[k], noise)
        if np.sum(count > 0) < 2:
            continue
        several[k] = 1
        for t in range(len(GRID)):
            costs[k, t] = _cost(A, b, count, GRID[t], states[k], k, priors)
            if np.isnan(costs[k, t]):
                several[k] = 0
                costs[k] = 0.0
                break


@njit(cache=True, nogil=True, error_model="numpy")
def _by_station(k, crops, weights, state, noise):  # type: ignore[no-untyped-def]
    """Information (g, 4, 4), gradient (g, 4) and number (g,) of the points of each station in turn on node ``k``."""
    first, last = crops.start[k], crops.start[k + 1]
    points, rays, station = crops.points, crops.rays, crops.station
    runs = 1
    for i in range(first + 1, last):
        runs += station[i] != station[i - 1]
    A, b, J = np.zeros((runs, 4, 4)), np.zeros((runs, 4)), np.empty(4)
    count = np.zeros(runs, np.int64)
    run = 0
    for i in range(first, last):
        if i > first and station[i] != station[i - 1]:
            run += 1
        if weights[i] <= 0.0 or station[i] < 0:
            continue
        e, cosine, J[0], J[1], J[2], J[3] = residual(
            points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2],
            state[0], state[1], state[2], state[3],
        )  # fmt: skip
        if cosine <= 0.02:
            continue
        w = weights[i] / variance(noise, crops.ranges[i], max(cosine, 0.1))
        count[run] += 1
        for p in range(4):
            b[run, p] += w * J[p] * e
            for q in range(4):
                A[run, p, q] += w * J[p] * J[q]
    return A, b, count


@inner_ieee
def _cost(A, b, count, sd, state, k, priors):  # type: ignore[no-untyped-def]
    """Minus twice the log likelihood of the shifts' ``sd`` by one sphere; NaN where the sphere is not determined."""
    inverse, M, S, gain = np.empty((4, 4)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 5))
    H, g = np.zeros((4, 4)), np.zeros(4)
    for p in range(3):
        for q in range(3):
            H[p, q] = priors.centre_weight[k, p, q]
            g[p] += priors.centre_weight[k, p, q] * state[q]
    H[3, 3] = priors.size_weights[k]
    g[3] = priors.size_weights[k] * (state[3] - priors.sizes[k])
    cost = 0.0
    for run in range(len(count)):
        if count[run] == 0:
            continue
        for p in range(4):
            g[p] += b[run, p]
            for q in range(4):
                H[p, q] += A[run, p, q]
        if sd == 0.0:
            continue
        for p in range(3):
            for q in range(3):
                S[p, q] = A[run, p, q]
            S[p, p] += 1.0 / sd**2
        if not inverse_of(S, M):
            continue
        for p in range(3):
            for q in range(5):
                gain[p, q] = 0.0
                for i in range(3):
                    gain[p, q] += M[p, i] * (A[run, i, q] if q < 4 else b[run, i])
        for p in range(4):
            for i in range(3):
                g[p] -= A[run, p, i] * gain[i, 4]
                for q in range(4):
                    H[p, q] -= A[run, p, i] * gain[i, q]
        for i in range(3):
            cost -= b[run, i] * gain[i, 4]
        cost += log_det(S) + 6.0 * np.log(sd)
    if not inverse_of(H, inverse):
        return np.nan
    for p in range(4):
        for q in range(4):
            cost -= g[p] * inverse[p, q] * g[q]
    return cost + log_det(H)
