"""The stochastic model of a frame, estimated from all of its spheres together, because one has too few points.

Noise of ranges from the residuals, the scatter of radii about their sizes, and the shifts of stations: each station's
points on one sphere may be shifted together. Shifts are taken to be normal with the same standard deviation along each
axis, and independent between stations; the most likely one is returned. Values stated for the scanner only start the
estimate.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.optimize import nnls

from processor.geometry.linalg_small import inverse_of, log_det
from processor.geometry.sphere_fit import residual
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner_ieee
from processor.model import Floats
from processor.robust_statistics import MAD_TO_SD
from processor.space_frame.points.sphere_crops import CropsWithRays
from processor.space_frame.spheres.ball_fit import variance
from processor.space_frame.spheres.records import Priors

NOISE_POINTS = 60  # a variance by the median of 60 is known to 21 % (sqrt(2.7 / n)); of fewer points the start is kept
CELL_POINTS = 20  # as above, to 37 %
NEAREST_MM, RATIO = 1000.0, 1.4  # of the bins of the range
COSINES = np.array([0.15, 0.22, 0.3, 0.4, 0.55, 0.7, 0.85, 1.0 + 1e-9])  # bins: narrow where tangents grow fast
LEAST_MM = 0.02  # for scans without noise
LIMB_STEP, LIMB_POINTS = 0.05, 40  # of the cosine; points of a band, whose median is known to 0.2 of the noise
LIMB = np.arange(0.15, 0.451, LIMB_STEP)  # chosen: bands in which a cut beam may bias residuals
RADII = 10  # the stated scatter of radii has the weight of as many spheres
# In mm. The others must beat the first by EVIDENCE in chi-square.
GRID = np.array([0.0, 0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8, 1.1, 1.6, 2.2, 3.2, 4.5, 6.4])
EVIDENCE = 10.0  # 1 in 600 for a single unknown: no shift is found in spheres without one
LEAST_SPHERES = 5  # seen by several stations: fewer do not show what is common


@njit(cache=True, nogil=True, error_model="numpy")
def variances_of(noise, cosines, ranges):  # type: ignore[no-untyped-def]
    """Variances (n,) of ranges by the model's parts (3,)."""
    variances = np.empty(len(ranges))
    for i in range(len(ranges)):
        variances[i] = variance(noise, ranges[i], max(cosines[i], 0.1))
    return variances


def noise_model(
    errors: Floats, cosines: Floats, ranges: Floats, weights: Floats, start: Floats
) -> tuple[Floats, float]:
    """Return the variance's parts (3,) (constant, by range^2 / cosine, by tangent^2), and the number of points used.

    ``errors`` (n,) are residuals corrected for leverage; ``weights`` (n,) > 0 mark those on spheres. The scale of each
    cell of range and incidence is estimated by the median absolute residual; non-negative parts are fitted to its
    square. With fewer than 60 points the ``start`` is returned, with the weight of 10 points.
    """
    on = weights > 0.0
    e, c, L = np.abs(errors[on]), cosines[on], ranges[on]
    if len(e) < NOISE_POINTS:
        return start, 10.0
    whole = float(MAD_TO_SD * np.median(e))
    band = np.floor(np.log(np.maximum(L, NEAREST_MM) / NEAREST_MM) / np.log(RATIO)).astype(np.int64)
    # 16 bits: sorted in one pass
    cell = (band * len(COSINES) + np.searchsorted(COSINES, c, side="right")).astype(np.int16)
    order = np.argsort(cell, kind="stable")
    edges = np.flatnonzero(np.diff(cell[order])) + 1
    rows, variances, counts = [], [], []
    for members in np.split(order, edges):
        if len(members) < CELL_POINTS:
            continue
        scale = MAD_TO_SD * float(np.median(e[members]))
        cos, far = float(np.median(c[members])), float(np.median(L[members]))
        rows.append([variance(part, far, cos) for part in np.eye(3)])
        variances.append(max(scale, LEAST_MM) ** 2)
        counts.append(len(members))
    if len(rows) < 4:
        return np.array([max(whole, LEAST_MM) ** 2, 0.0, 0.0]), float(len(e))
    A, b = np.array(rows), np.array(variances)
    model = np.full(len(b), whole**2)
    parts = np.array([whole**2, 0.0, 0.0])
    size = np.abs(A).max(axis=0)
    for _ in range(5):  # a variance by the median of n points has the relative standard deviation sqrt(2.7 / n)
        w = np.sqrt(np.array(counts)) / model
        parts = nnls((A / size) * w[:, None], b * w)[0] / size
        model = np.maximum(A @ parts, 1e-3 * whole**2)
    if not parts[0] + parts[1] > 0.0:
        return np.array([whole**2, 0.0, 0.0]), float(len(e))
    parts[0] = max(parts[0], LEAST_MM**2)
    return parts, float(len(e))


