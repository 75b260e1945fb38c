"""What the steps hand over for a comparison of epochs: values of one quantity of one component over the epochs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from processor.language.messages import Message
from processor.model import Flags, Floats


@dataclass(frozen=True, kw_only=True)
class Series:
    """A quantity of a component at each epoch (e,), NaN where an epoch has no value.

    ``ci95`` (e,) are half-widths of 95 % intervals, NaN where a method states none. ``doubtful`` (e,) are values that
    may be wrong beyond their interval; empty: none is. ``chosen_from`` is the number of values that this one was chosen
    from as the one that changed most; its interval is widened for that number.
    """

    component: str
    quantity: str | Message
    value: Floats
    ci95: Floats
    unit: str = "mm"
    doubtful: Flags = field(default_factory=lambda: np.empty(0, np.bool_))
    chosen_from: int = 1

    def __post_init__(self) -> None:
        if not len(self.doubtful):
            object.__setattr__(self, "doubtful", np.zeros(len(self.value), np.bool_))
