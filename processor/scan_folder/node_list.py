"""A table of a space frame's nodes, as surveyors and designers write it: name, coordinates, diameter or radius.

Columns are matched by the names of the trade. A size may have another unit than the coordinates: the one in its
heading, else the coordinates' own where sizes are usual in it, else millimetres as on drawings, else inches.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from processor import column_names
from processor.model import Floats, FrameDesign, InputError, Ints, Reason, UsageError, reason
from processor.scan_folder.text_files import csv_rows, read_text
from processor.scan_folder.units import MM_PER_UNIT, known_unit

SUFFIXES = (".csv", ".txt")
HEADINGS = {  # of columns, as one word in lower case
    "name": "id point pointno pointnr pointid pointname pointnumber pt ptno ptnr ptid node nodeno nodenr nodeid "
    "nodename nodenumber ball ballno ballid joint jointno jointid name label punkt punktnr punktnummer punktid pkt "
    "pktnr knoten knotennr knotennummer 点号 点名 节点 节点号 节点编号 球号 球编号 编号 名称",
    "number": "no nr num number numero 序号",  # names where there is no other column of names
    "radius": "radius radii r rad ballradius noderadius rayon radio 半径 球半径",
    "diameter": "diameter dia diam d ø dm od durchmesser kugeldurchmesser balldiameter balldia nodediameter "
    "spherediameter diametre diametro 直径 球径 球直径 外径",
}
KNOWN = {kind: frozenset(words.split()) for kind, words in HEADINGS.items()}
# Radii of balls: bolt balls of JG/T 10 have 50 to 150 mm, welded hollow ones of JG/T 11 up to 450 mm; smaller models.
USUAL_MM = (10.0, 500.0)


class _Header(NamedTuple):
    """Columns of name, x, y, z and size, the factor from size to radius, and the units stated, "" for none."""

    name: int
    at: tuple[int, int, int]
    size: int
    to_radius: float
    unit: str
    size_unit: str
    separator: str


def is_node_list(path: Path) -> bool:
    """Whether a file of text begins with names of the columns of nodes: a name, coordinates and a size."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(4096)
    first = next((line for line in start.decode("utf-8", "replace").splitlines() if line.strip()), "")
    names, _ = _cells(first)
    try:
        return _header(names, "") is not None
    except InputError:
        return True


def read_node_list(path: Path, table_unit: str) -> tuple[FrameDesign, tuple[Reason, ...]]:
    """Return the nodes of a table in mm, and what was taken of it that it does not state.

    ``table_unit`` is the unit of coordinates without one in their headings. Raises InputError for missing columns,
    sizes in no usual unit, and rows that do not fit.
    """
    first = next((line for line in read_text(path).splitlines() if line.strip()), "")
    names, separator = _cells(first)
    try:
        header = _header(names, separator)
    except InputError as error:
        raise InputError(str(error), path=path) from None
    if header is None:
        raise InputError(
            "expected columns id,x,y,z,radius, or such as PointNo,Easting,Northing,Height,Diameter, found "
            f"{first.strip()[:80]!r}; correct the headings",
            path=path,
        )
    try:
        unit = known_unit(header.unit or table_unit)
    except UsageError as error:
        raise InputError(str(error), path=path) from None
    ids, numbers = _rows(path, header, len(names))
    size_unit, guessed = _size_unit(header.size_unit, header.to_radius * numbers[:, 3], unit)
    if not size_unit:
        raise InputError(
            f"column {names[header.size]!r}: sizes such as {numbers[0, 3]:g} are usual for balls in none of "
            f"{unit}, mm and inch; state the unit in the heading, such as {names[header.size]}_mm",
            path=path,
        )
    columns = tuple(names[i] for i in header.at)
    remarks = []
    if [_word(name) for name in columns] != ["x", "y", "z"]:
        remarks.append(reason("units.node-list", columns=columns, size=names[header.size], nodes=len(ids)))
    if guessed and size_unit != unit:
        remarks.append(reason("units.node-sizes", column=names[header.size], units=size_unit, other=unit))
    numbered, labels = numbered_names(ids)
    radii = header.to_radius * numbers[:, 3] * MM_PER_UNIT[size_unit]
    return FrameDesign(numbered, numbers[:, :3] * MM_PER_UNIT[unit], radii, labels=labels), tuple(remarks)


