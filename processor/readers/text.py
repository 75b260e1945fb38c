"""Tables of numbers: XYZ, TXT, ASC, CSV, PTS. Any separator, header or none, decimal point or comma.

A header names the columns, see :mod:`processor.column_names`. Without one the first three are x, y, z; the fourth is
the intensity of tables with four or seven columns, the last three of seven are the colour. A line of one whole number
before the rows is the number of points.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

import processor.readers.pieces as pieces
from processor import column_names, large_arrays
from processor.large_arrays import allocate
from processor.model import Floats, InputError
from processor.plain_text import decoded
from processor.readers.ascii_rows import Rows
from processor.readers.columns import COLOURS, Wanted, wanted
from processor.readers.file_checks import check_declared_points, check_last_row, errors_name_the_file
from processor.readers.raw_scan import RawScan, build_scan, scan_name

SUFFIXES = (".asc", ".csv", ".pts", ".txt", ".xyz")
SNIFFED = 65_536  # bytes: hundreds of rows, from which separator, header and columns are told
SHORTEST_ROW = 6  # bytes: "0 0 0" and its end of line
COMMENTS = ("#", "//", "%")
COUNTED = 5  # rows by which a column of row numbers is recognised
SAMPLED = 200  # rows
MOST_COLUMNS = 1_000  # exports of the trade have some twenty
MOST_OTHERS = 0.1  # share of sampled rows of another width that are errors, not a habit of the file
GRID_HEAD = r"(ncols|nrows|[xy]ll(corner|center)|cellsize|nodata_value)\s+\S+"  # of ESRI ASCII grids


@dataclass(frozen=True)
class Layout:
    """The format of a table."""

    skip: int = 0  # lines before the first row
    declared: int = -1  # number of points, -1 where no line declares it
    header: tuple[str, ...] = ()  # cells of the line that names the columns, else of the last line before the first row
    remark: bool = False  # whether that line begins as a comment and names no coordinates
    separator: str | None = None  # None: blanks
    decimal_comma: bool = False
    columns: int = 0
    comments_between: bool = False
    encoding: str = "latin-1"
    sample: tuple[tuple[str, ...], ...] = ()  # of rows

    @property
    def width(self) -> int:
        """The number of columns that every row must have; 0 where the rows differ, as those that end in a remark."""
        others = sum(len(row) != self.columns for row in self.sample)
        return self.columns if others <= MOST_OTHERS * len(self.sample) else 0


def read(path: Path) -> list[RawScan]:
    """Read a table of points as one scan, or a PTS file of several scans, each after its number of points."""
    layout = sniff(path)
    check_last_row(path, "text")
    read = _columns(path, layout)
    size = path.stat().st_size
    tables, declared = [], layout.declared
    with errors_name_the_file(path, "text"), _opened(path, layout) as file:
        rows = _rows(file, layout)
        while True:
            check_declared_points(path, "text", max(declared, 0), SHORTEST_ROW, size)
            tables.append(_filled(rows, read.columns, declared, layout.width))
            following = rows.line()
            if following is None or declared < 0:
                break
            if not re.fullmatch(r"\d+", following):
                raise InputError(f"expected {declared} points as declared, found more; export it again", path=path)
            declared = int(following)
    names = [scan_name(path)] if len(tables) == 1 else [f"{scan_name(path)}-{i}" for i in range(1, len(tables) + 1)]
    return [
        build_scan(path, name, points, **read.fields(others.T))
        for name, (points, others) in zip(names, tables, strict=True)
    ]


def _filled(rows: Rows, wanted: Sequence[int], declared: int, width: int) -> tuple[Floats, Floats]:
    """Return coordinates (n, 3) and the other wanted columns (n, k) of the declared rows, for -1 of all rows."""
    room, count = declared if declared >= 0 else rows.likely_left(), 0
    points, others = allocate(room, 3), allocate(room, len(wanted) - 3)
    for piece in rows.pieces(wanted, declared if declared >= 0 else 2**62, width):
        if count + len(piece) > room:
            room = room + room // 4 + len(piece)
            points, others = (_grown(column[:count], room) for column in (points, others))
        points[count : count + len(piece)] = piece[:, :3]
        others[count : count + len(piece)] = piece[:, 3:]
        count += len(piece)
        pieces.read(len(piece), rows.bytes_read(), rows.size)
    if count < declared:
        raise ValueError(f"expected {declared} points as declared, found {count}")
    return points[:count], others[:count]


def _grown(column: Floats, room: int) -> Floats:
    larger = allocate(room, column.shape[1])
    for part in large_arrays.blocks(len(column)):
        larger[part] = column[part]
    return larger


def numbers(path: Path, layout: Layout) -> Floats:
    """Return all columns (n, k) of a table. Raises InputError for a cell that is not a number."""
    with errors_name_the_file(path, "text"), _opened(path, layout) as file:
        rows = _rows(file, layout)
        copies = [piece.copy() for piece in rows.pieces(range(layout.columns), width=layout.width)]
    return np.concatenate(copies) if copies else np.empty((0, layout.columns))


def _rows(file: BinaryIO, layout: Layout) -> Rows:
    rows = Rows(file, layout.separator, layout.decimal_comma, layout.comments_between)
    for _ in range(layout.skip):
        rows.skip_line()
    return rows


@contextmanager
def _opened(path: Path, layout: Layout) -> Iterator[BinaryIO]:
    """Open a table in an encoding that contains ASCII, after its byte order mark."""
    if layout.encoding == "utf-16":
        yield io.BytesIO(path.read_bytes().decode("utf-16", "replace").encode())
        return
    with path.open("rb") as file:
        file.seek(3 if layout.encoding == "utf-8-sig" else 0)
        yield file


def sniff(path: Path) -> Layout:
    """Determine the format of a table from its first lines. Raises InputError if none of them is a row of numbers."""
    with path.open("rb") as file:
        head = file.read(SNIFFED)
    encoding, text = _text(path, head)
    lines = text.splitlines()
    declared, before = -1, _Before()
    for number, line in enumerate(lines):
        stripped = line.strip()
        if declared < 0 and (before.coordinates or not before.last) and re.fullmatch(r"\d+", stripped):
            declared = int(stripped)
            continue
        separator, comma = _separator(stripped)
        cells = _cells(stripped, separator, comma)
        if len(cells) > MOST_COLUMNS:
            raise InputError(
                f"line {number + 1}: expected at most {MOST_COLUMNS} columns, found {len(cells)}", path=path
            )
        if stripped and not stripped.startswith(COMMENTS) and len(cells) >= 3 and before.is_row(cells):
            _check_passed_over(path, lines[:number], len(cells))
            whole = lines[number:-1] if len(head) == SNIFFED else lines[number:]
            rows = [row.strip() for row in whole[:SAMPLED] if row.strip()] or [stripped]
            # A first row of whole numbers does not show the decimal sign.
            comma = comma or (separator in (None, ";") and any(_separator(row) == (separator, True) for row in rows))
            return Layout(
                skip=number,
                declared=declared,
                header=before.coordinates or before.last,
                remark=before.remark and not before.coordinates,
                separator=separator,
                decimal_comma=comma,
                columns=len(cells),
                comments_between=any(mark in later for later in lines[number:] for mark in COMMENTS[1:]),
                encoding=encoding,
                sample=tuple(tuple(_cells(row, separator, comma)) for row in rows if not row.startswith(COMMENTS)),
            )
        if stripped:
            before.add(path, stripped)
    raise InputError(_no_rows(lines, before), path=path)


def _text(path: Path, head: bytes) -> tuple[str, str]:
    """Return the encoding in which a table is opened and the text of its first bytes."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16", head.decode("utf-16", "replace")
    if b"\0" in head:
        raise InputError("expected a table of numbers as text, found binary data", path=path)
    if len(head) == SNIFFED:
        head = head[: head.rfind(b"\n") + 1] or head  # a cut within a character would look like another encoding
    # Latin-1 never fails, and only numbers are decoded.
    return "utf-8-sig" if head[:3] == b"\xef\xbb\xbf" else "latin-1", decoded(head)


