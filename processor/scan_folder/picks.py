"""picks.csv of a scan folder: common points picked in two scans each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from processor.model import InputError, Picks, Scan
from processor.scan_folder.text_files import csv_table
from processor.scan_folder.units import MM_PER_UNIT

COLUMNS = ("scan_a", "scan_b", "point", "xa", "ya", "za", "xb", "yb", "zb")


def read_picks(path: Path, scans: Sequence[Scan], unit: str) -> Picks:
    """Read picked points, whose coordinates are in the ``unit`` of the scans.

    Raises InputError, which names the line, for malformed rows and for scans that do not exist.
    """
    known = {scan.name for scan in scans}
    names_a, names_b, point_names, numbers = [], [], [], []
    for where, cells in csv_table(path, COLUMNS):
        a, b, point, *row = (cells[name] for name in COLUMNS)
        for name in (a, b):
            if name not in known:
                raise InputError(f"{where}: there is no scan {name!r}; there are {', '.join(sorted(known))}")
        if a == b:
            raise InputError(f"{where}: expected two scans, found {a!r} twice; name two scans")
        try:
            values = [float(cell) for cell in row]
        except ValueError:
            raise InputError(f"{where}: expected six numbers, found {row}") from None
        if not np.isfinite(values).all():
            raise InputError(f"{where}: expected finite numbers, found {row}")
        names_a.append(a)
        names_b.append(b)
        point_names.append(point)
        numbers.append(values)
    if not numbers:
        raise InputError("holds no points; expected three or more for each pair of scans", path=path)
    table = np.array(numbers) * MM_PER_UNIT[unit]
    return Picks(tuple(names_a), tuple(names_b), tuple(point_names), table[:, :3], table[:, 3:])