def numbered_names(names: Sequence[str]) -> tuple[Ints, tuple[str, ...]]:
    """Return whole numbers (k,) for names, and the names where they are not these numbers themselves; else none."""
    whole = [int(name) if re.fullmatch(r"0|-?[1-9]\d{0,15}", name) else None for name in names]
    if all(number is not None and abs(number) < 2**53 for number in whole):
        return np.array(whole, np.int64), ()
    return np.arange(1, len(names) + 1), tuple(names)


def check_names(where: str, names: Sequence[str]) -> None:
    """Raise InputError for no names, one that is empty or not printable, and one that is given twice."""
    if not names:
        raise InputError(f"{where}: expected nodes, found none")
    seen: set[str] = set()
    for name in names:
        if not name or not name.isprintable():
            raise InputError(f"{where}: expected a printable id of each node, found {name[:40]!r}")
        if name in seen:
            raise InputError(f"{where}: id {name[:40]} is given more than once; give each node its own")
        seen.add(name)


def _cells(line: str) -> tuple[list[str], str]:
    """Return the cells of a line and what separates them."""
    separator = next((mark for mark in (";", "\t", ",") if mark in line), ",")
    return [cell.strip().strip('"\ufeff') for cell in line.split(separator)], separator


def _header(names: Sequence[str], separator: str) -> _Header | None:
    """Return the columns by their names; None where one is missing. Raises InputError for two of one meaning."""
    words = [_word(name) for name in names]
    named = [i for kind in ("name", "number") for i, word in enumerate(words) if word in KNOWN[kind]]
    sizes = [i for kind in ("radius", "diameter") for i, word in enumerate(words) if word in KNOWN[kind]]
    others = [name if i not in (*named, *sizes) else "" for i, name in enumerate(names)]
    try:
        places = column_names.coordinates(others)
    except column_names.AmbiguousNamesError as error:
        raise InputError(str(error)) from None
    if places is None or not named or not sizes:
        return None
    if len(set(places.units)) > 1:
        raise InputError(
            f"expected columns id,x,y,z,radius with coordinates of one unit, found {', '.join(names)[:80]}"
        )
    size = sizes[0]
    return _Header(
        name=named[0],
        at=places.columns,
        size=size,
        to_radius=1.0 if words[size] in KNOWN["radius"] else 0.5,
        unit=places.units[0],
        size_unit=column_names.meaning(names[size]).unit,
        separator=separator,
    )


def _word(name: str) -> str:
    """Return a name in lower case as one word, without accents, marks and unit."""
    plain = unicodedata.normalize("NFKD", unicodedata.normalize("NFKC", name).lower())
    plain = "".join(mark for mark in plain if not unicodedata.combining(mark))
    words = re.findall(r"[^\W\d_]+", plain)
    if len(words) > 1 and words[-1] in column_names.UNIT_WORDS:
        words = words[:-1]
    return "".join(words)


def _rows(path: Path, header: _Header, width: int) -> tuple[list[str], Floats]:
    """Return names and x, y, z, size (k, 4) of the rows below the header."""
    ids, numbers = [], []
    for line, row in csv_rows(path, header.separator)[1:]:
        if len(row) > width and any(cell.strip() for cell in row[width:]):
            raise InputError(f"line {line}: expected {width} cells, found {len(row)}: {row}", path=path)
        try:
            cells = [row[i].strip() for i in (*header.at, header.size)]
            values = [float(cell.replace(",", ".") if header.separator != "," else cell) for cell in cells]
            ids.append(row[header.name].strip())
        except (ValueError, IndexError):
            raise InputError(f"line {line}: expected id,x,y,z,radius, found {row}", path=path) from None
        if not np.isfinite(values).all() or values[3] <= 0:
            raise InputError(f"line {line}: expected finite numbers and a radius above 0, found {row}", path=path)
        numbers.append(values)
    check_names(str(path), ids)
    return ids, np.array(numbers)


def _size_unit(stated: str, radii: Floats, unit: str) -> tuple[str, bool]:
    """Return the unit of radii, stated or the first in which they are usual, and whether it was not stated.

    Of a few nodes that are no balls the size may be any, so the median decides. "" where no unit fits.
    """
    if stated:
        return known_unit(stated), False
    typical = float(np.median(radii))
    usual = [one for one in (unit, "mm", "inch") if USUAL_MM[0] <= typical * MM_PER_UNIT[one] <= USUAL_MM[1]]
    return (usual[0] if usual else ""), True
