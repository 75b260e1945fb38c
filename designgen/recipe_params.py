"""Sections of a recipe, read into Params records with every key and type checked."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, TypeVar

from processor.model import UsageError

P = TypeVar("P")


def filled(cls: type[P], recipe: Mapping[str, Any], section: str) -> P:
    """Fill a Params record from a section of the recipe. Raises UsageError for unknown keys and wrong types."""
    table = recipe.get(section, {})
    if not isinstance(table, Mapping):
        raise UsageError(f"{section}: expected a section, got {table!r}")
    fields = {f.name: f.default for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in fields:
            raise UsageError(f"{section}.{key}: unknown key; there are {', '.join(fields)}")
        values[key] = _like(fields[key], value, f"{section}.{key}")
    return cls(**values)


def _like(default: Any, value: Any, where: str) -> Any:
    """Check a value against the type of the default and return it; as a tuple if the default is one."""
    if isinstance(default, tuple):
        items = value if isinstance(value, list) else [value]
        return tuple(_like(default[0] if default else 0.0, item, where) for item in items)  # empty: of numbers
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not type(default):
        raise UsageError(f"{where}: expected a {type(default).__name__}, got {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise UsageError(f"{where}: expected a finite number, got {value!r}")
    return value
