"""How one tube after another is fitted; see :mod:`processor.space_frame.members.cylinder` for the model."""

from __future__ import annotations

import numpy as np
from numba import njit

from processor.space_frame.members.cylinder import (
    ACROSS_MM,
    GRAZING_COS,
    NP,
    reach_of,
    residual,
    roughly,
    spread_of,
    step,
)
from processor.space_frame.points.hash_sampling import STEPS_PER_MM
from processor.space_frame.points.line_crops import FIELD, HALF

BIN_MM = 10.0
ROUGH_TRIM_MM = 30.0  # off each rough end
CUTS_MM = (30.0, 15.0)
CUT_SIGMAS = 3.5
LEAST_CUT_MM = 4.0  # of rough fits, where stations may be off each other
ROUGH_MM = 2.0  # by which a straight axis and what is wrong with stations may be off, beside the noise
NEAR_M = 20.0  # of a station; what is wrong with its attitude shows in the others
FINE_MM = 0.7  # and a bowed axis
LEFT_MM = 0.02  # by the last step: a tenth of what noise moves an axis by
TRIM_MM = 8.0  # taken off each end: where a cone begins is not seen that sharply
LEAST_SIGMA_MM = 0.05
ROUGH_COS = 0.5  # of incidence, in rough fits
COS_BINS = 8  # of 0.1 from GRAZING_COS to 1


@njit(cache=True, nogil=True)
def tell(p, h, P, U, seen, bounds, away, sigma, cut, inverse, by_incidence, scatter):  # type: ignore[no-untyped-def]
    """Residuals by incidence, and what the stations' scatter says of how far they are off each other.

    Of the scores y_s of a movement of each station (two, across) after the fit, Q = sum of y_s' A_s^-1 y_s. It should
    be E0 from noise alone, and E0 + a E1 + b E2 where stations at distances d (m) are moved with variances a + b d^2
    (DerSimonian and Laird 1986, with the parameters of the fit taken into account). ``scatter`` gets Q - E0, E1 and E2
    of the stations nearer than NEAR_M, and of the others.
    """
    groups = len(bounds) - 1
    A, y, J = np.zeros((groups, 5, 5)), np.zeros((groups, 5)), np.zeros(NP)
    count = np.zeros(groups, np.int64)
    k2 = (ACROSS_MM / sigma) ** 2
    for g in range(groups):
        for i in range(bounds[g], bounds[g + 1]):
            if abs(P[i, 2]) > h:
                continue
            v, cos = residual(p, h, P[i, 0], P[i, 1], P[i, 2], U[i, 0], U[i, 1], U[i, 2], seen[i], J)
            if cos < GRAZING_COS or not seen[i]:
                continue
            w = 1.0 / (1.0 + k2 * (1.0 - cos * cos) / (cos * cos))
            if w * v * v > cut * cut:
                continue
            k = min(int((cos - GRAZING_COS) * 10.0), COS_BINS - 1)
            by_incidence[k, 0] += 1.0
            by_incidence[k, 1] += v * cos
            by_incidence[k, 2] += v * v * cos * cos
            if cos < ROUGH_COS:
                continue
            count[g] += 1
            for a in range(5):
                y[g, a] -= w * J[a] * v
                for b in range(5):
                    A[g, a, b] += w * J[a] * J[b]
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
                        told = B1[a, b] * H[b, c] * H[a, c]
                        scatter[side, 1] += told
                        scatter[side, 2] += told * away[k] ** 2


@njit(cache=True, nogil=True)
def fit_roughly(  # type: ignore[no-untyped-def]
    counts, room, places, stations, middles, scanners, points, directions, inner, spans, most, least_radius,
    most_radius, ok, lengths, radii, sigmas, by_incidence, scatter, first, last,
):  # fmt: skip
    """Fit straight tubes first..last to ``most`` points each, changing points and directions in place."""
    for m in range(first, last):
        if counts[m] < 16:
            continue
        rows = slice(m * room, m * room + counts[m])
        own, at, bounds = thin(places[rows], stations[rows], most)
        n = len(own)
        P, U, seen = np.empty((n, 3)), np.zeros((n, 3)), np.zeros(n, np.bool_)
        point, direction, side, other = points[m].copy(), directions[m].copy(), np.empty(3), np.empty(3)
        framed(direction, side, other)
        localised(own, at, middles[m], point, direction, side, other, scanners, P, U, seen)
        p, inverse, sizes = np.zeros(NP), np.zeros((NP, NP)), np.empty(n)
        h = inner[m]
        if not roughly(P, -h, h, 1e9, p, h) or not 0.7 * least_radius < p[4] < 1.3 * most_radius:
            continue
        none, unmoved, response = np.zeros((len(bounds) - 1, 2)), np.zeros(len(bounds) - 1), np.zeros((0, NP, 2))
        good, sigma, cut, count, total = True, 2.0, 0.0, 0, 0.0
        for turn in range(4):
            if turn < 2:
                cut = CUTS_MM[turn]
            else:
                sigma = max(spread_of(sizes, count), LEAST_SIGMA_MM)
                cut = max(CUT_SIGMAS * sigma, LEAST_CUT_MM)
            count, total, _, good = step(
                p, h, P, U, seen, bounds, none, 5, ROUGH_COS, cut, sigma, 1.0, unmoved, sizes, inverse, response
            )
            if not good or not 0.7 * least_radius < p[4] < 1.3 * most_radius:
                good = False
                break
        if not good:
            continue
        sigma = max(spread_of(sizes, count), LEAST_SIGMA_MM)
        away = distances(point, at, bounds, scanners)
        tell(
            p,
            h,
            P,
            U,
            seen,
            bounds,
            away,
            np.sqrt(total / max(count - 5, 1)),
            cut,
            inverse,
            by_incidence[m],
            scatter[m],
        )
        bins = np.empty(2 * int(spans[m] / BIN_MM) + 2)
        slack = np.sqrt(sigma**2 + ROUGH_MM**2)
        low, high = reach_of(p, h, P, U, seen, bounds, none, slack, bins, BIN_MM, 0.5 * BIN_MM * len(bins))
        if high - low < 100.0:
            continue
        moved(p, h, point, direction, side, other)
        for i in range(3):
            points[m, i], directions[m, i] = point[i] + 0.5 * (low + high) * direction[i], direction[i]
        ok[m], lengths[m], radii[m], sigmas[m] = True, high - low, p[4], sigma


