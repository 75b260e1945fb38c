"""A table for the page, a CSV file and the terminal."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import math
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor.language.messages import Message, Text, label, messages, text
from processor.model import Checked, Reason, StepRun
from processor.plain_text import printable, spreadsheet_text

NAN = float("nan")


@dataclass(frozen=True)
class Table:
    """A titled table: in a CSV file of the name ``file`` where that is not empty, on the page and on the terminal.

    ``columns`` are the names in the CSV file, with units. ``headings`` are those for display, one each; without them
    they are the words of the names without units, which the title states. ``groups`` are headings above the columns,
    one each, of which equal neighbours are merged; CSV files have none.
    """

    title: str | Message
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    file: str = ""
    note: str | Message = ""
    groups: tuple[str | Message, ...] = ()
    headings: tuple[str, ...] = ()
    on_page: bool = True
    on_terminal: bool = True
    folded: bool = False  # on the page: among the further tables, which a reader opens


def figures_of(title: str, runs: Sequence[StepRun], file: str) -> Table:
    """Tabulate the fields of results with a heading, a column per method; see :func:`processor.model.described`."""
    columns = [list(_figures(run.result)) for run in runs]
    rows = tuple(
        (heading, *(column[i][1] for column in columns), unit) for i, (heading, _, unit) in enumerate(columns[0])
    )
    return Table(label(title), ("figure", *(run.method for run in runs), "unit"), rows, file)


def _figures(result: Checked) -> Iterator[tuple[Message, Any, str]]:
    yield text("status"), result.status, ""  # type: ignore[attr-defined]
    for field in dataclasses.fields(result):  # type: ignore[arg-type]
        heading = field.metadata.get("heading")
        if not heading:
            continue
        percent, value = field.metadata.get("percent", False), getattr(result, field.name)
        unit = "%" if percent else field.metadata.get("unit", "")
        if isinstance(value, np.ndarray):
            low, high = (value * (100.0 if percent else 1.0)).tolist() if value.size else (NAN, NAN)
            yield text("{quantity}, from", quantity=label(heading)), low, unit
            yield text("{quantity}, to", quantity=label(heading)), high, unit
        else:
            yield label(heading), 100.0 * value if percent else value, unit


def csv_text(table: Table) -> str:
    """Write a table as CSV; a leading apostrophe protects text that a spreadsheet would execute as a formula."""
    return csv_of_rows(table.columns, table.rows)


def csv_of_rows(columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Write columns and rows as CSV; see :func:`csv_text`."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([csv_cell(cell) for cell in row] for row in rows)
    return out.getvalue()


def csv_cell(cell: Any) -> Any:
    """Return a cell as CSV files have it: full numbers, and text that no spreadsheet executes."""
    if isinstance(cell, float | np.floating):
        return "" if not math.isfinite(cell) else repr(round(float(cell), 6))
    if isinstance(cell, str | Text | Reason | list | tuple):
        return spreadsheet_text(shown(cell))
    return cell


def shown(cell: Any) -> str:
    """Write a cell for people, messages in English: three decimals, a dash for no number, no control characters."""
    if isinstance(cell, Text | Reason | list | tuple):
        cell = messages("en").text(cell)
    if isinstance(cell, float | np.floating):
        return "–" if not math.isfinite(cell) else f"{cell:.3f}"
    return printable(str(cell))


def plain_text(table: Table, most: int = 40) -> str:
    """Write a table for the terminal, columns aligned, at most so many rows."""
    cells = [list(headings(table)), *([shown(cell) for cell in row] for row in table.rows[:most])]
    widths = [max(_width(row[i]) for row in cells) for i in range(len(table.columns))]
    lines = [shown(table.title)]
    if table.groups:
        lines.append(_group_line(table, widths))
    right = numeric(table)
    lines += ["  " + "  ".join(map(_aligned, row, widths, right)) for row in cells]
    if len(table.rows) > most:
        where = f" in {table.file}.csv" if table.file else ""
        lines.append(f"  ... and {len(table.rows) - most} more{where}")
    return "\n".join(line.rstrip() for line in lines)


def headings(table: Table) -> tuple[str, ...]:
    """Return the headings of the columns for display: those of the table, or the names without their units."""
    if table.headings:
        return table.headings
    return tuple(column.removesuffix("_mm").removesuffix("_mrad").replace("_", " ") for column in table.columns)


def _group_line(table: Table, widths: list[int]) -> str:
    """Put each group's heading above its columns, which widen where it is longer."""
    line = "  "
    start = 0
    for group, members in itertools.groupby(table.groups):
        columns = range(start, start + len(list(members)))
        start, heading = columns.stop, shown(group)
        width = sum(widths[i] for i in columns) + 2 * (len(columns) - 1)
        widths[columns[-1]] += max(0, _width(heading) - width)
        line += heading + " " * (max(width, _width(heading)) - _width(heading) + 2)
    return line


def numeric(table: Table) -> tuple[bool, ...]:
    """Mark the columns of numbers, which are aligned to the right."""
    return tuple(
        any(isinstance(row[i], int | float | np.number) for row in table.rows) for i in range(len(table.columns))
    )


def _aligned(cell: str, width: int, right: bool) -> str:
    space = " " * (width - _width(cell))
    return space + cell if right else cell + space


def _width(text: str) -> int:
    """Return the width of a text on a terminal, where Chinese characters take two columns."""
    return sum(2 if unicodedata.east_asian_width(character) in "WF" else 1 for character in text)