def limb_cosine(errors: Floats, cosines: Floats, ranges: Floats, weights: Floats, noise: Floats, least: float) -> float:
    """Return the least cosine of incidence at which residuals have no bias: from ``least`` to 0.5.

    Near the limb a wide beam is cut, and its mean range differs from that of its centre. Bands of the cosine are left
    out whose median residual exceeds a tenth of the noise and its own standard error, and one band beyond them.
    """
    on = (weights > 0.0) & (cosines < LIMB[-1])
    c = cosines[on]
    u = errors[on] / np.sqrt(variances_of(noise, c, ranges[on]))
    limb = least
    for low, high in pairwise(LIMB.tolist()):
        here = np.sort(u[(c >= low) & (c < high)])
        if len(here) < LIMB_POINTS:
            continue
        middle = abs(float(np.median(here)))
        spread = MAD_TO_SD * float(np.median(np.abs(here)))
        if middle > max(0.1, 3.0 * 1.2533 / np.sqrt(len(here))) * spread:
            limb = high + LIMB_STEP
    return max(least, min(limb, 0.5))


def radius_scatter(radii: Floats, variances: Floats, sizes: Floats, used_sd: float, stated_sd: float) -> float:
    """Return the most likely standard deviation of radii about their sizes, mm.

    ``radii`` (k,) and ``variances`` (k,) come from fits with a prior of sd ``used_sd``. The prior is removed first, so
    that only the points contribute. The stated scatter has the weight of ten spheres. Spheres with little information
    are left out.
    """
    off, variance = _off_sizes(radii, variances, sizes, used_sd, stated_sd)
    if not len(off):
        return stated_sd
    grid = stated_sd * np.geomspace(0.2, 2.5, 128)
    total = variance[None] + grid[:, None] ** 2
    cost = (np.log(total) + off[None] ** 2 / total).sum(axis=1)
    cost += RADII * (np.log(grid**2) + stated_sd**2 / grid**2)
    return float(grid[np.argmin(cost)])


def radius_offset(
    radii: Floats, variances: Floats, sizes: Floats, used_sd: float, stated_sd: float
) -> tuple[float, float]:
    """Return the mean deviation of all radii from their sizes, mm, and its standard deviation.

    A range error common to all stations, or a wide beam, makes every sphere too small or too large; a single sphere
    does not show it. Arguments are those of :func:`radius_scatter`; ``used_sd`` is also the scatter of radii.
    """
    off, variance = _off_sizes(radii, variances, sizes, used_sd, stated_sd)
    weight = 1.0 / (variance + used_sd**2)
    total = float(weight.sum())
    return (float((weight * off).sum()) / total, total**-0.5) if total > 0.0 else (0.0, np.inf)


def _off_sizes(
    radii: Floats, variances: Floats, sizes: Floats, used_sd: float, stated_sd: float
) -> tuple[Floats, Floats]:
    """Radii less sizes (j,) from the points alone, and their variances (j,), of spheres with enough information."""
    by_points, variance = without_prior(radii, variances, sizes, used_sd)
    off = by_points - sizes
    near = np.abs(off) < 4.0 * np.sqrt(variance + stated_sd**2)
    return off[near], variance[near]


def without_prior(radii: Floats, variances: Floats, sizes: Floats, used_sd: float) -> tuple[Floats, Floats]:
    """Return radii (k,) by the points alone and their variances, mm^2; NaN where the prior, of ``used_sd``, decides."""
    prior = 1.0 / used_sd**2
    weight = 1.0 / variances - prior
    variance = 1.0 / np.where(weight > 0.1 * prior, weight, np.nan)
    return (radii / variances - sizes * prior) * variance, variance


# --- shifts of stations ----------------------------------------------------------------------------------------------


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
