"""Compiled fits of tubes, one after another; see :mod:`processor.space_frame.members.cylinder_model` for the model."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.linalg_small import assign, assign_rows
from processor.inner_kernels import inner
from processor.model import Floats
from processor.space_frame.members.cylinder_model import (
    ACROSS_MM,
    GRAZING_COS,
    NP,
    STRAIGHT,
    Observations,
    Shifts,
    Solution,
    Weighting,
    circle_along,
    extent_of,
    residual,
    spread_of,
    step,
)
from processor.space_frame.points.hash_sampling import STEPS_PER_MM
from processor.space_frame.points.line_crops import FIELD, HALF

# Numbers of steps and parameters are passed as np.int64: numba compiles a kernel anew for every literal.

BIN_MM = 10.0  # of the length: an end is found to a bin, and TRIM_MM more is taken off
ROUGH_TRIM_MM = 30.0  # off each rough end
CUTS_MM = (30.0, 15.0)  # chosen: of the first two rough fits: a line of voxels is off by as much
CUT_SIGMAS = 3.5  # chosen: of normal errors 1 in 2,000 is lost; larger cuts take in the ends of cones
LEAST_CUT_MM = 4.0  # of rough fits: stations may be shifted
ROUGH_MM = 2.0  # errors of a straight axis and of the stations, beside the noise
NEAR_M = 20.0  # of a station; beyond it errors of its attitude dominate
FINE_MM = 0.7  # error of a bowed axis
LEFT_MM = 0.02  # remaining change that stops the iteration: a tenth of an axis's error by noise
TRIM_MM = 8.0  # off each end: the start of a cone is not sharp
LEAST_SIGMA_MM = 0.05  # of the scatter about a tube, for scans without noise
ROUGH_COS = 0.5  # of incidence, in rough fits
COS_BINS = 8  # of 0.1 from GRAZING_COS to 1
SECTORS = 24  # around a tube


class Limits(NamedTuple):
    """Radii of tubes, mm, and the number of points of each that is enough to find its axis."""

    least_radius: float
    most_radius: float
    most: int


class Errors(NamedTuple):
    """Largest bow as a share of the length, least cosine of incidence, and the variance a + b d^2 of stations.

    a is in mm^2, b in mm^2/m^2, and d the distance from the station in m.
    """

    bow_share: float
    least_cos: float
    a: float
    b: float


class Frame(NamedTuple):
    """A line in space: point, unit direction, and two unit vectors across it."""

    point: Floats
    direction: Floats
    side: Floats
    other: Floats


# --- straight tubes --------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def fit_roughly(gathered, scanners, inner, spans, limits, rough, first, last):  # type: ignore[no-untyped-def]
    """Fit straight tubes first..last to ``limits.most`` points each, from the lines in ``rough``, which is filled."""
    for m in range(first, last):
        if gathered.counts[m] < 16:
            continue
        frame = _frame(rough.points[m].copy(), rough.directions[m].copy())
        places, at = _thinned(gathered, m, limits.most)
        observations = _localised(places, at, gathered.middles[m], frame, scanners)
        n, bounds = len(places), observations.bounds
        p, sizes, h = np.zeros(NP), np.empty(n), inner[m]
        least, most = 0.7 * limits.least_radius, 1.3 * limits.most_radius
        if not circle_along(observations.points, -h, h, 1e9, p, h) or not least < p[4] < most:
            continue
        fixed = Shifts(np.zeros((len(bounds) - 1, 2)), np.zeros(len(bounds) - 1))
        solution = Solution(np.zeros((NP, NP)), np.zeros((0, NP, 2)))
        good, sigma, cut, count, total = True, 2.0, 0.0, 0, 0.0
        for turn in range(4):
            if turn < 2:
                cut = CUTS_MM[turn]
            else:
                sigma = max(spread_of(sizes, count), LEAST_SIGMA_MM)
                cut = max(CUT_SIGMAS * sigma, LEAST_CUT_MM)
            weighting = Weighting(ROUGH_COS, cut, sigma, 1.0)
            count, total, _, good = step(p, h, observations, fixed, np.int64(STRAIGHT), weighting, sizes, solution)
            if not good or not least < p[4] < most:
                good = False
                break
        if not good:
            continue
        sigma = max(spread_of(sizes, count), LEAST_SIGMA_MM)
        noise = np.sqrt(total / max(count - STRAIGHT, 1))
        _score_incidence(p, h, observations, noise, cut, rough.by_incidence[m])
        away = _distances(frame.point, at, bounds, scanners)
        _score_stations(p, h, observations, away, noise, cut, solution.inverse, rough.scatter[m])
        bins = np.empty(2 * int(spans[m] / BIN_MM) + 2)
        slack = np.sqrt(sigma**2 + ROUGH_MM**2)
        low, high = extent_of(p, h, observations, fixed.values, slack, bins, BIN_MM)
        if high - low < 100.0:
            continue
        _move(frame, p, h)
        for i in range(3):
            rough.points[m, i] = frame.point[i] + 0.5 * (low + high) * frame.direction[i]
            rough.directions[m, i] = frame.direction[i]
        rough.ok[m], rough.lengths[m], rough.radii[m], rough.sigma[m] = True, high - low, p[4], sigma


@inner
def _score_incidence(p, h, observations, sigma, cut, by_incidence):  # type: ignore[no-untyped-def]
    """Add to ``by_incidence`` (8, 3) number, sum and sum of squares of distances by the cosine of incidence."""
    P, U, known, bounds = observations
    J = np.zeros(NP)
    k2 = (ACROSS_MM / sigma) ** 2
    for i in range(bounds[0], bounds[-1]):
        if abs(P[i, 2]) > h:
            continue
        v, cos = residual(p, h, P[i, 0], P[i, 1], P[i, 2], U[i, 0], U[i, 1], U[i, 2], known[i], J)
        if cos < GRAZING_COS or not known[i]:
            continue
        w = 1.0 / (1.0 + k2 * (1.0 - cos * cos) / (cos * cos))
        if w * v * v > cut * cut:
            continue
        k = min(int((cos - GRAZING_COS) * 10.0), COS_BINS - 1)
        by_incidence[k, 0] += 1.0
        by_incidence[k, 1] += v * cos
        by_incidence[k, 2] += v * v * cos * cos


@inner
def _score_stations(p, h, observations, away, sigma, cut, inverse, scatter):  # type: ignore[no-untyped-def]
    """Fill statistics ``scatter`` (2, 3) from which the variance of the stations' shifts is estimated.

    Of the scores y_s of a shift of each station (two, across) after the fit, Q = sum of y_s' A_s^-1 y_s. Its
    expectation is E0 from noise alone, and E0 + a E1 + b E2 where stations at distances d (m) have shifts of variances
    a + b d^2 (DerSimonian and Laird 1986, the parameters of the fit taken into account). ``scatter`` gets Q - E0, E1
    and E2 of the stations nearer than NEAR_M, and of the others.
    """
    groups = len(observations.bounds) - 1
    A, y = np.zeros((groups, 5, 5)), np.zeros((groups, 5))
    count = _station_equations(p, h, observations, sigma, cut, A, y)
    use = np.flatnonzero(count >= 12)
    if len(use) < 2:
        return
    for s in use:
        side = 0 if away[s] < NEAR_M else 1
        B = A[s, :2, :2]
        det = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
        if not det > 1e-3 * B[0, 0] * B[1, 1]:
            continue
        B1 = np.empty((2, 2))
        B1[0, 0], B1[1, 1], B1[0, 1], B1[1, 0] = B[1, 1] / det, B[0, 0] / det, -B[0, 1] / det, -B[1, 0] / det
        scatter[side, 0] += B1[0, 0] * y[s, 0] ** 2 + 2.0 * B1[0, 1] * y[s, 0] * y[s, 1] + B1[1, 1] * y[s, 1] ** 2
        pulled = A[s, :2] @ inverse[:5, :5].copy()
        for k in range(groups):
            H = -(pulled @ A[k, :, :2].copy())
            if k == s:
                H += B
            for a in range(2):
                for b in range(2):
                    if k == s:
                        scatter[side, 0] -= sigma * sigma * B1[a, b] * H[b, a]
                    for c in range(2):
                        term = B1[a, b] * H[b, c] * H[a, c]
                        scatter[side, 1] += term
                        scatter[side, 2] += term * away[k] ** 2


@inner
def _station_equations(p, h, observations, sigma, cut, A, y):  # type: ignore[no-untyped-def]
    """Fill normal equations A (g, 5, 5) and y (g, 5) of each station's points; returns their numbers (g,)."""
    P, U, known, bounds = observations
    J, count = np.zeros(NP), np.zeros(len(bounds) - 1, np.int64)
    k2 = (ACROSS_MM / sigma) ** 2
    for g in range(len(bounds) - 1):
        for i in range(bounds[g], bounds[g + 1]):
            if abs(P[i, 2]) > h:
                continue
            v, cos = residual(p, h, P[i, 0], P[i, 1], P[i, 2], U[i, 0], U[i, 1], U[i, 2], known[i], J)
            if cos < ROUGH_COS or not known[i]:
                continue
            w = 1.0 / (1.0 + k2 * (1.0 - cos * cos) / (cos * cos))
            if w * v * v > cut * cut:
                continue
            count[g] += 1
            for a in range(5):
                y[g, a] -= w * J[a] * v
                for b in range(5):
                    A[g, a, b] += w * J[a] * J[b]
    return count


