"""Measured values against limits: rows of comparisons with a verdict each.

A step states what it measured as :class:`Measured`, a value with its 95 % interval, and gets one row per comparison. A
value passes where its interval lies within the limit and fails where it lies beyond. Otherwise it is indeterminate, as
it is where the step flags the value as doubtful or a bound depends on a size that is not known (ISO 14253-1).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from processor.limits import limit_bounds
from processor.limits.decision_rule import decide
from processor.model import (
    AMOUNT,
    NUMBER,
    OPEN,
    Bools,
    Floats,
    Limit,
    Rows,
    Tolerance,
    Verdict,
    column,
    names,
    words,
    worst,
)

NOT_VERIFIED = "not verified"


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


@dataclass(frozen=True)
class Measured:
    """A quantity as measured: of what, its value and the ends of its 95 % interval, in the limit's unit.

    ``sizes_mm`` are for limits that depend on a size, by the names of ``Limit.of``. NaN: not known. ``doubtful``: it
    may be wrong altogether, beyond what the interval covers. ``unsigned``: the interval is that of a size whose sign is
    not sure, so the tighter bound counts.
    """

    of: str
    value: float
    low: float
    high: float
    sizes_mm: Mapping[str, float] = field(default_factory=dict)
    doubtful: bool = False
    unsigned: bool = False

    @classmethod
    def within(
        cls,
        of: str,
        value: float,
        ci95: float,
        sizes_mm: Mapping[str, float] | None = None,
        doubtful: bool = False,
    ) -> Measured:
        """Return a quantity with the half-width ``ci95`` of its interval."""
        return cls(of, value, value - ci95, value + ci95, sizes_mm=sizes_mm or {}, doubtful=doubtful)


@dataclass(frozen=True)
class Comparison:
    """A quantity compared with a limit: the bounds and the verdict."""

    limit: Limit
    measured: Measured
    low: float
    high: float
    verdict: Verdict


def compare(limit: Limit, measured: Measured) -> Comparison:
    """Compare a quantity with a limit; indeterminate where either is not known."""
    low, high = limit_bounds.bounds(limit, measured.sizes_mm)
    unknown = any(map(math.isnan, (low, high, measured.low, measured.high)))
    least, most = (-math.inf, min(-low, high)) if measured.unsigned else (low, high)
    verdict = (
        Verdict.INDETERMINATE if unknown or measured.doubtful else decide((measured.low, measured.high), least, most)
    )
    return Comparison(limit=limit, measured=measured, low=low, high=high, verdict=verdict)


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


def judged(comparisons: Iterable[Comparison], tolerance: Tolerance) -> JudgedLimits | None:
    """Return the comparisons as the record of a result; None without any, as nothing is limited then."""
    rows: Sequence[Comparison] = tuple(comparisons)
    if not rows:
        return None
    half = [0.5 * (row.measured.high - row.measured.low) for row in rows]
    return JudgedLimits(
        key=tuple(row.limit.key for row in rows),
        what=tuple(row.limit.what for row in rows),
        of=tuple(row.measured.of for row in rows),
        value=np.array([row.measured.value for row in rows]),
        ci95=np.array([number if math.isfinite(number) else math.nan for number in half]),
        low=np.array([row.low for row in rows]),
        high=np.array([row.high for row in rows]),
        unit=tuple(row.limit.unit for row in rows),
        verdict=tuple(row.verdict for row in rows),
        clause=tuple(clause_of(row.limit, tolerance) for row in rows),
        source=tuple(row.limit.source for row in rows),
        verified=np.array([row.limit.verified for row in rows], np.bool_),
    )


def clause_of(limit: Limit, tolerance: Tolerance) -> str:
    """Name where a limit is from: standard and clause, or the source of a limit without one."""
    return f"{tolerance.standard} {limit.clause}" if limit.clause else limit.source
