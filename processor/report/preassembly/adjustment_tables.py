"""Tables of what only the adjustment gives: what to do at the joints, limits, measures, span, closure, budget."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from processor.geometry import rigid
from processor.language.messages import Message, label, text
from processor.limits.judging import JudgedLimits
from processor.model import Floats
from processor.preassembly.chain.joint_measures import JointQuantity, MeasuredQuantities
from processor.preassembly.parts.systematic_errors import BudgetSource
from processor.preassembly.result import Adjustment, Result
from processor.report.columns import MM, columns, under
from processor.report.table import NAN, Table, rows_of, tabulate, yes_no

TO_DO, LIMITS, CHAIN = "what-to-do", "limits", "limits-chain"
CLOSURE = (
    text("closure along the span"),
    text("closure across, to the left"),
    text("closure up"),
    text("closure about the span"),
    text("closure about the axis across"),
    text("closure about the vertical"),
)
CLOSURE_UNITS = ("mm",) * 3 + ("mrad",) * 3  # of the shifts and turns above
_PAIRS = (JointQuantity.MISALIGNMENT, JointQuantity.GROOVE_GAP_LEAST, JointQuantity.GROOVE_GAP_GREATEST)
WHAT_TO_DO = (
    *columns("joint", "verdict", "proposal"),
    *under(text("misalignment"), "misalignment_mm", "misalignment_ci95_mm"),
    *under(text("groove gap, least"), "least_groove_gap_mm", "least_groove_gap_ci95_mm"),
    *under(text("groove gap, greatest"), "greatest_groove_gap_mm", "greatest_groove_gap_ci95_mm"),
    *under(text("largest rotation"), "rotation_mrad", "rotation_ci95_mrad", "rotation_about"),
    *under(text("probability that all limits hold"), "probability_now", "probability_after"),
)
_NOTE = text(
    "± is the 95 % half-width. Groove gap: right part minus left along the bridge, positive is open. Pass: the whole "
    "interval keeps the limit; fail: the whole interval exceeds it; indeterminate: the limit lies within it. "
    "Probabilities: as it is, and after the proposed work."
)
BUDGET_NOTE = text(
    "Standard deviations of one coordinate. Of the ends as measured: the median over all coordinates of key points, "
    "from noise, lack of fit and differences between stations. The others are of an end of the longest part."
)
SPAN_NOTE = text(
    "Span: the distance of the outer ends less the design's. Closure: departure of the last part's outer end from the "
    "design where the joints alone place all parts after the first."
)

LOOP = (
    text("along the joint's x"),
    text("along its y"),
    text("along its z"),
    text("about the joint's x"),
    text("about its y"),
    text("about its z"),
)
LOOP_NOTE = text(
    "The joint is left open and the further joints alone place the parts: where its right part then lies against its "
    "left one. x leads from the left to the right part, y to P1 from P2, z up."
)


def adjusted(result: Result, method: str) -> list[Table]:
    """Tables of the adjustment's own records, what to do first; none for a result without them."""
    adjustment = result.adjustment
    if adjustment is None:
        return []
    return [
        Table(
            text("Joints: what to do, method {method}", method=method),
            WHAT_TO_DO,
            tuple(_joint_rows(adjustment)),
            file=TO_DO,
            note=_NOTE,
        ),
        _limits(adjustment, method),
        *_chain(adjustment, method),
        _measures(adjustment, method),
        _span_and_closure(adjustment, method),
        *_loops(adjustment, method),
        Table(
            text("Budget of the uncertainty, method {method}", method=method),
            columns("source", "sd_mm"),
            tuple(zip(BudgetSource, adjustment.budget_sd.tolist(), strict=False)),
            file="budget",
            note=BUDGET_NOTE,
        ),
        Table(
            text("What limits the accuracy, and which scan would help"),
            columns("subject", "statement"),
            (
                (text("what limits the accuracy"), text("{reasons:;}", reasons=adjustment.limiting)),
                (text("which scan would help"), text("{reasons:;}", reasons=adjustment.advice)),
            ),
            file="accuracy",
        ),
        *_candidates(result, adjustment),
        _trade_off(result, adjustment, method),
    ]


def _joint_rows(adjustment: Adjustment) -> Iterator[tuple[Any, ...]]:
    joints = adjustment.joints
    for joint, measures, conformity, proposal in zip(
        joints.name, joints.measures, joints.conformity, joints.proposal, strict=True
    ):
        pairs = [number for name in _PAIRS for number in measures.of(name)]
        turns = [(*measures.of(f"rotation_{axis}"), axis) for axis in "xyz"]
        finite = [turn for turn in turns if math.isfinite(turn[0])]
        turn = max(finite, key=lambda turn: abs(turn[0])) if finite else (NAN, NAN, "")
        sentences = text("{reasons:.}", reasons=proposal.reasons)
        yield (joint, conformity.verdict, sentences, *pairs, *turn, conformity.probability, proposal.probability)


def _limits(adjustment: Adjustment, method: str) -> Table:
    limits = [conformity.limits for conformity in adjustment.joints.conformity]
    joints = [joint for joint, one in zip(adjustment.joints.name, limits, strict=True) for _ in one.key]
    cells = {"joint": joints, **_cells_of_limits(JudgedLimits.concat(limits))}
    title = text("Limits, method {method}", method=method)
    return tabulate(title, cells, LIMITS, units=MM, on_page=False)


