"""Tables of what only the adjustment says: what to do at the joints, limits, measures, span, closure, budget."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from processor.preassembly.result import Result
from processor.report.table import NAN, Table

TO_DO, LIMITS = "what-to-do", "limits"
CLOSURE = (
    "along the span",
    "across, to the left",
    "up",
    "about the span",
    "about the axis across",
    "about the vertical",
)
_PAIRS = ("misalignment", "groove_gap_least", "groove_gap_greatest")
WHAT_TO_DO = (
    "joint", "verdict", "proposal", "misalignment_mm", "misalignment_ci95_mm", "least_groove_gap_mm",
    "least_groove_gap_ci95_mm", "greatest_groove_gap_mm", "greatest_groove_gap_ci95_mm", "rotation_mrad",
    "rotation_ci95_mrad", "rotation_about", "probability_now", "probability_after",
)  # fmt: skip
PROPOSAL = WHAT_TO_DO.index("proposal")
_GROUPS = (
    "", "", "", *["misalignment (mm)"] * 2, *["groove gap, least (mm)"] * 2, *["groove gap, greatest (mm)"] * 2,
    *["largest rotation (mrad)"] * 3, *["probability that all limits hold"] * 2,
)  # fmt: skip
_NOTE = (
    "± is the 95 % half-width. Groove gap: right part minus left along the bridge, positive is open. Pass and fail "
    "are sure with 95 %, indeterminate is neither. Probabilities: as it is, and after what is proposed."
)
LIMITS_NOTE = (
    "Least and greatest allowed; a dash is no bound. Limits that are not verified were not compared with the "
    "standard's text: do so before the verdicts are relied on."
)


def adjusted(result: Result, method: str) -> list[Table]:
    """Tables of the adjustment's own records, what to do first; none for a result without them."""
    if not result.measures:
        return []
    title = f"Joints: what to do, method {method}"
    todo = tuple(_todo(result))
    weights, traded = result.trade_lambda.tolist(), result.trade_figures.tolist()
    return [
        Table(title, WHAT_TO_DO, todo, TO_DO, _NOTE, _GROUPS, on_terminal=False),
        Table(
            title,
            _without_proposal(WHAT_TO_DO),
            tuple(map(_without_proposal, todo)),
            groups=_without_proposal(_GROUPS),
            on_page=False,
        ),
        Table("Proposals", ("joint", "proposal"), tuple((row[0], row[PROPOSAL]) for row in todo), on_page=False),
        _limits(result, method),
        Table(
            f"Measures of the joints, method {method}",
            ("joint", "measure", "value", "ci95", "low95", "high95", "unit"),
            tuple(_measures(result)),
            "measures",
            on_terminal=False,
        ),
        Table(
            f"Span and closure, method {method}",
            ("figure", "departure", "ci95", "unit", "beyond_its_interval"),
            tuple(_span_and_closure(result)),
            "span",
            "Span: how much farther apart the outer ends are than designed. Closure: where the last part's outer end "
            "comes to lie when the joints alone place all parts after the first.",
        ),
        Table(
            f"Budget of the uncertainty, method {method}",
            ("source", "sd_mm"),
            tuple(zip(result.budget_source, result.budget_sd.tolist(), strict=True)),
            "budget",
            "Standard deviations of one coordinate of an end of the longest part.",
        ),
        Table(
            f"Trade-off over lambda, method {method} (mm)",
            ("lambda", "splicing_mean_mm", "splicing_max_mm", "linear_mean_mm", "linear_max_mm"),
            tuple((weight, *row) for weight, row in zip(weights, traded, strict=True)),
            "trade-off",
            f"The answer was made with lambda {result.weight:g}.",
            ("", *["splicing error"] * 2, *["linear error"] * 2),
            on_terminal=False,
        ),
    ]  # fmt: skip


def _without_proposal(row: tuple[Any, ...]) -> tuple[Any, ...]:
    return row[:PROPOSAL] + row[PROPOSAL + 1 :]


def _todo(result: Result) -> Iterator[tuple[Any, ...]]:
    for j, joint in enumerate(result.joints):
        measures, proposal = result.measures[j], result.proposals[j]
        pairs = [number for name in _PAIRS for number in measures.of(name)]
        turns = [(*measures.of(f"rotation_{axis}"), axis) for axis in "xyz"]
        known = [turn for turn in turns if math.isfinite(turn[0])]
        turn = max(known, key=lambda one: abs(one[0])) if known else (NAN, NAN, "")
        probability = result.judged[j].probability
        yield (joint, result.verdict[j], proposal.sentence, *pairs, *turn, probability, proposal.probability)


def _limits(result: Result, method: str) -> Table:
    rows = []
    for joint, one in zip(result.joints, result.judged, strict=True):
        for k, what in enumerate(one.what):
            low, high = float(one.low[k]), float(one.high[k])
            standing = "verified" if one.verified[k] else "NOT VERIFIED"
            if math.isnan(low) or math.isnan(high):
                standing += "; hangs on a size that is not known"
            rows.append(
                (
                    joint, what, one.each[k], standing, float(one.value[k]), float(one.ci95[k]), low, high,
                    float(one.each_probability[k]), one.clause[k],
                )
            )  # fmt: skip
    columns = (
        "joint", "limit", "verdict", "standing", "value_mm", "ci95_mm", "least_mm", "greatest_mm", "probability",
        "clause",
    )  # fmt: skip
    return Table(f"Limits, method {method} (mm)", columns, tuple(rows), LIMITS, LIMITS_NOTE)


def _measures(result: Result) -> Iterator[tuple[Any, ...]]:
    for joint, one in zip(result.joints, result.measures, strict=True):
        columns = (one.value.tolist(), one.ci95.tolist(), one.low.tolist(), one.high.tolist(), one.unit)
        for name, *numbers in zip(one.name, *columns, strict=True):
            yield (joint, name.replace("_", " "), *numbers)


def _span_and_closure(result: Result) -> Iterator[tuple[Any, ...]]:
    rows = [("span", result.span_departure, result.span_ci95, "mm")]
    for k, (value, half) in enumerate(zip(result.closure.tolist(), result.closure_ci95.tolist(), strict=True)):
        rows.append((f"closure {CLOSURE[k]}", value, half, "mm" if k < 3 else "mrad"))
    for name, value, half, unit in rows:
        beyond = ("yes" if abs(value) > half else "no") if math.isfinite(value) and math.isfinite(half) else ""
        yield (name, value, half, unit, beyond)
