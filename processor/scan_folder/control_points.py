"""Control points from files: ``[[control]]`` of project.toml, or a table ``control.csv``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from processor.model import Control, InputError, Scan, Stations
from processor.scan_folder.file_values import existing_file_in
from processor.scan_folder.files import CONTROL
from processor.scan_folder.project_file import ControlPoint
from processor.scan_folder.text_files import csv_table
from processor.scan_folder.units import MM_PER_UNIT, FileUnit

COLUMNS = ("name", "scan", "x", "y", "z", "sd_mm")
LARGEST_FILE = 16 * 2**20  # bytes: 200,000 rows; no network has a hundredth of it


def read_control(
    folder: Path, given: tuple[ControlPoint, ...] | Path | None
) -> tuple[tuple[ControlPoint, ...], Path | None]:
    """Return the control points of project.toml, or those of a CSV file with its path.

    Without either control.csv is read if it exists. Raises InputError for malformed entries.
    """
    if isinstance(given, tuple):
        return given, None
    if given is None and not (folder / CONTROL).exists():
        return (), None
    path = given or existing_file_in(folder, CONTROL, str(folder))
    return tuple(_from_csv(path)), path


def _from_csv(path: Path) -> list[ControlPoint]:
    if not path.is_file():
        raise InputError("expected a file of control points, found a folder", path=path)
    if path.stat().st_size > LARGEST_FILE:
        raise InputError(
            f"expected at most {LARGEST_FILE} bytes, found {path.stat().st_size}; is it the right file?", path=path
        )
    measured = []
    for where, cells in csv_table(path, COLUMNS):
        row, name, scan = list(cells.values()), cells["name"], cells["scan"]
        try:
            position = np.array([float(cells[axis]) for axis in "xyz"])
            sd_mm = float(cells["sd_mm"] or "0")
        except ValueError:
            raise InputError(f"{where}: expected {','.join(COLUMNS)}, found {row}") from None
        if not name or not np.isfinite(position).all():
            raise InputError(f"{where}: expected a name and finite coordinates, found {row}")
        if not scan and not 0.0 < sd_mm < np.inf:
            raise InputError(f"{where}: expected sd_mm above 0 for known coordinates, found {sd_mm:g}")
        if not 0.0 <= sd_mm < np.inf:
            raise InputError(f"{where}: expected a standard deviation of 0 mm or more, found {sd_mm}")
        measured.append(
            ControlPoint(name, scan=scan, seen=position, seen_sd_mm=sd_mm, where=where)
            if scan
            else ControlPoint(name, position=position, sd_mm=sd_mm, where=where)
        )
    return measured


def control_points(
    measured: Sequence[ControlPoint],
    scans: Sequence[Scan],
    units: Sequence[FileUnit],
    stations: Stations | None,
    unit: str,
    searched: bool = False,
) -> Control | None:
    """Combine known and seen positions of targets; None without any.

    ``units`` are those of the scans' coordinates, ``unit`` is that of known ones. Raises InputError for a target that
    is seen but not known, or given twice, for an unknown scan or station, and if no target is seen at all, unless the
    scans are ``searched`` for them.
    """
    if not measured:
        return None
    known = [target for target in measured if target.position is not None]
    row = {target.name: i for i, target in enumerate(known)}
    for i, target in enumerate(known):
        if row[target.name] != i:
            raise InputError(f"{target.where}: control point {target.name!r} has coordinates already; give them once")
    seen = [target for target in measured if target.seen is not None]
    if not seen and not searched:
        raise InputError(
            f"{known[0].where}: no control point was measured in a scan; give 'scan' and 'seen' for one, or [targets] "
            "to search the scans for them"
        )
    views: list[tuple[int, int, int]] = []  # rows of the point, of the scan and of the station
    for target in seen:
        if target.name not in row:
            raise InputError(
                f"{target.where}: {target.name!r} is seen in {target.scan!r}, but has no known coordinates; give them"
            )
        view = (row[target.name], *_scan_and_station(target, scans, stations))
        if view in views:
            raise InputError(f"{target.where}: {target.name!r} is seen in {target.scan!r} twice; give one place")
        views.append(view)
    point, scan, station = np.array(views, np.int64).reshape(-1, 3).T
    return Control(
        tuple(target.name for target in known),
        positions=np.array([target.position for target in known]) * MM_PER_UNIT[unit],
        sd=np.array([target.sd_mm for target in known]),
        point=point,
        scan=scan,
        station=station,
        seen=np.array([target.seen * units[s].factors for target, s in zip(seen, scan, strict=True)]).reshape(-1, 3),
        seen_sd=np.array([target.seen_sd_mm for target in seen]),
    )


def _scan_and_station(target: ControlPoint, scans: Sequence[Scan], stations: Stations | None) -> tuple[int, int]:
    """Return the row of the scan that saw a target, and of the station in a merged scan (-1 = the scan's own)."""
    named = [i for i, scan in enumerate(scans) if target.scan == scan.name]
    named = named or [i for i, scan in enumerate(scans) if target.scan == scan.station]
    if len(named) > 1:
        raise InputError(f"{target.where}: {target.scan!r} is the station of several scans; name the scan")
    merged = [i for i, scan in enumerate(scans) if not scan.position.size and len(scan.point_station)]
    if named and named[0] not in merged:
        return named[0], -1
    if stations is not None and target.scan in stations.ids and merged:
        if len(merged) > 1:
            raise InputError(f"{target.where}: station {target.scan!r} is in several merged clouds; join them first")
        return merged[0], stations.ids.index(target.scan)
    if named:
        raise InputError(
            f"{target.where}: scan {target.scan!r} has several stations; name the one that saw {target.name!r}"
        )
    known = [*(scan.name for scan in scans), *(stations.ids if stations is not None and merged else ())]
    raise InputError(f"{target.where}: unknown scan or station {target.scan!r}; expected one of {', '.join(known)}")
