"""Factors between units of length, to recognise a mistaken unit from a ratio of sizes."""

from __future__ import annotations

import math
from collections.abc import Iterable


def nearest_factor(ratio: float, factors: Iterable[float], tolerance: float) -> float | None:
    """Return the factor nearest to ``ratio``, None where its relative difference exceeds ``tolerance``.

    The nearest one is chosen by the logarithm. A ratio that is not a finite number above 0 has no factor.
    """
    if not 0.0 < ratio < math.inf:
        return None
    nearest = min(factors, key=lambda factor: abs(math.log(ratio / factor)))
    return nearest if abs(ratio / nearest - 1.0) <= tolerance else None