# --- bowed tubes -----------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def refine(gathered, scanners, spans, limits, errors, fits, first, last):  # type: ignore[no-untyped-def]
    """Fit bowed tubes first..last to all their points, from the rough axes in ``fits``, which is filled."""
    for m in range(first, last):
        if not fits.ok[m]:
            continue
        fits.ok[m] = False
        frame = _frame(fits.points[m].copy(), fits.directions[m].copy())
        p = np.zeros(NP)
        p[4] = fits.radii[m]
        h = max(0.5 * fits.lengths[m] - ROUGH_TRIM_MM, 50.0)
        middle = gathered.middles[m]
        # A part of the points is enough to find the axis.
        places, at = _thinned(gathered, m, limits.most)
        observations = _localised(places, at, middle, frame, scanners)
        shifts, solution = _unknowns(frame, at, observations, scanners, errors)
        slack = np.sqrt(shifts.sd.max() ** 2 + FINE_MM**2)
        good, count, assumed, sigma = _improve(
            p, h, observations, shifts, errors, fits.sigma[m], slack, np.int64(2), solution
        )
        if not good:
            continue
        # The ends of the cylinder need all points; the rest of the fit runs about its middle.
        known, known_at = shifts.values, at[observations.bounds[:-1]]
        rows = slice(m * gathered.room, m * gathered.room + gathered.counts[m])
        at = gathered.stations[rows]
        observations = _localised(gathered.places[rows], at, middle, frame, scanners)
        bounds = observations.bounds
        values = np.zeros((len(bounds) - 1, 2))
        for g in range(len(bounds) - 1):
            for k in range(len(known)):
                if known_at[k] == at[bounds[g]]:
                    assign(values[g], known[k])
        bins = np.empty(2 * int(spans[m] / BIN_MM) + 2)
        low, high = extent_of(p, h, observations, values, np.sqrt(sigma**2 + FINE_MM**2), bins, BIN_MM)
        half = 0.5 * (high - low) - TRIM_MM
        if half < 50.0:
            continue
        _centre(frame, observations.points, p, h, 0.5 * (low + high), half)
        shifts, solution = _unknowns(frame, at, observations, scanners, errors)
        assign_rows(shifts.values, values)
        good, count, assumed, sigma = _improve(p, half, observations, shifts, errors, sigma, 0.0, np.int64(4), solution)
        if not good or not limits.least_radius < p[4] < limits.most_radius:
            continue
        _count_around(p, half, observations, CUT_SIGMAS * sigma, fits.around[m])
        _move(frame, p, half)
        fits.ok[m], fits.number[m], fits.sigma[m] = True, count, sigma
        _store(fits, m, frame, p, half, assumed, solution)
        _store_response(fits.response[m], at, bounds, solution.response, shifts.sd, half)


