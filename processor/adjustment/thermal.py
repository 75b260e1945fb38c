"""Thermal expansion of structural steel between the design and the scan."""

from __future__ import annotations

import math

REFERENCE_C = 20.0  # at which a design's lengths hold (ISO 1)
EXPANSION_PER_K = 12e-6  # of structural steel (EN 1993-1-1, 3.2.6)


def expansion(temperature_C: float) -> float:
    """Return the factor of all lengths at a temperature of the steel; 1 where that is not known (NaN)."""
    return 1.0 + EXPANSION_PER_K * (temperature_C - REFERENCE_C) if math.isfinite(temperature_C) else 1.0
