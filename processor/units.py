"""Units of length that input may be in."""

from __future__ import annotations

from processor.model import UsageError

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
