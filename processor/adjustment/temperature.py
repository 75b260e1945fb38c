"""Thermal expansion of steel (EN 1991-1-5, table C.1)."""

from __future__ import annotations

import math

REFERENCE_C = 20.0  # of drawings
EXPANSION_PER_K = 12e-6


def expansion(temperature_C: float) -> float:
    """Return the ratio of lengths at a temperature to those at REFERENCE_C; 1 for an unknown temperature, NaN."""
    return 1.0 + EXPANSION_PER_K * (temperature_C - REFERENCE_C if math.isfinite(temperature_C) else 0.0)
