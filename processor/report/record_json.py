"""Records as JSON objects, by the metadata of their fields; arrays and numbers stay as they are."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from processor.language.messages import messages
from processor.model import Checked, Reason, Rows
from processor.store.codec import reason_object


def as_object(record: Checked) -> dict[str, Any]:
    """Write a record as the metadata of its fields have it; see :func:`processor.model.described`.

    A record within it is null where all that it would hold is absent.
    """
    found: dict[str, Any] = {}
    for field in dataclasses.fields(record):  # type: ignore[arg-type]
        key, value = field.metadata.get("json", field.name), getattr(record, field.name)
        if key and not _absent(value, field.metadata):
            _put(found, key, _value(value))
    return found


def as_rows(table: Rows) -> list[dict[str, Any]]:
    """Write a table as a list of its rows; a column without values is left out."""
    rows: list[dict[str, Any]] = [{} for _ in range(len(table))]
    for field in dataclasses.fields(table):  # type: ignore[arg-type]
        key, column = field.metadata.get("json", field.name), getattr(table, field.name)
        if not key or not len(column):
            continue
        keys, present = field.metadata.get("keys", ()), _present(table, field.metadata)
        for row, value in ((rows[i], column[i]) for i in present):
            for name, item in zip(keys, value, strict=True) if keys else [("", value)]:
                null = field.metadata.get("nullable") and np.isnan(item).all()
                _put(row, key.replace("*", name), None if null else _value(item))
    return rows


def reason_json(reason: Reason) -> dict[str, Any]:
    """Write a reason with its English text."""
    return {**reason_object(reason), "text": messages("en").text(reason)}


def _absent(value: Any, metadata: Mapping[str, Any]) -> bool:
    return value is None or bool(metadata.get("optional") and not len(value))


def _present(table: Rows, metadata: Mapping[str, Any]) -> list[int]:
    """Return the rows that have a value in a column: all, or those where column ``where`` is finite."""
    if "where" not in metadata:
        return list(range(len(table)))
    known = getattr(table, metadata["where"])
    return np.flatnonzero(np.isfinite(known.reshape(len(known), -1)).all(axis=1)).tolist() if len(known) else []


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
