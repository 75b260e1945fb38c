"""The record that all readers return, and the checks that all formats share."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from processor.model import Checked, Floats, InputError, Ints, Labels, column, optional

FAR = 10_000.0  # units; an origin is subtracted from coordinates beyond this
ORIGIN_STEP = 1_000.0


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
    station: Ints = column("n", dtype=np.int64)  # station that saw the point, from 1; 0 = unknown
    grid_row: Labels = column("n", dtype=np.int32)  # as stored; see scan_folder.scanner_grid
    grid_column: Labels = column("n", dtype=np.int32)
    step: float = 0.0  # resolution of the coordinates in the file's number type; 0 = unlimited


# How readers allocate the arrays they fill: in the process of ``sandbox`` they lie in shared memory.
_new_array: Callable[[tuple[int, ...], type], npt.NDArray[Any]] = np.empty


def room_for(*shape: int, dtype: type = np.float64) -> npt.NDArray[Any]:
    """Return an array to be filled; pages that are never written take no memory."""
    return _new_array(shape, dtype)


def give_room_by(new_array: Callable[[tuple[int, ...], type], npt.NDArray[Any]]) -> None:
    """Replace the function that allocates the arrays of ``room_for``."""
    global _new_array
    _new_array = new_array


def stem(path: Path) -> str:
    """Return the name of a file's scan: the name of the file without suffix, as text."""
    return text_of(path.stem) or "scan"


def text_of(name: str) -> str:
    """Return the name of a file as text, decoded as GB18030 where it is not UTF-8."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return decoded(os.fsencode(name))
    return name


def make(
    path: Path,
    name: str,
    points: Floats,
    *,
    unit: str,
    intensity: npt.ArrayLike = (),
    position: npt.ArrayLike = (),
    T_project_scan: npt.ArrayLike = (),
    station: npt.ArrayLike = (),
    grid: tuple[Labels, Labels] | None = None,
    single: bool = False,
) -> RawScan:
    """Build the record from coordinates (n, 3); an origin of whole thousands is subtracted in place where they are far.

    ``grid``: rows and columns (n,) of the scanner's grid. ``single``: coordinates are 32-bit floats in the file. Raises
    InputError without points, and for coordinates that are not finite.
    """
    if not len(points):
        raise InputError(f"{path}: scan {name!r} holds no points; export it again")
    low, high = float(points.min()), float(points.max())  # NaN where there is one
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        raise InputError(
            f"{path}: {len(bad)} of {len(points)} points of {name!r} have coordinates that are not finite, "
            f"the first in row {bad[0] + 1}; remove them or export the scan again"
        )
    farthest = max(-low, high)
    origin = np.zeros(3)
    if farthest > FAR:
        # The median of a sample: a single point may be an outlier.
        sample = points[:: max(1, len(points) // 1000)]
        origin = np.floor(np.sort(sample, axis=0)[len(sample) // 2] / ORIGIN_STEP) * ORIGIN_STEP
        points -= origin
    with np.errstate(over="ignore"):
        step = float(np.spacing(np.float32(farthest))) if single else 0.0
    return RawScan(
        name,
        points,
        origin,
        intensity=np.asarray(intensity, np.float64),
        position=np.asarray(position, np.float64),
        T_project_scan=np.asarray(T_project_scan, np.float64),
        unit=unit,
        station=np.asarray(station, np.int64),
        grid_row=grid[0] if grid else np.empty(0, np.int32),
        grid_column=grid[1] if grid else np.empty(0, np.int32),
        step=step,
    )


def used_up(raw: RawScan, factor: float) -> Floats:
    """Return the points times a factor, in the record's memory; the record must not be used afterwards."""
    points: Floats = raw.points
    points.flags.writeable = True
    if factor != 1.0:
        points *= factor
    return points


@contextmanager
def parsing(path: Path, kind: str) -> Iterator[None]:
    """Convert any error of a format's library into an InputError that names the file.

    Readers written in Rust panic with a BaseException, so it is caught too; an interrupt is not.
    """
    try:
        yield
    except (InputError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        message = (str(error).strip().splitlines() or [""])[0][:200] or type(error).__name__
        raise InputError(f"{path}: not a readable {kind} file: {message}; copy or export it again") from error


def check_room(path: Path, kind: str, declared: int, least_bytes: float, room: int) -> None:
    """Raise InputError if ``declared`` points of at least ``least_bytes`` each do not fit in ``room`` bytes."""
    if declared < 0 or declared * least_bytes > room:
        raise InputError(
            f"{path}: the header declares {declared} points, but the file has only {room} bytes for them; "
            f"this {kind} file is cut off or damaged: copy or export it again"
        )


def decoded(data: bytes) -> str:
    """Decode bytes as UTF-8, or else as GB18030, or else as UTF-8 with replacement characters."""
    for encoding in ("utf-8-sig", "gb18030"):
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    return data.decode("utf-8", "replace")


def first_named(columns: Any, pattern: str) -> str | None:
    """Return the first column name that matches a whole pattern, ignoring case; None without one."""
    return next((name for name in columns if re.fullmatch(pattern, name, re.IGNORECASE)), None)


INTENSITY_NAMES = r"(scalar_)?(intensity|reflectance|reflectivity|amplitude)|i"
STATION_NAMES = r"(scalar_)?station"


# --- Records of fixed size, and columns filled from pieces: used for binary PLY and PCD.


PIECE_BYTES = 1 << 19  # fits in the cache of a processor core between the passes over it


def of_records(file: BinaryIO, dtype: Any, wanted: Sequence[str], count: int) -> Iterator[Sequence[Any]]:
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


def fill(columns: Sequence[Floats], pieces: Iterable[Any]) -> None:
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
    if filled != count:
        raise ValueError(f"expected {count} points as declared, found {filled}")
