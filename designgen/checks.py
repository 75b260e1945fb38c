"""Checks of the values in a recipe."""

from __future__ import annotations

from processor.model import UsageError


def expect(fits: bool, key: str, value: object, expected: str) -> None:
    """Raise UsageError that names the recipe's ``key`` (section.key), unless its value fits."""
    if not fits:
        raise UsageError(f"{key}: expected {expected}, got {value!r}")


def expect_all(section: str, *conditions: tuple[bool, str, object, str]) -> None:
    """Raise UsageError for the first of the conditions (fits, key, value, expected) that does not fit."""
    for fits, key, value, expected in conditions:
        expect(fits, f"{section}.{key}", value, expected)


def expect_positive(params: object, section: str, *keys: str) -> None:
    """Raise UsageError that names the key, unless these lengths in a section's record are above 0."""
    for key in keys:
        value = getattr(params, key)
        expect(value > 0.0, f"{section}.{key}", value, "a length above 0")
