"""Verdicts: quantities as measured, judged by limits.

A step states what it measured as :class:`Measured`, a value with its 95 % interval; :func:`judge` alone decides and
returns a row. A value passes where its interval lies within the limit and fails where it lies beyond. Otherwise it is
indeterminate, as it is where the step flags the value as doubtful or a bound depends on a size that is not known (ISO
14253-1).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from processor.limits import limit_bounds
from processor.model import (
    AMOUNT,
    NUMBER,
    OPEN,
    Bools,
    Floats,
    Limit,
    Reason,
    Rows,
    Tolerance,
    Verdict,
    column,
    names,
    words,
    worst,
)

NAN = float("nan")


@dataclass(frozen=True)
class JudgedLimits(Rows):
    """Values compared with limits, one row per comparison.

    ``of`` names what was measured: a component, node, pair of supports, scan. ``ci95`` is the half-width of the 95 %
    interval, NaN where that is open to a side or not known. ``low`` and ``high`` are allowed, -inf and inf without a
    bound, NaN where they depend on an unknown size. ``clause`` is of the standard, or the source where there is none.
    """

    key: tuple[str, ...] = names("v", json="limit")
    what: tuple[str, ...] = names("v")
    of: tuple[str, ...] = names("v")
    value: Floats = column("v", means=NUMBER)
    ci95: Floats = column("v", means=AMOUNT)
    low: Floats = column("v", means=OPEN)
    high: Floats = column("v", means=OPEN)
    unit: tuple[str, ...] = names("v")
    verdict: tuple[Verdict, ...] = words("v", Verdict)
    clause: tuple[str, ...] = names("v")
    source: tuple[str, ...] = names("v")
    verified: Bools = column("v", dtype=np.bool_)

    @property
    def overall(self) -> Verdict:
        """The worst verdict; none without a comparison."""
        return worst(self.verdict)

    @classmethod
    def joined(cls, tables: Iterable[JudgedLimits | None]) -> JudgedLimits | None:
        """Return the rows of several tables as one; None without any."""
        known = [one for one in tables if one is not None]
        return cls.concat(known) if known else None

    @property
    def rows(self) -> list[Judged]:
        """The rows, one by one."""
        return [Judged(**row) for row in self.items()]


@dataclass(frozen=True)
class Measured:
    """A quantity as measured: of what, its value and the ends of its 95 % interval; NaN: not known.

    ``what`` it is where a step measures several. The value is a deviation from ``nominal``, if given. ``ci95`` is the
    half-width to state, NaN for half of the interval. ``sizes_mm`` are for limits that depend on a size, by the names
    of ``Limit.of``. ``doubtful``: it may be wrong altogether, beyond what the interval covers. ``unsigned``: the
    interval is that of a size whose sign is not sure, so the tighter bound counts. ``reasons`` state why it was not
    measured, or what the value lacks.
    """

    of: str
    value: float = NAN
    low: float = NAN
    high: float = NAN
    what: str = ""
    unit: str = "mm"
    nominal: float = 0.0
    ci95: float = NAN
    sizes_mm: Mapping[str, float] = field(default_factory=dict)
    doubtful: bool = False
    unsigned: bool = False
    reasons: tuple[Reason, ...] = ()

    @classmethod
    def within(cls, of: str, value: float, half_width: float, **further: Any) -> Measured:
        """Return a quantity with the half-width of its interval."""
        return cls(of, value, value - half_width, value + half_width, **further)

    @property
    def wider_side(self) -> float:
        """The wider side of the interval about the value, about its size where the sign is not sure."""
        middle = abs(self.value) if self.unsigned else self.value
        return max(self.high - middle, middle - self.low)


@dataclass(frozen=True, kw_only=True)
class Judged:
    """A quantity judged by a limit: a row of the tables of a result, whose columns have the names of these fields.

    ``of``, ``what`` and ``clause`` are messages where a report words them. ``probability``: that the limit is kept.
    """

    of: Any
    what: Any = ""
    value: float
    ci95: float
    low: float = NAN
    high: float = NAN
    verdict: Verdict = Verdict.NONE
    probability: float = NAN
    nominal: float = 0.0
    unit: str = "mm"
    key: str = ""
    clause: Any = ""
    edition: str = ""
    source: str = ""
    verified: bool = False

    @property
    def actual(self) -> float:
        """The value itself where it is a deviation; NaN where the nominal is not known."""
        return self.nominal + self.value


def judge(
    limit: Limit | None,
    measured: Measured,
    tolerance: Tolerance,
    greatest: Measured | None = None,
    *,
    probability: float = NAN,
) -> Judged:
    """Judge a quantity by a limit of a ``tolerance``; indeterminate where bound or interval is unknown, or doubtful.

    Of many values ``measured`` is the least and ``greatest`` is given as well: each is compared with the bound on its
    side. The verdict is the worse of both, and the value stated is the one nearer to its bound. Without a limit there
    is no verdict.
    """
    if limit is None:
        return Judged(of=measured.of, value=measured.value, ci95=measured.ci95, nominal=measured.nominal)
    low, high = limit_bounds.bounds(limit, measured.sizes_mm)
    sides = [(measured, low, high)]
    if greatest is not None:
        sides = [(measured, low, math.inf), (greatest, -math.inf, high)]
    verdicts = []
    for one, least, most in sides:
        if one.unsigned:
            least, most = -math.inf, min(-least, most)
        unknown = one.doubtful or any(map(math.isnan, (low, high, one.low, one.high)))
        if not unknown and least <= one.low and one.high <= most:
            verdicts.append(Verdict.PASS)
        else:
            beyond = not unknown and (one.high < least or one.low > most)
            verdicts.append(Verdict.FAIL if beyond else Verdict.INDETERMINATE)
    stated, *_ = min(sides, key=lambda side: min(side[0].value - side[1], side[2] - side[0].value))
    ci95 = 0.5 * (stated.high - stated.low) if math.isnan(stated.ci95) else stated.ci95
    return Judged(
        of=stated.of,
        what=limit.what,
        value=stated.value,
        ci95=ci95 if math.isfinite(ci95) else NAN,
        low=low,
        high=high,
        verdict=worst(verdicts),
        probability=probability,
        nominal=stated.nominal,
        unit=limit.unit,
        key=limit.key,
        clause=f"{tolerance.standard} {limit.clause}" if limit.clause else limit.source,
        edition="" if of_project(limit) else tolerance.edition,
        source=limit.source,
        verified=limit.verified,
    )


def limits_for(tolerance: Tolerance, measure: str, component: str = "") -> list[Limit]:
    """Return the limits of a measure that hold for a component: of one key those that name it before the general one.

    Of two patterns that fit, the one that comes later in the project wins.
    """
    found: dict[str, Limit] = {}
    for limit in tolerance.limits:
        if limit.measure == measure and limit_bounds.names_component(limit, component):
            known = found.get(limit.key)
            if known is None or limit.component is not None or known.component is None:
                found[limit.key] = limit
    return list(found.values())


def of_project(limit: Limit) -> bool:
    """Whether the project gave the limit itself: of a standard's rows only those with a clause are verified."""
    return limit.verified and not limit.clause


def table(rows: Iterable[Judged]) -> JudgedLimits | None:
    """Return what a step judged as the record of its result; None without any, as nothing is limited then."""
    rows = tuple(rows)
    return JudgedLimits.from_items(rows) if rows else None
