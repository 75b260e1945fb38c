"""Compiled final fit of every ball whose size is chosen: state, covariance, bound and what it rests on."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import math

import numpy as np
from numba import njit

from processor.geometry.linalg_small import inverse_of
from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints, Labels
from processor.space_frame.spheres.gauss_newton import normal_equations, residual, solve, variance, weight
from processor.space_frame.spheres.size_selection import AROUND_MM, COARSE_MM, fit_one, rows_within, segments, taken

SETTLED_MM = 1e-6
TURNS = 4  # of the scale and the fit by it
LARGEST_BIAS = 0.3  # sd
BANDS, SECTORS = 10, 20  # cells of equal area that the visible share is counted in


@njit(cache=True, nogil=True, error_model="numpy")
def leftover(  # type: ignore[no-untyped-def]
    points, rays, ranges, station, chosen, noise, state, shifts, gains, covariance, errors, cosines, on, cells
):  # fmt: skip
    """Fill each chosen point's residual, cosine and weight.

    Returns the sums of w, of w u^2, of w leverage and of w e^2, cells and stations.

    Residuals are divided by sqrt(1 - leverage), so that their spread is the noise itself however few there are.
    """
    J, K = np.empty(4), np.empty(4)
    weights, squares, leverages, plain = 0.0, 0.0, 0.0, 0.0
    segment, inside, stations, seen = 0, False, 0, 0
    for i in range(len(cells)):
        cells[i] = 0
    for i in range(len(points)):
        on[i] = 0.0
        if chosen[i] == 1:
            e, cosine, J[0], J[1], J[2], J[3] = residual(
                points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2],
                state[0] + shifts[segment, 0], state[1] + shifts[segment, 1], state[2] + shifts[segment, 2], state[3],
            )  # fmt: skip
            if cosine > 0.02:
                v = variance(noise, ranges[i], max(cosine, 0.1))
                w = weight(e / np.sqrt(v))
                h = 0.0
                for p in range(4):
                    K[p] = J[p]
                    for q in range(3):
                        K[p] -= J[q] * gains[segment, q, p]
                for p in range(4):
                    for q in range(4):
                        h += K[p] * covariance[p, q] * K[q]
                        if p < 3 and q < 3:
                            h += J[p] * gains[segment, p, 5 + q] * J[q]
                h = min(h / v, 0.9)
                errors[i] = e / np.sqrt(1.0 - h)
                cosines[i] = cosine
                on[i] = w
                weights += w
                squares += w * e * e / v
                plain += w * e * e
                leverages += w * h
                if w > 0.0:
                    inside = True
                    sphere_x = points[i, 0] - state[0] - shifts[segment, 0]
                    sphere_y = points[i, 1] - state[1] - shifts[segment, 1]
                    sphere_z = points[i, 2] - state[2] - shifts[segment, 2]
                    d = np.sqrt(sphere_x**2 + sphere_y**2 + sphere_z**2)
                    band = min(max(int(np.floor((sphere_z / d + 1.0) * (BANDS / 2.0))), 0), BANDS - 1)
                    turn = math.atan2(sphere_y, sphere_x) / (2.0 * np.pi) + 0.5
                    sector = min(max(int(np.floor(turn * SECTORS)), 0), SECTORS - 1)
                    seen += 1 - cells[band * SECTORS + sector]
                    cells[band * SECTORS + sector] = 1
        if i + 1 == len(points) or station[i + 1] != station[i]:
            segment += 1
            if inside:
                stations += 1
            inside = False
    return weights, squares, leverages, plain, seen, stations


@njit(cache=True, nogil=True, error_model="numpy")
def bias(  # type: ignore[no-untyped-def]
    points, rays, ranges, chosen, noise, state, covariance, found
):
    """Fill the bias (4,) of least squares by the residuals' curvature, -1/2 C sum J w trace(C H).

    Source: M. J. Box, Bias in nonlinear estimation, J. Roy. Statist. Soc. B 33 (1971), 171-201.
    """
    cx, cy, cz, r = state[0], state[1], state[2], state[3]
    total, J, v, u = np.zeros(4), np.empty(4), np.empty(3), np.empty(3)
    for i in range(len(points)):
        if chosen[i] != 1:
            continue
        e, cosine, J[0], J[1], J[2], J[3] = residual(
            points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2], cx, cy, cz, r
        )
        if cosine <= 0.1:
            continue
        s2 = variance(noise, ranges[i], cosine)
        w = weight(e / np.sqrt(s2)) / s2
        u[0], u[1], u[2] = rays[i, 0], rays[i, 1], rays[i, 2]
        trace = 0.0
        if u[0] == 0.0 and u[1] == 0.0 and u[2] == 0.0:  # distance from the centre: (1 - n n') / distance
            for p in range(3):
                for q in range(3):
                    trace += covariance[p, q] * ((1.0 if p == q else 0.0) - J[p] * J[q]) / (r + e)
        else:
            root = cosine * r
            for p in range(3):
                v[p] = -(J[p] + u[p]) * root
            v2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
            for p in range(3):
                for q in range(3):
                    across = (1.0 if p == q else 0.0) - u[p] * u[q]
                    trace -= covariance[p, q] * (across / root + v[p] * v[q] / root**3)
                trace += 2.0 * covariance[p, 3] * v[p] * r / root**3
            trace -= covariance[3, 3] * v2 / root**3
        for p in range(4):
            total[p] += w * J[p] * trace
    for p in range(4):
        found[p] = 0.0
        for q in range(4):
            found[p] -= 0.5 * covariance[p, q] * total[q]


@njit(cache=True, nogil=True, error_model="numpy")
def lean(points, rays, chosen, noise, state, covariance, found):  # type: ignore[no-untyped-def]
    """Fill what noise moves the state (4,) by where rays are unknown, if it is the same in all directions.

    Noise across the normal of a sphere takes points off its centre by variance / distance in the mean. Of noise along a
    ray only a part is across.
    """
    J, total = np.empty(4), np.zeros(4)
    for i in range(len(points)):
        if chosen[i] != 1 or rays[i, 0] != 0.0 or rays[i, 1] != 0.0 or rays[i, 2] != 0.0:
            continue
        e, cosine, J[0], J[1], J[2], J[3] = residual(
            points[i, 0], points[i, 1], points[i, 2], 0.0, 0.0, 0.0, state[0], state[1], state[2], state[3]
        )
        if cosine > 0.0:
            w = weight(e / np.sqrt(variance(noise, 0.0, 1.0))) / (state[3] + e)
            for p in range(4):
                total[p] += w * J[p]
    for p in range(4):
        found[p] = 0.0
        for q in range(4):
            found[p] -= covariance[p, q] * total[q]


@njit(cache=True, nogil=True, error_model="numpy")
def finish_at(  # type: ignore[no-untyped-def]
    k, start, points, rays, ranges, station, end_start, axis_points, axes, keep_off, hole, least_cosine, noise,
    believed, centre_weight, sizes, size_weights, states, catch, shift_covariance, found, covariances, bounds,
    numbers, errors, cosines, on,
):  # fmt: skip
    """Fit node ``k``; see :func:`finish`."""
    if np.isnan(states[k, 0]) or start[k + 1] == start[k]:
        return
    a, b = start[k], start[k + 1]
    rows = rows_within(points[a:b], states[k, 3] - AROUND_MM, states[k, 3] + AROUND_MM)
    n = len(rows)
    if n == 0:
        return
    p, u, L, s = taken(rows, points[a:b], rays[a:b], ranges[a:b], station[a:b])
    e, c, w = np.zeros(n), np.zeros(n), np.zeros(n)
    ap, ad = axis_points[end_start[k] : end_start[k + 1]], axes[end_start[k] : end_start[k + 1]]
    keep = keep_off[end_start[k] : end_start[k + 1]]
    state = states[k].copy()
    origin = np.zeros(3)
    shifts = np.zeros((segments(s), 3))
    gains = np.zeros((len(shifts), 3, 8))
    chosen = np.zeros(n, np.uint8)
    covariance, cells = np.zeros((4, 4)), np.zeros(BANDS * SECTORS, np.int64)
    used = fit_one(
        p, u, L, s, ap, ad, keep, hole, least_cosine, noise, origin, centre_weight[k], sizes[k], size_weights[k],
        shift_covariance, catch, SETTLED_MM, state, shifts, chosen, covariance,
    )  # fmt: skip
    if used < 1:
        return
    scale = 1.0
    local = noise.copy()
    free = 0.0
    # as variables: numba compiles a kernel anew for every literal
    steps, robust, whole = 6, False, True
    if n > 0:
        steps, robust, whole = 10, n < 0, n > 0
    for turn in range(TURNS):
        weights, squares, leverages, plain, seen, stations = leftover(
            p, u, L, s, chosen, local, state, shifts, gains, covariance, e, c, w, cells,
        )  # fmt: skip
        free = max(weights - leverages, 0.0)
        scale2 = (believed + squares * scale * scale) / (believed + free) if believed + free > 0.0 else 1.0
        scale = np.sqrt(scale2)
        for i in range(3):
            local[i] = noise[i] * scale2
        used = solve(
            p, u, L, s, chosen, local, 1.0, origin, centre_weight[k], sizes[k], size_weights[k], shift_covariance,
            SETTLED_MM if turn + 1 == TURNS else COARSE_MM, state, shifts, gains, steps, covariance,
        )  # fmt: skip
        if used < 1:
            break
    if used < 1:
        return
    H, g = np.empty((4, 4)), np.empty(4)
    normal_equations(
        p, u, L, s, chosen, local, 1.0, robust, origin, centre_weight[k], sizes[k], size_weights[k],
        shift_covariance, state, shifts, gains, H, g,
    )  # fmt: skip
    if not inverse_of(H, covariance):
        return
    weights, squares, leverages, plain, seen, stations = leftover(
        p, u, L, s, chosen, local, state, shifts, gains, covariance, e, c, w, cells,
    )  # fmt: skip
    bound = np.empty((4, 4))
    used = normal_equations(
        p, u, L, s, chosen, local, 1.0, whole, origin, centre_weight[k], sizes[k], size_weights[k],
        shift_covariance[:0], state, shifts, gains, H, g,
    )  # fmt: skip
    if not inverse_of(H, bound):
        return
    chi2 = 0.0
    for i in range(3):
        for j in range(3):
            chi2 += state[i] * centre_weight[k, i, j] * state[j]
    off = np.zeros(4)
    bias(p, u, L, chosen, local, state, covariance, off)
    largest = 0.0
    for i in range(4):
        largest = max(largest, abs(off[i]) / np.sqrt(covariance[i, i]))
    if largest < LARGEST_BIAS:  # beyond it the series has no meaning, nor has the ball
        for i in range(4):
            state[i] -= off[i]
    # Where rays are unknown noise moves the ball by nothing to all of this; as far off are both from the middle.
    lean(p, u, chosen, local, state, covariance, off)
    for i in range(4):
        state[i] -= 0.5 * off[i]
        for j in range(4):
            covariance[i, j] += off[i] * off[j] / 12.0
    for i in range(n):
        errors[a + rows[i]], cosines[a + rows[i]], on[a + rows[i]] = e[i], c[i], w[i]
    for i in range(4):
        found[k, i] = state[i]
        for j in range(4):
            covariances[k, i, j], bounds[k, i, j] = covariance[i, j], bound[i, j]
    numbers[k, 0], numbers[k, 1], numbers[k, 2] = used, seen, stations
    numbers[k, 3] = np.sqrt(plain / max(weights, 1e-9))
    numbers[k, 4], numbers[k, 5] = scale, believed + free
    numbers[k, 6], numbers[k, 7] = chi2, 1.0


def finish(
    crops: tuple[Ints, Floats, Floats, Floats, Labels],
    ends: tuple[Ints, Floats, Floats, Floats],
    limits: tuple[float, float],
    noise: Floats,
    believed: float,
    centre_weight: Floats,
    sizes: Floats,
    size_weights: Floats,
    states: Floats,
    catch: float,
    shift_covariance: Floats,
    threads: int = 0,
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats, Floats]:
    """Fit every node whose state (k, 4) is finite, with its size's prior, and say how well.

    ``believed`` is how many points the noise model is worth: the scale about it is estimated ball by ball, its squares
    with as many degrees of freedom as points, and the model's own beside them. The bounds are those of the noise and
    the priors with every point at its full weight and stations that stand still.

    ``crops``, ``ends`` and ``limits`` are those of :func:`~processor.space_frame.spheres.size_selection.choose`,
    without the tubes'.
    Returns states (k, 4), covariances (k, 4, 4), bounds (k, 4, 4), numbers (k, 8) = points, cells, stations, rms, scale
    about the noise model, degrees of freedom, chi-square of the centre's prior, whether it fitted; and of every point
    residual, cosine and weight.
    """
    nodes, count = len(states), len(crops[1])
    found, numbers = np.full((nodes, 4), np.nan), np.zeros((nodes, 8))
    covariances, bounds = np.full((nodes, 4, 4), np.nan), np.full((nodes, 4, 4), np.nan)
    errors, cosines, on = np.zeros(count), np.zeros(count), np.zeros(count)
    over_ranges(
        lambda a, b: _finish_range(
            a, b, *crops, *ends, *limits, noise, believed, centre_weight, sizes, size_weights, states, catch,
            shift_covariance, found, covariances, bounds, numbers, errors, cosines, on,
        ),
        nodes,
        threads,
    )  # fmt: skip
    return found, covariances, bounds, numbers, errors, cosines, on


@njit(cache=True, nogil=True, error_model="numpy")
def _finish_range(  # type: ignore[no-untyped-def]
    begin, end, start, points, rays, ranges, station, end_start, axis_points, axes, keep_off, hole, least_cosine,
    noise, believed, centre_weight, sizes, size_weights, states, catch, shift_covariance, found, covariances, bounds,
    numbers, errors, cosines, on,
):  # fmt: skip
    """Fit nodes ``begin`` to ``end``; see :func:`finish`."""
    for k in range(begin, end):
        finish_at(
            k, start, points, rays, ranges, station, end_start, axis_points, axes, keep_off, hole, least_cosine, noise,
            believed, centre_weight, sizes, size_weights, states, catch, shift_covariance, found, covariances, bounds,
            numbers, errors, cosines, on,
        )  # fmt: skip
