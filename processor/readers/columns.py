"""Columns of tables and records: found by name, and filled piece by piece."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

import processor.readers.pieces as progress_of
from processor import column_names
from processor.large_arrays import allocate
from processor.model import Floats, InputError
from processor.readers.colours import of_columns

OTHERS = {  # names of columns that are not coordinates
    "intensity": r"(scalar_)?(intensity|reflectance|reflectivity|amplitude)|i",
    "station": r"(scalar_)?station",
}
COLOURS = {"red": r"(diffuse_)?r(ed)?", "green": r"(diffuse_)?g(reen)?", "blue": r"(diffuse_)?b(lue)?"}
PIECE_BYTES = 1 << 19  # fits in the cache of a processor core between the passes over it


def first_named(columns: Any, pattern: str) -> str | None:
    """Return the first column name that matches a whole pattern, ignoring case; None without one."""
    return next((name for name in columns if re.fullmatch(pattern, name, re.IGNORECASE)), None)


class Wanted(NamedTuple):
    """Columns that a scan is made of, counted from 0: x, y and z, then ``others`` (of OTHERS and COLOURS).

    ``unit`` is that which the names of coordinates give, "" for none.
    """

    columns: tuple[int, ...]
    others: tuple[str, ...] = ()
    unit: str = ""

    def room(self, count: int) -> list[Any]:
        """Return arrays for ``count`` rows: coordinates (n, 3), then a column (n,) for each of the others."""
        types = (np.float32 if name in COLOURS else np.float64 for name in self.others)
        return [allocate(count, 3), *(allocate(count, dtype=dtype) for dtype in types)]

    def fields(self, others: Iterable[Any]) -> dict[str, Any]:
        """Return the fields of a scan, but for its coordinates, from the columns (n,) of the others."""
        found = dict(zip(self.others, others, strict=True))
        colour = of_columns([found.pop(name) for name in COLOURS if name in found])
        return {"unit": self.unit, "colour": colour, **found}


def wanted(path: Path, names: Sequence[str], colours: bool = True) -> Wanted | None:
    """Return the columns to be read by their names, None where these do not name x, y and z; colours are three or none.

    Raises InputError for two columns of one axis, and for coordinates in different units.
    """
    try:
        named = column_names.coordinates(names)
    except column_names.AmbiguousNamesError as error:
        raise InputError(f"{error}; leave one of them out, or name it otherwise", path=path) from None
    if named is None:
        return None
    if len(set(named.units)) != 1:
        raise InputError(f"expected x, y, z in one unit, found different units ({', '.join(names)[:120]})", path=path)
    found = {key: first_named(names, pattern) for key, pattern in (OTHERS | COLOURS).items()}
    used = {key: names.index(name) for key, name in found.items() if name is not None}
    places = [used.get(key, -1) for key in COLOURS]
    if not colours or min(places) < 0 or {*places} & {*named.columns}:
        used = {key: place for key, place in used.items() if key in OTHERS}
    return Wanted((*named.columns, *used.values()), tuple(used), named.units[0])


def columns_of_records(file: BinaryIO, dtype: Any, wanted: Sequence[str], count: int) -> Iterator[Sequence[Any]]:
    """Yield the wanted fields, as columns, of the next ``count`` records of a file, piece by piece.

    A piece is valid until the next one is requested.
    """
    size = dtype.itemsize
    text = bytearray(max(1, min(count, PIECE_BYTES // size)) * size)
    view = memoryview(text)
    while count > 0:
        filled = 0
        while filled < len(view) and (read := file.readinto(view[filled:])):  # type: ignore[attr-defined]
            filled += read
        records = np.frombuffer(text, dtype, min(filled // size, count))
        if not len(records):
            return
        count -= len(records)
        yield [records[name] for name in wanted]


def fill_columns(columns: Sequence[Floats], pieces: Iterable[Any]) -> None:
    """Fill columns, the first of them (n, 3), the others (n,), from pieces: lists of columns, or arrays (m, k).

    Raises ValueError if the pieces have fewer than n rows.
    """
    filled, count = 0, len(columns[0])
    for piece in pieces:
        if isinstance(piece, np.ndarray):
            rows = slice(filled, filled + len(piece))
            columns[0][rows] = piece[:, :3]
            parts = list(piece.T)
        else:
            parts = piece
            rows = slice(filled, filled + len(parts[0]))
            for axis in range(3):
                columns[0][rows, axis] = parts[axis]
        for values, part in zip(columns[1:], parts[3:], strict=True):
            values[rows] = part
        filled += len(parts[0])
        progress_of.read(len(parts[0]), filled, count)
    if filled != count:
        raise ValueError(f"expected {count} points as declared, found {filled}")
