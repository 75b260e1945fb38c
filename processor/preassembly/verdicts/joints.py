"""A joint held against its limits: pass, fail or indeterminate, with the probability that it conforms.

By ISO 14253-1 only what is surely within its limit passes, and only what is surely beyond fails: the 95 % interval lies
wholly on one side. The probability is by JCGM 106: the share of draws of the gaps, as their covariance spreads them,
that keep the limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from processor.limits import standards as limits_of
from processor.model import Checked, Codes, Floats, Limit, Tolerance, column, names
from processor.preassembly.verdicts.joint_measures import ACROSS, Measures, draws, motion_of

Marks = npt.NDArray[np.bool_]
NO_SIZES: Mapping[str, float] = MappingProxyType({})
Held = tuple[float, float, float, float, str, float]  # value, half-width, bounds, verdict and probability
MEASURES = ("misalignment", "groove_gap", "eccentricity")


@dataclass(frozen=True)
class Verdict(Checked):
    """Verdict on a joint, and a row for every limit held against it."""

    verdict: str = "indeterminate"  # pass | fail | indeterminate
    probability: float = float("nan")  # that all limits are kept
    key: tuple[str, ...] = names("v")
    what: tuple[str, ...] = names("v")
    value: Floats = column("v")  # of the groove gap: the extreme nearer to its limit, the design's root gap taken off
    ci95: Floats = column("v")
    low: Floats = column("v")  # allowed, -inf and inf without a bound; NaN: hangs on a size that is not known
    high: Floats = column("v")
    each: tuple[str, ...] = names("v")  # pass | fail | indeterminate
    each_probability: Floats = column("v")
    clause: tuple[str, ...] = names("v")  # of its standard; where there is none, the source
    edition: tuple[str, ...] = names("v")
    source: tuple[str, ...] = names("v")
    verified: Codes = column("v", dtype=np.uint8)
    said: str = ""  # one line, in words


def held(tolerance: Tolerance) -> list[Limit]:
    """Return the limits that a joint is held against."""
    return [limit for limit in tolerance.limits if limit.measure in MEASURES]


def judge(measures: Measures, tolerance: Tolerance, sizes_mm: Mapping[str, float] = NO_SIZES) -> Verdict:
    """Hold a joint against the limits of ``tolerance``; ``sizes_mm`` (thickness) are for limits that hang on them.

    Unknown gaps are indeterminate, and so is a joint without any limit. The joint fails if any limit does, and passes
    if all do.
    """
    rows = held(tolerance)
    if not rows:
        said = f"{tolerance.standard or 'the project'} has no limit for joints"
        return Verdict("indeterminate", float("nan"), said=said)
    known = bool(np.isfinite(measures.gaps).all() and np.isfinite(measures.covariance).all())
    drawn = draws(measures.gaps.ravel(), measures.covariance).reshape(-1, 8, 3) if known else None
    found = []
    every: Marks = np.ones(0 if drawn is None else len(drawn), bool)
    certain = drawn is not None
    for limit in rows:
        low, high = limits_of.bounds(limit, sizes_mm)
        value, half, verdict = _held(measures, limit, low, high, tolerance.root_gap_mm)
        probability = float("nan")
        if drawn is not None and not (math.isnan(low) or math.isnan(high)):
            kept = keeps(drawn, measures.points, limit, low, high, tolerance.root_gap_mm)
            probability, every = float(kept.mean()), every & kept
        else:
            certain = False
        found.append((value, half, low, high, verdict, probability))
    return written(rows, found, tolerance, float(every.mean()) if certain else float("nan"), in_words(rows, found))


def written(
    rows: Sequence[Limit], held: Sequence[Held], tolerance: Tolerance, probability: float, said: str
) -> Verdict:
    """Write the verdict on all limits from what was held against each, and where each stands."""
    values, halves, lows, highs, each, probabilities = zip(*held, strict=True)
    return Verdict(
        worst(each),
        probability,
        tuple(limit.key for limit in rows),
        tuple(limit.what for limit in rows),
        np.array(values),
        np.array(halves),
        np.array(lows),
        np.array(highs),
        each,
        np.array(probabilities),
        clause=tuple(f"{tolerance.standard} {limit.clause}" if limit.clause else limit.source for limit in rows),
        edition=tuple("" if own(limit) else tolerance.edition for limit in rows),
        source=tuple(limit.source for limit in rows),
        verified=np.array([limit.verified for limit in rows], np.uint8),
        said=said,
    )


def worst(verdicts: Sequence[str]) -> str:
    """Return the verdict on all: one that fails decides, then one that is indeterminate."""
    return next((one for one in ("fail", "indeterminate") if one in verdicts), "pass")


def own(limit: Limit) -> bool:
    """Whether a project gave the limit itself: of a standard's rows only those are verified that have a clause."""
    return limit.verified and not limit.clause


def _held(measures: Measures, limit: Limit, low: float, high: float, root_gap_mm: float) -> tuple[float, float, str]:
    """Value and half-width that decide, and the verdict."""
    if limit.measure != "groove_gap":
        value, half = measures.of(limit.measure)
        return value, half, guarded(measures.interval(limit.measure), low, high)
    sides = []
    for name, bounds in (("groove_gap_least", (low, math.inf)), ("groove_gap_greatest", (-math.inf, high))):
        value, half = measures.of(name)
        ends = measures.interval(name)
        off = value - root_gap_mm
        room = off - low if name == "groove_gap_least" else high - off
        sides.append((room, off, half, guarded((ends[0] - root_gap_mm, ends[1] - root_gap_mm), *bounds)))
    _, value, half, _ = min(sides, key=lambda side: side[0])
    return value, half, worst([side[3] for side in sides])


def guarded(interval: tuple[float, float], low: float, high: float) -> str:
    """Judge a 95 % interval against bounds: pass wholly within, fail wholly beyond one, else indeterminate."""
    if interval[0] >= low and interval[1] <= high:
        return "pass"
    return "fail" if interval[1] < low or interval[0] > high else "indeterminate"


def keeps(gaps: Floats, points: Floats, limit: Limit, low: float, high: float, root_gap_mm: float) -> Marks:
    """Mark which of (n, 8, 3) gaps in joint axes keep a limit."""
    if limit.measure == "groove_gap":
        x = gaps[:, :, 0] - root_gap_mm
        kept = (x.min(axis=1) >= low) & (x.max(axis=1) <= high)
    elif limit.measure == "misalignment":
        across = np.abs(np.stack([gaps[:, point, axis] for point, axis in ACROSS], axis=1)).max(axis=1)
        kept = (across >= low) & (across <= high)
    else:
        off = np.linalg.norm(gaps.reshape(-1, 24) @ motion_of(points)[4:].T, axis=1)
        kept = (off >= low) & (off <= high)
    return np.asarray(kept, bool)


def in_words(rows: Sequence[Limit], found: Sequence[Held]) -> str:
    """Say each limit with what is held against it: value, half-width, bounds, verdict and probability."""
    parts = []
    for limit, (value, half, low, high, verdict, probability) in zip(rows, found, strict=True):
        within = f"{low:g} to {high:g}" if math.isfinite(low) else f"at most {high:g}"
        if math.isnan(low) or math.isnan(high):
            within = f"a limit by the {limit.of}, which is not known"
        spread = f"+- {half:.2f} mm" if math.isfinite(half) else "mm, its interval not known"
        text = f"{limit.what}: {value:.2f} {spread}, {within}: {verdict}"
        text += f" ({probability:.0%} conforms)" if math.isfinite(probability) else ""
        parts.append(text + ("" if limit.verified else "; limit not verified"))
    return "; ".join(parts)
