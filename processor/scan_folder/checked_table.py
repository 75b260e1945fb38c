"""Checked values of project.toml and design.json; messages name their place in the file."""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import Floats, InputError, UsageError, did_you_mean
from processor.scan_folder.units import FileUnit, file_unit, known_unit

LOG = logging.getLogger("processor.input")
MOST_NAMED = 6  # unknown keys


def existing_file_in(folder: Path, text: str, where: str) -> Path:
    """Return the path of an existing file below ``folder``.

    Raises InputError if it does not exist, or leads out of the folder.
    """
    path = folder / text
    parts = text.replace("\\", "/").split("/")
    if "\0" in text or (path.is_absolute() and text.startswith(("/", "\\"))) or ".." in parts or ":" in parts[0]:
        raise InputError(f"{where}: {text!r} leads out of the folder; give a path below it")
    try:
        stays = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):
        stays = False
    if not stays:
        raise InputError(f"{where}: {text!r} is a link that leads out of the folder; copy the file there")
    try:
        found = path.exists()
    except OSError:  # a name of any length may come
        found = False
    if not found:
        raise InputError(f"{where}: there is no file {text!r} in {folder}")
    return path


@dataclass(frozen=True)
class Table:
    """A table of a file, and its place there."""

    where: str
    values: Mapping[str, Any]

    @classmethod
    def of(cls, where: str, value: Any) -> Table:
        """Return a value as a table. Raises InputError for any other type."""
        if not isinstance(value, dict):
            raise InputError(f"{where}: expected a table of names and values, found {_kind(value)}")
        return cls(where, value)

    def only(self, known: Collection[str]) -> None:
        """Raise InputError for a key that is not in ``known``."""
        unknown = [key for key in self.values if key not in known]
        if unknown:
            like = did_you_mean(unknown[0], known)
            raise InputError(f"{self.where}: unknown key {unknown[0]!r}{like}; known are {', '.join(known)}")

    def _error(self, key: str, expected: str) -> InputError:
        value = _kind(self.values[key]) if key in self.values else "nothing"
        return InputError(f"{self.where}: expected {expected} as {key!r}, found {value}")

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text that is not empty."""
        value = self.values.get(key, default)
        if not isinstance(value, str) or (key in self.values and not value):
            raise self._error(key, "a text")
        return value

    def unit(self, key: str, default: str | None = None) -> str:
        """Return the name of a known unit of length."""
        text = self.text(key, default)
        try:
            return known_unit(text) if text else text
        except UsageError as error:
            raise InputError(f"{self.where}: {error}") from None

    def file_unit(self, key: str) -> FileUnit | None:
        """Return the units of a file's coordinates, as ``m`` or ``m/us-ft``; None where they are not given."""
        text = self.text(key, "")
        try:
            return file_unit(text) if text else None
        except UsageError as error:
            raise InputError(f"{self.where}: {error}") from None

    def number(self, key: str, default: float | None = None, positive: bool = False) -> float:
        """Return a finite number."""
        if key not in self.values and default is not None:
            return default
        value = self.values.get(key)
        try:
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise ValueError
            number = float(value)
        except (ValueError, OverflowError):
            raise self._error(key, "a number") from None
        if not math.isfinite(number) or (positive and number <= 0):
            raise self._error(key, "a number above 0" if positive else "a finite number")
        return number

    def integer(self, key: str, expected: str = "a whole number") -> int:
        """Return a whole number of at most 53 bits; ``expected`` is for the error."""
        value = self.values.get(key)
        if isinstance(value, bool) or not isinstance(value, int) or abs(value) >= 2**53:
            raise self._error(key, expected)
        return value

    def array(self, key: str, *shape: int) -> Floats:
        """Return an array of finite numbers; -1 in ``shape`` allows any length of an axis."""
        expected = "numbers of shape " + " x ".join("n" if n < 0 else str(n) for n in shape)
        try:
            array = np.array(self.values.get(key), np.float64)
        except (ValueError, TypeError, OverflowError):
            raise self._error(key, expected) from None
        fits = array.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits or not np.isfinite(array).all():
            raise self._error(key, expected)
        return array

    def tables(self, key: str) -> list[Table]:
        """Return a list of tables, empty without the key."""
        value = self.values.get(key, [])
        if not isinstance(value, list):
            raise self._error(key, "a list")
        return [Table.of(f"{self.where}: {key} {i}", item) for i, item in enumerate(value, 1)]

    def table(self, key: str) -> Table:
        """Return a table within this one."""
        if key not in self.values:
            raise self._error(key, "a table")
        return Table.of(f"{self.where}: {key}", self.values[key])


def _kind(value: Any) -> str:
    if isinstance(value, (str, int, float)):
        return repr(value)[:60]
    return {list: "a list", dict: "a table", type(None): "null"}.get(type(value), type(value).__name__)


def ignore_unknown(where: str, tables: Sequence[Table], known: Collection[str]) -> None:
    """Log one line on the keys of tables that are not in ``known``: they are ignored."""
    unknown = sorted({key for table in tables for key in table.values if key not in known})
    if unknown:
        like = did_you_mean(unknown[0], known)
        LOG.warning("%s: ignored unknown %s%s", where, ", ".join(map(repr, unknown[:MOST_NAMED])), like)