@dataclass
class _Before:
    """The lines before the first row, of which one may be a header."""

    last: tuple[str, ...] = ()  # cells of the last line
    remark: bool = False  # whether it begins as a comment
    coordinates: tuple[str, ...] = ()  # cells of the last line that names x, y and z
    axes: tuple[int, ...] = ()  # of it, the columns of x, y and z
    mixed: tuple[str, ...] = ()  # cells of the first line of three numbers and texts

    def add(self, path: Path, line: str) -> None:
        """Add a line. Raises InputError for the head of a grid of heights, and for two columns of one axis."""
        if re.fullmatch(GRID_HEAD, line, re.IGNORECASE):
            raise InputError(
                "expected rows of points, found a grid of heights (ESRI ASCII: ncols, nrows, cellsize); convert it to "
                "points, for example by gdal_translate -of XYZ",
                path=path,
            )
        text = re.sub(r"^(#|//|%)+\s*", "", line)
        self.remark, self.last = text != line, _header_cells(text)
        if not (self.mixed or self.remark) and sum(map(_is_number, self.last)) >= 3:
            self.mixed = self.last
        # Bytes that are not UTF-8 were read as Chinese.
        latin = () if text.isascii() else _header_cells(text.encode("gb18030", "replace").decode("latin-1"))
        for names in (self.last, latin):
            if named := wanted(path, names):
                self.coordinates, self.axes = names, named.columns[:3]
                return

    def is_row(self, cells: Sequence[str]) -> bool:
        """Whether all cells are numbers, or at least the coordinates by a header: other cells may be text."""
        wanted = self.axes if len(self.coordinates) == len(cells) else ()
        return all(map(_is_number, [cells[axis] for axis in wanted] or cells))


