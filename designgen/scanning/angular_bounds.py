"""Compiled kernels of the ray caster: the windows of the angular grid that shapes cover, in float64."""
# Numba infers the types of the arguments: the kernels have no annotations.

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def grid_windows(centres, radii, reach, spread, step, lowest, rows, columns, side):  # type: ignore[no-untyped-def]
    """Return the windows (b, 5) of bounding spheres on the grid: sphere, first and last column, first and last row.

    Centres (k, 3) in the scanner's frame, ``radii`` (k,) and ``reach``, the greatest range, are in mm. ``spread``, the
    largest angle between a ray and its nominal direction, ``step`` and ``lowest`` are in rad. Columns extend ``side``
    beyond the first and the last, so that a window over the seam of the azimuth is on both sides of it.
    """
    result = np.empty((3 * len(radii), 5), np.int32)
    count = 0
    across = columns / (2.0 * np.pi)
    for k in range(len(radii)):
        x, y, z = centres[k, 0], centres[k, 1], centres[k, 2]
        d = np.sqrt(x * x + y * y + z * z)
        if d - radii[k] > reach:
            continue
        first, last, low, high = -side, columns - 1 + side, 0, rows - 1
        if d > 1.000001 * radii[k]:
            half = np.arcsin(radii[k] / d) + spread
            elevation = np.arcsin(z / d)
            low = max(low, int(np.floor((elevation - half - lowest) / step)))
            high = min(high, int(np.ceil((elevation + half - lowest) / step)))
            if abs(elevation) + half < 0.5 * np.pi - 1e-6 and half < 1.5:
                half_azimuth = np.arcsin(min(1.0, np.sin(half) / np.cos(elevation)))
                azimuth = np.arctan2(y, x)
                first = int(np.floor((azimuth - half_azimuth) * across))
                last = int(np.ceil((azimuth + half_azimuth) * across))
        if low > high:
            continue
        whole = last - first >= columns
        if whole:
            first, last = -side, columns - 1 + side
        for wrap in range(0 if whole else -1, 1 if whole else 2):
            left, right = max(first + wrap * columns, -side), min(last + wrap * columns, columns - 1 + side)
            if left <= right:
                result[count, 0], result[count, 1], result[count, 2] = k, left, right
                result[count, 3], result[count, 4] = low, high
                count += 1
    return result[:count].copy()


@njit(cache=True, nogil=True)
def by_strip(windows, width, strips, side):  # type: ignore[no-untyped-def]
    """Return the windows (c, 5) sorted by strip, and each strip's first (strips + 1,).

    A window is in every strip it touches, with ``side`` columns on either side of the strip.
    """
    start = np.zeros(strips + 1, np.int64)
    for fill in range(2):
        if fill:
            start = np.cumsum(start)
            place = start[:-1].copy()
            result = np.empty((start[-1], 5), np.int32)
        for w in range(len(windows)):
            low = max(0, (windows[w, 1] - side) // width)
            for s in range(low, min(strips - 1, (windows[w, 2] + side) // width) + 1):
                if fill:
                    for k in range(5):
                        result[place[s], k] = windows[w, k]
                    place[s] += 1
                else:
                    start[s + 1] += 1
    return result, start
