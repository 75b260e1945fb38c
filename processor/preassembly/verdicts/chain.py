"""Verdict on the whole chain: span, and bottom edges along, sideways and in height.

As for joints, a pass and a fail are sure with 95 %. A limit that applies all along the bridge is compared with the
extremes over all chainages, see :func:`processor.adjustment.maximum_interval.of_independent`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from processor.adjustment import maximum_interval
from processor.limits import judging, limit_bounds
from processor.limits.judging import Judged, Measured
from processor.model import MEASURES as OF_STEPS
from processor.model import NORMAL_95, Floats, Limit, Reason, Tolerance, reason
from processor.preassembly.chain.adjustment import Adjusted
from processor.preassembly.parts.part_in_chain import Member
from processor.preassembly.verdicts.joints import Conformity, LimitOrigin

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


def judge(measured: Quantities, tolerance: Tolerance, span_mm: float, doubts: tuple[Reason, ...] = ()) -> Conformity:
    """Judge the chain by the limits of ``tolerance``; ``span_mm`` is the design's, for limits that depend on it.

    ``doubts`` are reasons why no verdict is possible (an ambiguous part, a joint without a result): then all is
    indeterminate.
    """
    limits = [limit for limit in tolerance.limits if limit.measure in MEASURES]
    if not limits:
        standard = tolerance.standard or LimitOrigin.PROJECT
        return Conformity(reasons=(reason("preassemble.no-chain-limit", standard=standard),))
    rows = [_judged(measured[limit.measure], limit, tolerance, span_mm, bool(doubts)) for limit in limits]
    return Conformity.of_rows(rows, probability=float("nan"), doubts=doubts)


def unused_limits(tolerance: Tolerance) -> list[Limit]:
    """Return the limits given by a project that apply to nothing of a bridge."""
    compared = (*OF_STEPS["preassemble"], *OF_STEPS["inspect"])
    return [limit for limit in tolerance.limits if judging.of_project(limit) and limit.measure not in compared]


def _judged(
    measured: tuple[Floats, Floats], limit: Limit, tolerance: Tolerance, span_mm: float, doubtful: bool
) -> Judged:
    """Judge the least and the greatest value; the probability is of single values only."""
    sizes_mm = {"length": span_mm}
    low, high = limit_bounds.bounds(limit, sizes_mm)
    values, sd = measured
    known = np.isfinite(values) & np.isfinite(sd) & ~np.isnan([low, high]).any()
    values, sd = values[known], sd[known]
    sides, probability = [Measured("chain", sizes_mm=sizes_mm)] * 2, float("nan")
    if len(values):
        for side, sign in enumerate((-1.0, 1.0)):
            value, bottom, top = maximum_interval.of_independent(sign * values, sd)
            ends = sorted((sign * bottom, sign * top))
            sides[side] = replace(sides[side], value=sign * value, low=ends[0], high=ends[1], ci95=top - value)
    if len(values) == 1 and not doubtful:
        spread = max(float(sd[0]), maximum_interval.EXACT_MM)
        probability = float(ndtr((high - sides[1].value) / spread) - ndtr((low - sides[1].value) / spread))
    least, greatest = (replace(side, doubtful=doubtful) for side in sides)
    return judging.judge(limit, least, tolerance, greatest, probability=probability)
