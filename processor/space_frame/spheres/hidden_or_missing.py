"""Spheres without points: hidden or missing, by where the rays towards them end."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numba import njit

from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats, Ints, reason
from processor.space_frame.points.source import Source
from processor.space_frame.result import Evidence, Flag
from processor.space_frame.spheres.records import Spheres

CENTRAL = 0.7  # of the radius: rays that pass the centre within this meet the sphere in spite of noise
CLEAR = 1.5  # radii before or behind the centre: a ray that ends there does not end on the sphere
LEAST_RAYS = 5
UNKNOWN_RADIUS_MM = 40.0  # where neither design nor catalogue gives one


def count_rays(source: Source, places: Floats, radii: Floats) -> Ints:
    """Count the rays (k, 3) aimed at spheres that ended before, at and beyond them; one pass over the source.

    ``places`` (k, 3) are relative to the source's origin. Points of unknown scanners are left out.
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
        reach = CENTRAL * radii[k]
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


def with_cause_of_absence(spheres: Spheres, source: Source, smallest_mm: float) -> Spheres:
    """Separate hidden spheres from missing ones, where scanners are known.

    A sphere is not found where rays passed through its place: its node is known from the axes, but the sphere is
    missing. ``smallest_mm`` is the radius taken where the design gives none; NaN = unknown.
    """
    without_points = [evidence is Evidence.AXES and flag is not Flag.NOT_FOUND
                      for evidence, flag in zip(spheres.evidence, spheres.flag, strict=True)]  # fmt: skip
    rows = np.flatnonzero(np.array(without_points, bool))
    if not len(rows) or not len(source.scanners):
        return spheres
    radii = np.where(np.isfinite(spheres.nominal[rows]), spheres.nominal[rows], smallest_mm)
    counts = count_rays(source, spheres.centres[rows], np.where(np.isfinite(radii), radii, UNKNOWN_RADIUS_MM))
    flags, reasons = list(spheres.flag), list(spheres.reasons)
    for row, (before, at, passed) in zip(rows.tolist(), counts.tolist(), strict=True):
        if passed >= max(LEAST_RAYS, at):
            flags[row] = Flag.NOT_FOUND
            reasons[row] += (reason("spheres.missing", rays=passed),)
        elif before >= LEAST_RAYS and before > at:
            reasons[row] += (reason("spheres.hidden"),)
        elif before + at + passed < LEAST_RAYS:
            reasons[row] += (reason("spheres.few-rays"),)
    return replace(spheres, flag=tuple(flags), reasons=tuple(reasons))
