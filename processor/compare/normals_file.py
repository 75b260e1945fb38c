"""Normals of core points from a file: nx, ny, nz, one row a core point, with or without coordinates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from processor.model import Floats, InputError
from processor.readers import ply, text
from processor.readers.columns import first_named
from processor.readers.file_checks import errors_name_the_file

NAMES = tuple(rf"(n|normal_?){axis}" for axis in "xyz")
UNIT_LENGTH = 0.1  # difference of a normal's length from 1 allowed in columns without names


def read(path: Path, core: Floats, origin: Floats, tolerance: float) -> Floats:
    """Read unit normals (k, 3) for core points (k, 3), which are relative to ``origin``, in their order.

    PLY, or text with columns nx, ny, nz by name, or three columns, or six with x, y, z first. Raises InputError if
    their number differs from the core points', if one has no length, or lies farther than ``tolerance`` from its core
    point; without names also if they are not unit vectors, as they may be coordinates or colours. A normal of NaN stays
    NaN: its core point has none.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    suffix = path.suffix.lower()
    if suffix == ".ply":
        named, (points, normals) = True, _from_ply(path)
    elif suffix in text.SUFFIXES:
        named, points, normals = _from_text(path)
    else:
        raise InputError(f"{path}: expected normals as PLY or text ({', '.join(text.SUFFIXES)}), found {suffix!r}")
    if len(normals) != len(core):
        raise InputError(f"{path}: expected a normal for each of {len(core)} core points, found {len(normals)}")
    if points is not None:
        distance = np.linalg.norm(points - origin - core, axis=1)
        if len(distance) and not distance.max() <= tolerance:
            row = int(np.argmax(np.where(np.isfinite(distance), distance, np.inf)))
            raise InputError(f"{path}: row {row + 1} lies elsewhere than its core point; expected the same order")
    length = np.linalg.norm(normals, axis=1)
    bad = np.flatnonzero(~(length > 0.0) & ~np.isnan(length) | np.isinf(length))
    if len(bad):
        raise InputError(f"{path}: the normal in row {bad[0] + 1} has no direction; expected nx, ny, nz")
    far = np.flatnonzero(np.abs(length - 1.0) > UNIT_LENGTH)
    if len(far) and not named:
        raise InputError(
            f"{path}: row {far[0] + 1} has the length {length[far[0]]:.6g}; expected unit normals nx, ny, nz (length "
            "1), not coordinates; columns named nx, ny, nz may have any length"
        )
    with np.errstate(invalid="ignore"):
        unit: Floats = normals / length[:, None]
    return unit


def _from_ply(path: Path) -> tuple[Floats | None, Floats]:
    from plyfile import PlyData

    ply.read_header(path)
    with errors_name_the_file(path, "PLY"):
        data: Any = PlyData.read(str(path))["vertex"].data
    return _by_name(path, data.dtype.names, lambda name: np.asarray(data[name], np.float64))


def _from_text(path: Path) -> tuple[bool, Floats | None, Floats]:
    """Return whether columns have names, points (k, 3) or None, and normals (k, 3)."""
    layout = text.sniff(path)
    data = text.numbers(path, layout)
    names = [name.strip("\"' ") for name in layout.header]
    if len(names) == layout.columns and any(first_named(names, pattern) for pattern in NAMES):
        return True, *_by_name(path, names, lambda name: data[:, names.index(name)])
    if layout.columns == 3:
        return False, None, data
    if layout.columns == 6:
        return False, data[:, :3], data[:, 3:]
    raise InputError(f"{path}: expected columns nx, ny, nz by name, 3 columns or 6; found {layout.columns}")


def _by_name(path: Path, names: Any, column: Any) -> tuple[Floats | None, Floats]:
    normal = [first_named(names, pattern) for pattern in NAMES]
    if not all(normal):
        raise InputError(f"{path}: expected columns nx, ny, nz, found {', '.join(names)[:80]}")
    point = [first_named(names, axis) for axis in "xyz"]
    normals = np.column_stack([column(name) for name in normal])
    return (np.column_stack([column(name) for name in point]) if all(point) else None), normals
