"""Tables of numbers: XYZ, TXT, ASC, CSV, PTS. Any separator, header or none, decimal point or comma.

Without a header the first three columns are x, y, z, and a fourth is the intensity where there are four columns or
seven. A first line of one whole number is the count of points.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from processor.model import Floats, InputError
from processor.readers.raw import (
    INTENSITY_NAMES,
    STATION_NAMES,
    RawScan,
    check_room,
    decoded,
    first_named,
    make,
    parsing,
)

SUFFIXES = (".asc", ".csv", ".pts", ".txt", ".xyz")
UNIT = ""
SNIFFED = 65_536
COMMENTS = ("#", "//", "%")
UNITS_IN_HEADERS = r"(mm|cm|m|ft|in)?"


@dataclass(frozen=True)
class Layout:
    """How a table is written."""

    skip: int = 0  # lines before the first row
    declared: int = -1  # points, -1 where no line says
    header: tuple[str, ...] = ()
    separator: str | None = None  # None: blanks
    decimal_comma: bool = False
    columns: int = 0
    comments_between: bool = False
    encoding: str = "latin-1"


def read(path: Path) -> list[RawScan]:
    """Read a table of points as one scan."""
    layout = sniff(path)
    axes, intensity, station, unit = _columns(path, layout)
    check_room(path, "text", max(layout.declared, 0), 6, path.stat().st_size)
    wanted = [*axes, *(one for one in (intensity, station) if one is not None)]
    with parsing(path, "text"):
        data = rows(path, layout, wanted)
    if layout.declared >= 0 and len(data) != layout.declared:
        raise InputError(
            f"{path}: the first line declares {layout.declared} points, but {len(data)} follow; export it again"
        )
    return [
        make(
            path,
            path.stem,
            data[:, :3],
            unit=unit,
            intensity=data[:, 3] if intensity is not None else (),
            station=data[:, -1] if station is not None else (),
        )
    ]


def rows(path: Path, layout: Layout, columns: list[int]) -> Floats:
    """Return columns (n, k) of a table; ValueError where a row is not of numbers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of numpy, for a table without rows: seen by who asked
        found: Floats = np.loadtxt(
            _normalised(path, layout) if layout.decimal_comma else path,
            delimiter=None if layout.decimal_comma else layout.separator,
            comments=list(COMMENTS) if layout.comments_between else "#",
            skiprows=0 if layout.decimal_comma else layout.skip,
            usecols=columns,
            ndmin=2,
            encoding=layout.encoding,
        )
    return found


def sniff(path: Path) -> Layout:
    """Find how a table is written from its first lines. Raises InputError where no row of numbers is among them."""
    with path.open("rb") as file:
        head = file.read(SNIFFED)
    encoding = (
        "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig" if head[:3] == b"\xef\xbb\xbf" else ""
    )
    if not encoding and b"\0" in head:
        raise InputError(f"{path}: expected a table of numbers as text, found binary data")
    text = head.decode(encoding, "replace") if encoding else decoded(head)
    encoding = encoding or "latin-1"  # never fails, and only numbers are read with it
    lines = text.splitlines()
    declared, header = -1, ""
    for number, line in enumerate(lines):
        stripped = line.strip()
        comment = stripped.startswith(COMMENTS)
        if declared < 0 and not header and re.fullmatch(r"\d+", stripped):
            declared = int(stripped)
            continue
        separator, comma = _separator(stripped)
        cells = _cells(stripped, separator, comma)
        if stripped and not comment and all(map(_is_number, cells)) and len(cells) >= 3:
            names = tuple(_cells(header, *_separator(header))) if header else ()
            later = any(one.strip().startswith(COMMENTS[1:]) for one in lines[number:])
            return Layout(number, declared, names, separator, comma, len(cells), later, encoding)
        if stripped:
            header = re.sub(r"^(#|//|%)+\s*", "", stripped)
    raise InputError(
        f"{path}: expected rows of at least three numbers x y z, found {lines[0][:60]!r}"
        if lines
        else f"{path}: expected rows of numbers, found none"
    )


def _separator(line: str) -> tuple[str | None, bool]:
    """Separator of a line (None = blanks) and whether its numbers have a decimal comma."""
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


def _columns(path: Path, layout: Layout) -> tuple[list[int], int | None, int | None, str]:
    """Columns of x, y, z, of the intensity and of the station, and the unit that a header names."""
    names = [re.sub(r'["\']', "", name).strip() for name in layout.header]
    found = [first_named(names, rf"{axis}([\s_\[(]*{UNITS_IN_HEADERS}[\])]?)") for axis in "xyz"]
    if len(names) == layout.columns and all(found):
        intensity, station = first_named(names, INTENSITY_NAMES), first_named(names, STATION_NAMES)
        units = {re.fullmatch(rf".[\s_\[(]*{UNITS_IN_HEADERS}[\])]?", name or "", re.IGNORECASE) for name in found}
        said = {(match.group(1) or "").lower() for match in units if match}
        if len(said) != 1:
            raise InputError(f"{path}: the header gives x, y, z in different units ({', '.join(layout.header)})")
        axes = [names.index(name) for name in found if name is not None]
        others = [names.index(name) if name else None for name in (intensity, station)]
        return axes, others[0], others[1], said.pop()
    if any(found) and len(names) != layout.columns:
        raise InputError(
            f"{path}: the header names {len(names)} columns ({' '.join(names)[:80]}), but rows have {layout.columns}"
        )
    return [0, 1, 2], 3 if layout.columns in (4, 7) else None, None, UNIT


def _normalised(path: Path, layout: Layout) -> Iterator[str]:
    with path.open(encoding=layout.encoding) as file:
        yield from _pointed(islice(file, layout.skip, None))


def _pointed(lines: Iterable[str]) -> Iterator[str]:
    """Lines with decimal points and blanks for separators."""
    to = str.maketrans({",": ".", ";": " "})
    return (line.translate(to) for line in lines)
