"""What every reader hands over, and the checks that all formats share."""

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

FAR = 10_000.0  # units; beyond this an origin is taken off
ORIGIN_STEP = 1_000.0


@dataclass(frozen=True)
class RawScan(Checked):
    """One scan as its file has it. The coordinate in the scan's frame is ``origin + points``, in ``unit``."""

    name: str
    points: Floats = column("n", 3)
    origin: Floats = dataclasses.field(
        default_factory=lambda: np.zeros(3), metadata={"shape": (3,), "dtype": np.float64}
    )
    intensity: Floats = column("n")
    position: Floats = optional(3)  # of the scanner, in the scan's frame
    T_project_scan: Floats = optional(4, 4)
    unit: str = ""  # "" = the format does not say
    station: Ints = column("n", dtype=np.int64)  # number of the station a point was seen from, from 1; 0 = unknown
    grid_row: Labels = column("n", dtype=np.int32)  # as the file has them: whether they are a scanner's is not known
    grid_column: Labels = column("n", dtype=np.int32)
    step: float = 0.0  # what two coordinates differ by at least, in the type the file has them in; 0 = nothing


# How readers get the arrays they fill: in a process of its own (see apart) they lie in memory shared with the other.
_new_array: Callable[[tuple[int, ...], type], npt.NDArray[Any]] = np.empty


def room_for(*shape: int, dtype: type = np.float64) -> npt.NDArray[Any]:
    """Return an array to be filled; of what is never written no memory is taken."""
    return _new_array(shape, dtype)


def give_room_by(new_array: Callable[[tuple[int, ...], type], npt.NDArray[Any]]) -> None:
    """Let another function make the arrays of ``room_for``."""
    global _new_array
    _new_array = new_array


def stem(path: Path) -> str:
    """Return how a file calls its scan: its name without suffix, as text."""
    return text_of(path.stem) or "scan"


def text_of(name: str) -> str:
    """Return the name of a file as text: by GB18030 where its bytes are no UTF-8."""
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
    """Make the record from coordinates (n, 3), taking off an origin of whole thousands, in place, where they are far.

    ``grid``: rows and columns (n,) of the scanner's grid. ``single``: the file has the coordinates in 32 bits. Raises
    InputError for no points, and for coordinates that are not finite.
    """
    if not len(points):
        raise InputError(f"{path}: scan {name!r} holds no points")
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
        # The middle of a sample: the first point may be a stray one.
        sample = points[:: max(1, len(points) // 1000)]
        origin = np.floor(np.sort(sample, axis=0)[len(sample) // 2] / ORIGIN_STEP) * ORIGIN_STEP
        points -= origin
    with np.errstate(over="ignore"):
        step = float(np.spacing(np.float32(farthest))) if single else 0.0
    return RawScan(
        name,
        points,
        origin,
        np.asarray(intensity, np.float64),
        np.asarray(position, np.float64),
        np.asarray(T_project_scan, np.float64),
        unit,
        np.asarray(station, np.int64),
        *(grid or (np.empty(0, np.int32),) * 2),
        step,
    )


def used_up(raw: RawScan, factor: float) -> Floats:
    """Return the points times a factor, in the record's own memory: the record is not to be used afterwards."""
    points: Floats = raw.points
    points.flags.writeable = True
    if factor != 1.0:
        points *= factor
    return points


@contextmanager
def parsing(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a format's library raises within into an InputError that names the file.

    Native readers written in Rust panic with a BaseException, so that is caught here; an interrupt passes.
    """
    try:
        yield
    except (InputError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        said = (str(error).strip().splitlines() or [""])[0][:200]
        raise InputError(
            f"{path}: not a readable {kind} file: {said or type(error).__name__}; copy or export it again"
        ) from error


def check_room(path: Path, kind: str, declared: int, least_bytes: float, room: int) -> None:
    """Raise InputError where ``declared`` points of at least ``least_bytes`` each cannot lie in ``room`` bytes."""
    if declared < 0 or declared * least_bytes > room:
        raise InputError(
            f"{path}: the header declares {declared} points, but the file has only {room} bytes for them; "
            f"this {kind} file is cut off or damaged: copy or export it again"
        )


def decoded(data: bytes) -> str:
    """Text of bytes in UTF-8 or, failing that, GB18030 (sites in China), or else with marks for what is neither."""
    for encoding in ("utf-8-sig", "gb18030"):
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    return data.decode("utf-8", "replace")


def first_named(columns: Any, pattern: str) -> str | None:
    """First of some column names that matches a pattern as a whole, case aside."""
    return next((name for name in columns if re.fullmatch(pattern, name, re.IGNORECASE)), None)


INTENSITY_NAMES = r"(scalar_)?(intensity|reflectance|reflectivity|amplitude)|i"
STATION_NAMES = r"(scalar_)?station"


# --- Records of fixed size, and columns filled from pieces: what binary PLY and PCD share.


PIECE_BYTES = 1 << 19  # small enough to stay in a processor's own cache between the passes over it


def of_records(file: BinaryIO, dtype: Any, wanted: Sequence[str], count: int) -> Iterator[Sequence[Any]]:
    """Give the wanted fields, as columns, of the next ``count`` records of a file, piece by piece.

    Each piece is good until the next one is asked for.
    """
    size = dtype.itemsize
    text = bytearray(max(1, min(count, PIECE_BYTES // size)) * size)
    view = memoryview(text)
    while count > 0:
        filled = 0
        while filled < len(view) and (got := file.readinto(view[filled:])):  # type: ignore[attr-defined]
            filled += got
        records = np.frombuffer(text, dtype, min(filled // size, count))
        if not len(records):
            return
        count -= len(records)
        yield [records[name] for name in wanted]


def fill(columns: Sequence[Floats], pieces: Iterable[Any]) -> None:
    """Fill columns, the first of them (n, 3), the others (n,), from pieces: lists of columns, or arrays (m, k).

    Raises ValueError where the pieces hold fewer rows.
    """
    found, count = 0, len(columns[0])
    for piece in pieces:
        if isinstance(piece, np.ndarray):
            rows = slice(found, found + len(piece))
            columns[0][rows] = piece[:, :3]
            parts = list(piece.T)
        else:
            parts = piece
            rows = slice(found, found + len(parts[0]))
            for axis in range(3):
                columns[0][rows, axis] = parts[axis]
        for values, part in zip(columns[1:], parts[3:], strict=True):
            values[rows] = part
        found += len(parts[0])
    if found != count:
        raise ValueError(f"{count} points are declared, but {found} were found")
