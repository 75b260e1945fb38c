"""Input of the comparison of epochs: one quantity of one component at every epoch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from processor.language.messages import Message
from processor.model import Bools, Floats, Word

T = TypeVar("T")


class Kind(Word):
    """What a component is; components are counted by it."""

    JOINT = "joint"
    SPAN = "span"
    BALL = "ball"
    SURFACE = "surface"
    WITH_DEFECTS = "body with defects"
    PART = "part"
    MEMBER = "member"


@dataclass(frozen=True, kw_only=True)
class Series:
    """A quantity of a component at each epoch (e,), NaN where an epoch has no value.

    ``ci95`` (e,) are half-widths of 95 % intervals, NaN where a method states none. ``doubtful`` (e,) are values that
    may be wrong beyond their interval; empty: none is. ``chosen_from`` is the number of values that this one was chosen
    from as the one that changed most; its interval is widened for that number. ``between`` are the balls whose places
    give the value.
    """

    component: str
    kind: Kind
    quantity: str | Message
    value: Floats
    ci95: Floats
    unit: str = "mm"
    doubtful: Bools = field(default_factory=lambda: np.empty(0, np.bool_))
    chosen_from: int = 1
    between: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.doubtful):
            object.__setattr__(self, "doubtful", np.zeros(len(self.value), np.bool_))


def by_key(results: Sequence[T | None], rows: Callable[[T], Iterable[tuple[Any, ...]]]) -> dict[Any, Floats]:
    """Return numbers (k, e) at the epochs of everything that ``rows`` yields of a result, a key before k numbers.

    NaN where an epoch lacks the key.
    """
    found: dict[Any, Floats] = {}
    for e, result in enumerate(results):
        for key, *numbers in () if result is None else rows(result):
            found.setdefault(key, np.full((len(numbers), len(results)), np.nan))[:, e] = numbers
    return found


def strongest(value: Floats, ci95: Floats) -> int:
    """Return which of k values (e, k) at epochs changed most from the first epoch, by its half-width (e, k)."""
    return int((np.abs(value[1:] - value[0]) / np.hypot(ci95[1:], ci95[0])).max(axis=0).argmax())
