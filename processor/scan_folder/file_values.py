"""Kinds of values that the files of a scan folder have: files below it, and units."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from processor.column_names import UNIT_WORDS
from processor.model import InputError, UsageError
from processor.model.inputs import Kind, Place
from processor.scan_folder.units import file_unit, known_unit


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


def _file(value: Any, place: Place) -> Path:
    if not isinstance(value, str) or not value:
        raise ValueError
    return existing_file_in(place.folder, value, place.where)


def _by(unit_of: Callable[[str], Any]) -> Callable[[Any, Place], Any]:
    def convert(value: Any, place: Place) -> Any:
        if not isinstance(value, str) or not value:
            raise ValueError
        try:
            return unit_of(value)
        except UsageError as error:
            raise place.refused(str(error)) from None

    return convert


FILE = Kind("a text", _file, {"$ref": "#/$defs/path"})
UNIT = Kind("a unit of length", _by(known_unit), {"enum": list(UNIT_WORDS)})
FILE_UNIT = Kind("a unit of length, or m/us-ft", _by(file_unit), {"type": "string"})
