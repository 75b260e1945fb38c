"""What a scanner looked through: places of one scan held against the rays of another."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from processor.model import Floats

PIXELS = 320  # at most along each side of the six faces of a cube: 0.28 degrees
FEWEST_PIXELS = 40
SEEN_NEIGHBOURS = 5  # of 9 pixels, that must hold rays before a place is said to have been looked through
FILLED = 0.85  # share of pixels with points that must have so many neighbours: else pixels are too small
UNANSWERED = 0.3  # weight of a place in whose direction rays were sent that did not come back: bare steel does that too


@njit(cache=True, nogil=True)
def pixel(x, y, z, n):  # type: ignore[no-untyped-def]
    """Face, row and column of the cube of pixels that a direction goes through."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face = 0 if x > 0 else 1
        u, v, w = y, z, ax
    elif ay >= az:
        face = 2 if y > 0 else 3
        u, v, w = x, z, ay
    else:
        face = 4 if z > 0 else 5
        u, v, w = x, y, az
    if w == 0.0:
        return 0, 0, 0
    # Equal angles rather than equal widths.
    i = min(n - 1, int((np.arctan(u / w) / (np.pi / 2.0) + 0.5) * n))
    j = min(n - 1, int((np.arctan(v / w) / (np.pi / 2.0) + 0.5) * n))
    return face, i, j


@njit(cache=True, nogil=True)
def fill(points, near, n):  # type: ignore[no-untyped-def]
    """Write the least range into each pixel (6, n, n); infinite where there is none."""
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        f, i, j = pixel(x, y, z, n)
        r = np.sqrt(x * x + y * y + z * z)
        if r < near[f, i, j]:
            near[f, i, j] = r


@njit(cache=True, nogil=True)
def looked_through(points, near, tolerance, slope, least, unanswered, out):  # type: ignore[no-untyped-def]
    """Mark (n,) the points nearer than all that the pixels around saw: the scanner looked through them.

    A pixel of a negative range was never looked at, of an infinite one nothing came back.
    """
    n = near.shape[1]
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        f, i, j = pixel(x, y, z, n)
        r = np.sqrt(x * x + y * y + z * z)
        seen, nearest = 0, np.inf
        for di in range(-1, 2):
            for dj in range(-1, 2):
                a, b = i + di, j + dj
                if 0 <= a < n and 0 <= b < n and near[f, a, b] >= 0.0:
                    seen += 1
                    nearest = min(nearest, near[f, a, b])
        if seen >= least and r < nearest - tolerance - slope * r:
            out[k] = 1.0 if nearest < np.inf else unanswered


@njit(cache=True, nogil=True)
def send(rays, near, n):  # type: ignore[no-untyped-def]
    """Mark the pixels that rays without an answer went through."""
    for k in range(len(rays)):
        f, i, j = pixel(rays[k, 0], rays[k, 1], rays[k, 2], n)
        if near[f, i, j] < 0.0:
            near[f, i, j] = np.inf


@njit(cache=True, nogil=True)
def filled(near, least):  # type: ignore[no-untyped-def]
    """Share of the pixels with points that have at least so many of 9 around."""
    n = near.shape[1]
    held, good = 0, 0
    for f in range(6):
        for i in range(1, n - 1):
            for j in range(1, n - 1):
                if 0.0 <= near[f, i, j] < np.inf:
                    held += 1
                    count = 0
                    for a in range(i - 1, i + 2):
                        for b in range(j - 1, j + 2):
                            count += 0.0 <= near[f, a, b] < np.inf
                    good += count >= least
    return good / max(held, 1)


@dataclass(frozen=True)
class Sight:
    """The least range that a scanner saw in each direction (6, n, n), mm; infinite = no answer, negative = no ray."""

    near: Floats

    @classmethod
    def of(cls, points: Floats, unanswered: Floats) -> Sight:
        """Gather the ranges of points around their scanner, and the rays (m, 3) that did not come back."""
        n = PIXELS
        while True:
            near = np.full((6, n, n), np.inf)
            fill(points, near, n)
            near[np.isinf(near)] = -1.0
            if n <= FEWEST_PIXELS or filled(near, SEEN_NEIGHBOURS) >= FILLED:
                break
            n = int(n / 1.3)
        send(unanswered, near, n)
        return cls(near)

    def through(self, points: Floats, tolerance_mm: float, slope: float = 0.02) -> Floats:
        """Weigh points (n, 3) in the scanner's frame: 1 where it looked through by more than a margin, else 0 (n,)."""
        out = np.zeros(len(points))
        looked_through(np.ascontiguousarray(points), self.near, tolerance_mm, slope, SEEN_NEIGHBOURS, UNANSWERED, out)
        return out
