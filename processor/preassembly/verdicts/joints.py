"""Verdict on a joint against its limits: pass, fail or indeterminate, with the probability of conformity.

By ISO 14253-1 a value passes where its 95 % interval lies wholly within the limits, and fails where it lies wholly
beyond one. The probability of conformity is by JCGM 106: the share of draws of the gaps, by their covariance, that keep
the limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from processor.adjustment import normal_draws
from processor.limits import limit_bounds
from processor.limits.decision_rule import decide
from processor.limits.judging import clause_of
from processor.model import (
    AMOUNT,
    NUMBER,
    OPEN,
    SHARE,
    Bools,
    Checked,
    Floats,
    Limit,
    Reason,
    Rows,
    Tolerance,
    Verdict,
    Word,
    column,
    described,
    names,
    reason,
    reasons,
    words,
    worst,
)
from processor.preassembly.chain.joint_measures import ACROSS, Measures, motion_of

MEASURES = ("misalignment", "groove_gap", "eccentricity")


class LimitOrigin(Word):
    """Where limits are from, if from no standard."""

    PROJECT = "the project"


@dataclass(frozen=True)
class ComparedLimits(Rows):
    """Values compared with limits, a row per limit.

    Of the groove gap the value is the extreme nearer to its limit, less the design's root gap. ``low`` and ``high`` are
    allowed, -inf and inf without a bound; NaN: they depend on an unknown size. ``clause`` is of the standard, or the
    source where there is none.
    """

    key: tuple[str, ...] = names("v", json="limit")
    what: tuple[str, ...] = names("v")
    value: Floats = column("v", means=NUMBER)
    ci95: Floats = column("v", means=AMOUNT)
    low: Floats = column("v", means=OPEN)
    high: Floats = column("v", means=OPEN)
    verdict: tuple[Verdict, ...] = words("v", Verdict)
    probability: Floats = column("v", means=SHARE)
    clause: tuple[str, ...] = names("v")
    edition: tuple[str, ...] = names("v")
    source: tuple[str, ...] = names("v")
    verified: Bools = column("v", dtype=np.bool_)

    @property
    def bounds_known(self) -> Bools:
        """Mark the limits (v,) that do not depend on an unknown size."""
        return ~(np.isnan(self.low) | np.isnan(self.high))


@dataclass(frozen=True)
class Conformity(Checked):
    """Verdict on a joint or the chain, its comparison with each limit, and why a verdict is not possible."""

    verdict: Verdict = described(Verdict.INDETERMINATE, words=Verdict)
    probability: float = described(float("nan"), means=SHARE)  # that all limits are kept
    limits: ComparedLimits = field(default_factory=ComparedLimits)
    reasons: tuple[Reason, ...] = reasons()


class Comparison(NamedTuple):
    """A value compared with one limit: half-width of its interval, the bounds, verdict and probability."""

    value: float
    ci95: float
    low: float
    high: float
    verdict: Verdict
    probability: float


class Allowed(NamedTuple):
    """A limit of a joint with its bounds in mm; ``root_gap_mm`` is the design's gap."""

    limit: Limit
    low: float
    high: float
    root_gap_mm: float

    @property
    def known(self) -> bool:
        """Whether both bounds are known."""
        return not (math.isnan(self.low) or math.isnan(self.high))


def joint_limits(tolerance: Tolerance) -> list[Limit]:
    """Return the limits of ``tolerance`` that apply to a joint."""
    return [limit for limit in tolerance.limits if limit.measure in MEASURES]


def allowed(limit: Limit, tolerance: Tolerance) -> Allowed:
    """Return the bounds of a limit; NaN where they depend on a size (thickness), which a joint's design does not state.

    A project that knows the size gives the limit as a number.
    """
    low, high = limit_bounds.bounds(limit, {})
    return Allowed(limit, low, high, tolerance.root_gap_mm)