def _cells_of_limits(limits: JudgedLimits) -> dict[str, Any]:
    return {
        "limit": list(map(label, limits.what)),
        "verdict": limits.verdict,
        "value_mm": limits.value,
        "ci95_mm": limits.ci95,
        "least_mm": limits.low,
        "greatest_mm": limits.high,
        "probability": limits.probability,
        "clause": list(map(label, limits.clause)),
    }


def _chain(adjustment: Adjustment, method: str) -> Iterator[Table]:
    """Yield the limits of the whole chain, and those stated ones that nothing is compared with."""
    limits = JudgedLimits.concat([conformity.limits for conformity in adjustment.chain])
    if len(limits):
        further = {"edition": limits.edition, "source": list(map(label, limits.source))}
        title = text("Limits of the whole chain, method {method}", method=method)
        yield tabulate(title, {**_cells_of_limits(limits), **further}, CHAIN, units=MM, on_page=False)
    if adjustment.unused_limits:
        yield tabulate(
            text("Limits that nothing is compared with"),
            {"key": adjustment.unused_limits, "limit": list(map(label, adjustment.unused_limits_what))},
            "limits-not-held",
            text("They are given for this project, and no measured quantity corresponds to them."),
        )


def _candidates(result: Result, adjustment: Adjustment) -> Iterator[Table]:
    """Yield both poses of ambiguous parts, to read and as matrices."""
    rows = []
    parts = result.components
    for name, rival in zip(adjustment.rivals.component, adjustment.rivals.T_rival_scan, strict=True):
        i = parts.name.index(name)
        pose, reasons = parts.T_bridge_scan[i], text("{reasons:;}", reasons=parts.reasons[i])
        turn = math.degrees(rigid.rotation_angle(rival[:3, :3] @ pose[:3, :3].T))
        for candidate, T, turned in ((text("as assembled"), pose, 0.0), (text("the other pose"), rival, turn)):
            rows.append((name, candidate, turned, *T[:3].ravel().tolist(), reasons))
    if not rows:
        return
    title, first, last = (
        text("Parts that fit in two poses"),
        ("component", "candidate", "turned_deg"),
        "what_would_decide",
    )
    yield Table(
        title,
        columns(*first, last),
        tuple((*row[: len(first)], row[-1]) for row in rows),
        note=text("Both fit the design alike. The matrices of both, scan to bridge, are in candidates.csv, mm."),
    )
    places = ("xx", "xy", "xz", "xt_mm", "yx", "yy", "yz", "yt_mm", "zx", "zy", "zz", "zt_mm")
    yield Table(title, columns(*first, *places, last), tuple(rows), file="candidates", on_page=False, on_terminal=False)


def _measures(adjustment: Adjustment, method: str) -> Table:
    of_joints = [measures.quantities for measures in adjustment.joints.measures]
    every = MeasuredQuantities.concat(of_joints)
    cells = {
        "joint": [joint for joint, rows in zip(adjustment.joints.name, of_joints, strict=True) for _ in rows.name],
        "measure": [label(str(name).replace("_", " ")) for name in every.name],
        "value": every.value,
        "ci95": every.ci95,
        "low95": every.low,
        "high95": every.high,
        "unit": every.unit,
    }
    title = text("Measures of the joints, method {method}", method=method)
    return tabulate(title, cells, "measures", on_terminal=False)


def _span_and_closure(adjustment: Adjustment, method: str) -> Table:
    values = np.append(adjustment.span_departure, adjustment.closure)
    cells = _departures((text("span"), *CLOSURE), ("mm", *CLOSURE_UNITS), values,
                        np.append(adjustment.span_ci95, adjustment.closure_ci95))  # fmt: skip
    return tabulate(text("Span and closure, method {method}", method=method), cells, "span", SPAN_NOTE)


def _departures(figures: Sequence[Message], units: Sequence[str], values: Floats, ci95: Floats) -> dict[str, Any]:
    """Return the columns of departures (n,) with their half-widths; figures and units may be more."""
    known = np.isfinite(values) & np.isfinite(ci95)
    beyond = zip(known, yes_no(np.abs(values) > ci95), strict=True)
    return {
        "figure": figures[: len(values)],
        "departure": values,
        "ci95": ci95,
        "unit": units[: len(values)],
        "beyond_its_interval": [word if is_known else "" for is_known, word in beyond],
    }


def _loops(adjustment: Adjustment, method: str) -> list[Table]:
    """Tabulate the closure of each loop of parts; none without loops."""
    loops = adjustment.loops
    if loops is None:
        return []
    cells = {
        "joint": [joint for joint in loops.joint for _ in LOOP],
        "further_joints": [" > ".join(joints) for joints in loops.joints for _ in LOOP],
        **_departures(LOOP * len(loops), CLOSURE_UNITS * len(loops), loops.closure.ravel(), loops.closure_ci95.ravel()),
    }
    return [tabulate(text("Closure of loops of parts, method {method}", method=method), cells, "loops", LOOP_NOTE)]


def _trade_off(result: Result, adjustment: Adjustment, method: str) -> Table:
    trade = result.trade_off
    return Table(
        text("Trade-off over lambda, method {method}", method=method),
        (
            *columns("lambda"),
            *under(text("splicing error"), "splicing_mean_mm", "splicing_max_mm"),
            *under(text("linear error"), "linear_mean_mm", "linear_max_mm"),
        ),
        rows_of(trade.weight, trade.figures),
        file="trade-off",
        note=text("The result was made with lambda {weight:g}.", weight=adjustment.weight),
        units=MM,
        on_terminal=False,
    )
