"""How far a ball's radius may be off its nominal one, by a standard's limits on the blank's diameter."""

from __future__ import annotations

from processor.model import Tolerance
from processor.preassembly import tolerance

NAN = float("nan")


def blank_tolerance(radius: float, limits: Tolerance) -> tuple[float, float]:
    """How much smaller and larger in mm a ball's radius may be: half of the limits on the blank's diameter.

    Limits that do not speak of balls leave them to those of the default standard.
    """
    for one in (limits, tolerance.load(tolerance.DEFAULT)):
        for limit in one.limits:
            if limit.key.startswith("ball_blank_diameter_") and tolerance.applies(limit, 2.0 * radius):
                low, high = tolerance.bounds(limit, {"diameter": 2.0 * radius})
                return -0.5 * low, 0.5 * high
    return NAN, NAN


def beyond(radius: float, nominal: float, margin: float, limits: Tolerance) -> str:
    """Say that a radius is beyond the blank's tolerance by more than ``margin`` in mm; empty where it is not."""
    below, above = blank_tolerance(nominal, limits)
    error = radius - nominal
    if not (error < -below - margin or error > above + margin):
        return ""
    return f"radius {error:+.1f} mm from nominal, beyond the blank's +{above:g}/-{below:g} by {margin:.1f} mm"
