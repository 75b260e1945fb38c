"""Rows of the comparison with the source papers: a published number, ours over the seeds, and whether they agree."""

from __future__ import annotations

import math
from collections.abc import Iterable
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
    NONE = "none"  # cannot be made from our data


class Outcome(Word):
    """Whether a published number is reproduced."""

    YES = "yes"
    NO = "no"
    NOT_MADE = "not made"  # cannot be made from our data, or a data set failed


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
        if self.rule is Rule.NONE:
            return Outcome.NOT_MADE
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
            "reason": {"code": self.reason.code, "values": dict(self.reason.values), "text": english.text(self.reason)},
        }


def median(values: Iterable[float]) -> float:
    """Return the median of what is known among values, for a reason; 0 of nothing, as then its row is not made."""
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else 0.0


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
