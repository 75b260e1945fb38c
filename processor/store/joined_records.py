"""Many records of one kind as one table, so that a file holds a dataset a field and not one a field and record.

The table of k records has a row (k,) for each field of a single value. The rows of the records' own tables follow one
another in one table of the same name; ``<name>_rows`` (k,) holds how many of them each record has.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from processor.model import Checked, RecordError, Rows, column, names, reasons, words

ROWS = "{name}_rows"


@cache
def table_of(kind: Any) -> Any:
    """Return the record that holds many records of a kind. Raises TypeError for a field that has no place in it."""
    hints = typing.get_type_hints(kind)
    declared: list[Any] = []
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        if isinstance(hint, type) and issubclass(hint, Rows):
            declared += [
                (field.name, hint, dataclasses.field(default_factory=hint)),
                (ROWS.format(name=field.name), np.ndarray, column("k", dtype=np.int64)),
            ]
        elif "reasons" in field.metadata and not field.metadata["reasons"]:
            declared.append((field.name, types.GenericAlias(tuple, (hint, ...)), reasons("k")))
        elif "words" in field.metadata and "axis" not in field.metadata:
            declared.append((field.name, types.GenericAlias(tuple, (hint, ...)), words("k", field.metadata["words"])))
        elif hint is str:
            declared.append((field.name, tuple[str, ...], names("k")))
        else:
            raise TypeError(f"{kind.__name__}.{field.name}: a {hint} cannot be stored in a table")
    return dataclasses.make_dataclass(f"{kind.__name__}Table", declared, bases=(Checked,), frozen=True)


def joined(records: Sequence[Any]) -> Any:
    """Return the table of one or more records of one kind."""
    kind: Any = type(records[0])
    values: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        every = tuple(getattr(record, field.name) for record in records)
        if isinstance(every[0], Rows):
            values[field.name] = every[0].concat(every)
            values[ROWS.format(name=field.name)] = np.array([len(one) for one in every], np.int64)
        else:
            values[field.name] = every
    return table_of(kind)(**values)


def split(table: Any, kind: Any) -> tuple[Any, ...]:
    """Return the records of a kind that a table holds. Raises RecordError where its rows do not add up."""
    columns: dict[str, Sequence[Any]] = {}
    for field in dataclasses.fields(kind):
        value = getattr(table, field.name)
        if isinstance(value, Rows):
            counts = getattr(table, ROWS.format(name=field.name))
            if (counts < 0).any() or counts.sum() != len(value):
                raise RecordError(
                    f"{field.name}: expected {counts.sum()} rows, as {ROWS.format(name=field.name)} adds up to,"
                    f" found {len(value)}"
                )
            ends = np.cumsum(counts).tolist()
            value = [value.take(slice(start, end)) for start, end in zip([0, *ends], ends, strict=False)]
        columns[field.name] = value
    return tuple(kind(**dict(zip(columns, values, strict=True))) for values in zip(*columns.values(), strict=True))
