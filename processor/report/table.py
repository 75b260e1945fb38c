"""A table, for the page, for a CSV file and for the terminal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

NAN = float("nan")


@dataclass(frozen=True)
class Table:
    """A titled table: in a CSV file of the name ``file`` where that is not empty, on the page and on the terminal.

    ``groups`` are headings above the columns, one each, equal neighbours taken together; CSV files have none.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    file: str = ""
    note: str = ""
    groups: tuple[str, ...] = ()
    on_page: bool = True
    on_terminal: bool = True
