"""The tables of quantities judged by limits, alike for all steps: as compared, and as characteristics with nominals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from processor.language.messages import Message, label, text
from processor.limits.judging import Judged, JudgedLimits
from processor.model import WORST_FIRST, StepRun, Verdict
from processor.report.columns import columns
from processor.report.table import NAN, Table

FILE = "characteristics"
RISKS = ("risk_accept", "risk_reject")
COLUMNS = columns(
    "id", "verdict", "quantity", "nominal", "actual", "deviation", "ci95", "lower", "upper", "unit", *RISKS,
    "limit_from",
)  # fmt: skip
OF_LIMITS = columns("limit", "of", "verdict", "value", "ci95", "least", "greatest", "unit", *RISKS, "clause")
MOST_NAMED = 4  # of a summary of one or two lines
NOTE = text(
    "Worst first. Deviation is actual less nominal, ci95 the half-width of its 95 % interval, lower and upper the "
    "deviations allowed; a dash is no bound, or not known. The risks are the probabilities that it is wrong to accept "
    "and to reject."
)
NOTE_OF_LIMITS = text(
    "± is the 95 % half-width, a dash is no bound or no number. Pass: the whole interval keeps the limit; fail: the "
    "whole interval exceeds it; indeterminate: the limit lies within it, or the value is in doubt. With the decision "
    "rule simple the value alone decides, with risk the probability that accepting or rejecting is wrong."
)


def worst_first(rows: Iterable[Judged]) -> list[Judged]:
    """Return what was judged with the worst first, else in its order."""
    order = {verdict: place for place, verdict in enumerate(WORST_FIRST)}
    return sorted(rows, key=lambda one: order.get(one.verdict, len(order)))


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
    return [Table(text("Compared with limits"), OF_LIMITS, rows, file, NOTE_OF_LIMITS, on_page=False)]


def table(judged: Sequence[Judged], remark: str | Message = "") -> Table:
    """Tabulate characteristics, with a remark on them."""
    rows = tuple(
        (
            one.of, one.verdict, one.what, one.nominal, one.actual, one.value, one.ci95,
            *(bound if math.isfinite(bound) else NAN for bound in (one.low, one.high)), one.unit,
            one.risk_accept, one.risk_reject, one.clause,
        )
        for one in judged
    )  # fmt: skip
    note = text("{note} {remark}", note=NOTE, remark=remark) if remark else NOTE
    return Table(text("Characteristics"), COLUMNS, rows, FILE, note, on_terminal=False)


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


def _named(one: Judged) -> Message:
    if not math.isfinite(one.value):
        return one.of if isinstance(one.of, Message) else label(one.of)
    return text("{id} {deviation:+.2f} {unit}", id=one.of, deviation=one.value, unit=one.unit)
