"""Compiled kernels of the stations' self-registration: points of tubes against their axes.

An observation is the set of points of one tube from one station. Its unknowns, in this order: offsets of the tube's
axis along e1 and e2 at the middle of the stretch seen, its further offsets along e1 and e2 at the end of that stretch
(zeta = 1), bow along e1 and e2 as the factor of zeta^2 - 1/3, radius, and offset of the ranges; all mm. The last
belongs to the station alone. Sums over an observation run in the points' order and do not depend on threads.
"""
# Numba infers the types of the arguments: they stay without annotations.

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats, Ints, Labels

TUBE = 8  # unknowns of an observation; a tube has the first seven
STATION = 7  # unknowns of a station: turn about its own place, translation, offset of its ranges
ASIDE = 0.01  # variance of the noise across the ray over that along it
LEAST = 32  # items of a range for one thread


class Layout(NamedTuple):
    """Observations (q,): their points, tube and station. Those of tube j are ``of_tube[j]`` to ``of_tube[j + 1]``."""

    start: Ints  # (q + 1,) of the points
    tube: Ints  # (q,)
    station: Ints  # (q,)
    of_tube: Ints  # (m + 1,)


class Axes(NamedTuple):
    """Axes of tubes: point and direction (m, 6), two unit vectors (m, 3) across, half length and radius (m,)."""

    line: Floats
    e1: Floats
    e2: Floats
    half: Floats
    radius: Floats


@njit(cache=True, nogil=True)
def grouped(tube_start, station, stations, most):  # type: ignore[no-untyped-def]
    """Order of points (CSR by tube) by tube and station, stable, and the start of each pair's points; -1 left out.

    Of the stations that see a tube, the ``most`` with the most points on it are used.
    """
    tubes = len(tube_start) - 1
    order = np.empty(len(station), np.int64)
    pair_start = np.empty(tubes * stations + 1, np.int64)
    number = np.empty(stations + 1, np.int64)
    at = 0
    for j in range(tubes):
        number[:] = 0
        for i in range(tube_start[j], tube_start[j + 1]):
            if 0 <= station[i] < stations:
                number[station[i] + 1] += 1
        while np.count_nonzero(number) > most:
            fewest = 0
            for s in range(1, stations + 1):
                if number[s] > 0 and (fewest == 0 or number[s] <= number[fewest]):
                    fewest = s
            number[fewest] = 0
        taken = number[1:] > 0
        for s in range(stations):
            number[s + 1] += number[s]
            pair_start[j * stations + s] = at + number[s]
        for i in range(tube_start[j], tube_start[j + 1]):
            if 0 <= station[i] < stations and taken[station[i]]:
                order[at + number[station[i]]] = i
                number[station[i]] += 1
        at += number[stations - 1]  # shifted up by one place: now the end of the last station's
    pair_start[tubes * stations] = at
    return order[:at], pair_start


@njit(cache=True, nogil=True)
def extent(points, start, at, along):  # type: ignore[no-untyped-def]
    """First and last of the points (CSR by tube) along each axis; -1 and 1 for a tube without points."""
    low, high = np.full(len(at), -1.0), np.full(len(at), 1.0)
    for j in range(len(at)):
        first, last = np.inf, -np.inf
        for i in range(start[j], start[j + 1]):
            t = 0.0
            for k in range(3):
                t += (points[i, k] - at[j, k]) * along[j, k]
            first, last = min(first, t), max(last, t)
        if last > first:
            low[j], high[j] = first, last
    return low, high


@njit(cache=True, nogil=True)
def _residuals(points, layout, T, offset, scanners, axes, steepest, seen, first, last):  # type: ignore[no-untyped-def]
    axis, e1, e2, half, radius = axes
    for q in range(first, last):
        j, s = layout.tube[q], layout.station[q]
        M = T[s]
        ax, ay, az = axis[j, 0], axis[j, 1], axis[j, 2]
        dx, dy, dz = axis[j, 3], axis[j, 4], axis[j, 5]
        r = radius[j]
        cx, cy, cz = scanners[s, 0], scanners[s, 1], scanners[s, 2]
        ox = M[0, 0] * cx + M[0, 1] * cy + M[0, 2] * cz + M[0, 3] - ax
        oy = M[1, 0] * cx + M[1, 1] * cy + M[1, 2] * cz + M[1, 3] - ay
        oz = M[2, 0] * cx + M[2, 1] * cy + M[2, 2] * cz + M[2, 3] - az
        o1 = ox * e1[j, 0] + oy * e1[j, 1] + oz * e1[j, 2]
        o2 = ox * e2[j, 0] + oy * e2[j, 1] + oz * e2[j, 2]
        for i in range(layout.start[q], layout.start[q + 1]):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            px = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3] - ax
            py = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3] - ay
            pz = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3] - az
            p1 = px * e1[j, 0] + py * e1[j, 1] + pz * e1[j, 2]
            p2 = px * e2[j, 0] + py * e2[j, 1] + pz * e2[j, 2]
            zeta = (px * dx + py * dy + pz * dz) / half[j]
            length = np.sqrt((px - ox) ** 2 + (py - oy) ** 2 + (pz - oz) ** 2)
            u1, u2 = (p1 - o1) / length, (p2 - o2) / length
            across = u1 * u1 + u2 * u2
            if across < 1e-6:
                continue
            t0 = -(o1 * u1 + o2 * u2) / across
            f1, f2 = o1 + t0 * u1, o2 + t0 * u2  # the ray's foot by the axis: no difference of large squares
            under = r * r - f1 * f1 - f2 * f2
            if under <= 0.0:
                continue
            t = t0 - np.sqrt(under / across)
            n1, n2 = (o1 + t * u1) / r, (o2 + t * u2) / r
            cosine = -(n1 * u1 + n2 * u2)
            if cosine < steepest:
                continue
            seen[i, 0], seen[i, 1] = length - offset[s] - t, cosine
            # zeta is the model's, too: the noise of the range must not enter the weights
            seen[i, 2], seen[i, 3] = n1, n2
            seen[i, 4] = zeta + (t - length) / length * ((px - ox) * dx + (py - oy) * dy + (pz - oz) * dz) / half[j]


