"""A point cloud to be written: its points in blocks, so that no writer holds all of them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from processor.model import Floats, Scan

BLOCK = 1 << 19  # points
METRES = 0.001  # of a millimetre
# Names of the columns with a meaning in the formats; all others are scalar fields.
INTENSITY, STATION, ROW, COLUMN = "intensity", "station", "row", "column"
COLOURS = ("red", "green", "blue")
GRID = (ROW, COLUMN)


class Block(NamedTuple):
    """Some points of a cloud.

    ``points`` (n, 3) are in mm less the cloud's origin; ``fields`` are columns (n,) by name, those of the cloud.
    """

    points: Floats
    fields: Mapping[str, Any]


@dataclass(frozen=True)
class Cloud:
    """A cloud of points whose coordinates are ``origin`` (3,) + points, in mm.

    ``fields`` are the types of its columns by name: ``intensity``, ``red``, ``green`` and ``blue``, ``station`` (from
    1, 0 = unknown), ``row`` and ``column`` of the scanner's grid, and scalar fields. ``blocks`` yields its points once
    or more often, ``count`` is their number where it is known before. ``T_project_scan`` (4, 4) is written by formats
    that hold poses (E57); empty = none. ``comments`` are written by formats that hold text (PLY). ``brightest`` is the
    intensity that formats with whole numbers write as their greatest; 0 = intensities are such numbers already.
    ``largest`` limits columns of whole numbers, ``identity`` is what distinguishes the content from that of others.
    """

    name: str
    fields: Mapping[str, np.dtype[Any]]
    blocks: Callable[[], Iterator[Block]]
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    count: int | None = None
    T_project_scan: Floats = field(default_factory=lambda: np.empty(0))
    comments: tuple[str, ...] = ()
    brightest: float = 0.0
    largest: Mapping[str, int] = field(default_factory=dict)
    identity: bytes = b""


def columns_of(scan: Scan, rows: slice = slice(None)) -> dict[str, Any]:
    """Return the columns of some rows of a scan that a file can hold, by name."""
    fields: dict[str, Any] = {}
    if len(scan.intensity):
        fields[INTENSITY] = scan.intensity[rows].astype(np.float32)
    if len(scan.colour):
        fields |= dict(zip(COLOURS, scan.colour[rows].T, strict=True))
    if len(scan.point_station):
        fields[STATION] = scan.point_station[rows] + np.int32(1)
    # A merged cloud has no grid: the rows and columns of its scans repeat.
    elif len(scan.grid_row):
        fields[ROW], fields[COLUMN] = scan.grid_row[rows], scan.grid_column[rows]
    return fields


def of_scan(scan: Scan) -> Cloud:
    """Return the cloud of a scan in memory, in the scan's frame."""

    def blocks() -> Iterator[Block]:
        for start in range(0, len(scan.points), BLOCK):
            rows = slice(start, start + BLOCK)
            yield Block(scan.points[rows], columns_of(scan, rows))

    columns = columns_of(scan)
    return Cloud(
        scan.name,
        {name: column.dtype for name, column in columns.items()},
        blocks,
        scan.origin,
        len(scan.points),
        T_project_scan=scan.T_project_scan,
        brightest=max(float(scan.intensity.max(initial=0.0)), 1e-12),
        largest={name: int(columns[name].max(initial=0)) for name in GRID if name in columns},
        identity=hashlib.sha256(b"".join([scan.origin.tobytes(), scan.points.tobytes()])).digest(),
    )
