"""What every reader hands over, and the checks that all formats share."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from processor.model import Checked, Floats, InputError, Ints, column, optional

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


def make(
    path: Path,
    name: str,
    xyz: npt.ArrayLike,
    *,
    unit: str,
    intensity: npt.ArrayLike = (),
    position: npt.ArrayLike = (),
    T_project_scan: npt.ArrayLike = (),
    station: npt.ArrayLike = (),
) -> RawScan:
    """Make the record from coordinates (n, 3), taking off an origin of whole thousands where they are far.

    Raises InputError for no points, and for coordinates that are not finite.
    """
    points = np.array(xyz, np.float64)
    if not len(points):
        raise InputError(f"{path}: scan {name!r} holds no points")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(
            f"{path}: {len(bad)} of {len(points)} points of {name!r} have coordinates that are not finite, "
            f"the first in row {bad[0] + 1}; remove them or export the scan again"
        )
    origin = np.zeros(3)
    if np.abs(points).max() > FAR:
        origin = np.floor(points[0] / ORIGIN_STEP) * ORIGIN_STEP
        points -= origin
    return RawScan(
        name,
        points,
        origin,
        np.asarray(intensity, np.float64),
        np.asarray(position, np.float64),
        np.asarray(T_project_scan, np.float64),
        unit,
        np.asarray(station, np.int64),
    )


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
