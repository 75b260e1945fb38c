"""The truth of a scan folder as JSON, for scenes of other generators and for references measured otherwise.

``truth.json`` holds ``"format": "processor-truth"`` and the fields of :class:`processor.model.Truth` by their names,
lengths in mm; null is NaN. A file of another format is not a truth of this kind, and is passed over.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import BodyTruth, InputError, RecordError, Truth

NAME, FORMAT = "truth.json", "processor-truth"
RECORDS: dict[str, type[Any]] = {
    name: typing.get_args(hint)[0]
    for name, hint in typing.get_type_hints(Truth).items()
    if type(None) in typing.get_args(hint)
}
NUMBERS = ("spacing_mm", "sigma_mm")
KNOWN = {"format", "about", *NUMBERS, *RECORDS}


def read(folder: Path) -> Truth | None:
    """Read the truth of a folder; None where it has none of this format. Raises InputError for one with faults."""
    path = folder / NAME
    if not path.is_file():
        return None
    try:
        table = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(table, dict) or table.get("format") != FORMAT:
        return None
    if unknown := sorted(set(table) - KNOWN):
        raise InputError(f"{path}: unknown key {unknown[0]!r}; there are {', '.join(sorted(KNOWN))}")
    try:
        values: dict[str, Any] = {name: float(table[name]) for name in NUMBERS if name in table}
        values |= {name: _record(kind, table[name]) for name, kind in RECORDS.items() if name in table}
    except (TypeError, ValueError, RecordError) as error:
        raise InputError(f"{path}: expected a truth in {FORMAT}, found one with faults ({error})") from error
    return Truth(**values)


def _record(kind: type[Any], table: dict[str, Any]) -> Any:
    """Return a record made of lists; an unknown key raises TypeError."""
    arrays = {field.name: field.metadata["dtype"] for field in dataclasses.fields(kind) if "dtype" in field.metadata}
    values: dict[str, Any] = {
        key: np.array(value, arrays[key]) if key in arrays else value for key, value in table.items()
    }
    if values.get("bodies") is not None:
        values["bodies"] = _record(BodyTruth, values["bodies"])
    return kind(**values)
