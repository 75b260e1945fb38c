"""Coverage of the 95 % intervals of a night's results, pooled over scenes of one origin.

Every quantity with intervals is judged by the written limits: the share of all its errors that lie within their
intervals, and the least share of a single scene. A share misses a limit where its own 95 % interval (Clopper and
Pearson 1934, Biometrika 26, 404-413) lies beyond it: of 96 errors all lie within good intervals once in 140 nights.
Scenes of designgen and those of foreign generators are never pooled.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from scipy.special import betaincinv

from processor.model import Statistic, Word
from processor.validation.cells import Origin
from processor.validation.history import Quantity, Row, by_quantity, of_items

AT_LEAST = ("mean and largest errors",)  # quantities whose intervals are stated to hold 95 % or more


@dataclass(frozen=True)
class Limits:
    """Limits of coverage, %: ``low`` to ``high`` of all errors together, ``scene`` the least of one scene.

    Shares of fewer than ``least`` errors are not judged: those of 50 have a standard error of 3 %. Of a scene no more
    count, as they share the errors of its stations and poses.
    """

    low: float = 92.0
    high: float = 98.0
    scene: float = 85.0
    least: int = 50


class Holds(Word):
    """Whether intervals hold what they state."""

    YES = "as stated"
    NARROW = "too narrow"
    WIDE = "too wide"
    FEW = "too few errors"


@dataclass(frozen=True)
class Coverage:
    """Intervals of one quantity over the scenes of one origin: ``share`` of all errors, ``worst`` scene, in %."""

    origin: Origin
    step: str
    method: str
    quantity: str
    scenes: int
    number: int
    share: float
    worst: float
    holds: Holds


def pooled(
    rows: Sequence[Row], nights: Collection[str], methods: Collection[tuple[str, str]], limits: Limits
) -> tuple[Coverage, ...]:
    """Pool the rows of ``nights``; a fixed seed counts once. ``methods``: steps with the method that is judged."""
    found = []
    for key, of_scenes in sorted(by_quantity(rows, nights).items()):
        share, scenes = of_items(of_scenes.values(), Statistic.COVERAGE)
        if scenes and key[1:3] in methods:
            found.append(_judged(key, share, scenes, limits))
    return tuple(found)


def _judged(key: Quantity, share: float, scenes: Sequence[tuple[float, float]], limits: Limits) -> Coverage:
    number = int(sum(n for _, n in scenes))
    least = min((s for s, n in scenes if n >= limits.least), default=100.0)
    low, high = share_interval(share, sum(min(n, limits.least) for _, n in scenes))
    holds = Holds.YES
    if number < limits.least:
        holds = Holds.FEW
    elif high < limits.low or least < limits.scene:
        holds = Holds.NARROW
    elif low > limits.high and key[3] not in AT_LEAST:
        holds = Holds.WIDE
    return Coverage(
        Origin(key[0]), *key[1:], scenes=len(scenes), number=number, share=share, worst=min(s for s, _ in scenes),
        holds=holds,
    )  # fmt: skip


def share_interval(share: float, number: float) -> tuple[float, float]:
    """Return the 95 % interval of a share, %, of a number of independent draws."""
    within = 0.01 * share * number
    beyond = number - within
    low = betaincinv(within, beyond + 1.0, 0.025) if within > 0.0 else 0.0
    high = betaincinv(within + 1.0, beyond, 0.975) if beyond > 0.0 else 1.0
    return 100.0 * float(low), 100.0 * float(high)


def missed(found: Sequence[Coverage]) -> list[Coverage]:
    """Return what is beyond the limits."""
    return [one for one in found if one.holds in (Holds.NARROW, Holds.WIDE)]
