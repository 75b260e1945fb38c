"""Control points from files: ``[[control]]`` of project.toml, or a table ``control.csv``."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from processor.model import Control, Floats, InputError, Scan, Stations
from processor.readers.common import decoded, parsing
from processor.scan_folder.checked_toml import Table, inside
from processor.scan_folder.units import MM_PER_UNIT

CONTROL = "control.csv"
KEYS = ("name", "position", "sd_mm", "scan", "seen", "seen_sd_mm")
COLUMNS = ("name", "scan", "x", "y", "z", "sd_mm")
LARGEST_FILE = 16 * 2**20


@dataclass(frozen=True)
class Measured:
    """A target's place (3,) with its standard deviation, in the file's own unit: as known, or as seen in ``scan``."""

    where: str  # in which file this stands
    name: str
    scan: str  # of a scan or station; empty: the place is known, in the project's frame
    place: Floats
    sd_mm: float


def read_control(folder: Path, project: Table) -> tuple[tuple[Measured, ...], Path | None]:
    """Read what project.toml says of control points, and the table that holds them where there is one.

    ``control`` is a list of tables, or names a CSV file; without, control.csv is read where it is there. Raises
    InputError for what cannot be used.
    """
    said = project.values.get("control")
    if isinstance(said, list):
        return tuple(one for table in project.tables("control") for one in _of_table(table)), None
    if said is None and not (folder / CONTROL).exists():
        return (), None
    path = inside(folder, project.text("control", CONTROL), project.where)
    return tuple(_of_csv(path)), path


def _of_table(table: Table) -> list[Measured]:
    table.only(KEYS)
    name = table.text("name")
    found = []
    if "position" in table.values:
        found.append(Measured(table.where, name, "", table.array("position", 3), table.number("sd_mm", positive=True)))
    if "scan" in table.values or "seen" in table.values:
        sd = _not_negative(table.where, table.number("seen_sd_mm", 0.0))
        found.append(Measured(table.where, name, table.text("scan"), table.array("seen", 3), sd))
    if not found:
        raise InputError(f"{table.where}: expected 'position' with 'sd_mm', or 'scan' with 'seen', found neither")
    return found


def _not_negative(where: str, sd_mm: float) -> float:
    if not 0.0 <= sd_mm < np.inf:
        raise InputError(f"{where}: expected a standard deviation of 0 mm or more, found {sd_mm}")
    return sd_mm


def _of_csv(path: Path) -> list[Measured]:
    if not path.is_file() or path.stat().st_size > LARGEST_FILE:
        raise InputError(f"{path}: expected a table of control points, found a folder or more than 16 MB")
    try:
        text = decoded(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    with parsing(path, "CSV"):
        rows = [(line, row) for line, row in enumerate(csv.reader(text.splitlines()), 1) if any(map(str.strip, row))]
    header = tuple(name.strip().lower() for name in rows[0][1]) if rows else ()
    if sorted(header) != sorted(COLUMNS):
        raise InputError(f"{path}: expected columns {','.join(COLUMNS)}, found {','.join(header)[:80]!r}")
    found = []
    for line, row in rows[1:]:
        where = f"{path}: line {line}"
        cells = dict(zip(header, (cell.strip() for cell in row), strict=False))
        try:
            place = np.array([float(cells[axis]) for axis in "xyz"])
            sd_mm = float(cells["sd_mm"] or "0")
        except (KeyError, ValueError):
            raise InputError(f"{where}: expected {','.join(COLUMNS)}, found {row}") from None
        if not cells["name"] or not np.isfinite(place).all():
            raise InputError(f"{where}: expected a name and finite coordinates, found {row}")
        if not cells["scan"] and not 0.0 < sd_mm < np.inf:
            raise InputError(f"{where}: expected sd_mm above 0 for coordinates that are known, found {sd_mm:g}")
        found.append(Measured(where, cells["name"], cells["scan"], place, _not_negative(where, sd_mm)))
    return found


def control_points(
    measured: Sequence[Measured],
    scans: Sequence[Scan],
    units: Sequence[str],
    stations: Stations | None,
    unit: str,
) -> Control | None:
    """Put known and seen places together; None without any.

    ``units`` are those of the scans' coordinates, ``unit`` is that of known ones. Raises InputError for a target that
    is seen but not known, one given twice, a scan or station that is not there, and where no target was seen at all.
    """
    if not measured:
        return None
    known = [one for one in measured if not one.scan]
    row = {one.name: i for i, one in enumerate(known)}
    for i, one in enumerate(known):
        if row[one.name] != i:
            raise InputError(f"{one.where}: control point {one.name!r} has coordinates already; give them once")
    seen = [one for one in measured if one.scan]
    if not seen:
        raise InputError(f"{known[0].where}: no control point is seen in a scan; say where one has it ('scan', 'seen')")
    point: list[int] = []
    scan: list[int] = []
    station: list[int] = []
    place: list[Floats] = []
    for one in seen:
        if one.name not in row:
            raise InputError(f"{one.where}: {one.name!r} is seen in {one.scan!r}, but has no coordinates of its own")
        s, k = _saw(one, scans, stations)
        if (row[one.name], s, k) in zip(point, scan, station, strict=True):
            raise InputError(f"{one.where}: {one.name!r} is seen in {one.scan!r} twice; give one place")
        point.append(row[one.name])
        scan.append(s)
        station.append(k)
        place.append(one.place * MM_PER_UNIT[units[s]])
    return Control(
        tuple(one.name for one in known),
        np.array([one.place for one in known]) * MM_PER_UNIT[unit],
        np.array([one.sd_mm for one in known]),
        np.array(point),
        np.array(scan),
        np.array(station),
        np.array(place),
        np.array([one.sd_mm for one in seen]),
    )


def _saw(one: Measured, scans: Sequence[Scan], stations: Stations | None) -> tuple[int, int]:
    """Row of the scan that saw a target, and of the station where the scan is of several (-1 = the scan's own)."""
    named = [i for i, scan in enumerate(scans) if one.scan == scan.name]
    named = named or [i for i, scan in enumerate(scans) if one.scan == scan.station]
    if len(named) > 1:
        raise InputError(f"{one.where}: {one.scan!r} is the station of several scans; name the scan")
    merged = [i for i, scan in enumerate(scans) if not scan.position.size and len(scan.point_station)]
    if named and named[0] not in merged:
        return named[0], -1
    if stations is not None and one.scan in stations.ids and merged:
        if len(merged) > 1:
            raise InputError(f"{one.where}: station {one.scan!r} is one of several clouds'; join them first")
        return merged[0], stations.ids.index(one.scan)
    if named:
        raise InputError(f"{one.where}: scan {one.scan!r} is of several stations; name the one that saw {one.name!r}")
    there = [*(scan.name for scan in scans), *(stations.ids if stations is not None and merged else ())]
    raise InputError(f"{one.where}: there is no scan or station {one.scan!r}; there are {', '.join(there)}")
