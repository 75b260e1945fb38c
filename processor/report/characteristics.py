"""The table of characteristics: quantities compared with limits, with nominal, actual value and verdict."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from processor.language.messages import Message, label, text
from processor.limits.judging import JudgedLimits
from processor.model import WORST_FIRST, Verdict
from processor.report.columns import columns
from processor.report.table import NAN, Table

FILE = "characteristics"
COLUMNS = columns(
    "id", "verdict", "quantity", "nominal", "actual", "deviation", "ci95", "lower", "upper", "unit", "limit_from",
)  # fmt: skip
ORDER = {verdict: place for place, verdict in enumerate(WORST_FIRST)}
MOST_NAMED = 4
NOTE = text(
    "Worst first. Deviation is actual less nominal, ci95 the half-width of its 95 % interval, lower and upper the "
    "deviations allowed; a dash is no bound, or not known."
)


@dataclass(frozen=True, kw_only=True)
class Characteristic:
    """A quantity compared with limits: ``deviation`` = actual - nominal, allowed from ``lower`` to ``upper``; NaN none.

    ``limit_from`` says where the limit is from, and whether it was checked against the standard's text.
    """

    id: str | Message
    quantity: str | Message
    deviation: float
    ci95: float
    verdict: Verdict
    nominal: float = NAN
    lower: float = NAN
    upper: float = NAN
    unit: str = "mm"
    limit_from: str | Message = ""

    @property
    def actual(self) -> float:
        """The value itself; NaN where the nominal is not known."""
        return self.nominal + self.deviation


def worst_first(found: Iterable[Characteristic]) -> list[Characteristic]:
    """Return characteristics with the worst first, else in their order."""
    return sorted(found, key=lambda one: ORDER.get(one.verdict, len(ORDER)))


def of_limits(limits: JudgedLimits | None) -> Iterator[Characteristic]:
    """Yield what a step compared with limits; such values are deviations."""
    for k in range(0 if limits is None else len(limits)):
        assert limits is not None
        yield Characteristic(
            id=label(limits.of[k]),
            quantity=label(limits.what[k]),
            nominal=0.0,
            deviation=float(limits.value[k]),
            ci95=float(limits.ci95[k]),
            lower=float(limits.low[k]),
            upper=float(limits.high[k]),
            unit=limits.unit[k],
            verdict=limits.verdict[k],
            limit_from=label(limits.clause[k]),
        )


def table(found: Sequence[Characteristic], remark: str | Message = "") -> Table:
    """Tabulate characteristics, with a remark on them."""
    rows = tuple(
        (
            one.id, one.verdict, one.quantity, one.nominal, one.actual, one.deviation, one.ci95, _bound(one.lower),
            _bound(one.upper), one.unit, one.limit_from,
        )
        for one in found
    )  # fmt: skip
    note = text("{note} {remark}", note=NOTE, remark=remark) if remark else NOTE
    return Table(text("Characteristics"), COLUMNS, rows, FILE, note, on_terminal=False)


def _bound(value: float) -> float:
    return value if math.isfinite(value) else NAN


def summary(found: Iterable[Characteristic]) -> Message:
    """Say how many characteristics have which verdict, and name the first of the worst."""
    ordered = worst_first(found)
    if not ordered:
        return text("Nothing was compared with limits.")
    worst = ordered[0].verdict
    of_worst = [one for one in ordered if one.verdict is worst]
    if worst is Verdict.PASS:
        return text("All {count} characteristics keep their limits.", count=len(ordered))
    named = [_named(one) for one in of_worst[:MOST_NAMED]]
    if len(of_worst) > MOST_NAMED:
        named.append(text("and {count} more", count=len(of_worst) - MOST_NAMED))
    return text(
        "{of_worst} of {count} characteristics {verdict}: {named}",
        of_worst=len(of_worst),
        count=len(ordered),
        verdict=worst,
        named=named,
    )


def _named(one: Characteristic) -> Message:
    if not math.isfinite(one.deviation):
        return one.id if isinstance(one.id, Message) else label(one.id)
    return text("{id} {deviation:+.2f} {unit}", id=one.id, deviation=one.deviation, unit=one.unit)
