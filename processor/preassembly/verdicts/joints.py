"""Verdict on a joint against its limits: pass, fail or indeterminate, with the probability of conformity.

By ISO 14253-1 a value passes where its 95 % interval lies wholly within the limits, and fails where it lies wholly
beyond one. The probability of conformity is by JCGM 106: the share of draws of the gaps, by their covariance, that keep
the limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from processor.adjustment import normal_draws
from processor.limits import judging, limit_bounds
from processor.limits.judging import Judged, JudgedLimits
from processor.model import (
    SHARE,
    Bools,
    Checked,
    Floats,
    Limit,
    Reason,
    Tolerance,
    Verdict,
    Word,
    described,
    reason,
    reasons,
    worst,
)
from processor.preassembly.chain.joint_measures import ACROSS, JointQuantity, Measures, motion_of

MEASURES = ("misalignment", "groove_gap", "eccentricity")
DRAWS = 4_000  # give a probability of a half to 0.008
GROOVE_GAPS = (JointQuantity.GROOVE_GAP_LEAST, JointQuantity.GROOVE_GAP_GREATEST)


class LimitOrigin(Word):
    """Where limits are from, if from no standard."""

    PROJECT = "the project"


@dataclass(frozen=True)
class Conformity(Checked):
    """Verdict on a joint or the chain, its comparison with each limit, and why a verdict is not possible."""

    verdict: Verdict = described(Verdict.INDETERMINATE, words=Verdict)
    probability: float = described(float("nan"), means=SHARE)  # that all limits are kept
    limits: JudgedLimits = field(default_factory=JudgedLimits)
    reasons: tuple[Reason, ...] = reasons()

    @classmethod
    def of_rows(cls, rows: Sequence[Judged], probability: float, doubts: tuple[Reason, ...] = ()) -> Conformity:
        """Return the verdict on all limits from that on each."""
        verdict = worst(row.verdict for row in rows)
        return cls(verdict=verdict, probability=probability, limits=JudgedLimits.from_items(rows), reasons=doubts)


def joint_limits(tolerance: Tolerance) -> list[Limit]:
    """Return the limits of ``tolerance`` that apply to a joint."""
    return [limit for limit in tolerance.limits if limit.measure in MEASURES]


def judge(measures: Measures, tolerance: Tolerance, doubts: tuple[Reason, ...] = ()) -> Conformity:
    """Judge a joint by the limits of ``tolerance``.

    Unknown gaps are indeterminate, and so is a joint without any limit, and one of whose gaps there are ``doubts``. The
    joint fails if any limit does, and passes if all do.
    """
    limits = joint_limits(tolerance)
    if not limits:
        standard = tolerance.standard or LimitOrigin.PROJECT
        return Conformity(reasons=doubts or (reason("preassemble.no-joint-limit", standard=standard),))
    drawn = draws(measures) if measures.known and not doubts else None
    kept = [None if drawn is None else conforms(drawn, measures.points, limit, tolerance) for limit in limits]
    rows = []
    for limit, conforming in zip(limits, kept, strict=True):
        of_groove = limit.measure == "groove_gap"
        less = tolerance.root_gap_mm if of_groove else 0.0
        least, *greatest = (
            replace(one, value=one.value - less, low=one.low - less, high=one.high - less, doubtful=bool(doubts))
            for one in map(measures.measured, GROOVE_GAPS if of_groove else (limit.measure,))
        )
        rows.append(judging.judge(limit, least, tolerance, *greatest, probability=share([conforming])))
    return Conformity.of_rows(rows, probability=share(kept), doubts=doubts)


def draws(measures: Measures) -> Floats:
    """Draw gaps (n, 8, 3) of a joint by their covariance, each with its mirror image about the mean (antithetic draws).

    By the mirror images linear functions of the draws are exact: a value on its limit keeps it in exactly half of them.
    """
    errors = normal_draws.errors_of(measures.covariance, DRAWS // 2)
    return np.asarray(measures.gaps.ravel() + np.concatenate([errors, -errors])).reshape(-1, 8, 3)


def conforms(gaps: Floats, points: Floats, limit: Limit, tolerance: Tolerance) -> Bools | None:
    """Mark which of (n, 8, 3) gaps, in joint axes at key points (8, 3), keep a limit.

    None where a bound depends on a size (thickness), which a joint's design does not state; a project that knows the
    size gives the limit as a number.
    """
    low, high = limit_bounds.bounds(limit, {})
    if math.isnan(low) or math.isnan(high):
        return None
    if limit.measure == "groove_gap":
        x = gaps[:, :, 0] - tolerance.root_gap_mm
        least, greatest = x.min(axis=1), x.max(axis=1)
    elif limit.measure == "misalignment":
        least = greatest = np.abs(np.stack([gaps[:, point, axis] for point, axis in ACROSS], axis=1)).max(axis=1)
    else:
        least = greatest = np.linalg.norm(gaps.reshape(-1, 24) @ motion_of(points)[4:].T, axis=1)
    return np.asarray((least >= low) & (greatest <= high))


def share(marks: Sequence[Bools | None]) -> float:
    """Share of draws that keep all limits; NaN without a limit or with an unknown one."""
    known = [mark for mark in marks if mark is not None]
    return float(np.all(known, axis=0).mean()) if known and len(known) == len(marks) else float("nan")
