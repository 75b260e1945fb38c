"""Verdicts: quantities as measured, judged by limits.

A step states what it measured as :class:`Measured`, a value with its 95 % interval; :func:`judge` alone decides and
returns a row, by the rule of the project (JCGM 106, ILAC-G8):

- guarded, the default: a value passes where its interval lies within the limit and fails where it lies beyond (ISO
  14253-1: guard bands as wide as the interval);
- simple: a value passes where it lies within the limit, else it fails;
- risk: it passes where the limit is exceeded with at most the probability ``risk``, and fails where it is kept with at
  most that.

Otherwise it is indeterminate, as it is where the step flags the value as doubtful or a bound depends on a size that is
not known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import ndtr

from processor.limits import limit_bounds
from processor.model import (
    AMOUNT,
    NORMAL_95,
    NUMBER,
    OPEN,
    SHARE,
    Bools,
    DecisionRule,
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
    ``risk_accept`` is the probability that accepting it is wrong, ``risk_reject`` that rejecting it is.
    """

    key: tuple[str, ...] = names("v", json="limit")
    what: tuple[str, ...] = names("v")
    of: tuple[str, ...] = names("v", newer=True)  # of joints it came later, as did the unit
    value: Floats = column("v", means=NUMBER)
    ci95: Floats = column("v", means=AMOUNT)
    low: Floats = column("v", means=OPEN)
    high: Floats = column("v", means=OPEN)
    unit: tuple[str, ...] = names("v", newer=True)
    verdict: tuple[Verdict, ...] = words("v", Verdict)
    probability: Floats = column("v", newer=True, means=SHARE)  # that the limit is kept, of joints and the chain
    risk_accept: Floats = column("v", newer=True, means=SHARE)
    risk_reject: Floats = column("v", newer=True, means=SHARE)
    clause: tuple[str, ...] = names("v")
    edition: tuple[str, ...] = names("v", newer=True)
    source: tuple[str, ...] = names("v")
    verified: Bools = column("v", dtype=np.bool_)

    @property
    def bounds_known(self) -> Bools:
        """Mark the limits (v,) that do not depend on an unknown size."""
        return ~(np.isnan(self.low) | np.isnan(self.high))

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
    def middle(self) -> float:
        """The value, or its size where the sign is not sure: what the interval lies about."""
        return abs(self.value) if self.unsigned else self.value

    @property
    def wider_side(self) -> float:
        """The wider side of the interval about the value."""
        return max(self.high - self.middle, self.middle - self.low)


@dataclass(frozen=True, kw_only=True)
class Judged:
    """A quantity judged by a limit: a row of the tables of a result, whose columns have the names of these fields.

    ``of``, ``what`` and ``clause`` are messages where a report words them. ``probability``: that the limit is kept.
    ``risk_accept`` and ``risk_reject``: that it is wrong to accept and to reject; NaN where that is not known.
    """

    of: Any
    what: Any = ""
    value: float
    ci95: float
    low: float = NAN
    high: float = NAN
    verdict: Verdict = Verdict.NONE
    probability: float = NAN
    risk_accept: float = NAN
    risk_reject: float = NAN
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
    is no verdict. ``probability`` that the limit is kept is given where it is of more than one value.
    """
    if limit is None:
        return Judged(
            of=measured.of, value=measured.value, ci95=measured.ci95, nominal=measured.nominal, unit=measured.unit
        )
    low, high = limit_bounds.bounds(limit, measured.sizes_mm)
    sides = [(measured, low, high)]
    if greatest is not None:
        sides = [(measured, low, math.inf), (greatest, -math.inf, high)]
    known = not (math.isnan(low) or math.isnan(high))
    each = [_beyond(one, least, most) if known else NAN for one, least, most in sides]
    # Of two values at most the sum (Boole's inequality); NaN stays NaN
    beyond = float(np.minimum(sum(each), 1.0)) if math.isnan(probability) else 1.0 - probability
    stated, *_ = min(sides, key=lambda side: min(side[0].value - side[1], side[2] - side[0].value))
    ci95 = 0.5 * (stated.high - stated.low) if math.isnan(stated.ci95) else stated.ci95
    return Judged(
        of=stated.of,
        what=limit.what,
        value=stated.value,
        ci95=ci95 if math.isfinite(ci95) else NAN,
        low=low,
        high=high,
        verdict=_decided(sides, each, beyond, tolerance),
        probability=probability,
        risk_accept=beyond,
        risk_reject=1.0 - beyond,
        nominal=stated.nominal,
        unit=limit.unit,
        key=limit.key,
        clause=limit.source if of_project(limit) else f"{tolerance.standard} {limit.clause}".strip(),
        edition="" if of_project(limit) else tolerance.edition,
        source=limit.source,
        verified=limit.verified,
    )


def _allowed(one: Measured, least: float, most: float) -> tuple[float, float]:
    """Return the bounds of a quantity: the tighter one of a size whose sign is not sure."""
    return (-math.inf, min(-least, most)) if one.unsigned else (least, most)


def _decided(
    sides: Sequence[tuple[Measured, float, float]], each: Sequence[float], beyond: float, tolerance: Tolerance
) -> Verdict:
    """Return the verdict on values with their bounds, by the probabilities that ``each`` and any lies ``beyond``."""
    if tolerance.decision is DecisionRule.RISK and not math.isnan(beyond):
        if beyond <= tolerance.largest_risk:
            return Verdict.PASS
        return Verdict.FAIL if 1.0 - beyond <= tolerance.largest_risk else Verdict.INDETERMINATE
    verdicts = []
    for (one, least, most), risk in zip(sides, each, strict=True):
        least, most = _allowed(one, least, most)
        simple = tolerance.decision is DecisionRule.SIMPLE
        low, high = (one.middle, one.middle) if simple else (one.low, one.high)
        if math.isnan(risk):
            verdicts.append(Verdict.INDETERMINATE)
        elif least <= low and high <= most:
            verdicts.append(Verdict.PASS)
        else:
            verdicts.append(Verdict.FAIL if high < least or low > most else Verdict.INDETERMINATE)
    return worst(verdicts)


def _beyond(one: Measured, least: float, most: float) -> float:
    """Return the probability that a quantity lies beyond its bounds: on either side of its value half of a normal one.

    Of a size whose sign is not sure the interval is that of the size. NaN where the interval is not known or in doubt.
    """
    if one.doubtful or math.isnan(one.low) or math.isnan(one.high):
        return NAN
    least, most = _allowed(one, least, most)
    # The greatest of many noisy values is biased, and may lie outside of its interval.
    value = one.middle if one.low <= one.middle <= one.high else 0.5 * (one.low + one.high)

    def below(bound: float, exact: float) -> float:
        sd = (one.high - value if bound > value else value - one.low) / NORMAL_95
        if bound == value:
            return exact if one.low == one.high else 0.5
        return float(bound > value) if sd == 0.0 or math.isinf(bound) else float(ndtr((bound - value) / sd))

    return below(least, exact=0.0) + 1.0 - below(most, exact=1.0)


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
