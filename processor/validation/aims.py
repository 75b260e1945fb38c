"""Where better lies: every figure turned into a number that is larger the worse it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

LOW, HIGH = "low", "high"
TINY = 1e-12
# By the first of these that a figure's name holds; without, a share in % is better high, and all else low.
BY_NAME: tuple[tuple[str, str | float], ...] = (
    ("95 % intervals", 95.0),
    ("rms of error by standard deviation", 1.0),
    (", bias", 0.0),
    (", number", HIGH),
    ("farther", LOW),
    ("efficiency", HIGH),
    ("not found", LOW),
    ("are none", LOW),
    ("wrong", LOW),
    ("false", LOW),
    ("missed", LOW),
    ("error", LOW),
    ("recall", HIGH),
    ("precision", HIGH),
    ("overlap", HIGH),
    ("correct", HIGH),
)
RATIO_MARGIN = math.log(1.02)
POINTS_MARGIN = 1.0  # of shares, in %
BIAS_MARGIN = 0.1  # of the size that the figure has


@dataclass(frozen=True)
class Badness:
    """``of`` a value is larger the worse it is; differences below ``margin`` + ``share`` of its size are passed over.

    ``is_ratio``: a difference is the logarithm of a ratio.
    """

    of: Callable[[float], float]
    margin: float
    share: float
    is_ratio: bool


def badness(name: str, unit: str, aims: Mapping[str, str | float]) -> Badness:
    """Return how a figure is judged; ``aims`` are the matrix's, by name."""
    aim = aims.get(name)
    if aim is None:
        aim = next((found for part, found in BY_NAME if part in name), HIGH if unit == "%" else LOW)
    if isinstance(aim, int | float):
        if unit == "%":
            return Badness(lambda v: abs(v - aim), POINTS_MARGIN, 0.0, False)
        if aim > 0.0:
            return Badness(lambda v: abs(_log(v / aim)), RATIO_MARGIN, 0.0, False)
        return Badness(lambda v: abs(v - aim), 0.0, BIAS_MARGIN, False)
    sign = 1.0 if aim == LOW else -1.0
    if unit == "%":
        return Badness(lambda v: sign * v, POINTS_MARGIN, 0.0, False)
    if unit == "" and aim == LOW:  # numbers of things that should not be, mostly none
        return Badness(lambda v: v, 0.0, 0.0, False)
    return Badness(lambda v: sign * _log(v), RATIO_MARGIN, 0.0, True)


def _log(value: float) -> float:
    return math.log(max(abs(value), TINY)) if value == value else math.nan  # a mean error may have a sign
