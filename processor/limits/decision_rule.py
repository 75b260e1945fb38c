"""Decision by a 95 % interval against bounds (ISO 14253-1)."""

from __future__ import annotations

from processor.model import Verdict


def decide(interval: tuple[float, float], low: float, high: float) -> Verdict:
    """Judge a 95 % interval against bounds: pass wholly within, fail wholly beyond one, else indeterminate."""
    if interval[0] >= low and interval[1] <= high:
        return Verdict.PASS
    return Verdict.FAIL if interval[1] < low or interval[0] > high else Verdict.INDETERMINATE
