"""PTX: a grid a scan, each with its scanner's pose; points stay in the scanner's frame. Metres.

A scan is: columns, rows; the scanner's position; its three axes; the 4x4 matrix for row vectors, so it is transposed
here; then a line a grid cell ``x y z intensity [r g b]``. A cell of ``0 0 0`` had no return and is left out.
"""

from __future__ import annotations

import dataclasses
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from processor.model import Floats, InputError
from processor.readers.raw import RawScan, check_room, make, parsing

SUFFIXES = (".ptx",)
UNIT = "m"
SHORTEST_ROW = 6  # bytes: "0 0 0" and its end of line
RIGID_TOLERANCE = 1e-3  # of R^T R from the identity: matrices are often written with few digits


def read(path: Path) -> list[RawScan]:
    """Read every grid of a PTX file as a scan."""
    scans: list[RawScan] = []
    size = path.stat().st_size
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        while (first := _next_line(file)) is not None:
            number = len(scans) + 1
            scans.append(_read_grid(path, file, first, number, size))
    if not scans:
        raise InputError(f"{path}: holds no scans")
    if len(scans) == 1:
        return scans
    return [_renamed(scan, f"{path.stem}-{i}") for i, scan in enumerate(scans, 1)]


def _renamed(scan: RawScan, name: str) -> RawScan:
    return dataclasses.replace(scan, name=name)


def _next_line(file: TextIO) -> str | None:
    return next((line for line in iter(file.readline, "") if line.strip()), None)


def _read_grid(path: Path, file: TextIO, first: str, number: int, size: int) -> RawScan:
    head = [first, *islice(file, 9)]
    widths = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
    try:
        rows = [[float(word) for word in line.split()] for line in head]
        columns, lines = int(head[0]), int(head[1])
    except (ValueError, IndexError):
        rows = []
    if len(rows) != 10 or any(len(row) != width for row, width in zip(rows, widths, strict=True)):
        raise InputError(
            f"{path}: scan {number} has no PTX header of ten lines (columns, rows, position, axes, matrix); "
            "the file is cut off or damaged, or declares fewer cells than it holds"
        )
    cells = columns * lines
    if columns < 1 or lines < 1:
        raise InputError(f"{path}: scan {number} declares a grid of {columns} x {lines} cells")
    check_room(path, "PTX", cells, SHORTEST_ROW, size)
    T_project_scan = _rigid(path, number, np.array(rows[6:]).T)
    with parsing(path, "PTX"):
        data = np.loadtxt(islice(file, cells), ndmin=2, comments=None)
    if len(data) != cells or data.shape[1] < 3:
        raise InputError(
            f"{path}: scan {number} declares {cells} cells of three columns or more, "
            f"found {len(data)} of {data.shape[1]}; copy or export it again"
        )
    returned = (data[:, :3] != 0.0).any(axis=1)
    if not returned.any():
        raise InputError(f"{path}: scan {number} holds no returns, only cells of 0 0 0")
    position = T_project_scan[:3, :3].T @ (np.array(rows[2]) - T_project_scan[:3, 3])
    intensity = data[returned, 3] if data.shape[1] in (4, 7) else ()
    return make(
        path,
        path.stem,
        data[returned, :3],
        unit=UNIT,
        intensity=intensity,
        position=position,
        T_project_scan=T_project_scan,
    )


def _rigid(path: Path, number: int, T: Floats) -> Floats:
    """Return the pose with its rotation made exact. Raises InputError for a matrix that scales, mirrors or shears."""
    R = T[:3, :3]
    off = float(np.abs(R.T @ R - np.eye(3)).max()) if np.isfinite(T).all() else float("nan")
    if not (off < RIGID_TOLERANCE and np.linalg.det(R) > 0 and np.abs(T[3] - [0, 0, 0, 1]).max() < RIGID_TOLERANCE):
        raise InputError(
            f"{path}: the matrix of scan {number} is not a rotation and a translation "
            f"(R^T R is {off:.3g} off the identity, determinant {np.linalg.det(R):.3g}); export the scan unscaled"
        )
    u, _, vt = np.linalg.svd(R)
    exact = np.eye(4)
    exact[:3, :3], exact[:3, 3] = u @ vt, T[:3, 3]
    return exact
