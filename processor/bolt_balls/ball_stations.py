"""How far stations stand from where they are said to, as the balls see it that several of them saw.

Each station's points of one ball may be off together. Were the shifts of one sd along each axis, normal and independent
between stations, the balls' residuals would be as likely as computed here; the likeliest sd is taken.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit, prange

from processor.bolt_balls.ball_residuals import residual, variance
from processor.bolt_balls.ball_solve import inverse_of
from processor.model import Floats, Ints, Labels

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
) -> float:
    """Return the likeliest sd in mm of a station's shift along each axis; 0 where the balls do not ask for one.

    ``on`` (n,) are the weights and ``states`` (k, 4) the balls of fits with stations that stand still.
    """
    costs, several = _costs(
        start, points, rays, ranges, station, on, states, usable, noise, centre_weights, sizes, size_weight, GRID
    )
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


@njit(cache=True, nogil=True, parallel=True)
def _costs(  # type: ignore[no-untyped-def]
    start, points, rays, ranges, station, on, states, usable, noise, centre_weights, sizes, size_weight, grid
):
    """Minus twice the logarithm of the likelihood (k, m) of each sd, and whether several stations saw the ball (k,)."""
    nodes = len(start) - 1
    costs, several = np.zeros((nodes, len(grid))), np.zeros(nodes, np.uint8)
    for k in prange(nodes):
        if not usable[k]:
            continue
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
        if np.sum(held > 0) < 2:
            continue
        several[k] = 1
        inverse, M, S = np.empty((4, 4)), np.empty((3, 3)), np.empty((3, 3))
        for t in range(len(grid)):
            H, g = np.zeros((4, 4)), np.zeros(4)
            for p in range(3):
                for q in range(3):
                    H[p, q] = centre_weights[k, p, q]
                    g[p] += centre_weights[k, p, q] * states[k, q]
            H[3, 3] = size_weight
            g[3] = size_weight * (r - sizes[k])
            cost = 0.0
            for run in range(runs):
                if held[run] == 0:
                    continue
                H += A[run]
                g += b[run]
                if grid[t] == 0.0:
                    continue
                S[:, :] = A[run, :3, :3]
                for p in range(3):
                    S[p, p] += 1.0 / grid[t] ** 2
                if not inverse_of(S, M):
                    continue
                gain = M @ np.ascontiguousarray(A[run, :3, :])
                H -= A[run, :, :3].copy() @ gain
                Mb = M @ b[run, :3]
                g -= A[run, :, :3].copy() @ Mb
                cost -= b[run, :3] @ Mb
                cost += np.log(np.linalg.det(S)) + 6.0 * np.log(grid[t])
            if not inverse_of(H, inverse):
                several[k] = 0
                break
            cost -= g @ (inverse @ g)
            cost += np.log(np.linalg.det(H))
            costs[k, t] = cost
        if several[k] == 0:
            costs[k] = 0.0
    return costs, several