def judge(measures: Measures, tolerance: Tolerance) -> Conformity:
    """Compare a joint with the limits of ``tolerance``.

    Unknown gaps are indeterminate, and so is a joint without any limit. The joint fails if any limit does, and passes
    if all do.
    """
    limits = joint_limits(tolerance)
    if not limits:
        standard = tolerance.standard or LimitOrigin.PROJECT
        return Conformity(reasons=(reason("preassemble.no-joint-limit", standard=standard),))
    drawn = None
    if measures.known:
        drawn = normal_draws.antithetic(measures.gaps.ravel(), measures.covariance).reshape(-1, 8, 3)
    comparisons = []
    all_kept: Bools = np.ones(0 if drawn is None else len(drawn), bool)
    complete = drawn is not None
    for limit in limits:
        bounds = allowed(limit, tolerance)
        value, half_width, verdict = _compare(measures, bounds)
        probability = float("nan")
        if drawn is not None and bounds.known:
            conforming = conforms(drawn, measures.points, bounds)
            probability, all_kept = float(conforming.mean()), all_kept & conforming
        else:
            complete = False
        comparisons.append(
            Comparison(
                value=value,
                ci95=half_width,
                low=bounds.low,
                high=bounds.high,
                verdict=verdict,
                probability=probability,
            )
        )
    probability = float(all_kept.mean()) if complete else float("nan")
    return compose(limits, comparisons, tolerance, probability)


def compose(
    limits: Sequence[Limit],
    comparisons: Sequence[Comparison],
    tolerance: Tolerance,
    probability: float,
    doubts: tuple[Reason, ...] = (),
) -> Conformity:
    """Compose the verdict on all limits from the comparison with each, with the clause that each limit is from."""
    compared = ComparedLimits(
        key=tuple(limit.key for limit in limits),
        what=tuple(limit.what for limit in limits),
        value=np.array([comparison.value for comparison in comparisons]),
        ci95=np.array([comparison.ci95 for comparison in comparisons]),
        low=np.array([comparison.low for comparison in comparisons]),
        high=np.array([comparison.high for comparison in comparisons]),
        verdict=tuple(comparison.verdict for comparison in comparisons),
        probability=np.array([comparison.probability for comparison in comparisons]),
        clause=tuple(clause_of(limit, tolerance) for limit in limits),
        edition=tuple("" if of_project(limit) else tolerance.edition for limit in limits),
        source=tuple(limit.source for limit in limits),
        verified=np.array([limit.verified for limit in limits], np.bool_),
    )
    return Conformity(verdict=worst(compared.verdict), probability=probability, limits=compared, reasons=doubts)


def left_open(conformity: Conformity, doubts: tuple[Reason, ...]) -> Conformity:
    """Make a verdict on a joint, and each of its rows, indeterminate where there are reasons to doubt its gaps."""
    if not doubts:
        return conformity
    limits = conformity.limits
    return replace(
        conformity,
        verdict=Verdict.INDETERMINATE,
        probability=float("nan"),
        limits=replace(
            limits,
            verdict=(Verdict.INDETERMINATE,) * len(limits),
            probability=np.full_like(limits.probability, np.nan),
        ),
        reasons=doubts,
    )


def of_project(limit: Limit) -> bool:
    """Whether the project gave the limit itself: of a standard's rows only those with a clause are verified."""
    return limit.verified and not limit.clause


def conforms(gaps: Floats, points: Floats, allowed: Allowed) -> Bools:
    """Mark which of (n, 8, 3) gaps, in joint axes at key points (8, 3), keep a limit."""
    if allowed.limit.measure == "groove_gap":
        x = gaps[:, :, 0] - allowed.root_gap_mm
        conforming = (x.min(axis=1) >= allowed.low) & (x.max(axis=1) <= allowed.high)
    elif allowed.limit.measure == "misalignment":
        across = np.abs(np.stack([gaps[:, point, axis] for point, axis in ACROSS], axis=1)).max(axis=1)
        conforming = (across >= allowed.low) & (across <= allowed.high)
    else:
        offset = np.linalg.norm(gaps.reshape(-1, 24) @ motion_of(points)[4:].T, axis=1)
        conforming = (offset >= allowed.low) & (offset <= allowed.high)
    return np.asarray(conforming, bool)


def _compare(measures: Measures, allowed: Allowed) -> tuple[float, float, Verdict]:
    """Value and half-width that decide, and the verdict."""
    low, high = allowed.low, allowed.high
    if allowed.limit.measure != "groove_gap":
        value, half_width = measures.of(allowed.limit.measure)
        return value, half_width, decide(measures.interval(allowed.limit.measure), low, high)
    sides = []
    for name, bounds in (("groove_gap_least", (low, math.inf)), ("groove_gap_greatest", (-math.inf, high))):
        gap, half_width = measures.of(name)
        interval = measures.interval(name)
        value = gap - allowed.root_gap_mm
        room = value - low if name == "groove_gap_least" else high - value
        verdict = decide((interval[0] - allowed.root_gap_mm, interval[1] - allowed.root_gap_mm), *bounds)
        sides.append((room, value, half_width, verdict))
    _, value, half_width, _ = min(sides, key=lambda side: side[0])
    return value, half_width, worst([side[3] for side in sides])
