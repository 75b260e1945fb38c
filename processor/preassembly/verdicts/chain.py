"""Verdict on the whole chain: span, and bottom edges along, sideways and in height.

As for joints, a pass and a fail are sure with 95 %. A limit that applies all along the bridge is compared with the
extremes over all chainages, see :func:`processor.adjustment.maximum_interval.of_independent`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from processor.adjustment import maximum_interval
from processor.limits import limit_bounds
from processor.limits.decision_rule import decide
from processor.model import MEASURES as OF_STEPS
from processor.model import NORMAL_95, Floats, Limit, Reason, Tolerance, Verdict, reason, worst
from processor.preassembly.chain.adjustment import Adjusted
from processor.preassembly.parts.part_in_chain import Member
from processor.preassembly.verdicts.joints import (
    Comparison,
    Conformity,
    LimitOrigin,
    compose,
    of_project,
)

OF_SPAN, OF_EDGES = ("span", "unit_length"), ("inner_arc", "lateral_axis", "elevation")
MEASURES = (*OF_SPAN, *OF_EDGES)
STEEPEST = 0.5  # cosine of an edge's slope; steeper edges have no height over a place

Quantities = Mapping[str, tuple[Floats, Floats]]


def quantities(members: Sequence[Member], adjusted: Adjusted, span: float, span_ci95: float) -> Quantities:
    """Values (n,) and standard deviations (n,) of MEASURES, mm.

    The length of an arch's unit is that of its chord, like its span. The inner arc departs by the edges' departures up,
    the axis sideways by the mean of both edges; their errors may be equal, so its standard deviation is the mean of
    theirs. Elevation is over a place of the span: where the arch is steep, it is more than the departure.
    """
    chord = np.array([span]), np.array([span_ci95 / NORMAL_95])
    up, up_sd, height, height_sd, sideways, sideways_sd = ([np.empty(0)] for _ in range(6))
    for member, departure, variance in zip(members, adjusted.departures, adjusted.departure_variance, strict=True):
        sd = np.sqrt(np.maximum(variance, 0.0))
        up.append(departure[:, 1])
        up_sd.append(sd[:, 1])
        cosine = np.where(member.edges.axes[:, 1, 2] > STEEPEST, member.edges.axes[:, 1, 2], np.nan)
        height.append(departure[:, 1] / cosine)
        height_sd.append(sd[:, 1] / cosine)
        sides = [np.flatnonzero(np.array(member.edges.side) == side) for side in ("left", "right")]
        count = min(map(len, sides))
        left, right = (rows[:count] for rows in sides)
        sideways.append(0.5 * (departure[left, 0] + departure[right, 0]))
        sideways_sd.append(0.5 * (sd[left, 0] + sd[right, 0]))
    return {
        "span": chord,
        "unit_length": chord,
        "inner_arc": (np.concatenate(up), np.concatenate(up_sd)),
        "lateral_axis": (np.concatenate(sideways), np.concatenate(sideways_sd)),
        "elevation": (np.concatenate(height), np.concatenate(height_sd)),
    }


def applicable(tolerance: Tolerance, *, span: bool, edges: bool) -> Tolerance:
    """Return the limits without those of what an assembly does not have: a span, bottom edges."""
    absent = (*(() if span else OF_SPAN), *(() if edges else OF_EDGES))
    return replace(tolerance, limits=tuple(limit for limit in tolerance.limits if limit.measure not in absent))


def judge(measured: Quantities, tolerance: Tolerance, span_mm: float, doubts: tuple[Reason, ...] = ()) -> Conformity:
    """Compare the chain with the limits of ``tolerance``; ``span_mm`` is the design's, for limits that depend on it.

    ``doubts`` are reasons why no verdict is possible (an ambiguous part, a joint without a result): then all is
    indeterminate.
    """
    limits = [limit for limit in tolerance.limits if limit.measure in MEASURES]
    if not limits:
        standard = tolerance.standard or LimitOrigin.PROJECT
        return Conformity(reasons=(reason("preassemble.no-chain-limit", standard=standard),))
    comparisons = [_compare(measured[limit.measure], limit, span_mm, bool(doubts)) for limit in limits]
    return compose(limits, comparisons, tolerance, float("nan"), doubts)


def unused_limits(tolerance: Tolerance) -> list[Limit]:
    """Return the limits given by a project that apply to nothing of a bridge."""
    compared = (*OF_STEPS["preassemble"], *OF_STEPS["inspect"])
    return [limit for limit in tolerance.limits if of_project(limit) and limit.measure not in compared]


def _compare(measured: tuple[Floats, Floats], limit: Limit, span_mm: float, doubtful: bool) -> Comparison:
    """Compare the value nearer to its limit; the probability is of single values only."""
    nan = float("nan")
    low, high = limit_bounds.bounds(limit, {"length": span_mm})
    values, sd = measured
    known = np.isfinite(values) & np.isfinite(sd)
    values, sd = values[known], sd[known]
    if not len(values) or math.isnan(low) or math.isnan(high):
        return Comparison(value=nan, ci95=nan, low=low, high=high, verdict=Verdict.INDETERMINATE, probability=nan)
    sides = []
    for sign, bound in ((-1.0, -low), (1.0, high)):
        value, bottom, top = maximum_interval.of_independent(sign * values, sd)
        sides.append((bound - value, sign * value, top - value, decide((bottom, top), -math.inf, bound)))
    verdict = worst([side[3] for side in sides])
    _, value, half_width, _ = min(sides, key=lambda side: side[0])
    probability = nan
    if len(values) == 1 and not doubtful:
        spread = max(float(sd[0]), maximum_interval.EXACT_MM)
        probability = float(ndtr((high - value) / spread) - ndtr((low - value) / spread))
    verdict = Verdict.INDETERMINATE if doubtful else verdict
    return Comparison(value=value, ci95=half_width, low=low, high=high, verdict=verdict, probability=probability)
