"""Compiled fit of one ball: centre and radius by robust residuals along the ray, with priors.

Each station may be shifted as a whole by an unknown vector of known covariance (from its registration). The shift is
estimated with the sphere and so enters the sphere's covariance. Coordinates are relative to the node, so that the
prior of the centre has mean 0. The final fit, once the size of the ball is chosen, also has the bound of its
covariance and what it rests on.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.linalg_small import assign, assign_rows, inverse_of
from processor.geometry.sphere import BANDS, SECTORS
from processor.geometry.sphere_fit import residual
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner_ieee
from processor.model import Floats, Labels
from processor.space_frame.points.sphere_crops import CropsWithRays
from processor.space_frame.spheres.records import (
    CELLS,
    CENTRE_CHI2,
    DEGREES,
    FITTED,
    POINTS,
    RMS,
    SCALE,
    STATIONS,
    Finished,
    Masks,
    Priors,
    Residuals,
    StochasticModel,
)

LEAST_COSINE = 0.15  # of incidence, 81 degrees: nearer to the limb a beam is split between ball and background
MISSED, VISIBLE, MASKED = 0, 1, 2  # what a ray meets
FULL_SD, CUT_SD = 3.0, 4.5  # residuals up to the first have weight 1, beyond the second weight 0
GATE_MM = 40.0  # chosen: from the sphere at the start: as far as crossings of axes may be off a centre
AROUND_MM = 25.0  # points farther from a sphere's surface are not used
COARSE_MM, FINE_MM = 1e-3, 1e-4  # step that ends an iteration before the last; which tolerances take one iteration less
TOLERANCE_MM = 1e-6  # step that ends the last: rounding
ITERATIONS = 4  # alternations of the scale and the fit by it
LARGEST_BIAS = 0.3  # sd


class Observations(NamedTuple):
    """Points of one sphere by station: see :class:`~processor.space_frame.points.sphere_crops.CropsWithRays`."""

    points: Floats
    rays: Floats
    ranges: Floats
    station: Labels


class SphereMask(NamedTuple):
    """Mask of one sphere; see :class:`~processor.space_frame.spheres.records.Masks`."""

    axis_points: Floats
    axes: Floats
    keep_off: Floats
    hole: float
    least_cosine: float


class Prior(NamedTuple):
    """Inverse covariance (3, 3) of the centre about 0, and radius with its weight (1 / variance)."""

    centre_weight: Floats
    radius: float
    radius_weight: float


class Unknowns(NamedTuple):
    """State (x, y, z, r), shift (g, 3) of each station in turn, and the gains (g, 3, 8) that eliminate the shifts."""

    state: Floats
    shifts: Floats
    gains: Floats


class NormalEquations(NamedTuple):
    """Matrix H (4, 4) and gradient g (4,) of the state."""

    H: Floats
    g: Floats


# --- weights and the choice of points --------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def weight(t):  # type: ignore[no-untyped-def]
    """Weight of a residual of t sd: 1 up to FULL_SD, then a biweight that is 0 from CUT_SD."""
    t = abs(t)
    if t <= FULL_SD:
        return 1.0
    if t >= CUT_SD:
        return 0.0
    q = (t - FULL_SD) / (CUT_SD - FULL_SD)
    return (1.0 - q * q) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def variance(noise, distance, cosine):  # type: ignore[no-untyped-def]
    """Variance of a range: constant, signal (R^2 / cosine) and footprint (tangent^2) parts, mm^2."""
    c2 = cosine * cosine
    return noise[0] + noise[1] * distance * distance / cosine + noise[2] * (1.0 - c2) / c2


@njit(cache=True, nogil=True, error_model="numpy")
def select(points, rays, mask, state, gate, surface):  # type: ignore[no-untyped-def]
    """Mark points in ``surface`` (n,) by where their rays meet the model, and count those on visible surface.

    VISIBLE: the ray meets the sphere's own visible surface. MASKED: it meets masked surface, that is flats and
    sleeves (``keep_off`` from each member's axis) or the process hole about the lowest point. MISSED: it misses the
    model or its incidence is below ``least_cosine``. The noisy point itself is not used. ``gate`` (mm) only saves work:
    it is far beyond the noise.
    """
    cx, cy, cz, r = state[0], state[1], state[2], state[3]
    total = 0
    for i in range(len(points)):
        surface[i] = MISSED
        e, cosine, jx, jy, jz, _ = residual(
            points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2], cx, cy, cz, r
        )
        if cosine < mask.least_cosine or abs(e) > gate:
            continue
        if rays[i, 0] == 0.0 and rays[i, 1] == 0.0 and rays[i, 2] == 0.0:
            qx, qy, qz = -r * jx, -r * jy, -r * jz
        else:
            qx = points[i, 0] - e * rays[i, 0] - cx
            qy = points[i, 1] - e * rays[i, 1] - cy
            qz = points[i, 2] - e * rays[i, 2] - cz
        masked = qz < 0.0 and qx * qx + qy * qy < mask.hole * mask.hole
        for m in range(len(mask.axes)):
            if masked:
                break
            dx, dy, dz = mask.axes[m, 0], mask.axes[m, 1], mask.axes[m, 2]
            sx = qx + cx - mask.axis_points[m, 0]
            sy = qy + cy - mask.axis_points[m, 1]
            sz = qz + cz - mask.axis_points[m, 2]
            along = sx * dx + sy * dy + sz * dz
            across2 = sx * sx + sy * sy + sz * sz - along * along
            masked = along > 0.0 and across2 < mask.keep_off[m] * mask.keep_off[m]
        surface[i] = MASKED if masked else VISIBLE
        total += not masked
    return total


# --- normal equations and their solution -----------------------------------------------------------------------------


@inner_ieee
def _add_shifted(A, b, T, shift, normal, gain):  # type: ignore[no-untyped-def]
    """Add one station's information A (4, 4) and gradient b (4,), its unknown shift of covariance T eliminated.

    ``gain`` (3, 8) is filled so that the shift's own step is -(gain[:, :4] . step of the state + gain[:, 4]), and the
    shift's covariance given the state is gain[:, 5:].
    """
    W, S = np.empty((3, 3)), np.empty((3, 3))
    if not inverse_of(T, W):
        return False
    for i in range(3):
        for j in range(3):
            S[i, j] = A[i, j] + W[i, j]
    M = np.empty((3, 3))
    if not inverse_of(S, M):
        return False
    for i in range(3):
        for k in range(3):
            gain[i, 5 + k] = M[i, k]
    for i in range(3):
        for k in range(5):
            total = 0.0
            for j in range(3):
                total += M[i, j] * (
                    A[j, k] if k < 4 else b[j] + W[j, 0] * shift[0] + W[j, 1] * shift[1] + W[j, 2] * shift[2]
                )
            gain[i, k] = total
    for i in range(4):
        for j in range(4):
            normal.H[i, j] += A[i, j]
            for k in range(3):
                normal.H[i, j] -= A[i, k] * gain[k, j]
        normal.g[i] += b[i]
        for k in range(3):
            normal.g[i] -= A[i, k] * gain[k, 4]
    return True


@inner_ieee
def _start_from(prior, state, normal):  # type: ignore[no-untyped-def]
    """Set the normal equations to those of the prior alone."""
    H, g = normal.H, normal.g
    for i in range(4):
        g[i] = 0.0
        for j in range(4):
            H[i, j] = 0.0
    for i in range(3):
        for j in range(3):
            H[i, j] = prior.centre_weight[i, j]
            g[i] += prior.centre_weight[i, j] * state[j]
    H[3, 3] = prior.radius_weight
    g[3] = prior.radius_weight * (state[3] - prior.radius)


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(observations, surface, model, stretch, whole, prior, unknowns, normal):  # type: ignore[no-untyped-def]
    """Fill the normal equations at the unknowns; returns the number of points of weight above 0.

    ``stretch`` widens the robust cut; ``whole`` gives all these points their full weight.
    """
    points, rays, ranges, station = observations
    state, shifts, gains = unknowns
    H, g = normal.H, normal.g
    _start_from(prior, state, normal)
    A, b, J = np.zeros((4, 4)), np.zeros(4), np.empty(4)
    n = len(points)
    used, segment, inside = 0, 0, 0
    for i in range(n):
        if surface[i] == VISIBLE:
            cx = state[0] + shifts[segment, 0]
            cy = state[1] + shifts[segment, 1]
            cz = state[2] + shifts[segment, 2]
            e, cosine, J[0], J[1], J[2], J[3] = residual(
                points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2], cx, cy, cz, state[3]
            )
            if cosine > 0.02:
                v = variance(model.noise, ranges[i], max(cosine, 0.1))
                w = weight(e / (stretch * np.sqrt(v)))
                if w > 0.0:
                    used += 1
                    inside += 1
                    w = (1.0 if whole else w) / v
                    for p in range(4):
                        b[p] += w * J[p] * e
                        for q in range(p + 1):
                            A[p, q] += w * J[p] * J[q]
        if i + 1 == n or station[i + 1] != station[i]:
            for p in range(4):
                for q in range(p):
                    A[q, p] = A[p, q]
            s = station[i]
            eliminated = False
            if inside > 0 and s >= 0 and s < len(model.shift_covariance) and model.shift_covariance[s, 0, 0] > 0.0:
                eliminated = _add_shifted(A, b, model.shift_covariance[s], shifts[segment], normal, gains[segment])
            if not eliminated:
                for p in range(4):
                    g[p] += b[p]
                    for q in range(4):
                        H[p, q] += A[p, q]
                for p in range(3):
                    for q in range(8):
                        gains[segment, p, q] = 0.0
            for p in range(4):
                b[p] = 0.0
                for q in range(4):
                    A[p, q] = 0.0
            segment += 1
            inside = 0
    return used


@njit(cache=True, nogil=True, error_model="numpy")
def solve(observations, surface, model, stretch, prior, unknowns, tolerance, steps, covariance):  # type: ignore[no-untyped-def]
    """Move state and shifts by at most ``steps`` Gauss-Newton steps; returns the number of points used, or -1.

    Iteration stops after a step below ``tolerance`` mm. ``covariance`` (4, 4) is the inverse of the information at the
    last but one state. -1: the sphere is not determined.
    """
    state, shifts, gains = unknowns
    normal = NormalEquations(np.empty((4, 4)), np.empty(4))
    used = 0
    for _ in range(steps):
        # a variable for False: numba compiles a kernel anew for every literal
        used = normal_equations(observations, surface, model, stretch, steps < 0, prior, unknowns, normal)
        if not inverse_of(normal.H, covariance):
            return -1
        step = np.zeros(4)
        size = 0.0
        for i in range(4):
            for j in range(4):
                step[i] -= covariance[i, j] * normal.g[j]
            size = max(size, abs(step[i]))
        scale = 1.0 if size <= 0.2 * state[3] else 0.2 * state[3] / size
        for i in range(4):
            state[i] += scale * step[i]
        if not (state[3] > 1.0 and state[3] < 2000.0):
            return -1
        for k in range(len(shifts)):
            for i in range(3):
                move = gains[k, i, 4]
                for j in range(4):
                    move += gains[k, i, j] * scale * step[j]
                shifts[k, i] -= move
        if size < tolerance:
            break
    return used


# --- one fit ---------------------------------------------------------------------------------------------------------


@inner_ieee
def mask_of(masks, k):  # type: ignore[no-untyped-def]
    """Return the mask of node ``k``."""
    ends = slice(masks.start[k], masks.start[k + 1])
    return SphereMask(masks.axis_points[ends], masks.axes[ends], masks.keep_off[ends], masks.hole, masks.least_cosine)


@njit(cache=True, nogil=True, error_model="numpy")
def within(crops, k, near, far):  # type: ignore[no-untyped-def]
    """Return the rows of the points of node ``k`` at distances ``near`` to ``far`` from it, and these observations."""
    rows = np.empty(crops.start[k + 1] - crops.start[k], np.int64)
    n = 0
    for i in range(crops.start[k], crops.start[k + 1]):
        d2 = crops.points[i, 0] ** 2 + crops.points[i, 1] ** 2 + crops.points[i, 2] ** 2
        if near * near <= d2 <= far * far:
            rows[n] = i
            n += 1
    points, rays, ranges, station = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, np.int32)
    for j in range(n):
        i = rows[j]
        for axis in range(3):
            points[j, axis] = crops.points[i, axis]
            rays[j, axis] = crops.rays[i, axis]
        ranges[j] = crops.ranges[i]
        station[j] = crops.station[i]
    return rows[:n], Observations(points, rays, ranges, station)


@njit(cache=True, nogil=True, error_model="numpy")
def segments(station):  # type: ignore[no-untyped-def]
    """Count the runs of one station among points sorted by station, at least 1."""
    runs = 1
    for i in range(1, len(station)):
        if station[i] != station[i - 1]:
            runs += 1
    return runs


@inner_ieee
def fit_one(observations, mask, model, prior, first_reach_mm, tolerance, state, shifts, surface, covariance):  # type: ignore[no-untyped-def]
    """Fit from ``state``: select points, solve, and select again as the cut narrows; returns points used or -1."""
    points, rays, ranges, _ = observations
    noise = model.noise
    unknowns = Unknowns(state, shifts, np.zeros((len(shifts), 3, 8)))
    far = 0.0
    for i in range(len(ranges)):
        far += ranges[i] / len(ranges)
    typical = np.sqrt(noise[0] + noise[1] * far * far)
    first = max(1.0, first_reach_mm / (CUT_SD * typical))
    used = -1
    iterations = 3 if tolerance > FINE_MM else 4
    for iteration in range(iterations):
        last = iteration + 1 == iterations
        stretch = first if iteration == 0 else np.sqrt(first) if iteration == 1 else 1.0
        gate = GATE_MM if iteration == 0 else max(GATE_MM * 0.5, 30.0 * typical)
        if select(points, rays, mask, state, gate, surface) == 0:
            return -1
        used = solve(
            observations, surface, model, stretch, prior, unknowns, tolerance if last else max(tolerance, COARSE_MM),
            12 if last else 6, covariance,
        )  # fmt: skip
        if used < 0:
            return -1
    return used


# --- the final fit ---------------------------------------------------------------------------------------------------


class ResidualSums(NamedTuple):
    """Sums over the points of one sphere, by their robust weights w."""

    weight: float  # of w
    scaled_squares: float  # of w (e / sd)^2
    leverage: float  # of w h
    squares: float  # of w e^2, mm^2
    cells: int  # of the sphere's surface that hold points
    stations: int


class NodesToFit(NamedTuple):
    """Nodes to be fitted: their points, and states (k, 4) of centre and radius, mm, with the priors of these.

    ``model_points`` is the number of points that the noise model is worth, ``first_reach_mm`` the reach of the first
    steps.
    """

    crops: CropsWithRays
    masks: Masks
    model: StochasticModel
    model_points: float
    priors: Priors
    states: Floats
    first_reach_mm: float
    threads: int = 0

    def of_nodes(self, nodes: slice) -> NodesToFit:
        """Return some of the nodes."""
        return self._replace(
            crops=self.crops.of_nodes(nodes),
            masks=self.masks.of_nodes(nodes),
            priors=Priors(*(column[nodes] for column in self.priors)),
            states=self.states[nodes],
        )


def fit_final(nodes_to_fit: NodesToFit) -> Finished:
    """Fit every node whose state is finite, with the priors of its centre and size.

    The scale about the noise model is estimated for each sphere, with as many degrees of freedom as points and
    ``model_points`` more. Bounds are those of the noise and the priors with every point at its full weight and stations
    fixed.
    """
    crops, masks, model, model_points, priors, states, first_reach_mm, threads = nodes_to_fit
    nodes, count = len(states), len(crops.points)
    residuals = Residuals(np.zeros(count), np.zeros(count), np.zeros(count))
    finished = Finished(
        states=np.full((nodes, 4), np.nan),
        covariances=np.full((nodes, 4, 4), np.nan),
        bounds=np.full((nodes, 4, 4), np.nan),
        numbers=np.zeros((nodes, 8)),
        residuals=residuals,
    )
    fit_range = partial(_fit_range, crops, masks, model, model_points, priors, states, first_reach_mm, finished)
    over_ranges(fit_range, nodes, threads)
    return finished


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_range(crops, masks, model, model_points, priors, states, first_reach_mm, finished, first, last):  # type: ignore[no-untyped-def]
    for k in range(first, last):
        if not np.isnan(states[k, 0]) and crops.start[k + 1] > crops.start[k]:
            _fit_at(k, crops, masks, model, model_points, priors, states[k].copy(), first_reach_mm, finished)


@inner_ieee
def _fit_at(k, crops, masks, model, model_points, priors, state, first_reach_mm, finished):  # type: ignore[no-untyped-def]
    """Fit node ``k`` from ``state``; see :func:`fit_final`."""
    rows, observations = within(crops, k, state[3] - AROUND_MM, state[3] + AROUND_MM)
    n = len(rows)
    if n == 0:
        return
    shifts = np.zeros((segments(observations.station), 3))
    unknowns = Unknowns(state, shifts, np.zeros((len(shifts), 3, 8)))
    prior = Prior(priors.centre_weight[k], priors.sizes[k], priors.size_weights[k])
    surface, covariance = np.zeros(n, np.uint8), np.zeros((4, 4))
    used = fit_one(
        observations, mask_of(masks, k), model, prior, first_reach_mm, TOLERANCE_MM, state, shifts, surface, covariance
    )
    if used < 1:
        return
    local = StochasticModel(model.noise.copy(), model.shift_covariance)
    residuals = Residuals(np.zeros(n), np.zeros(n), np.zeros(n))
    used, scale, degrees = _scaled(
        observations, surface, model.noise, local, model_points, prior, unknowns, covariance, residuals
    )
    if used < 1:
        return
    # variables for False and True: numba compiles a kernel anew for every literal
    robust, whole = n < 0, n > 0
    normal = NormalEquations(np.empty((4, 4)), np.empty(4))
    normal_equations(observations, surface, local, 1.0, robust, prior, unknowns, normal)
    if not inverse_of(normal.H, covariance):
        return
    sums = fill_residuals(observations, surface, local.noise, unknowns, covariance, residuals)
    fixed = StochasticModel(local.noise, local.shift_covariance[:0])
    used = normal_equations(observations, surface, fixed, 1.0, whole, prior, unknowns, normal)
    if not inverse_of(normal.H, finished.bounds[k]):
        return
    chi2 = 0.0
    for i in range(3):
        for j in range(3):
            chi2 += state[i] * prior.centre_weight[i, j] * state[j]
    _without_bias(observations, surface, local.noise, state, covariance)
    assign(finished.states[k], state)
    assign_rows(finished.covariances[k], covariance)
    for i in range(n):
        finished.residuals.errors[rows[i]] = residuals.errors[i]
        finished.residuals.cosines[rows[i]] = residuals.cosines[i]
        finished.residuals.weights[rows[i]] = residuals.weights[i]
    numbers = finished.numbers[k]
    numbers[POINTS], numbers[CELLS], numbers[STATIONS] = used, sums.cells, sums.stations
    numbers[RMS] = np.sqrt(sums.squares / max(sums.weight, 1e-9))
    numbers[SCALE], numbers[DEGREES] = scale, degrees
    numbers[CENTRE_CHI2], numbers[FITTED] = chi2, 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def _scaled(observations, surface, noise, local, model_points, prior, unknowns, covariance, residuals):  # type: ignore[no-untyped-def]
    """Alternate the scale about the noise model and the fit; ``local.noise`` becomes the noise times its square.

    Returns points used (below 1: failed), the scale and its degrees of freedom.
    """
    scale, used, degrees = 1.0, 0, 0.0
    steps = 10 if len(surface) > 0 else 6  # a variable: see the literals above
    for iteration in range(ITERATIONS):
        sums = fill_residuals(observations, surface, local.noise, unknowns, covariance, residuals)
        free = max(sums.weight - sums.leverage, 0.0)
        degrees = model_points + free
        scale2 = (model_points + sums.scaled_squares * scale * scale) / degrees if degrees > 0.0 else 1.0
        scale = np.sqrt(scale2)
        for i in range(3):
            local.noise[i] = noise[i] * scale2
        tolerance = TOLERANCE_MM if iteration + 1 == ITERATIONS else COARSE_MM
        used = solve(observations, surface, local, 1.0, prior, unknowns, tolerance, steps, covariance)
        if used < 1:
            break
    return used, scale, degrees


@inner_ieee
def fill_residuals(observations, surface, noise, unknowns, covariance, residuals):  # type: ignore[no-untyped-def]
    """Fill the residual, cosine and weight of each point on visible surface, and return their sums.

    Residuals are divided by sqrt(1 - leverage): their spread is that of the noise, also for few points.
    """
    points, rays, ranges, station = observations
    state, shifts, gains = unknowns
    errors, cosines, on = residuals
    J, K, cells = np.empty(4), np.empty(4), np.zeros(BANDS * SECTORS, np.int64)
    weights, squares, leverages, plain = 0.0, 0.0, 0.0, 0.0
    segment, inside, stations, seen = 0, False, 0, 0
    for i in range(len(points)):
        on[i] = 0.0
        if surface[i] == VISIBLE:
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
                    cell = _cell_of(points[i], state, shifts[segment])
                    seen += 1 - cells[cell]
                    cells[cell] = 1
        if i + 1 == len(points) or station[i + 1] != station[i]:
            segment += 1
            if inside:
                stations += 1
            inside = False
    return ResidualSums(
        weight=weights, scaled_squares=squares, leverage=leverages, squares=plain, cells=seen, stations=stations
    )


@inner_ieee
def _cell_of(point, state, shift):  # type: ignore[no-untyped-def]
    """Return the cell that a point lies over; the cells of :func:`~processor.geometry.sphere.sphere_cells`."""
    x, y, z = point[0] - state[0] - shift[0], point[1] - state[1] - shift[1], point[2] - state[2] - shift[2]
    d = np.sqrt(x**2 + y**2 + z**2)
    band = min(max(int(np.floor((z / d + 1.0) * (BANDS / 2.0))), 0), BANDS - 1)
    angle = math.atan2(y, x) / (2.0 * np.pi) + 0.5
    sector = min(max(int(np.floor(angle * SECTORS)), 0), SECTORS - 1)
    return band * SECTORS + sector


# --- bias ------------------------------------------------------------------------------------------------------------


@inner_ieee
def _without_bias(observations, surface, noise, state, covariance):  # type: ignore[no-untyped-def]
    """Subtract the bias by curvature and half of that by unknown rays; add the latter's spread to the covariance."""
    off = np.zeros(4)
    curvature_bias(observations, surface, noise, state, covariance, off)
    largest = 0.0
    for i in range(4):
        largest = max(largest, abs(off[i]) / np.sqrt(covariance[i, i]))
    if largest < LARGEST_BIAS:  # the series does not hold for a larger one
        for i in range(4):
            state[i] -= off[i]
    # Where rays are unknown the bias lies between none and all of ``off``: uniform, its variance is off^2 / 12.
    unknown_ray_bias(observations.points, observations.rays, surface, noise, state, covariance, off)
    for i in range(4):
        state[i] -= 0.5 * off[i]
        for j in range(4):
            covariance[i, j] += off[i] * off[j] / 12.0


@inner_ieee
def curvature_bias(observations, surface, noise, state, covariance, off):  # type: ignore[no-untyped-def]
    """Fill the bias (4,) of least squares by the residuals' curvature, -1/2 C sum J w trace(C H).

    Source: M. J. Box, Bias in nonlinear estimation, J. Roy. Statist. Soc. B 33 (1971), 171-201.
    """
    points, rays, ranges, _ = observations
    cx, cy, cz, r = state[0], state[1], state[2], state[3]
    total, J, v, u = np.zeros(4), np.empty(4), np.empty(3), np.empty(3)
    for i in range(len(points)):
        if surface[i] != VISIBLE:
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
        off[p] = 0.0
        for q in range(4):
            off[p] -= 0.5 * covariance[p, q] * total[q]


@inner_ieee
def unknown_ray_bias(points, rays, surface, noise, state, covariance, off):  # type: ignore[no-untyped-def]
    """Fill the bias of the state (4,) where rays are unknown, for noise that is the same in all directions.

    Noise across the normal of a sphere moves points outward by variance / distance on the mean. Of noise along a ray
    only a part is across.
    """
    J, total = np.empty(4), np.zeros(4)
    for i in range(len(points)):
        if surface[i] != VISIBLE or rays[i, 0] != 0.0 or rays[i, 1] != 0.0 or rays[i, 2] != 0.0:
            continue
        e, cosine, J[0], J[1], J[2], J[3] = residual(
            points[i, 0], points[i, 1], points[i, 2], 0.0, 0.0, 0.0, state[0], state[1], state[2], state[3]
        )
        if cosine > 0.0:
            w = weight(e / np.sqrt(variance(noise, 0.0, 1.0))) / (state[3] + e)
            for p in range(4):
                total[p] += w * J[p]
    for p in range(4):
        off[p] = 0.0
        for q in range(4):
            off[p] -= covariance[p, q] * total[q]
