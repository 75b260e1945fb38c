"""Points with coordinates in two frames: how many determine a pose, and units that were mixed up."""

from __future__ import annotations

from processor import unit_ratio
from processor.model import Word

LEAST_HEIGHT = 1e-3  # of a triangle by its longest side: below this its corners count as on a line


class UnitSlip(Word):
    """Two units of length of which one was taken for the other."""

    M_MM = "m and mm"
    FEET_MM = "feet and mm"
    INCHES_M = "inches and m"
    INCHES_MM = "inches and mm"
    INCHES_FEET = "inches and feet"
    CM_MM = "cm and mm"
    FEET_M = "feet and m"


# By definition (an inch is 25.4 mm).
FACTORS = {
    UnitSlip.M_MM: 1000.0,
    UnitSlip.FEET_MM: 304.8,
    UnitSlip.INCHES_M: 39.3701,
    UnitSlip.INCHES_MM: 25.4,
    UnitSlip.INCHES_FEET: 12.0,
    UnitSlip.CM_MM: 10.0,
    UnitSlip.FEET_M: 3.28084,
}


def units_slip(scale: float) -> UnitSlip | None:
    """Return the two units whose ratio a scale is, within 2 %, or None."""
    slips = {ratio: slip for slip, factor in FACTORS.items() for ratio in (factor, 1.0 / factor)}
    ratio = unit_ratio.nearest_factor(scale, slips, 0.02)
    return slips[ratio] if ratio else None