def _no_rows(lines: Sequence[str], before: _Before) -> str:
    """Return why none of the lines is a row of numbers."""
    if not lines:
        return "expected rows of numbers, found none"
    number = next((i for i, cell in enumerate(before.mixed) if not _is_number(cell)), 0)
    if before.mixed:
        return (
            f"column {number + 1} is text ({before.mixed[number][:40]!r}), so it is not known which are x, y, z; "
            "name the columns in a first line (such as name x y z), or leave the text out"
        )
    return f"expected rows of at least three numbers x y z, found {lines[0][:60]!r}"


def _header_cells(text: str) -> tuple[str, ...]:
    return tuple(re.sub(r"[\"']", "", cell).strip() for cell in _cells(text, *_separator(text)))


def _check_passed_over(path: Path, lines: Sequence[str], width: int) -> None:
    """Raise InputError for a line before the first row that has its columns, half of them numbers: a damaged row."""
    for number, line in enumerate(lines, 1):
        stripped = line.strip()
        cells = _cells(stripped, _separator(stripped)[0], True)
        if stripped.startswith(COMMENTS) or len(cells) != width or 2 * sum(map(_is_number, cells)) < width:
            continue
        raise InputError(
            f"line {number}: expected {width} numbers or the names of the columns, found {stripped[:60]!r}; "
            "correct it, or begin a remark with #",
            path=path,
        )


def _separator(line: str) -> tuple[str | None, bool]:
    """Return the separator of a line (None = blanks) and whether its numbers have a decimal comma."""
    if ";" in line:
        return ";", "," in line and "." not in line
    words = line.split()
    number = r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?"
    if "," in line and len(words) >= 3 and all(re.fullmatch(number, word) for word in words):
        return None, True
    if "," in line:
        return ",", False
    return ("\t", False) if "\t\t" in line else (None, False)


def _cells(line: str, separator: str | None, decimal_comma: bool) -> list[str]:
    if separator and line.endswith(separator):
        line = line[: -len(separator)]
    cells = [cell.strip() for cell in line.split(separator)]
    return [cell.replace(",", ".") for cell in cells] if decimal_comma else cells


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def _columns(path: Path, layout: Layout) -> Wanted:
    """Return the columns that the header names, else those by their number."""
    names = layout.header
    named = wanted(path, names)
    if named and len(names) == layout.columns:
        return named
    # A line of other words is a title or a remark.
    likely = 2 * column_names.count_known(names) > len(names) > 1
    if len(names) != layout.columns and (named or likely):
        raise InputError(
            f"the header names {len(names)} columns ({' '.join(names)[:80]}), but rows have {layout.columns}", path=path
        )
    if len(names) == layout.columns and (likely or not layout.remark):
        kind = column_names.other_kind(names)
        advice = f", which are {kind}; export Cartesian coordinates" if kind else "; correct the line of names"
        raise InputError(
            f"expected columns x, y, z or Easting, Northing, Height, found {', '.join(names)[:120]}{advice}", path=path
        )
    _check_plain(path, layout)
    others = {4: ("intensity",), 7: ("intensity", *COLOURS)}.get(layout.columns, ())
    return Wanted(tuple(range(3 + len(others))), others)


def _check_plain(path: Path, layout: Layout) -> None:
    """Raise InputError for a table without names of columns that is ambiguous."""
    rows = layout.sample
    if layout.columns == 6 and layout.separator == "," and all(re.fullmatch(r"[+-]?\d+", c) for r in rows for c in r):
        raise InputError(
            "commas are either separators of six whole numbers or decimal signs of three numbers; "
            "separate by semicolons, or name the columns in a first line",
            path=path,
        )
    leading = _leading_numbers(rows, layout.columns)
    if leading:
        first = ", ".join(" ".join(row[:leading]) for row in rows[:3])
        raise InputError(
            f"expected coordinates, found row numbers in the first column{'s' * (leading > 1)} ({first}, ...); "
            f"name the columns in a first line ({'row column' if leading > 1 else 'id'} x y z), or leave them out",
            path=path,
        )


def _leading_numbers(rows: Sequence[Sequence[str]], columns: int) -> int:
    """Return how many columns count rows: by one from row to row, or whole numbers before three with decimals."""
    if len(rows) < COUNTED or columns < 4 or any(len(row) != columns for row in rows):
        return 0
    counts = [row[0] for row in rows]
    if counts[0].isdecimal() and counts == [str(int(counts[0]) + i) for i in range(len(counts))]:
        return 1
    whole = [all(re.fullmatch(r"[+-]?\d+", row[i]) for row in rows) for i in range(columns)]
    return next((n for n in (2, 1) if columns >= n + 3 and all(whole[:n]) and not any(whole[n : n + 3])), 0)
