"""Spheres without points: hidden or missing, by where the rays towards them end."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numba import njit

from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints
from processor.space_frame.points.source import Source
from processor.space_frame.spheres.records import Spheres

CORE = 0.7  # of the radius: rays that pass the centre within this meet the sphere in spite of noise
CLEAR = 1.5  # radii before or behind the centre: a ray that ends there does not end on the sphere
LEAST_RAYS = 5
UNKNOWN_RADIUS_MM = 40.0  # where neither design nor catalogue gives one
MISSING = "not-found"


def rays(source: Source, places: Floats, radii: Floats) -> Ints:
    """Count the rays (k, 3) aimed at spheres at ``places`` (k, 3), less the source's origin: ended before, at, beyond.

    One pass over the source; points of unknown scanners are left out.
    """
    counts = np.zeros((len(places), 3), np.int64)
    scanners = np.ascontiguousarray(source.scanners)
    places, radii = np.ascontiguousarray(places), np.ascontiguousarray(radii)
    for chunk in source.chunks():
        points, station = np.ascontiguousarray(chunk.points, np.float64).view(), chunk.station.view()
        points.flags.writeable = station.flags.writeable = False  # the kernel is compiled for one kind alone
        over_ranges(partial(_count, points, station, scanners, places, radii, counts), len(places))
    return counts


@njit(cache=True, nogil=True, error_model="numpy")
def _count(points, station, scanners, places, radii, counts, first, last):  # type: ignore[no-untyped-def]
    """Add the rays at spheres ``first`` to ``last`` to their counts (k, 3)."""
    for k in range(first, last):
        reach = CORE * radii[k]
        for i in range(len(points)):
            s = station[i]
            if s < 0 or s >= len(scanners):
                continue
            vx, vy, vz = points[i, 0] - scanners[s, 0], points[i, 1] - scanners[s, 1], points[i, 2] - scanners[s, 2]
            cx, cy, cz = places[k, 0] - scanners[s, 0], places[k, 1] - scanners[s, 1], places[k, 2] - scanners[s, 2]
            dot = vx * cx + vy * cy + vz * cz
            length2, away2 = vx * vx + vy * vy + vz * vz, cx * cx + cy * cy + cz * cz
            if dot <= 0.0 or away2 - dot * dot / length2 > reach * reach:
                continue
            behind = np.sqrt(length2) - np.sqrt(away2)
            counts[k, 0 if behind < -CLEAR * radii[k] else 2 if behind > CLEAR * radii[k] else 1] += 1


def classified(spheres: Spheres, source: Source, smallest_mm: float) -> Spheres:
    """Separate hidden spheres from missing ones, where scanners are known.

    A sphere is not found where rays passed through its place: its node is known from the axes, but the sphere is
    missing. ``smallest_mm`` is the radius taken where none is expected; NaN = unknown.
    """
    without_points = [evidence == "axes" and flag != MISSING
                      for evidence, flag in zip(spheres.evidence, spheres.flag, strict=True)]  # fmt: skip
    rows = np.flatnonzero(np.array(without_points, bool))
    if not len(rows) or not len(source.scanners):
        return spheres
    radii = np.where(np.isfinite(spheres.expected[rows]), spheres.expected[rows], smallest_mm)
    counts = rays(source, spheres.centres[rows], np.where(np.isfinite(radii), radii, UNKNOWN_RADIUS_MM))
    flags, reasons = list(spheres.flag), list(spheres.reason)
    for row, (before, at, beyond) in zip(rows.tolist(), counts.tolist(), strict=True):
        if beyond >= max(LEAST_RAYS, at):
            flags[row] = MISSING
            reasons[row] += f"; it is missing: {beyond} rays went through where it should be"
        elif before >= LEAST_RAYS and before > at:
            reasons[row] += "; what stands before it hides it"
        elif before + at + beyond < LEAST_RAYS:
            reasons[row] += "; hardly a ray was measured its way"
    return replace(spheres, flag=tuple(flags), reason=tuple(reasons))
