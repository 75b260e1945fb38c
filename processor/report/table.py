"""A table for the page, a CSV file and the terminal."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import math
import unicodedata
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor.language.messages import Message, Messages, Text, label, messages, text
from processor.model import Checked, Reason, StepRun
from processor.plain_text import printable, spreadsheet_text
from processor.report.columns import Column, columns, given

NAN = float("nan")
MOST_DECIMALS = 4  # a tenth of a micrometre: no scanner tells more
PLUS_MINUS = "±"  # heads half-widths beside their values
JUDGED = ("nominal", "actual", "deviation", "value", "value_mm", "departure")  # have their interval in ci95


@dataclass(frozen=True)
class Table:
    """A titled table: in a CSV file of the name ``file`` where that is not empty, on the page and on the terminal.

    ``units`` stand behind the title; headings do not repeat them. CSV files have the names of the columns alone.
    """

    title: str | Message
    columns: tuple[Column, ...]
    rows: tuple[tuple[Any, ...], ...]
    file: str = ""
    note: str | Message = ""
    units: tuple[str, ...] = ()
    on_page: bool = True
    on_terminal: bool = True


def tabulate(title: str | Message, cells: Mapping[str, Any], file: str = "", note: Any = "", **shown: Any) -> Table:
    """Tabulate columns of one length n by their names.

    A matrix (n, k) has the names of its k columns, with blanks between them. ``shown`` are further fields of a table.
    """
    header = columns(*(name for names in cells for name in names.split()))
    return Table(title, header, rows_of(*cells.values()), file, note, **shown)


def rows_of(*cells: Any) -> tuple[tuple[Any, ...], ...]:
    """Return the rows of columns of one length n: arrays (n,) or (n, k), and sequences."""
    columns_of = (np.atleast_2d(one.T).tolist() if isinstance(one, np.ndarray) else [one] for one in cells)
    return tuple(zip(*itertools.chain.from_iterable(columns_of), strict=True))


def yes_no(flags: Iterable[Any]) -> list[Text]:
    """Word flags."""
    return [text("yes") if flag else text("no") for flag in flags]


def figures_of(title: str, runs: Sequence[StepRun], file: str) -> Table:
    """Tabulate the fields of results with a heading, a column per method; see :func:`processor.model.described`."""
    figures = [list(_figures(run.result)) for run in runs]
    rows = tuple((heading, *(of[i][1] for of in figures), unit) for i, (heading, _, unit) in enumerate(figures[0]))
    by_method = given(*(run.method for run in runs))
    return Table(label(title), (*columns("figure"), *by_method, *columns("unit")), rows, file)


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


def csv_of_rows(columns: Iterable[Column], rows: Iterable[Iterable[Any]], full: bool = False) -> str:
    """Write columns and rows as CSV; see :func:`csv_text`.

    With ``full`` the cells stand as they are: floats with all digits, nan for none, and texts that the caller has made
    safe by :func:`csv_cell`.
    """
    cells = rows if full else ([csv_cell(cell) for cell in row] for row in rows)
    return csv_lines([[column.name for column in columns]]) + csv_lines(cells)


def csv_lines(rows: Iterable[Iterable[Any]]) -> str:
    """Write rows as lines of CSV, their cells as they stand."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def csv_cell(cell: Any) -> Any:
    """Return a cell as CSV files have it: full numbers, and text that no spreadsheet executes."""
    if isinstance(cell, float | np.floating):
        return "" if not math.isfinite(cell) else repr(round(float(cell), 6))
    if isinstance(cell, str | Text | Reason | list | tuple):
        return spreadsheet_text(shown(cell))
    return cell


def shown(cell: Any, digits: int = 3) -> str:
    """Write a cell for people, messages in English: with decimals, a dash for no number, no control characters."""
    if isinstance(cell, Text | Reason | list | tuple):
        cell = messages("en").text(cell)
    if isinstance(cell, float | np.floating):
        return "–" if not math.isfinite(cell) else f"{round(float(cell), digits) + 0.0:.{digits}f}"  # no -0.00
    return printable(str(cell))


def decimals(half_width: Any, otherwise: int = 2) -> int:
    """Return how many decimals a value has whose interval has two digits (GUM 7.2.6): -5.98 ± 0.14, 12 ± 15."""
    if not isinstance(half_width, float | np.floating) or not (math.isfinite(half_width) and half_width > 0.0):
        return otherwise
    return min(max(1 - math.floor(math.log10(float(f"{half_width:.1e}"))), 0), MOST_DECIMALS)


