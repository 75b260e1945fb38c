"""Tables stored as columns: rows chosen, tables joined, and tables made of one object a row."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

T = TypeVar("T", bound="Columns")
RowNumbers = slice | npt.NDArray[np.int64] | npt.NDArray[np.bool_]


class Columns:
    """A dataclass whose arrays (n, ...) and tuples (n) are columns of one length, a row per item.

    An empty column is an absent one. Other fields, such as a number or None, belong to the table as a whole.
    """

    def take(self: T, rows: RowNumbers) -> T:
        """Return the table of some rows: a slice, their numbers, or a flag (n,) a row."""
        taken = {
            name: one[rows] if isinstance(one, np.ndarray) else tuple(one[i] for i in np.arange(len(one))[rows])
            for name, one in _columns(self)
        }
        return dataclasses.replace(self, **taken)  # type: ignore[type-var]

    @classmethod
    def concat(cls: type[T], tables: Sequence[T]) -> T:
        """Return the rows of tables one after another; without any table the empty one, if there is such."""
        if not tables:
            return cls()
        joined: dict[str, Any] = {}
        for name, first in _columns(tables[0], absent=True):
            every = [getattr(table, name) for table in tables]
            joined[name] = np.concatenate(every) if isinstance(first, np.ndarray) else tuple(chain.from_iterable(every))
        return dataclasses.replace(tables[0], **joined)  # type: ignore[type-var]

    @classmethod
    def from_items(cls: type[T], items: Iterable[Any], **columns: Any) -> T:
        """Return the table with a row an item: its attributes of the columns' names, but for the given ``columns``."""
        items = tuple(items)
        names = (field.name for field in dataclasses.fields(cls) if field.name not in columns)  # type: ignore[arg-type]
        return cls(**columns, **{name: tuple(getattr(item, name) for item in items) for name in names})

    def items(self) -> Iterator[dict[str, Any]]:
        """Yield the rows, each as what the columns hold by their names; absent columns are left out."""
        columns = {name: one.tolist() if isinstance(one, np.ndarray) else one for name, one in _columns(self)}
        for values in zip(*columns.values(), strict=True):
            yield dict(zip(columns, values, strict=True))


def _columns(table: Any, absent: bool = False) -> list[tuple[str, Any]]:
    values = [(field.name, getattr(table, field.name)) for field in dataclasses.fields(table)]
    return [(name, one) for name, one in values if isinstance(one, np.ndarray | tuple) and (absent or len(one))]
