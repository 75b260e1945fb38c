"""Balls that no point lies on: hidden, or not there, by what the rays toward them did."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints
from processor.space_frame.points.source import Source
from processor.space_frame.spheres.records import Balls

CORE = 0.7  # of the radius: rays nearer to the centre than this meet the ball, wherever noise puts it
CLEAR = 1.5  # radii before or behind the centre: what ends there does not end on the ball
LEAST_RAYS = 5
UNKNOWN_RADIUS_MM = 40.0  # where neither design nor catalogue says it
MISSING = "not-found"


def rays(source: Source, places: Floats, radii: Floats) -> Ints:
    """Rays (k, 3) aimed at balls at ``places`` (k, 3), less the source's origin: ended before, at and beyond them.

    One pass over the source; points of unknown scanners are left out.
    """
    found = np.zeros((len(places), 3), np.int64)
    scanners = np.ascontiguousarray(source.scanners)
    places, radii = np.ascontiguousarray(places), np.ascontiguousarray(radii)
    for chunk in source.chunks():
        points, station = np.ascontiguousarray(chunk.points, np.float64).view(), chunk.station.view()
        points.flags.writeable = station.flags.writeable = False  # the kernel is compiled for one kind alone

        def count(first: int, last: int, points: Floats = points, station: Ints = station) -> None:
            _count(first, last, points, station, scanners, places, radii, CORE, CLEAR, found)

        over_ranges(count, len(places))
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _count(first, last, points, station, scanners, places, radii, core, clear, found):  # type: ignore[no-untyped-def]
    """Add the rays at balls ``first`` to ``last`` to those found (k, 3)."""
    for k in range(first, last):
        reach = core * radii[k]
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
            found[k, 0 if behind < -clear * radii[k] else 2 if behind > clear * radii[k] else 1] += 1


def told(found: Balls, source: Source, smallest_mm: float) -> Balls:
    """Tell balls that are hidden from those that are not there, where scanners are known.

    A ball that rays went through is not found: its node is known from the axes, the ball is missing. ``smallest_mm`` is
    the radius taken where none is expected; NaN = unknown.
    """
    axes_alone = np.array([one == "axes" for one in found.evidence], bool)
    rows = np.flatnonzero(axes_alone & np.array([flag != MISSING for flag in found.flag], bool))
    if not len(rows) or not len(source.scanners):
        return found
    radii = np.where(np.isfinite(found.expected[rows]), found.expected[rows], smallest_mm)
    counts = rays(source, found.centres[rows], np.where(np.isfinite(radii), radii, UNKNOWN_RADIUS_MM))
    flags, reasons = list(found.flag), list(found.reason)
    for row, (before, at, beyond) in zip(rows.tolist(), counts.tolist(), strict=True):
        if beyond >= max(LEAST_RAYS, at):
            flags[row] = MISSING
            reasons[row] += f"; it is missing: {beyond} rays went through where it should be"
        elif before >= LEAST_RAYS and before > at:
            reasons[row] += "; what stands before it hides it"
        elif before + at + beyond < LEAST_RAYS:
            reasons[row] += "; hardly a ray was measured its way"
    return replace(found, flag=tuple(flags), reason=tuple(reasons))
