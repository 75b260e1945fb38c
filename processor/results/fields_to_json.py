"""Records as JSON objects, by the metadata of their fields; arrays and numbers stay as they are."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from processor.language.messages import messages
from processor.model import Checked, Reason, Rows
from processor.store.codec import reason_to_json


def as_object(record: Checked) -> dict[str, Any]:
    """Write a record as the metadata of its fields have it; see :func:`processor.model.described`.

    A record within it is null where all that it would hold is absent.
    """
    values: dict[str, Any] = {}
    for field in dataclasses.fields(record):  # type: ignore[arg-type]
        value = getattr(record, field.name)
        if not _absent(value, field.metadata):
            _put_field(values, field, value)
        if "sentence" in field.metadata:
            _put(values, field.metadata["sentence"], messages("en").sentences(value))
    return values


def as_rows(table: Rows) -> list[dict[str, Any]]:
    """Write a table as a list of its rows; a column without values is left out."""
    count = len(table)
    rows: list[dict[str, Any]] = [{} for _ in range(count)]
    for field in dataclasses.fields(table):  # type: ignore[arg-type]
        column = getattr(table, field.name)
        if len(column):
            for i in _present(table, field.metadata) if "where" in field.metadata else range(count):
                _put_field(rows[i], field, column[i])
    return rows


def reason_json(reason: Reason) -> dict[str, Any]:
    """Write a reason with its English text."""
    return {**reason_to_json(reason), "text": messages("en").text(reason)}


def _put_field(target: dict[str, Any], field: dataclasses.Field[Any], value: Any) -> None:
    """Set the value of a field, or its value in one row, by the metadata of the field."""
    keys, metadata = field.metadata.get("json", field.name), field.metadata
    for key in (keys,) if isinstance(keys, str) else keys:
        if key:
            _put_by_key(target, key, value, metadata)


def _put_by_key(target: dict[str, Any], key: str, value: Any, metadata: Mapping[str, Any]) -> None:
    if "*" in key:
        for name, item in zip(metadata["keys"], value, strict=True):
            null = metadata.get("nullable") and np.isnan(item).all()
            _put(target, key.replace("*", str(name)), None if null else _value(item))
    elif "axes" in metadata:
        _put(target, key, _by_name(value, *metadata["axes"]))
    elif "by" in metadata:
        _put(target, key, {str(row.pop(metadata["by"])): row for row in as_rows(value)})
    else:
        null = metadata.get("nullable") and np.isnan(value).all()
        _put(target, key, None if null else _value(value))


def _by_name(values: Any, names: Sequence[str], *further: Sequence[str]) -> dict[str, Any]:
    """Name the items along each axis of an array; a part of it without any number is an empty object."""
    found = dict(zip(names, values, strict=True))
    if further:
        found = {name: _by_name(item, *further) if np.isfinite(item).any() else {} for name, item in found.items()}
    return found


def _absent(value: Any, metadata: Mapping[str, Any]) -> bool:
    return value is None or bool(metadata.get("optional") and not len(value))


def _present(table: Rows, metadata: Mapping[str, Any]) -> list[int]:
    """Return the rows that have a value in a column: those where column ``where`` is finite."""
    present = getattr(table, metadata["where"])
    return np.flatnonzero(np.isfinite(present.reshape(len(present), -1)).all(axis=1)).tolist() if len(present) else []


def _put(target: dict[str, Any], key: str, value: Any) -> None:
    """Set a value by a key with dots; "." merges an object into the target."""
    if key == ".":
        target |= value
        return
    *sections, last = key.split(".")
    for section in sections:
        target = target.setdefault(section, {})
    target[last] = value


def _value(value: Any) -> Any:
    if isinstance(value, Reason):
        return reason_json(value)
    if isinstance(value, Rows):
        return as_rows(value)
    if isinstance(value, Checked):
        return as_object(value) or None
    if isinstance(value, tuple):
        return [_value(item) for item in value]
    return value