def shown_rows(table: Table) -> Iterator[list[str]]:
    """Yield the cells of each row as written for people: numbers with the digits that their intervals support."""
    halves = _halves(table)
    for row in table.rows:
        yield [
            shown(cell, decimals(row[half]) if half >= 0 else column.decimals)
            for cell, column, half in zip(row, table.columns, halves, strict=True)
        ]


def _halves(table: Table) -> list[int]:
    """Return for each column the column of its half-widths, itself where it has half-widths, -1 where none has them."""
    rows = {column.name: i for i, column in enumerate(table.columns)}
    return [next((rows[name] for name in _half_widths(column.name) if name in rows), -1) for column in table.columns]


def _half_widths(name: str) -> Iterator[str]:
    """Yield the names that the column of half-widths of a column may have."""
    if "ci95" in name or name == "ci95":
        yield name
    else:
        stem, unit = (name.removesuffix("_mm"), "_mm") if name.endswith("_mm") else (name, "")
        yield from (f"ci95_{name}", f"{stem}_ci95{unit}")
        if name in JUDGED:
            yield f"ci95{unit}"


def plain_text(table: Table, most: int = 40) -> str:
    """Write a table for the terminal, columns aligned, at most so many rows."""
    english = messages("en")
    cells = [
        list(map(printable, headings(table, english))),
        *itertools.islice(shown_rows(table), most),
    ]
    widths = [max(_width(row[i]) for row in cells) for i in range(len(table.columns))]
    lines = [printable(title(table, english))]
    if above := groups(table, english):
        lines.append(_group_line(above, widths))
    right = numeric(table)
    lines += ["  " + "  ".join(map(_aligned, row, widths, right)) for row in cells]
    if len(table.rows) > most:
        where = f" in {table.file}.csv" if table.file else ""
        lines.append(f"  ... and {len(table.rows) - most} more{where}")
    return "\n".join(line.rstrip() for line in lines)


def title(table: Table, catalogue: Messages) -> str:
    """Return the title in a language, with the units of the table."""
    return _with_units(catalogue.text(table.title), table.units, catalogue)


def heading(column: Column, catalogue: Messages, stated: Collection[str] = ()) -> str:
    """Return a column's heading in a language with its unit, if that is not among the units ``stated`` above it."""
    if not column.heading:
        return catalogue.heading(column.unit)
    return _with_units(
        catalogue.heading(column.heading), () if column.unit in ("", *stated) else (column.unit,), catalogue
    )


def headings(table: Table, catalogue: Messages) -> tuple[str, ...]:
    """Return the headings of the columns in a language, with units that neither title nor group states."""
    of_columns = [(one, (*table.units, *units)) for _, members, units in _by_group(table) for one in members]
    halves = _halves(table)
    return tuple(
        PLUS_MINUS if i and halves[i - 1] == i and column.unit == table.columns[i - 1].unit
        else heading(column, catalogue, stated)
        for i, (column, stated) in enumerate(of_columns)
    )  # fmt: skip


def full_headings(table: Table, catalogue: Messages) -> tuple[str, ...]:
    """Return the headings of the columns with their groups and units, to be read without title and groups."""
    return tuple(
        ": ".join(filter(None, (catalogue.text(column.group), heading(column, catalogue)))) for column in table.columns
    )


def groups(table: Table, catalogue: Messages) -> list[tuple[str, int]]:
    """Return the headings above groups of columns, "" for none, and how many columns each has; [] without groups."""
    if not any(column.group for column in table.columns):
        return []
    return [
        (_with_units(catalogue.text(group), units, catalogue), len(members))
        for group, members, units in _by_group(table)
    ]


def _by_group(table: Table) -> Iterator[tuple[str | Message, list[Column], tuple[str, ...]]]:
    """Yield groups with their columns, and the unit that a group states as all of its columns with a unit have it."""
    for group, neighbours in itertools.groupby(table.columns, key=lambda column: column.group):
        members = list(neighbours)
        units = {column.unit for column in members} - {"", *table.units}
        yield group, members, tuple(units) if group and len(units) == 1 else ()


def _with_units(written: str, units: Sequence[str], catalogue: Messages) -> str:
    return f"{written} ({', '.join(map(catalogue.heading, units))})" if units else written


def _group_line(above: list[tuple[str, int]], widths: list[int]) -> str:
    """Put each group's heading above its columns, which widen where it is longer."""
    line = "  "
    start = 0
    for group, count in above:
        columns = range(start, start + count)
        start, heading = columns.stop, printable(group)
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
