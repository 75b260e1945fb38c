"""Verdict on a joint against its limits: pass, fail or indeterminate, with the probability of conformity.

By ISO 14253-1 a value passes where its 95 % interval lies wholly within the limits, and fails where it lies wholly
beyond one. The probability of conformity is by JCGM 106: the share of draws of the gaps, by their covariance, that keep
the limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from processor.adjustment.extremes import draws
from processor.limits import standards as limits_of
from processor.model import Checked, Codes, Floats, Limit, Tolerance, column, names
from processor.preassembly.verdicts.joint_measures import ACROSS, Measures, motion_of

Bools = npt.NDArray[np.bool_]
NO_SIZES: Mapping[str, float] = MappingProxyType({})
MEASURES = ("misalignment", "groove_gap", "eccentricity")


@dataclass(frozen=True)
class Verdict(Checked):
    """Verdict on a joint, and a row for every limit it is compared with."""

    verdict: str = "indeterminate"  # pass | fail | indeterminate
    probability: float = float("nan")  # that all limits are kept
    key: tuple[str, ...] = names("v")
    what: tuple[str, ...] = names("v")
    value: Floats = column("v")  # of the groove gap: the extreme nearer to its limit, the design's root gap taken off
    ci95: Floats = column("v")
    low: Floats = column("v")  # allowed, -inf and inf without a bound; NaN: depends on an unknown size
    high: Floats = column("v")
    each: tuple[str, ...] = names("v")  # pass | fail | indeterminate
    each_probability: Floats = column("v")
    clause: tuple[str, ...] = names("v")  # of its standard; where there is none, the source
    edition: tuple[str, ...] = names("v")
    source: tuple[str, ...] = names("v")
    verified: Codes = column("v", dtype=np.uint8)
    said: str = ""  # one line, in words


class Comparison(NamedTuple):
    """A value compared with one limit: half-width of its interval, the bounds, verdict and probability."""

    value: float
    ci95: float
    low: float
    high: float
    verdict: str
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


def allowed(limit: Limit, tolerance: Tolerance, sizes_mm: Mapping[str, float]) -> Allowed:
    """Return the bounds of a limit; NaN where they depend on a size that is not among ``sizes_mm``."""
    low, high = limits_of.bounds(limit, sizes_mm)
    return Allowed(limit, low, high, tolerance.root_gap_mm)


def judge(measures: Measures, tolerance: Tolerance, sizes_mm: Mapping[str, float] = NO_SIZES) -> Verdict:
    """Compare a joint with the limits of ``tolerance``; ``sizes_mm`` (thickness) are for limits that depend on them.

    Unknown gaps are indeterminate, and so is a joint without any limit. The joint fails if any limit does, and passes
    if all do.
    """
    limits = joint_limits(tolerance)
    if not limits:
        return Verdict(said=f"{tolerance.standard or 'the project'} has no limit for joints")
    drawn = draws(measures.gaps.ravel(), measures.covariance).reshape(-1, 8, 3) if measures.known else None
    comparisons = []
    all_kept: Bools = np.ones(0 if drawn is None else len(drawn), bool)
    complete = drawn is not None
    for limit in limits:
        bounds = allowed(limit, tolerance, sizes_mm)
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
    return compose(limits, comparisons, tolerance, probability, in_words(limits, comparisons))


def compose(
    limits: Sequence[Limit], comparisons: Sequence[Comparison], tolerance: Tolerance, probability: float, words: str
) -> Verdict:
    """Compose the verdict on all limits from the comparison with each, with the clause that each limit is from."""
    each = tuple(comparison.verdict for comparison in comparisons)
    return Verdict(
        verdict=worst(each),
        probability=probability,
        key=tuple(limit.key for limit in limits),
        what=tuple(limit.what for limit in limits),
        value=np.array([comparison.value for comparison in comparisons]),
        ci95=np.array([comparison.ci95 for comparison in comparisons]),
        low=np.array([comparison.low for comparison in comparisons]),
        high=np.array([comparison.high for comparison in comparisons]),
        each=each,
        each_probability=np.array([comparison.probability for comparison in comparisons]),
        clause=tuple(f"{tolerance.standard} {limit.clause}" if limit.clause else limit.source for limit in limits),
        edition=tuple("" if of_project(limit) else tolerance.edition for limit in limits),
        source=tuple(limit.source for limit in limits),
        verified=np.array([limit.verified for limit in limits], np.uint8),
        said=words,
    )


def left_open(verdict: Verdict, reason: str) -> Verdict:
    """Make a verdict on a joint, and each of its rows, indeterminate where there is a ``reason`` to doubt its gaps."""
    if not reason:
        return verdict
    return replace(
        verdict,
        verdict="indeterminate",
        probability=float("nan"),
        each=("indeterminate",) * len(verdict.each),
        each_probability=np.full_like(verdict.each_probability, np.nan),
        said=reason,
    )


def worst(verdicts: Sequence[str]) -> str:
    """Return the verdict on all: fail before indeterminate before pass."""
    return next((verdict for verdict in ("fail", "indeterminate") if verdict in verdicts), "pass")


def of_project(limit: Limit) -> bool:
    """Whether the project gave the limit itself: of a standard's rows only those with a clause are verified."""
    return limit.verified and not limit.clause


def guard_band(interval: tuple[float, float], low: float, high: float) -> str:
    """Judge a 95 % interval against bounds: pass wholly within, fail wholly beyond one, else indeterminate."""
    if interval[0] >= low and interval[1] <= high:
        return "pass"
    return "fail" if interval[1] < low or interval[0] > high else "indeterminate"


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


def in_words(limits: Sequence[Limit], comparisons: Sequence[Comparison]) -> str:
    """Describe the comparison with each limit: value, half-width, bounds, verdict and probability."""
    parts = []
    for limit, (value, half_width, low, high, verdict, probability) in zip(limits, comparisons, strict=True):
        within = f"{low:g} to {high:g}" if math.isfinite(low) else f"at most {high:g}"
        if math.isnan(low) or math.isnan(high):
            within = f"a limit by the {limit.of}, which is not known"
        spread = f"+- {half_width:.2f} mm" if math.isfinite(half_width) else "mm, its interval not known"
        text = f"{limit.what}: {value:.2f} {spread}, {within}: {verdict}"
        text += f" ({probability:.0%} conforms)" if math.isfinite(probability) else ""
        parts.append(text + ("" if limit.verified else "; limit not verified"))
    return "; ".join(parts)


def _compare(measures: Measures, allowed: Allowed) -> tuple[float, float, str]:
    """Value and half-width that decide, and the verdict."""
    low, high = allowed.low, allowed.high
    if allowed.limit.measure != "groove_gap":
        value, half_width = measures.of(allowed.limit.measure)
        return value, half_width, guard_band(measures.interval(allowed.limit.measure), low, high)
    sides = []
    for name, bounds in (("groove_gap_least", (low, math.inf)), ("groove_gap_greatest", (-math.inf, high))):
        gap, half_width = measures.of(name)
        interval = measures.interval(name)
        value = gap - allowed.root_gap_mm
        room = value - low if name == "groove_gap_least" else high - value
        verdict = guard_band((interval[0] - allowed.root_gap_mm, interval[1] - allowed.root_gap_mm), *bounds)
        sides.append((room, value, half_width, verdict))
    _, value, half_width, _ = min(sides, key=lambda side: side[0])
    return value, half_width, worst([side[3] for side in sides])
