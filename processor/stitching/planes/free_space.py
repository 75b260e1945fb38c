"""Free space of a scan: the directions and ranges in which its rays met nothing, as a range image on a cube."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numba import njit

from processor import large_arrays
from processor.model import Floats

PIXELS = 320  # at most along each side of the six faces of the cube: 0.28 degrees
FEWEST_PIXELS = 40  # along a side: 2.2 degrees; sparser scans are left with gaps
SEEN_NEIGHBOURS = 5  # of 3 x 3 pixels, that must hold rays for a point to count as lying in free space
FILLED = 0.85  # share of the pixels with points that must have so many neighbours: else pixels are too small
RAYS = 2.0  # across a patch, that are sure to hit it
UNANSWERED = 0.3  # weight of a point in a direction of rays without a return: bare steel may return none as well
# Share of the ranges that are below the reach of a scan: beyond it no return is no evidence, as the scanner, or who
# exported its scan, may have cut it off there. Strays beyond are fewer than one in 100.
WITHIN_REACH, RANGES = 0.99, 200_000  # and the number of ranges that show it


@dataclass(frozen=True)
class FreeSpace:
    """Range image (6, n, n) of the least range seen in each direction, mm; infinite = no return, negative = no ray.

    Rays without a return met nothing up to ``reach_mm``.
    """

    near: Floats
    reach_mm: float = np.inf

    @classmethod
    def from_rays(cls, points: Floats, unanswered: Iterable[Floats]) -> FreeSpace:
        """Build the range image of points (n, 3) in the scanner's frame and of parts of the rays without a return."""
        n = PIXELS
        while True:
            near = np.full((6, n, n), np.inf)
            for rows in large_arrays.blocks(len(points)):
                write_ranges(points[rows], near, n)
            near[np.isinf(near)] = -1.0
            if n <= FEWEST_PIXELS or filled_share(near, SEEN_NEIGHBOURS) >= FILLED:
                break
            n = int(n / 1.3)
        for rays in unanswered:
            write_unanswered(rays, near, n)
        some = large_arrays.every(points, max(1, len(points) // RANGES))
        return cls(near, float(np.quantile(np.linalg.norm(some, axis=1), WITHIN_REACH)) if len(some) else 0.0)

    def contains(self, points: Floats, tolerance_mm: float, slope: float = 0.02) -> Floats:
        """Return the weight (n,) with which points (n, 3) lie in free space by more than a margin: 1, or 0 outside.

        The margin is ``tolerance_mm`` plus ``slope`` times the range. Among rays without a return the weight is
        UNANSWERED, up to the reach.
        """
        weight, margin = np.zeros(len(points)), (tolerance_mm, slope)
        weigh_free(np.ascontiguousarray(points), self.near, self.reach_mm, margin, SEEN_NEIGHBOURS, UNANSWERED, weight)
        return weight

    def resolved(self, points: Floats, normals: Floats, side_mm: float) -> Floats:
        """Return the share (n,), 0 to 1, of patches of side ``side_mm`` that the rays cannot have missed.

        Two rays across a patch in both directions are sure to hit it; a column far away or a floor at grazing incidence
        may lie between the rays. ``points`` and ``normals`` (n, 3) are in the scanner's frame.
        """
        reach = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
        rays = side_mm / (RAYS * (0.5 * np.pi / self.near.shape[1]) * reach)
        cosine = np.abs(np.einsum("ni,ni->n", points, normals)) / reach
        share: Floats = np.minimum(rays, 1.0) * np.minimum(rays * cosine, 1.0)
        return share


@njit(cache=True, nogil=True)
def pixel(x, y, z, n):  # type: ignore[no-untyped-def]
    """Return the face, row and column of the cube's pixel in a direction."""
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
    # Pixels of equal angles rather than of equal widths.
    i = min(n - 1, int((np.arctan(u / w) / (np.pi / 2.0) + 0.5) * n))
    j = min(n - 1, int((np.arctan(v / w) / (np.pi / 2.0) + 0.5) * n))
    return face, i, j


@njit(cache=True, nogil=True)
def write_ranges(points, near, n):  # type: ignore[no-untyped-def]
    """Write the least range of the points in each pixel of ``near`` (6, n, n)."""
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        f, i, j = pixel(x, y, z, n)
        r = np.sqrt(x * x + y * y + z * z)
        if r < near[f, i, j]:
            near[f, i, j] = r


@njit(cache=True, nogil=True)
def write_unanswered(rays, near, n):  # type: ignore[no-untyped-def]
    """Set pixels without points to infinity where rays without a return passed."""
    for k in range(len(rays)):
        f, i, j = pixel(rays[k, 0], rays[k, 1], rays[k, 2], n)
        if near[f, i, j] < 0.0:
            near[f, i, j] = np.inf


@njit(cache=True, nogil=True)
def weigh_free(points, near, reach, margin, least, unanswered, weight):  # type: ignore[no-untyped-def]
    """Write the weight (n,) of points nearer than the ranges of all pixels around them; others are left as they are."""
    n, (tolerance, slope) = near.shape[1], margin
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
        answered = nearest < np.inf
        if seen >= least and r < (nearest if answered else reach) - tolerance - slope * r:
            weight[k] = 1.0 if answered else unanswered


@njit(cache=True, nogil=True)
def filled_share(near, least):  # type: ignore[no-untyped-def]
    """Return the share of the pixels with points that have ``least`` of them or more in their 3 x 3 neighbourhood."""
    n = near.shape[1]
    filled, good = 0, 0
    for f in range(6):
        for i in range(1, n - 1):
            for j in range(1, n - 1):
                if 0.0 <= near[f, i, j] < np.inf:
                    filled += 1
                    count = 0
                    for a in range(i - 1, i + 2):
                        for b in range(j - 1, j + 2):
                            count += 0.0 <= near[f, a, b] < np.inf
                    good += count >= least
    return good / max(filled, 1)
