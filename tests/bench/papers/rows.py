"""Rows of the comparison with the source papers: a published number, ours over the seeds, and whether they agree."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor.language.messages import Message, messages
from processor.model import Reason, Word

# A paper's number is of one run on data that are not ours. Most scatter less than this share from seed to seed.
TOLERANCE = 0.25
DECADE = math.sqrt(10.0)  # factor within which two numbers are of one order of magnitude


class Rule(Word):
    """When a published number counts as reproduced by the median over the seeds."""

    AT_MOST = "at most"  # an error: not larger than published, with TOLERANCE
    NEAR = "near"  # a quantity: within TOLERANCE of the published one
    MAGNITUDE = "magnitude"  # a blunder: of the same order of magnitude
    HOLDS = "holds"  # a statement: it holds in every seed


class Outcome(Word):
    """Whether a published number is reproduced."""

    YES = "yes"
    NO = "no"
    NOT_MADE = "not made"  # nothing was measured for it, as where a data set failed


@dataclass(frozen=True)
class Row:
    """A number that a table or figure of a paper states; ``values`` holds ours, one per seed, empty where not made.

    ``published`` is NaN where the row is of a method of ours. A statement has the published value 1, and ours is 1 in
    each seed in which it holds.
    """

    paper: str
    place: Message  # table or figure
    data: str
    method: str
    quantity: Message
    unit: str
    published: float
    values: tuple[float, ...]
    rule: Rule
    reason: Reason

    @property
    def median(self) -> float:
        """Median over the seeds; NaN without any."""
        known = self._known()
        return float(np.median(known)) if known else math.nan

    @property
    def worst(self) -> float:
        """The value of the seeds that is worst by the rule; NaN without any."""
        known = self._known()
        if not known:
            return math.nan
        if self.rule is Rule.AT_MOST or math.isnan(self.published):
            return max(known)
        if self.rule is Rule.HOLDS:
            return min(known)
        return max(known, key=lambda value: abs(math.log(max(abs(value), 1e-12) / max(abs(self.published), 1e-12))))

    @property
    def outcome(self) -> Outcome | None:
        """Whether the number is reproduced; None in a row of ours without a published number."""
        if math.isnan(self.published):
            return None
        if not self._known():
            return Outcome.NOT_MADE
        return Outcome.YES if self._reproduced() else Outcome.NO

    def _reproduced(self) -> bool:
        if self.rule is Rule.HOLDS:
            return self.worst >= 1.0
        if self.rule is Rule.AT_MOST:
            return abs(self.median) <= (1.0 + TOLERANCE) * abs(self.published)
        factor = 1.0 + TOLERANCE if self.rule is Rule.NEAR else DECADE
        ratio = self.median / self.published
        return 1.0 / factor <= ratio <= factor

    def _known(self) -> list[float]:
        return [value for value in self.values if math.isfinite(value)]

    def as_object(self) -> dict[str, Any]:
        """Return the row for papers.json, texts in English; numbers that are none are null."""
        english = messages("en")
        return {
            "paper": self.paper,
            "place": english.text(self.place),
            "data": self.data,
            "method": self.method,
            "quantity": english.text(self.quantity),
            "unit": self.unit,
            "published": _finite(self.published),
            "median": _finite(self.median),
            "worst": _finite(self.worst),
            "values": [_finite(value) for value in self.values],
            "rule": str(self.rule),
            "reproduced": None if self.outcome is None else str(self.outcome),
            "reason": {
                "code": self.reason.code,
                "values": {name: _finite(value) for name, value in self.reason.values.items()},
                "text": english.text(self.reason),
            },
        }


def median(values: Iterable[float]) -> float:
    """Return the median of what is known among values, for a reason; NaN of nothing."""
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else math.nan


def holds(values: Iterable[float], condition: Callable[[float], bool]) -> tuple[float, ...]:
    """Return 1 for each value that meets a condition, 0 for each that does not, NaN where there is none."""
    return tuple(float(condition(value)) if math.isfinite(value) else math.nan for value in values)


def is_smaller(values: Iterable[float], others: Iterable[float]) -> tuple[float, ...]:
    """Return 1 for each value that is smaller than the other of its seed, 0 if it is not, NaN where either is none."""
    return holds((value - other for value, other in zip(values, others, strict=True)), lambda off: off < 0.0)


def _finite(value: Any) -> Any:
    """Return a value for JSON, which has no number that is not finite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
