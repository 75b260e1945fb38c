"""Which way a figure is better: every figure as a number that is larger the worse it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from processor.model import Better

TINY = 1e-12  # of a logarithm: below any figure that is printed
TARGETS = {Better.ZERO: 0.0, Better.ONE: 1.0, Better.NOMINAL_95: 95.0}  # at which a figure is best
RATIO_MARGIN = math.log(1.02)  # 2 %: a smaller change is no news, however sure
POINTS_MARGIN = 1.0  # of shares, in %
BIAS_MARGIN = 0.1  # of the size that the figure has


@dataclass(frozen=True)
class Loss:
    r"""Maps a value to a number ``of`` it that grows as the value gets worse.

    Differences up to ``margin`` + ``margin_share`` times the value are not reported. ``is_ratio``: a difference is the
    logarithm of a ratio.
    """

    of: Callable[[float], float]
    margin: float
    margin_share: float
    is_ratio: bool


def loss(name: str, unit: str, better: Better, aims: Mapping[str, str | float]) -> Loss:
    """Return how a figure is judged; ``aims`` of the matrix, by name, take precedence over ``better``."""
    aim = aims.get(name, TARGETS.get(better, str(better)))
    if isinstance(aim, int | float):
        if unit == "%":
            return Loss(lambda v: abs(v - aim), POINTS_MARGIN, 0.0, False)
        if aim > 0.0:
            return Loss(lambda v: abs(_log(v / aim)), RATIO_MARGIN, 0.0, False)
        return Loss(lambda v: abs(v - aim), 0.0, BIAS_MARGIN, False)
    sign = 1.0 if aim == Better.LOW else -1.0
    if unit == "%":
        return Loss(lambda v: sign * v, POINTS_MARGIN, 0.0, False)
    if unit == "" and aim == Better.LOW:  # numbers of things that should not be, mostly none
        return Loss(lambda v: v, 0.0, 0.0, False)
    return Loss(lambda v: sign * _log(v), RATIO_MARGIN, 0.0, True)


def _log(value: float) -> float:
    return math.log(max(abs(value), TINY)) if value == value else math.nan  # a mean error may have a sign
