"""Detection of lengths in a wrong unit."""

from __future__ import annotations

import numpy as np

from processor import unit_ratio
from processor.model import Floats, Reason, reason

FACTORS = (1000.0, 304.8, 25.4)  # m, feet and inches read as mm, or the other way round
NEAR = 0.02  # relative tolerance of a factor
PLAUSIBLE_MM = (5.0, 2000.0)  # radii of any sphere or target
COMMON_MM = (20.0, 300.0)  # radii of most of them


def between(known: Floats, seen: Floats) -> str:
    """Return the factor of a unit, or its inverse, by which lengths (n,) exceed others (n,); empty without one."""
    sound = (known > 0.0) & (seen > 0.0)
    if not sound.any():
        return ""
    ratio = float(np.median(known[sound] / seen[sound]))
    factor = unit_ratio.nearest_factor(ratio, unit_ratio.with_inverses(FACTORS), NEAR)
    if factor is None:
        return ""
    return f"{factor:g}" if factor > 1.0 else f"1/{1.0 / factor:g}"


def implausible(radius: float) -> Reason | None:
    """Return a reason if a radius (mm) is outside of those of spheres and targets; else None."""
    if PLAUSIBLE_MM[0] <= radius <= PLAUSIBLE_MM[1]:
        return None
    shown = round(radius) if radius >= 100.0 else radius
    for factor in FACTORS:
        for scale, name in ((1.0 / factor, f"1/{factor:g}"), (factor, f"{factor:g}")):
            if COMMON_MM[0] <= radius * scale <= COMMON_MM[1]:
                return reason("spheres.unit-mistake", radius=shown, factor=name, scaled=radius * scale)
    return reason("spheres.implausible-radius", radius=shown)
