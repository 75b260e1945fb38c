"""How far stations stand from where they are said to, as the balls see it that several of them saw.

Each station's points of one ball may be off together. Were the shifts of one sd along each axis, normal and independent
between stations, the balls' residuals would be as likely as computed here; the likeliest sd is taken.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit

from processor.geometry.linalg_small import inverse_of, log_det
from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints, Labels
from processor.space_frame.spheres.gauss_newton import residual, variance

# In mm; the first is what the others must beat by EVIDENCE in chi-square.
GRID = np.array([0.0, 0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8, 1.1, 1.6, 2.2, 3.2, 4.5, 6.4])
EVIDENCE = 10.0
LEAST_BALLS = 5


def shift_sd(
    start: Ints,
    points: Floats,
    rays: Floats,
    ranges: Floats,
    station: Labels,
    on: Floats,
    states: Floats,
    usable: np.ndarray,
    noise: Floats,
    centre_weights: Floats,
    sizes: Floats,
    size_weight: float,
    threads: int = 0,
) -> float:
    """Return the likeliest sd in mm of a station's shift along each axis; 0 where the balls do not ask for one.

    ``on`` (n,) are the weights and ``states`` (k, 4) the balls of fits with stations that stand still.
    """
    nodes = len(states)
    costs, several = np.zeros((nodes, len(GRID))), np.zeros(nodes, np.uint8)
    over_ranges(
        lambda a, b: _cost_range(
            a, b, start, points, rays, ranges, station, on, states, usable, noise, centre_weights, sizes, size_weight,
            GRID, costs, several,
        ),
        nodes,
        threads,
    )  # fmt: skip
    if int(several.sum()) < LEAST_BALLS:
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
def _cost_at(  # type: ignore[no-untyped-def]
    k, start, points, rays, ranges, station, on, states, usable, noise, centre_weights, sizes, size_weight, grid,
    costs, several,
):  # fmt: skip
    """Fill the costs of node ``k``; see :func:`_cost_range`."""
    if not usable[k]:
        return
    x, y, z, r = states[k, 0], states[k, 1], states[k, 2], states[k, 3]
    first, last = start[k], start[k + 1]
    runs = 1
    for i in range(first + 1, last):
        runs += station[i] != station[i - 1]
    A, b, J = np.zeros((runs, 4, 4)), np.zeros((runs, 4)), np.empty(4)
    held = np.zeros(runs, np.int64)
    run = 0
    for i in range(first, last):
        if i > first and station[i] != station[i - 1]:
            run += 1
        if on[i] <= 0.0 or station[i] < 0:
            continue
        e, cosine, J[0], J[1], J[2], J[3] = residual(
            points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2], x, y, z, r
        )
        if cosine <= 0.02:
            continue
        w = on[i] / variance(noise, ranges[i], max(cosine, 0.1))
        held[run] += 1
        for p in range(4):
            b[run, p] += w * J[p] * e
            for q in range(4):
                A[run, p, q] += w * J[p] * J[q]
    stations = 0
    for run in range(runs):
        stations += held[run] > 0
    if stations < 2:
        return
    several[k] = 1
    inverse, M, S, gain = np.empty((4, 4)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 5))
    H, g = np.empty((4, 4)), np.empty(4)
    for t in range(len(grid)):
        for p in range(4):
            g[p] = size_weight * (r - sizes[k]) if p == 3 else 0.0
            for q in range(4):
                H[p, q] = 0.0
                if p < 3 and q < 3:
                    H[p, q] = centre_weights[k, p, q]
                    g[p] += centre_weights[k, p, q] * states[k, q]
        H[3, 3] = size_weight
        cost = 0.0
        for run in range(runs):
            if held[run] == 0:
                continue
            for p in range(4):
                g[p] += b[run, p]
                for q in range(4):
                    H[p, q] += A[run, p, q]
            if grid[t] == 0.0:
                continue
            for p in range(3):
                for q in range(3):
                    S[p, q] = A[run, p, q]
                S[p, p] += 1.0 / grid[t] ** 2
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
            cost += log_det(S) + 6.0 * np.log(grid[t])
        if not inverse_of(H, inverse):
            several[k] = 0
            break
        for p in range(4):
            for q in range(4):
                cost -= g[p] * inverse[p, q] * g[q]
        costs[k, t] = cost + log_det(H)
    if several[k] == 0:
        for t in range(len(grid)):
            costs[k, t] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _cost_range(  # type: ignore[no-untyped-def]
    begin, end, start, points, rays, ranges, station, on, states, usable, noise, centre_weights, sizes, size_weight,
    grid, costs, several,
):  # fmt: skip
    """Fill minus twice the logarithm of the likelihood (k, m) of each sd, and whether several stations saw the ball."""
    for k in range(begin, end):
        _cost_at(
            k, start, points, rays, ranges, station, on, states, usable, noise, centre_weights, sizes, size_weight,
            grid, costs, several,
        )  # fmt: skip
