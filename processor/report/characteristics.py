"""The tables of quantities judged by limits, alike for all steps: as compared, and as characteristics with nominals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from processor.language.messages import Message, Text, label, text
from processor.limits.judging import Judged, JudgedLimits
from processor.model import WORST_FIRST, StepRun, Verdict
from processor.report.columns import columns
from processor.report.table import NAN, Table, decimals

FILE = "characteristics"
RISKS = ("risk_accept", "risk_reject")
COLUMNS = columns(
    "id", "verdict", "quantity", "nominal", "actual", "deviation", "ci95", "lower", "upper", "unit", *RISKS,
    "limit_from",
)  # fmt: skip
OF_LIMITS = columns("limit", "of", "verdict", "value", "ci95", "least", "greatest", "unit", *RISKS, "clause")
MOST_NAMED = 4  # of a summary of one or two lines


def worst_first(rows: Iterable[Judged]) -> list[Judged]:
    """Return what was judged with the worst first, what was not measured last, else in its order."""
    return sorted(rows, key=lambda one: (rank(one.verdict), not math.isfinite(one.value)))


def rank(verdict: Verdict) -> int:
    """Return the place of a verdict among all, 0 the worst; "none" is last."""
    return WORST_FIRST.index(verdict) if verdict in WORST_FIRST else len(WORST_FIRST)


def limits_of(run: StepRun) -> JudgedLimits | None:
    """Return what the step of a run compared with limits; None where nothing is limited."""
    limits: JudgedLimits | None = getattr(run.result, "limits", None)
    return limits


def limit_table(limits: JudgedLimits | None, file: str) -> list[Table]:
    """Return the table of comparisons of a step, the worst first; none where nothing is limited."""
    if limits is None:
        return []
    rows = tuple(
        (
            label(one.what), one.of, one.verdict, one.value, one.ci95, one.low, one.high, one.unit,
            one.risk_accept, one.risk_reject, label(one.clause),
        )
        for one in worst_first(limits.rows)
    )  # fmt: skip
    return [Table(text("Compared with limits"), OF_LIMITS, rows, file, on_page=False)]


def table(judged: Sequence[Judged]) -> Table:
    """Tabulate characteristics."""
    rows = tuple(
        (
            one.of, one.verdict, one.what, one.nominal, one.actual, one.value, one.ci95,
            *(bound if math.isfinite(bound) else NAN for bound in (one.low, one.high)), one.unit,
            one.risk_accept, one.risk_reject, one.clause,
        )
        for one in judged
    )  # fmt: skip
    return Table(text("Characteristics"), COLUMNS, rows, FILE, on_terminal=False)


def summary(judged: Iterable[Judged]) -> Message:
    """Say how many characteristics have which verdict, and name the first of the worst."""
    ordered = worst_first(judged)
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


def name_of(one: Judged) -> Message | str:
    """Return what was measured: some steps name a characteristic, others the thing of which ``what`` is one."""
    is_thing = isinstance(one.of, Text) and one.of.values is None and str(one.what) not in ("", str(one.of))
    name: Message | str = text("{of} {what}", of=one.of, what=one.what) if is_thing else one.of
    return name


def _named(one: Judged) -> Message:
    return text("{id} {deviation}", id=name_of(one), deviation=with_interval(one.value, one.ci95, one.unit))


def with_interval(value: float, half: float, unit: str, sign: str = "+") -> str:
    """Write a deviation with its interval, "-5.98 ± 0.14 mm", or without one where it has none; a size has no sign."""
    if not math.isfinite(value):
        return ""
    digits = decimals(half)
    interval = f" ± {half:.{digits}f}" if math.isfinite(half) else ""
    return f"{value:{sign}.{digits}f}{interval} {unit}".rstrip()


def nearness(one: Judged) -> float:
    """Return the share of its limit that a value with its interval takes."""
    half = one.ci95 if math.isfinite(one.ci95) else 0.0
    sides = ((one.value + half, one.high), (one.value - half, one.low))
    return max((value / bound for value, bound in sides if math.isfinite(bound) and bound), default=0.0)


def allowed(low: float, high: float) -> str:
    """Write the bounds of a deviation: "± 2", "-1 / 2", "≤ 2"; nothing where a bound is not known."""
    if math.isnan(low) or math.isnan(high) or (math.isinf(low) and math.isinf(high)):
        return ""
    if math.isinf(low):
        return f"≤ {high:.3g}"
    if math.isinf(high):
        return f"≥ {low:.3g}"
    return f"± {high:.3g}" if low == -high else f"{low:.3g} / {high:.3g}"
