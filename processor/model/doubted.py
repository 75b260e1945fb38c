"""Results whose intervals do not hold what was done to the points: nothing in them is sure any more."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from processor.model.fields import Word

LESS_SURE = {"ok": ("weak", "low-confidence"), "pass": ("indeterminate",), "fail": ("indeterminate",)}
DOUBT = "doubtful"  # the column of a table that says so of each row


def doubted(value: Any) -> Any:
    """Return a record of the same numbers, in which statuses and flags that are ok are weak and no verdict is sure."""
    if isinstance(value, Word):
        return next((word for word in type(value) if str(word) in LESS_SURE.get(str(value), ())), value)
    if type(value) is tuple:
        return tuple(map(doubted, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        less = {name: np.ones_like(old) if name == DOUBT else doubted(old) for name, old in fields.items()}
        return dataclasses.replace(value, **{name: new for name, new in less.items() if new is not fields[name]})
    return value