@njit(cache=True, nogil=True)
def _unknowns(frame, at, observations, scanners, errors):  # type: ignore[no-untyped-def]
    """Shifts of 0 with the standard deviations that stations have at the tube, and an empty solution."""
    groups = len(observations.bounds) - 1
    sd = np.sqrt(errors.a + errors.b * _distances(frame.point, at, observations.bounds, scanners) ** 2)
    return Shifts(np.zeros((groups, 2)), sd), Solution(np.zeros((NP, NP)), np.zeros((groups, NP, 2)))


@inner
def _improve(p, h, observations, shifts, errors, sigma, slack, turns, solution):  # type: ignore[no-untyped-def]
    """Gauss-Newton steps of a bowed tube; returns (worked, points used, sigma of the last normal equations, sigma).

    ``slack`` is the error of the start, for the first step.
    """
    sizes = np.empty(len(observations.points))
    good, count, assumed, before = True, 0, sigma, 0.0
    for turn in range(turns):
        cut = max(CUT_SIGMAS * (np.sqrt(sigma**2 + slack**2) if turn == 0 else sigma), 0.5)
        assumed = sigma
        weighting = Weighting(errors.least_cos, cut, sigma, max(errors.bow_share * h, 1e-3))
        count, total, change, good = step(p, h, observations, shifts, np.int64(NP), weighting, sizes, solution)
        if not good:
            break
        sigma = max(np.sqrt(total / max(count - NP, 1)), LEAST_SIGMA_MM)
        # The sum of all further steps, if each is shorter than the one before by the same factor.
        if turn > 0 and (change < LEFT_MM or change * change < LEFT_MM * (before - change)):
            break
        before = change
    return good, count, assumed, sigma