def residuals(
    points: Floats,
    layout: Layout,
    T: Floats,
    offset: Floats,
    scanners: Floats,
    axes: Axes,
    steepest: float,
    threads: int = 0,
) -> Floats:
    """Residual, cosine of incidence, normal along e1 and e2, and zeta of each point (n, 5).

    The residual is the measured range less the range at which the ray meets the tube; the cosine is that of incidence
    there, or 0 for a ray with a cosine below ``steepest`` and one that misses the tube. Points and scanners are moved
    by their station's T (s, 4, 4) before, and ranges reduced by its offset (s,).
    """
    seen = np.zeros((len(points), 5))
    kernel = partial(_residuals, points, layout, T, np.ascontiguousarray(offset), scanners, axes, steepest, seen)
    over_ranges(kernel, len(layout.tube), threads, LEAST)
    return seen


@njit(cache=True, nogil=True)
def _observations(seen, layout, scale, cut, N, b, first, last):  # type: ignore[no-untyped-def]
    for q in range(first, last):
        sigma = scale[layout.station[q]]
        f = np.empty(TUBE)
        for i in range(layout.start[q], layout.start[q + 1]):
            cosine, v = seen[i, 1], seen[i, 0] / (cut * sigma)
            if cosine == 0.0 or abs(v) >= 1.0:
                continue
            w = (1.0 - v * v) ** 2 / (sigma * sigma * (cosine * cosine + ASIDE))
            n1, n2, zeta = seen[i, 2], seen[i, 3], seen[i, 4]
            arch = zeta * zeta - 1.0 / 3.0
            f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7] = (
                n1, n2, zeta * n1, zeta * n2, arch * n1, arch * n2, 1.0, cosine,
            )  # fmt: skip
            distance = -seen[i, 0] * cosine
            for a in range(TUBE):
                b[q, a] += w * f[a] * distance
                for c in range(a + 1):
                    N[q, a, c] += w * f[a] * f[c]
        for a in range(TUBE):
            for c in range(a):
                N[q, c, a] = N[q, a, c]


def observations(seen: Floats, layout: Layout, scale: Floats, cut: float, threads: int = 0) -> tuple[Floats, Floats]:
    """Information N (q, 8, 8) and N y (q, 8) of each observation.

    The normal distance -residual * cosine is a linear function of the unknowns. Its noise is cosine times the station's
    ``scale`` (s,), and slightly more for the error of angles. Tukey's biweight with ``cut`` scales.
    """
    q = len(layout.tube)
    N, b = np.zeros((q, TUBE, TUBE)), np.zeros((q, TUBE))
    over_ranges(partial(_observations, seen, layout, scale, cut, N, b), q, threads, LEAST)
    return N, b


@njit(cache=True, nogil=True)
def _corrected(points, station, places, offset, T, moved, first, last):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        s = station[i]
        if s < 0 or s >= len(places):
            continue
        x, y, z = points[i, 0] - places[s, 0], points[i, 1] - places[s, 1], points[i, 2] - places[s, 2]
        shorter = offset[s] / max(np.sqrt(x * x + y * y + z * z), 1e-300)
        x, y, z = points[i, 0] - shorter * x, points[i, 1] - shorter * y, points[i, 2] - shorter * z
        for k in range(3):
            moved[i, k] = T[s, k, 0] * x + T[s, k, 1] * y + T[s, k, 2] * z + T[s, k, 3]


def corrected(points: Floats, station: Labels, places: Floats, offset: Floats, T: Floats, threads: int = 0) -> Floats:
    """Subtract their station's range offset from points (n, 3), and move them by its T; in sums a coordinate."""
    moved: Floats = points.copy()
    over_ranges(partial(_corrected, points, station, places, offset, T, moved), len(points), threads, 20_000)
    return moved
