"""PTX: a grid per scan, each with the pose of its scanner; points stay in the scanner's frame. Metres.

A scan has lines for its columns, its rows, the scanner's position, the scanner's three axes, the 4x4 matrix for row
vectors (transposed here), and for each grid cell ``x y z intensity [r g b]``, column by column. A cell of ``0 0 0`` had
no return and is left out; the others keep their row and column.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numba import njit

import processor.readers.pieces as pieces
from processor.large_arrays import allocate
from processor.model import FARTHEST_MM, SAMPLED_POINTS, Codes, Floats, InputError, Labels, reason
from processor.readers.ascii_rows import Rows
from processor.readers.file_checks import check_declared_points, check_last_row, errors_name_the_file
from processor.readers.raw_scan import RawScan, build_scan, scan_name, without_empty

SUFFIXES = (".ptx",)
UNIT, MM_PER_UNIT = "m", 1000.0  # of the format
SHORTEST_ROW = 6  # bytes: "0 0 0" and its end of line
MOST_LINES = 2**31 - 1  # rows or columns of a grid: they are stored as int32
RIGID_TOLERANCE = 1e-3  # of R^T R - I: matrices are often written with few digits


def read(path: Path) -> list[RawScan]:
    """Read every grid of a PTX file as a scan."""
    scans, empty = list[RawScan](), list[str]()
    size = path.stat().st_size
    check_last_row(path, "PTX")
    with path.open("rb") as file:
        rows = Rows(file)
        with errors_name_the_file(path, "PTX"):
            first = rows.line()
        while first is not None:
            number = len(scans) + len(empty) + 1
            scan = _read_grid(path, rows, first, number, size)
            if scan is None:
                empty.append(f"{scan_name(path)}-{number}")
            else:
                scans.append(scan)
            with errors_name_the_file(path, "PTX"):
                first = rows.line()
    if not scans and not empty:
        raise InputError("expected scans, found none", path=path)
    if len(scans) + len(empty) == 1:
        name = scan_name(path)
        remarks = tuple(reason(one.code, count=1, scans=(name,)) for scan in scans for one in scan.remarks)
        scans, empty = [dataclasses.replace(scan, name=name, remarks=remarks) for scan in scans], [name for _ in empty]
    return without_empty(path, scans, empty)


def _read_grid(path: Path, rows: Rows, first: str, number: int, size: int) -> RawScan | None:
    """Read a grid and its header, whose first line is ``first``; None where no cell has a return."""
    widths = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
    with errors_name_the_file(path, "PTX"):
        head = [first, *(rows.line() or "" for _ in range(9))]
    try:
        numbers = [[float(word) for word in line.split()] for line in head]
        columns, lines = int(head[0]), int(head[1])
    except ValueError:
        numbers = []
    if len(numbers) != 10 or any(len(row) != width for row, width in zip(numbers, widths, strict=True)):
        raise InputError(
            f"scan {number} has no PTX header of ten lines (columns, rows, position, axes, matrix); "
            "the file is cut off or damaged, or has more cells than declared: export it again",
            path=path,
        )
    cells = columns * lines
    if columns < 1 or lines < 1:
        raise InputError(
            f"expected a grid of 1 x 1 cells or more, found {columns} x {lines} in scan {number}", path=path
        )
    check_declared_points(path, "PTX", cells, SHORTEST_ROW, size)
    matrix = np.array(numbers[6:])
    # Whether a matrix (4, 4) as written has its translation in the last column, and not in the last row
    for_columns = bool(
        np.abs(matrix[3] - [0, 0, 0, 1]).max() < RIGID_TOLERANCE and np.abs(matrix[:3, 3]).max() > RIGID_TOLERANCE
    )
    T_project_scan = _rigid(path, number, matrix if for_columns else matrix.T)
    with errors_name_the_file(path, "PTX"):
        width = rows.width()
        wide = width in (4, 7)
        points, intensity = allocate(cells, 3), allocate(cells if wide else 0)
        # A cloud without a grid is often written as one row or column.
        gridded = cells if min(columns, lines) > 1 and max(columns, lines) <= MOST_LINES else 0
        row, column = (allocate(gridded, dtype=np.int32) for _ in range(2))
        colour = allocate(cells if width == 7 else 0, 3, dtype=np.uint8)
        read = count = 0
        for piece in rows.pieces(tuple(range(width if wide else 3)), cells, width if wide else 0):
            count = copy_returns(piece, read, lines, count, points, (intensity, colour), (row, column))
            read += len(piece)
            pieces.read(len(piece), rows.bytes_read(), rows.size)
    if read != cells:
        raise InputError(f"expected {cells} cells in scan {number}, found {read}; copy or export it again", path=path)
    if not count:
        return None
    name = f"{scan_name(path)}-{number}"
    return build_scan(
        path,
        name,
        points[:count],
        unit=UNIT,
        intensity=intensity[:count],
        colour=colour[:count],
        position=_scanner(np.array(numbers[2]), T_project_scan, points[:count]),
        T_project_scan=T_project_scan,
        grid_row=row[:count],
        grid_column=column[:count],
        remarks=(reason("read.matrix-for-columns", count=1, scans=(name,)),) if for_columns else (),
    )


def _scanner(stated: Floats, T_project_scan: Floats, points: Floats) -> Floats:
    """Return the scanner's position (3,) in the scan's frame from that of the header, in the project's frame.

    A header of 0 0 0 above a matrix with a translation says nothing: points are in the scanner's frame. Where that
    cannot be, as of points on a map, the position is unknown: (0,).
    """
    if not stated.any():
        sample = points[:: max(1, len(points) // SAMPLED_POINTS)]
        near = np.linalg.norm(sample, axis=1).min() * MM_PER_UNIT < FARTHEST_MM
        return np.zeros(3 if near else 0)
    position: Floats = T_project_scan[:3, :3].T @ (stated - T_project_scan[:3, 3])
    return position


def _rigid(path: Path, number: int, T: Floats) -> Floats:
    """Return the pose with the nearest rotation. Raises InputError for a matrix that scales, mirrors or shears."""
    R = T[:3, :3]
    off = float(np.abs(R.T @ R - np.eye(3)).max()) if np.isfinite(T).all() else float("nan")
    if not (off < RIGID_TOLERANCE and np.linalg.det(R) > 0 and np.abs(T[3] - [0, 0, 0, 1]).max() < RIGID_TOLERANCE):
        raise InputError(
            f"the matrix of scan {number} is not a rotation and a translation "
            f"(R^T R is {off:.3g} off the identity, determinant {np.linalg.det(R):.3g}); export the scan unscaled",
            path=path,
        )
    u, _, vt = np.linalg.svd(R)
    exact = np.eye(4)
    exact[:3, :3], exact[:3, 3] = u @ vt, T[:3, 3]
    return exact


@njit(cache=True, nogil=True)
def copy_returns(
    cells: Floats,
    first: int,
    lines: int,
    count: int,
    points: Floats,
    values: tuple[Floats, Codes],
    grid: tuple[Labels, Labels],
) -> int:
    """Copy the cells (n, 3, 4 or 7) that are not ``0 0 0`` behind the ``count`` returns copied before.

    Cells are in order of columns of ``lines`` cells; the first one has the number ``first``. Fills ``points`` (m, 3)
    and those that are not empty of intensity (m,) and colour (m, 3) in ``values``, and of row and column (m,) in
    ``grid``. Returns the number of all returns.
    """
    intensity, colour = values
    row, column = grid
    c, r = divmod(first, lines)
    for i in range(len(cells)):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        if x != 0.0 or y != 0.0 or z != 0.0:
            points[count, 0], points[count, 1], points[count, 2] = x, y, z
            if len(intensity):
                intensity[count] = cells[i, 3]
            if len(colour):
                for k in range(3):
                    colour[count, k] = np.uint8(min(max(cells[i, 4 + k], 0.0), 255.0))
            if len(row):
                row[count], column[count] = r, c
            count += 1
        r += 1
        if r == lines:
            r, c = 0, c + 1
    return count
