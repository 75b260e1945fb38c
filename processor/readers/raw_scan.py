"""The record that all readers return, and how it is built."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from processor import large_arrays
from processor.model import Checked, Codes, Floats, InputError, Ints, Labels, Reason, column, optional, reason
from processor.plain_text import decoded

FAR = 10_000.0  # units; an origin is subtracted from coordinates beyond this
ORIGIN_STEP = 1_000.0  # units: round numbers, so that people and other software recognise the origin
MOST_NAMED = 5  # scans in a remark


@dataclass(frozen=True)
class RawScan(Checked):
    """One scan as stored in its file. Coordinates in the scan's frame are ``origin + points``, in ``unit``."""

    name: str
    points: Floats = column("n", 3)
    origin: Floats = dataclasses.field(
        default_factory=lambda: np.zeros(3), metadata={"shape": (3,), "dtype": np.float64}
    )
    intensity: Floats = column("n")
    position: Floats = optional(3)  # of the scanner, in the scan's frame
    T_project_scan: Floats = optional(4, 4)
    unit: str = ""  # "" = not given by the format
    unit_fault: Reason | None = None  # why the unit that the file states cannot be used
    remarks: tuple[Reason, ...] = ()  # on how the file was read, see :func:`summed`
    station: Ints = column("n", dtype=np.int64)  # station that saw the point, from 1; 0 = unknown
    grid_row: Labels = column("n", dtype=np.int32)  # as stored; see scan_folder.scanner_grid
    grid_column: Labels = column("n", dtype=np.int32)
    colour: Codes = column("n", 3, dtype=np.uint8)  # red, green, blue
    scanned: str = ""  # day of the scan by the file, YYYY-MM-DD; "" = not given
    step: float = 0.0  # resolution of the coordinates in the file's number type; 0 = unlimited


def file_name_as_text(name: str) -> str:
    """Return the name of a file as text, decoded as GB18030 where it is not UTF-8."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return decoded(os.fsencode(name))
    return name


def scan_name(path: Path) -> str:
    """Return the name of a file's scan: the name of the file without suffix, as text."""
    return file_name_as_text(path.stem) or "scan"


def build_scan(
    path: Path,
    name: str,
    points: Floats,
    *,
    intensity: npt.ArrayLike = (),
    station: npt.ArrayLike = (),
    single: bool = False,
    **fields: Any,
) -> RawScan:
    """Build the record from coordinates (n, 3); an origin of whole thousands is subtracted in place where they are far.

    ``single``: coordinates are 32-bit floats in the file; ``fields``: others of the record. Raises InputError without
    points, and for coordinates that are not finite.
    """
    if not len(points):
        raise InputError(f"scan {name!r} holds no points; export it again", path=path)
    low, high = large_arrays.extremes(points)
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        raise InputError(
            f"{len(bad)} of {len(points)} points of {name!r} have coordinates that are not finite, "
            f"the first in row {bad[0] + 1}; remove them or export the scan again",
            path=path,
        )
    farthest = max(-low, high)
    origin = np.zeros(3)
    if farthest > FAR:
        # The median of a sample: a single point may be an outlier.
        sample = large_arrays.every(points, max(1, len(points) // 1000))
        origin = np.floor(np.sort(sample, axis=0)[len(sample) // 2] / ORIGIN_STEP) * ORIGIN_STEP
        for rows in large_arrays.blocks(len(points)):
            points[rows] -= origin
    with np.errstate(over="ignore"):
        step = float(np.spacing(np.float32(farthest))) if single else 0.0
    return RawScan(
        name,
        points,
        origin,
        intensity=large_arrays.contiguous(intensity, np.float64),
        station=large_arrays.contiguous(station, np.int64),
        step=step,
        **fields,
    )


def without_empty(path: Path, scans: Sequence[RawScan], empty: Sequence[str]) -> list[RawScan]:
    """Return the scans of a file, the first of which names those without points.

    Raises InputError where all are ``empty``.
    """
    if not scans:
        listed = ", ".join(map(repr, empty[:5]))
        raise InputError(f"expected points, found none in scan{'s' * (len(empty) > 1)} {listed}", path=path)
    if not empty:
        return list(scans)
    remark = reason("read.scans-without-points", count=len(empty), scans=tuple(empty))
    return [dataclasses.replace(scans[0], remarks=(*scans[0].remarks, remark)), *scans[1:]]


def summed(remarks: Iterable[Reason]) -> tuple[Reason, ...]:
    """Return one remark of each code, in order, of remarks with a ``count`` and the names of the ``scans``."""
    sums: dict[str, Reason] = {}
    for one in remarks:
        count, scans = one.values["count"], tuple(one.values["scans"])
        if one.code in sums:
            count, scans = sums[one.code].values["count"] + count, (*sums[one.code].values["scans"], *scans)
        sums[one.code] = reason(one.code, count=count, scans=scans[:MOST_NAMED])
    return tuple(sums.values())


def scaled_in_place(raw: RawScan, factors: Floats) -> Floats:
    """Return the points times factors (3,), in the record's memory; the record must not be used afterwards."""
    points: Floats = raw.points
    points.flags.writeable = True
    # One factor is much faster than three along rows of three.
    one = (factors == factors[0]).all()
    for rows in large_arrays.blocks(len(points) if not one or factors[0] != 1.0 else 0):
        points[rows] *= factors[0] if one else factors
    return points