@njit(cache=True, nogil=True)
def improve(p, h, P, U, seen, bounds, shifts, station_sd, least_cos, sigma, slack, bow_share, turns, inverse, response):  # type: ignore[no-untyped-def]
    """Gauss-Newton steps of a bowed tube; returns (worked, points used, sigma of the last normal equations, sigma).

    ``slack`` is what the start may be off by, for the first step.
    """
    sizes = np.empty(len(P))
    good, count, assumed, before = True, 0, sigma, 0.0
    for turn in range(turns):
        cut = max(CUT_SIGMAS * (np.sqrt(sigma**2 + slack**2) if turn == 0 else sigma), 0.5)
        assumed = sigma
        count, total, shift, good = step(
            p, h, P, U, seen, bounds, shifts, NP, least_cos, cut, sigma, max(bow_share * h, 1e-3), station_sd, sizes,
            inverse, response,
        )  # fmt: skip
        if not good:
            break
        sigma = max(np.sqrt(total / max(count - NP, 1)), LEAST_SIGMA_MM)
        # Steps that get shorter by the same factor again and again have this left to go, all in all.
        if turn > 0 and (shift < LEFT_MM or shift * shift < LEFT_MM * (before - shift)):
            break
        before = shift
    return good, count, assumed, sigma


@njit(cache=True, nogil=True)
def refine(  # type: ignore[no-untyped-def]
    counts, room, places, stations, middles, scanners, points, directions, spans, most, least_radius, most_radius,
    bow_share, least_cos, variance, variance_m2, ok, sides, lengths, radii, bows, covariances, responses, used, sigmas,
    first, last,
):  # fmt: skip
    """Fit bowed tubes first..last to all their points, from a rough axis; changes points and directions in place."""
    for m in range(first, last):
        if not ok[m]:
            continue
        ok[m] = False
        point, direction, side, other = points[m].copy(), directions[m].copy(), np.empty(3), np.empty(3)
        framed(direction, side, other)
        p, inverse = np.zeros(NP), np.zeros((NP, NP))
        p[4] = radii[m]
        h = max(0.5 * lengths[m] - ROUGH_TRIM_MM, 50.0)
        rows = slice(m * room, m * room + counts[m])
        # Some points tell where the axis is.
        own, at, bounds = thin(places[rows], stations[rows], most)
        P, U, seen = np.empty((len(own), 3)), np.zeros((len(own), 3)), np.zeros(len(own), np.bool_)
        localised(own, at, middles[m], point, direction, side, other, scanners, P, U, seen)
        shifts, response = np.zeros((len(bounds) - 1, 2)), np.zeros((len(bounds) - 1, NP, 2))
        station_sd = np.sqrt(variance + variance_m2 * distances(point, at, bounds, scanners) ** 2)
        slack = np.sqrt(station_sd.max() ** 2 + FINE_MM**2)
        good, count, assumed, sigma = improve(
            p, h, P, U, seen, bounds, shifts, station_sd, least_cos, sigmas[m], slack, bow_share, 2, inverse, response
        )
        if not good:
            continue
        # All points show the cylinder's ends, and then all goes on about its middle.
        known, known_at = shifts, at[bounds[:-1]]
        own, at, bounds = places[rows], stations[rows], bounds_of(stations[rows])
        P, U, seen = np.empty((len(own), 3)), np.zeros((len(own), 3)), np.zeros(len(own), np.bool_)
        localised(own, at, middles[m], point, direction, side, other, scanners, P, U, seen)
        shifts, response = np.zeros((len(bounds) - 1, 2)), np.zeros((len(bounds) - 1, NP, 2))
        for g in range(len(bounds) - 1):
            for k in range(len(known)):
                if known_at[k] == at[bounds[g]]:
                    shifts[g] = known[k]
        bins = np.empty(2 * int(spans[m] / BIN_MM) + 2)
        low, high = reach_of(
            p, h, P, U, seen, bounds, shifts, np.sqrt(sigma**2 + FINE_MM**2), bins, BIN_MM, 0.5 * BIN_MM * len(bins)
        )
        middle, half = 0.5 * (low + high), 0.5 * (high - low) - TRIM_MM
        if half < 50.0:
            continue
        p[0] += p[2] * middle / h
        p[1] += p[3] * middle / h
        for a in range(2):
            p[2 + a] *= half / h
            p[5 + a] *= (half / h) ** 2
        for i in range(3):
            point[i] += middle * direction[i]
        P[:, 2] -= middle
        h = half
        station_sd = np.sqrt(variance + variance_m2 * distances(point, at, bounds, scanners) ** 2)
        good, count, assumed, sigma = improve(
            p, h, P, U, seen, bounds, shifts, station_sd, least_cos, sigma, 0.0, bow_share, 4, inverse, response
        )
        if not good or not least_radius < p[4] < most_radius:
            continue
        moved(p, h, point, direction, side, other)
        for i in range(3):
            points[m, i], directions[m, i], sides[m, i] = point[i], direction[i], side[i]
        ok[m], lengths[m], radii[m], used[m], sigmas[m] = True, 2.0 * h, p[4], count, sigma
        bows[m, 0], bows[m, 1] = p[5], p[6]
        scale = np.array([1.0, 1.0, 1.0 / h, 1.0 / h, 1.0])
        for i in range(5):
            for j in range(5):
                covariances[m, i, j] = assumed * assumed * scale[i] * scale[j] * inverse[i, j]
        for g in range(len(bounds) - 1):
            if 0 <= at[bounds[g]] < responses.shape[1]:
                for i in range(4):
                    responses[m, at[bounds[g]], i] = response[g, i] * scale[i] * station_sd[g]


