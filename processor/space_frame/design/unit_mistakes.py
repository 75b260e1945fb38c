"""Detection of lengths in a wrong unit."""

from __future__ import annotations

import numpy as np

from processor import unit_ratio
from processor.model import Floats, Reason, reason

FACTORS = (1000.0, 304.8, 25.4)  # m, feet and inches read as mm, or the other way round
NEAR = 0.02  # relative tolerance of a factor
PLAUSIBLE_MM = (5.0, 2000.0)  # radii of any sphere or target
COMMON_MM = (20.0, 300.0)  # radii of most of them
# Radii of balls and targets as they are sold: tooling balls and reflectors of 1/2, 7/8, 1.5 and 3 inch, spheres of 100,
# 139, 145, 152.4 (6 inch), 200 and 230 mm.
USUAL_MM = (6.35, 11.1125, 19.05, 38.1, 50.0, 69.5, 72.5, 76.2, 100.0, 115.0)


def between(known: Floats, seen: Floats) -> str:
    """Return the factor of a unit, or its inverse, by which lengths (n,) exceed others (n,); empty without one."""
    sound = (known > 0.0) & (seen > 0.0)
    if not sound.any():
        return ""
    ratio = float(np.median(known[sound] / seen[sound]))
    # Each factor f followed by 1 / f
    factor = unit_ratio.nearest_factor(
        ratio, tuple(value for factor in FACTORS for value in (factor, 1.0 / factor)), NEAR
    )
    if factor is None:
        return ""
    return f"{factor:g}" if factor > 1.0 else f"1/{1.0 / factor:g}"


def implausible(radius: float) -> Reason | None:
    """Return a reason if a radius (mm) is outside of those of spheres and targets; else None."""
    if PLAUSIBLE_MM[0] <= radius <= PLAUSIBLE_MM[1]:
        return None
    shown = round(radius) if radius >= 100.0 else radius
    scales = [(scale, name) for f in FACTORS for scale, name in ((1.0 / f, f"1/{f:g}"), (f, f"{f:g}"))]
    usual = [one for one in scales if unit_ratio.nearest_factor(radius * one[0], USUAL_MM, NEAR) is not None]
    common = [one for one in scales if COMMON_MM[0] <= radius * one[0] <= COMMON_MM[1]]
    for scale, name in (*usual, *common):
        return reason("spheres.unit-mistake", radius=shown, factor=name, scaled=radius * scale)
    return reason("spheres.implausible-radius", radius=shown)
