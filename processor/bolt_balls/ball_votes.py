"""Compiled votes for a ball's radius, and the small lists that the choice of a size keeps."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def votes(  # type: ignore[no-untyped-def]
    points, rays, axis_points, axes, keep_off, tube_off, hole, radii, kernel, found
):
    """Votes (m,) for radii: points in the shell less those deeper than two kernels inside, which no ball allows.

    Points within ``keep_off`` of an axis are sleeves. Cones are wider than sleeves and stand where a large ball would
    be: radii from twice ``tube_off`` on are denied the points within that of an axis too.
    """
    n = len(points)
    depth, slim = np.empty(n), np.empty(n, np.uint8)
    widest, farthest = 0.0, 0.0
    for m in range(len(axes)):
        widest = max(widest, tube_off[m])
    for k in range(len(radii)):
        farthest = max(farthest, radii[k] + kernel)
    kept = 0
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        d2 = x * x + y * y + z * z
        if d2 > farthest * farthest:
            continue
        d = np.sqrt(d2)
        facing = x * rays[i, 0] + y * rays[i, 1] + z * rays[i, 2]
        if facing > 0.0 or (z < 0.0 and x * x + y * y < hole * hole):
            continue
        masked, tube = False, False
        for m in range(len(axes)):
            sx, sy, sz = x - axis_points[m, 0], y - axis_points[m, 1], z - axis_points[m, 2]
            along = sx * axes[m, 0] + sy * axes[m, 1] + sz * axes[m, 2]
            if along <= 0.0:
                continue
            across = sx * sx + sy * sy + sz * sz - along * along
            if across < keep_off[m] * keep_off[m]:
                masked = True
                break
            tube = tube or across < tube_off[m] * tube_off[m]
        if not masked:
            depth[kept] = d
            slim[kept] = tube
            kept += 1
    for k in range(len(radii)):
        found[k] = 0.0
        for i in range(kept):
            off = depth[i] - radii[k]
            if abs(off) < kernel:
                if not slim[i] or radii[k] < 2.0 * widest:
                    found[k] += 1.0
            elif off < -2.0 * kernel:
                found[k] -= 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def with_expected(sizes, expected):  # type: ignore[no-untyped-def]
    """Return the sizes, and the expected one if it is none of them."""
    count = len(sizes)
    found = np.empty(count + 1)
    fresh = not np.isnan(expected)
    for j in range(count):
        found[j] = sizes[j]
        fresh = fresh and sizes[j] != expected
    found[count] = expected
    return found[: count + 1] if fresh else found[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def by_votes(vote):  # type: ignore[no-untyped-def]
    """Return the rows from the most votes to the least; equal ones keep their order."""
    order = np.arange(len(vote))
    for i in range(1, len(order)):
        j = i
        while j > 0 and vote[order[j]] > vote[order[j - 1]]:
            order[j], order[j - 1] = order[j - 1], order[j]
            j -= 1
    return order


@njit(cache=True, nogil=True, error_model="numpy")
def least_of(values, count):  # type: ignore[no-untyped-def]
    """Return the row of the least of the first values."""
    best = 0
    for i in range(1, count):
        if values[i] < values[best]:
            best = i
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def rows_within(points, near, far):  # type: ignore[no-untyped-def]
    """Rows of points whose distance from the origin is ``near`` to ``far``."""
    rows = np.empty(len(points), np.int64)
    kept = 0
    for i in range(len(points)):
        d2 = points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2
        if near * near <= d2 <= far * far:
            rows[kept] = i
            kept += 1
    return rows[:kept]


@njit(cache=True, nogil=True, error_model="numpy")
def taken(rows, points, rays, ranges, station):  # type: ignore[no-untyped-def]
    """Return the rows of points, rays, ranges and stations."""
    n = len(rows)
    p, u, L, s = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, np.int32)
    for j in range(n):
        i = rows[j]
        for axis in range(3):
            p[j, axis] = points[i, axis]
            u[j, axis] = rays[i, axis]
        L[j] = ranges[i]
        s[j] = station[i]
    return p, u, L, s