# --- Points and rays in the frame of a tube, and their stations.


@njit(cache=True, nogil=True, inline="always")
def framed(direction, side, other):  # type: ignore[no-untyped-def]
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
def bounds_of(stations):  # type: ignore[no-untyped-def]
    """Bounds of the stretches of one station each."""
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
def thin(places, stations, most):  # type: ignore[no-untyped-def]
    """Every k-th of ordered places, so that no more than ``most`` are left, with stations and their bounds."""
    k = max(1, (len(places) + most - 1) // most)
    fewer, where = places[::k], stations[::k]
    return fewer, where, bounds_of(where)


@njit(cache=True, nogil=True)
def localised(places, stations, middle, point, direction, side, other, scanners, P, U, seen):  # type: ignore[no-untyped-def]
    """Points and rays in the frame (side, other, direction) about a point."""
    mask = (1 << FIELD) - 1
    for i in range(len(places)):
        w = places[i]
        x = ((w >> (2 * FIELD)) - HALF + middle[0]) / STEPS_PER_MM - point[0]
        y = (((w >> FIELD) & mask) - HALF + middle[1]) / STEPS_PER_MM - point[1]
        z = ((w & mask) - HALF + middle[2]) / STEPS_PER_MM - point[2]
        P[i, 0] = x * side[0] + y * side[1] + z * side[2]
        P[i, 1] = x * other[0] + y * other[1] + z * other[2]
        P[i, 2] = x * direction[0] + y * direction[1] + z * direction[2]
        s = stations[i]
        seen[i] = 0 <= s < len(scanners)
        if seen[i]:
            rx, ry, rz = x + point[0] - scanners[s, 0], y + point[1] - scanners[s, 1], z + point[2] - scanners[s, 2]
            n = np.sqrt(rx * rx + ry * ry + rz * rz)
            rx, ry, rz = rx / n, ry / n, rz / n
            U[i, 0] = rx * side[0] + ry * side[1] + rz * side[2]
            U[i, 1] = rx * other[0] + ry * other[1] + rz * other[2]
            U[i, 2] = rx * direction[0] + ry * direction[1] + rz * direction[2]


@njit(cache=True, nogil=True)
def moved(p, h, point, direction, side, other):  # type: ignore[no-untyped-def]
    """Move a line by the parameters found, and its frame with it."""
    for i in range(3):
        point[i] += p[0] * side[i] + p[1] * other[i]
        direction[i] += (p[2] * side[i] + p[3] * other[i]) / h
    n = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    for i in range(3):
        direction[i] /= n
    framed(direction, side, other)


@njit(cache=True, nogil=True)
def distances(point, at, bounds, scanners):  # type: ignore[no-untyped-def]
    """Distance in m of a point from the station of each group; 0 where it is unknown."""
    away = np.zeros(len(bounds) - 1)
    for g in range(len(away)):
        s = at[bounds[g]]
        if 0 <= s < len(scanners):
            for i in range(3):
                away[g] += (1e-3 * (point[i] - scanners[s, i])) ** 2
        away[g] = np.sqrt(away[g])
    return away