@inner
def _count_around(p, h, observations, cut, around):  # type: ignore[no-untyped-def]
    """Count the points of unknown scanners by sectors from ``side`` to ``other``: those on |z| <= h within the cut."""
    P, U, known, _ = observations
    J = np.zeros(NP)
    for i in range(len(P)):
        if known[i] or abs(P[i, 2]) > h:
            continue
        v, _ = residual(p, h, P[i, 0], P[i, 1], P[i, 2], U[i, 0], U[i, 1], U[i, 2], known[i], J)
        if abs(v) <= cut:  # the derivatives by the offset are the negative normal
            turn = np.arctan2(-J[1], -J[0]) / (2.0 * np.pi)
            around[int(np.floor(turn * len(around))) % len(around)] += 1.0


@inner
def _centre(frame, points, p, h, middle, half):  # type: ignore[no-untyped-def]
    """Move frame, points (n, 3) and parameters from half length ``h`` to ``middle`` on the axis and length ``half``."""
    p[0] += p[2] * middle / h
    p[1] += p[3] * middle / h
    for a in range(2):
        p[2 + a] *= half / h
        p[5 + a] *= (half / h) ** 2
    for i in range(3):
        frame.point[i] += middle * frame.direction[i]
    for i in range(len(points)):
        points[i, 2] -= middle


@inner
def _store(fits, m, frame, p, h, sigma, solution):  # type: ignore[no-untyped-def]
    """Write line, radius, bow and covariance of tube ``m``."""
    for i in range(3):
        fits.points[m, i], fits.directions[m, i] = frame.point[i], frame.direction[i]
        fits.side[m, i] = frame.side[i]
    fits.lengths[m], fits.radii[m] = 2.0 * h, p[4]
    fits.bow[m, 0], fits.bow[m, 1] = p[5], p[6]
    scale = np.array([1.0, 1.0, 1.0 / h, 1.0 / h, 1.0])
    for i in range(5):
        for j in range(5):
            fits.covariance[m, i, j] = sigma * sigma * scale[i] * scale[j] * solution.inverse[i, j]
    for i in range(2):
        for j in range(2):
            fits.bow_covariance[m, i, j] = sigma * sigma * solution.inverse[5 + i, 5 + j]


@inner
def _store_response(response, at, bounds, change, sd, h):  # type: ignore[no-untyped-def]
    """Write the change (s, 4, 2) of offsets and turns by a shift of each station by one standard deviation."""
    scale = np.array([1.0, 1.0, 1.0 / h, 1.0 / h])
    for g in range(len(bounds) - 1):
        if 0 <= at[bounds[g]] < len(response):
            for i in range(4):
                for a in range(2):
                    response[at[bounds[g]], i, a] = change[g, i, a] * scale[i] * sd[g]


# --- points and rays in the frame of a tube, and their stations ------------------------------------------------------


@njit(cache=True, nogil=True, inline="always")
def _across(direction, side, other):  # type: ignore[no-untyped-def]
    """Set unit vectors across a direction; the first is level, or along y where the direction is upright."""
    x, y, z = direction[0], direction[1], direction[2]
    n = np.sqrt(x * x + y * y)
    if n > 1e-3:
        side[0], side[1], side[2] = -y / n, x / n, 0.0
    else:
        n = np.sqrt(y * y + z * z)
        side[0], side[1], side[2] = 0.0, z / n, -y / n
    other[0] = direction[1] * side[2] - direction[2] * side[1]
    other[1] = direction[2] * side[0] - direction[0] * side[2]
    other[2] = direction[0] * side[1] - direction[1] * side[0]


