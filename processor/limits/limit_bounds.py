"""Bounds of a limit: on which sides it has one, for which components and sizes it holds, and their values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Any

from processor.model import Limit

NAN = float("nan")


def two_sided(limit: Limit) -> bool:
    """Whether a limit has a lower bound too; then a project gives the least and the greatest value."""
    return not (math.isnan(limit.low) and math.isnan(limit.low_ratio))


def at_least(limit: Limit) -> bool:
    """Whether a limit has a lower bound alone; then a project gives the least value."""
    return two_sided(limit) and math.isnan(limit.high) and math.isnan(limit.high_ratio)


def names_component(limit: Limit, component: str) -> bool:
    """Whether a limit holds for a component of this name: one of all, or whose pattern fits."""
    return limit.component is None or fnmatchcase(component, limit.component)


def bounds(limit: Limit, sizes_mm: Mapping[str, float]) -> tuple[float, float]:
    """Return the least and the greatest allowed value; -inf and inf without a bound.

    ``sizes_mm`` has the names of ``Limit.of`` as keys. A bound that depends on a size without value is NaN.
    """
    size = sizes_mm.get(limit.of, NAN)
    low = _bound(limit.low, limit.low_ratio, limit.rule, size, max)
    high = _bound(limit.high, limit.high_ratio, limit.rule, size, min)
    return (-math.inf if low is None else low), (math.inf if high is None else high)


def _bound(number: float, ratio: float, rule: str, size_mm: float, tighter: Any) -> float | None:
    if math.isnan(ratio):
        return None if math.isnan(number) else number
    by_size = ratio * size_mm
    if math.isnan(number) or math.isnan(by_size):
        return by_size
    return float(number + by_size if rule == "sum" else tighter(number, by_size))


def applies(limit: Limit, size_mm: float) -> bool:
    """Whether a limit is for objects of this size."""
    return not (size_mm <= limit.above_mm or size_mm > limit.up_to_mm)
