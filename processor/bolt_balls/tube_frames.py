"""Points and rays in the frame of a tube, and their stations."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit

from processor.bolt_balls.corridors import FIELD, HALF
from processor.bolt_balls.thinning import STEPS_PER_MM


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