@njit(cache=True, nogil=True)
def _frame(point, direction):  # type: ignore[no-untyped-def]
    """Return the frame of a line; its arrays may be changed in place."""
    frame = Frame(point, direction, np.empty(3), np.empty(3))
    _across(direction, frame.side, frame.other)
    return frame


@njit(cache=True, nogil=True)
def _move(frame, p, h):  # type: ignore[no-untyped-def]
    """Move a line by its fitted parameters, and its frame with it."""
    point, direction, side, other = frame
    for i in range(3):
        point[i] += p[0] * side[i] + p[1] * other[i]
        direction[i] += (p[2] * side[i] + p[3] * other[i]) / h
    n = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    for i in range(3):
        direction[i] /= n
    _across(direction, side, other)


@inner
def _bounds_of(stations):  # type: ignore[no-untyped-def]
    """Bounds (g + 1,) of the runs of one station each."""
    groups = 0
    for i in range(len(stations)):
        if i == 0 or stations[i] != stations[i - 1]:
            groups += 1
    bounds = np.empty(groups + 1, np.int64)
    groups = 0
    for i in range(len(stations)):
        if i == 0 or stations[i] != stations[i - 1]:
            bounds[groups] = i
            groups += 1
    bounds[groups] = len(stations)
    return bounds


@njit(cache=True, nogil=True)
def _thinned(gathered, m, most):  # type: ignore[no-untyped-def]
    """Places and stations of every k-th point of line ``m``, with k so that no more than ``most`` are left."""
    rows = slice(m * gathered.room, m * gathered.room + gathered.counts[m])
    k = max(1, (gathered.counts[m] + most - 1) // most)
    return gathered.places[rows][::k].copy(), gathered.stations[rows][::k].copy()  # as slices they compile all anew


@inner
def _localised(places, stations, middle, frame, scanners):  # type: ignore[no-untyped-def]
    """Points and rays in the frame (side, other, direction) about its point."""
    n = len(places)
    P, U, known = np.empty((n, 3)), np.zeros((n, 3)), np.zeros(n, np.bool_)
    point, direction, side, other = frame
    mask = (1 << FIELD) - 1
    for i in range(n):
        w = places[i]
        x = ((w >> (2 * FIELD)) - HALF + middle[0]) / STEPS_PER_MM - point[0]
        y = (((w >> FIELD) & mask) - HALF + middle[1]) / STEPS_PER_MM - point[1]
        z = ((w & mask) - HALF + middle[2]) / STEPS_PER_MM - point[2]
        P[i, 0] = x * side[0] + y * side[1] + z * side[2]
        P[i, 1] = x * other[0] + y * other[1] + z * other[2]
        P[i, 2] = x * direction[0] + y * direction[1] + z * direction[2]
        s = stations[i]
        known[i] = 0 <= s < len(scanners)
        if known[i]:
            rx, ry, rz = x + point[0] - scanners[s, 0], y + point[1] - scanners[s, 1], z + point[2] - scanners[s, 2]
            length = np.sqrt(rx * rx + ry * ry + rz * rz)
            rx, ry, rz = rx / length, ry / length, rz / length
            U[i, 0] = rx * side[0] + ry * side[1] + rz * side[2]
            U[i, 1] = rx * other[0] + ry * other[1] + rz * other[2]
            U[i, 2] = rx * direction[0] + ry * direction[1] + rz * direction[2]
    return Observations(P, U, known, _bounds_of(stations))


@njit(cache=True, nogil=True)
def _distances(point, at, bounds, scanners):  # type: ignore[no-untyped-def]
    """Distance in m of a point from the station of each group; 0 where it is unknown."""
    away = np.zeros(len(bounds) - 1)
    for g in range(len(away)):
        s = at[bounds[g]]
        if 0 <= s < len(scanners):
            for i in range(3):
                away[g] += (1e-3 * (point[i] - scanners[s, i])) ** 2
        away[g] = np.sqrt(away[g])
    return away
