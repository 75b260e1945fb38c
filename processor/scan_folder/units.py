"""Units of length that input may be in."""

from __future__ import annotations

import numpy as np

from processor.model import Floats, InputError, UsageError

MM_PER_UNIT = {
    "mm": 1.0,
    "cm": 10.0,
    "dm": 100.0,
    "m": 1000.0,
    "km": 1_000_000.0,
    "inch": 25.4,
    "ft": 304.8,
    "us-ft": 1_200_000.0 / 3937.0,
}
LARGEST_KM = 10.0  # of what is measured to a millimetre; at a thousand times its size a step runs out of memory
STRAY = 0.01  # share of a scan's points at either end of an axis that say nothing of its size
SYNONYMS = {
    "in": "inch",
    "inches": "inch",
    "foot": "ft",
    "feet": "ft",
    "metre": "m",
    "metres": "m",
    "meter": "m",
    "meters": "m",
    "millimetre": "mm",
    "millimetres": "mm",
    "millimeter": "mm",
    "millimeters": "mm",
}


def known_unit(text: str) -> str:
    """Name of a unit as MM_PER_UNIT has it. Raises UsageError for any other, listing those known."""
    unit = SYNONYMS.get(text.strip().lower(), text.strip().lower())
    if unit not in MM_PER_UNIT:
        raise UsageError(f"unknown unit {text!r}; expected one of {', '.join(MM_PER_UNIT)}")
    return unit


def check_extent(what: str, points: Floats, unit: str, reason: str, correct: str, stray: float = 0.0) -> None:
    """Raise InputError where points (n, 3) in mm, read in ``unit``, are farther apart than any structure's.

    Where they lie on the map does not matter. ``what`` names file and thing, ``correct`` what to do; ``stray`` is the
    share of points at either end of an axis that do not count.
    """
    some = points[:: max(1, len(points) // 100_000)]
    if not len(some):
        return
    low, high = np.quantile(some, [stray, 1.0 - stray], axis=0) if stray else (points.min(axis=0), points.max(axis=0))
    across = float((high - low).max())
    if across <= LARGEST_KM * MM_PER_UNIT["km"]:
        return
    own = across / MM_PER_UNIT[unit]
    others = [f"{own * MM_PER_UNIT[one] / 1000.0:.3g} m if it were {one}" for one in ("m", "mm") if one != unit]
    raise InputError(
        f"{what} is {across / MM_PER_UNIT['km']:.3g} km across with its unit read as {unit} ({reason}), and no "
        f"structure is over {LARGEST_KM:g} km; it would be {' and '.join(others)}: {correct}"
    )
