"""The whole chain held against its limits: span, bottom edges along, sideways and in height.

As for joints, pass and fail are sure with 95 %. A limit that holds all along the bridge is held against the extremes of
all stations. Which of their errors go together is not known here: the band is widened as if all were independent, which
by Sidak's inequality never covers less. Stations that cannot be the extreme do not widen it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import chi2, norm

from processor.limits import standards as limits_of
from processor.model import NORMAL_95, Floats, Limit, Tolerance
from processor.preassembly.chain.adjustment import Adjusted, Member
from processor.preassembly.verdicts.joint_measures import CLEAR_SD, EXACT_MM
from processor.preassembly.verdicts.joints import MEASURES as OF_JOINTS
from processor.preassembly.verdicts.joints import Held, Verdict, guarded, in_words, own, worst, written

MEASURES = ("span", "unit_length", "inner_arc", "lateral_axis", "elevation")
STEEPEST = 0.5  # cosine of an edge's slope; where it is steeper, height over a place says nothing

Quantities = Mapping[str, tuple[Floats, Floats]]


def quantities(members: Sequence[Member], adjusted: Adjusted, span: float, span_ci95: float) -> Quantities:
    """Return values (n,) and standard deviations (n,) of what MEASURES name, mm.

    The length of a unit of an arch is that of its chord, as its span is. Edges depart up from the inner arc, the axis
    sideways by the mean of both edges: their errors may be the same, so its deviation is the mean of theirs. Height is
    that over a place of the span, so it is more than the departure where the arch is steep.
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
        sides = [np.flatnonzero([one == side for one in member.edges.side]) for side in ("left", "right")]
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


def judge(found: Quantities, tolerance: Tolerance, span_mm: float, unsure: str = "") -> Verdict:
    """Hold the chain against the limits of ``tolerance``; ``span_mm`` is the design's, for limits that hang on it.

    ``unsure`` says why nothing can be sure (a part that may lie otherwise, a joint without an answer): then
    all is indeterminate.
    """
    rows = [limit for limit in tolerance.limits if limit.measure in MEASURES]
    if not rows:
        return Verdict(said=f"{tolerance.standard or 'the project'} has no limit for the whole chain")
    judged = [_held(found[limit.measure], limit, span_mm, bool(unsure)) for limit in rows]
    said = "; ".join(filter(None, (unsure, in_words(rows, judged))))
    return written(rows, judged, tolerance, float("nan"), said)


def not_held(tolerance: Tolerance) -> list[Limit]:
    """Return the limits that a project stated itself and nothing of a bridge is held against."""
    return [limit for limit in tolerance.limits if own(limit) and limit.measure not in (*OF_JOINTS, *MEASURES)]


def _held(found: tuple[Floats, Floats], limit: Limit, span_mm: float, unsure: bool) -> Held:
    """Value nearer to its limit, its half-width, the bounds, verdict and, of a single value, the probability."""
    nan = float("nan")
    low, high = limits_of.bounds(limit, {"length": span_mm})
    values, sd = found
    known = np.isfinite(values) & np.isfinite(sd)
    values, sd = values[known], sd[known]
    if not len(values) or math.isnan(low) or math.isnan(high):
        return nan, nan, low, high, "indeterminate", nan
    sides = []
    for sign, bound in ((-1.0, -low), (1.0, high)):
        value, bottom, top = greatest(sign * values, sd)
        sides.append((bound - value, sign * value, top - value, guarded((bottom, top), -math.inf, bound)))
    verdict = worst([side[3] for side in sides])
    _, value, half, _ = min(sides, key=lambda side: side[0])
    probability = nan
    if len(values) == 1 and not unsure:
        spread = max(float(sd[0]), EXACT_MM)
        probability = float(norm.cdf((high - value) / spread) - norm.cdf((low - value) / spread))
    return value, half, low, high, "indeterminate" if unsure else verdict, probability


def greatest(values: Floats, sd: Floats, axes: int = 1) -> tuple[float, float, float]:
    """Greatest of values (n,), and its 95 % interval.

    ``sd`` (n,) is of the value itself, or of each of the ``axes`` of the vector whose size it is.
    """
    top = int(np.argmax(values))
    near = values >= values[top] - CLEAR_SD * (sd + sd[top]) - EXACT_MM
    reach = float(np.sqrt(chi2.ppf(0.95 ** (1.0 / near.sum()), axes))) * sd[near]
    return float(values[top]), float((values[near] - reach).max()), float((values[near] + reach).max())
