"""All tubes fitted, each on its own; see :mod:`processor.bolt_balls.cylinder` for the model."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.bolt_balls.corridors import FIELD, HALF, Gathered
from processor.bolt_balls.cylinder import NP, reach_of, roughly, spread_of, step
from processor.bolt_balls.thinning import STEPS_PER_MM
from processor.bolt_balls.threads import over_ranges
from processor.model import Floats, Ints

BIN_MM = 10.0
CUTS_MM = (30.0, 15.0)
CUT_SIGMAS = 3.5
TRIM_MM = 8.0  # taken off each end: where a cone begins is not seen that sharply


@dataclass(frozen=True)
class Fits:
    """Tubes (m,): middle of the cylinder ``points``, ``directions``, ``side`` across; see :class:`Tubes`.

    ``ok`` marks the tubes that could be fitted; ``sigma`` is the standard deviation of a residual.
    """

    ok: npt.NDArray[np.bool_]
    points: Floats
    directions: Floats
    side: Floats
    lengths: Floats
    radii: Floats
    bow: Floats
    covariance: Floats  # (m, 5, 5)
    count: Ints
    sigma: Floats


@njit(cache=True, nogil=True, inline="always")
def framed(direction, side, other):  # type: ignore[no-untyped-def]
    """Unit vectors across a direction: the first is level, or along x where the direction is upright."""
    x, y, z = direction[0], direction[1], direction[2]
    n = np.sqrt(x * x + y * y)
    if n > 1e-3:
        side[0], side[1], side[2] = -y / n, x / n, 0.0
    else:
        side[0], side[1], side[2] = 0.0, 1.0, 0.0
        along = y
        n = np.sqrt(x * x + (1.0 - y * along) ** 2 + z * z)
        side[0], side[1], side[2] = -along * x, 1.0 - along * y, -along * z
        n = np.sqrt(side[0] ** 2 + side[1] ** 2 + side[2] ** 2)
        side[0], side[1], side[2] = side[0] / n, side[1] / n, side[2] / n
    other[0] = direction[1] * side[2] - direction[2] * side[1]
    other[1] = direction[2] * side[0] - direction[0] * side[2]
    other[2] = direction[0] * side[1] - direction[1] * side[0]


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
def fit(  # type: ignore[no-untyped-def]
    counts, room, places, stations, middles, scanners, points, directions, sides, inner, spans, least_radius, most_radius,
    bow_share, fine, ok, lengths, radii, bows, covariances, used, sigmas, first, last,
):  # fmt: skip
    """Fit tubes first..last, changing ``points`` and ``directions`` in place; see :func:`fitted`."""
    for m in range(first, last):
        n = counts[m]
        if n < 16:
            continue
        # Stations one after another, and the points of each in the order of their coordinates: sums never vary.
        own = np.empty(n, np.int64)
        at = np.empty(n, np.int16)
        order = np.argsort(stations[m * room : m * room + n], kind="mergesort")
        for i in range(n):
            own[i], at[i] = places[m * room + order[i]], stations[m * room + order[i]]
        start = 0
        for i in range(1, n + 1):
            if i == n or at[i] != at[start]:
                own[start:i] = np.sort(own[start:i])
                start = i
        P, U, seen = np.empty((n, 3)), np.zeros((n, 3)), np.zeros(n, np.bool_)
        point, direction, side, other = points[m].copy(), directions[m].copy(), np.empty(3), np.empty(3)
        framed(direction, side, other)
        localised(own, at, middles[m], point, direction, side, other, scanners, P, U, seen)
        p, inverse, sizes = np.zeros(NP), np.zeros((NP, NP)), np.empty(n)
        h = inner[m]
        if not roughly(P, -h, h, 1e9, p, h) or not least_radius * 0.7 < p[4] < most_radius * 1.3:
            continue
        good = True
        sigma, count, total = 2.0, 0, 0.0
        for turn in range(4):
            if turn < 2:
                cut = CUTS_MM[turn]
            else:
                sigma = max(spread_of(sizes, count), 0.05)
                cut = max(CUT_SIGMAS * sigma, 0.5)
            count, total, shift, good = step(p, h, -h, h, P, U, seen, 5, cut, sigma, 1.0, sizes, inverse)
            if not good or not least_radius * 0.7 < p[4] < most_radius * 1.3:
                good = False
                break
        if not good:
            continue
        sigma = max(spread_of(sizes, count), 0.05)
        # The ends of the cylinder, and all again about its middle.
        span = spans[m]
        bins = np.empty(2 * int(span / BIN_MM) + 2)
        half = 0.5 * BIN_MM * len(bins)
        low, high = reach_of(p, h, P, U, seen, sigma, bins, BIN_MM, half)
        low, high = low + TRIM_MM, high - TRIM_MM
        if high - low < 100.0:
            continue
        moved(p, h, point, direction, side, other)
        for i in range(3):
            point[i] += 0.5 * (low + high) * direction[i]
        h = 0.5 * (high - low)
        localised(own, at, middles[m], point, direction, side, other, scanners, P, U, seen)
        p[0] = p[1] = p[2] = p[3] = 0.0
        free = NP if fine else 5
        prior = (0.5 * bow_share * 2.0 * h) ** 2
        for turn in range(5 if fine else 1):
            cut = max(CUT_SIGMAS * sigma, 0.5)
            count, total, shift, good = step(p, h, -h, h, P, U, seen, free, cut, sigma, prior, sizes, inverse)
            if not good:
                break
            sigma = max(np.sqrt(total / max(count - free, 1)), 0.05)
            if turn > 1 and shift < 1e-3:
                break
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
                covariances[m, i, j] = sigma * sigma * scale[i] * scale[j] * inverse[i, j]


def fitted(
    gathered: Gathered,
    scanners: Floats,
    points: Floats,
    directions: Floats,
    inner_mm: Floats,
    span_mm: Floats,
    radii_mm: tuple[float, float],
    bow_share: float,
    fine: bool,
    threads: int = 0,
) -> Fits:
    """Fit a tube about each line through points (m, 3) along unit directions (m, 3), off the true axis by 40 mm at most.

    Points within ``inner_mm`` (m,) of the middle are believed to be on the tube, and its ends are looked for within
    ``span_mm`` (m,). ``bow_share`` is the largest bow to expect as a share of the length; without ``fine`` tubes are
    straight and ends rough. Radii outside of ``radii_mm`` are no tubes.
    """
    m = len(points)
    points, directions, sides = points.copy(), directions.copy(), np.zeros((m, 3))
    ok, lengths, radii, bows = np.zeros(m, bool), np.zeros(m), np.zeros(m), np.zeros((m, 2))
    covariances, used, sigmas = np.zeros((m, 5, 5)), np.zeros(m, np.int64), np.zeros(m)
    kernel = partial(
        fit, gathered.counts, gathered.room, gathered.places, gathered.stations, gathered.middles, scanners, points,
        directions, sides, inner_mm, span_mm, *radii_mm, bow_share, fine, ok, lengths, radii, bows, covariances, used, sigmas,
    )  # fmt: skip
    over_ranges(kernel, m, threads)
    return Fits(ok, points, directions, sides, lengths, radii, bows, covariances, used, sigmas)
