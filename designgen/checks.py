"""Checks of the values in a recipe."""

from __future__ import annotations

from processor.model import UsageError


def expect(fits: bool, key: str, value: object, expected: str) -> None:
    """Raise UsageError that names the recipe's ``key`` (section.key), unless its value fits."""
    if not fits:
        raise UsageError(f"{key}: expected {expected}, got {value!r}")


def expect_positive(params: object, section: str, *keys: str) -> None:
    """Raise UsageError that names the key, unless these lengths in a section's record are above 0."""
    for key in keys:
        value = getattr(params, key)
        expect(value > 0.0, f"{section}.{key}", value, "a length above 0")
