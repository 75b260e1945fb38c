"""Rays and ranges of the points gathered about nodes, from the scanners that saw them."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from functools import partial

import numpy as np
from numba import njit

from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats
from processor.space_frame.points.sphere_crops import Crops
from processor.space_frame.spheres.records import CropsWithRays


def with_rays(crops: Crops, nodes: Floats, scanners: Floats, threads: int) -> CropsWithRays:
    """Add unit rays and ranges, mm, of gathered points from the scanners (s, 3) that saw them.

    The points are relative to their ``nodes`` (k, 3); nodes and scanners are in one frame, mm.
    """
    rays, ranges = np.zeros((len(crops.points), 3)), np.zeros(len(crops.points))
    found = CropsWithRays(crops.start, crops.points, rays, ranges, crops.station)
    over_ranges(partial(_aim, found, nodes, scanners), len(nodes), threads)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _aim(crops, nodes, scanners, first, last):  # type: ignore[no-untyped-def]
    """Fill unit rays (n, 3), 0 where the scanner is unknown, and ranges (n,)."""
    points = crops.points
    for k in range(first, last):
        for i in range(crops.start[k], crops.start[k + 1]):
            s = crops.station[i]
            if s < 0 or s >= len(scanners):
                continue
            x = points[i, 0] + (nodes[k, 0] - scanners[s, 0])
            y = points[i, 1] + (nodes[k, 1] - scanners[s, 1])
            z = points[i, 2] + (nodes[k, 2] - scanners[s, 2])
            d = np.sqrt(x * x + y * y + z * z)
            if d > 0.0:
                crops.rays[i, 0], crops.rays[i, 1], crops.rays[i, 2] = x / d, y / d, z / d
                crops.ranges[i] = d
