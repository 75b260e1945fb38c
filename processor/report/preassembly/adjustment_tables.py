"""Tables of what only the adjustment says: what to do at the joints, limits, measures, span, closure, budget."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from processor.geometry import rigid
from processor.preassembly.result import Result
from processor.preassembly.verdicts.joints import Verdict
from processor.report.table import NAN, Table

TO_DO, LIMITS, CHAIN = "what-to-do", "limits", "limits-chain"
NOWHERE = np.full((4, 4), NAN)
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


CHAIN_NOTE = (
    "Span and length of a unit: the distance of the outer ends, less the design's. Inner arc, axis and elevation: the "
    "bottom edges at all stations, of which the one nearer to its limit is shown, its interval widened for their "
    "number; height over a place of the span. Probabilities are of single values."
)
BUDGET_NOTE = (
    "Standard deviations of one coordinate. Of the ends as measured: the median over all coordinates of key points, "
    "from the points' noise, form that the fits do not follow and what stations differ by together. The others are of "
    "an end of the longest part."
)
AS_ASSEMBLED, OTHER_POSE = "as assembled", "the other pose"


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
        *_chain(result, method),
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
            BUDGET_NOTE,
        ),
        Table(
            "What limits the accuracy, and which scan would help",
            ("question", "answer"),
            (("what limits the accuracy", result.limiting), ("which scan would help", result.advice)),
            "accuracy",
            on_page=False,
        ),
        *_candidates(result),
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
            standing = _standing(one, k)
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


def _standing(one: Verdict, k: int) -> str:
    standing = "verified" if one.verified[k] else "NOT VERIFIED"
    unknown = math.isnan(one.low[k]) or math.isnan(one.high[k])
    return f"{standing}; hangs on a size that is not known" if unknown else standing


def _chain(result: Result, method: str) -> Iterator[Table]:
    """Yield the limits of the whole chain, and those stated ones that nothing is held against."""
    columns = (
        "limit", "verdict", "standing", "value_mm", "ci95_mm", "least_mm", "greatest_mm", "probability", "clause",
        "edition", "source",
    )  # fmt: skip
    rows = [
        (
            what, one.each[k], _standing(one, k), float(one.value[k]), float(one.ci95[k]), float(one.low[k]),
            float(one.high[k]), float(one.each_probability[k]), one.clause[k], one.edition[k], one.source[k],
        )
        for one in result.chain_judged
        for k, what in enumerate(one.what)
    ]  # fmt: skip
    if rows:
        yield Table(f"Limits of the whole chain, method {method} (mm)", columns, tuple(rows), CHAIN, CHAIN_NOTE)
    if result.not_held:
        yield Table(
            "Limits that nothing is held against",
            ("key", "limit"),
            tuple(zip(result.not_held, result.not_held_what, strict=True)),
            "limits-not-held",
            "They were stated for this project, and nothing that is measured here answers to them.",
        )


def _candidates(result: Result) -> Iterator[Table]:
    """Yield both poses of ambiguous parts, to read and as matrices."""
    rows, matrices = [], []
    for i, name in enumerate(result.components):
        both = result.T_bridge_scan[i], result.T_rival_scan[i] if len(result.T_rival_scan) else NOWHERE
        if not np.isfinite(both).all():
            continue
        turn = math.degrees(rigid.rotation_angle(both[1][:3, :3] @ both[0][:3, :3].T))
        for candidate, pose, turned in ((AS_ASSEMBLED, both[0], 0.0), (OTHER_POSE, both[1], turn)):
            rows.append((name, candidate, turned, result.component_message[i]))
            matrices.append((name, candidate, turned, *pose[:3].ravel().tolist(), result.component_message[i]))
    if not rows:
        return
    title = "Parts that fit in two poses"
    yield Table(
        title,
        ("component", "candidate", "turned_deg", "what_would_tell"),
        tuple(rows),
        note="Both fit the design alike. The matrices of both, scan to bridge, are in candidates.csv, mm.",
    )
    places = tuple(f"{row}{column}" + ("_mm" if column == "t" else "") for row in "xyz" for column in "xyzt")
    yield Table(
        title,
        ("component", "candidate", "turned_deg", *places, "what_would_tell"),
        tuple(matrices),
        "candidates",
        on_page=False,
        on_terminal=False,
    )


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
