"""Sections of a recipe, read into Params records with every key and type checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from processor.model import UsageError
from processor.model.inputs import Place, read

P = TypeVar("P")


def filled(cls: type[P], recipe: Mapping[str, Any], section: str) -> P:
    """Fill a Params record from a section of the recipe. Raises UsageError for unknown keys and wrong types."""
    return read(cls, recipe.get(section, {}), Place(section, UsageError, separator="."))
