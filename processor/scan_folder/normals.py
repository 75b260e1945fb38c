"""Normals of core points from a file: nx, ny, nz, a row a core point, with or without coordinates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from processor.model import Floats, InputError
from processor.readers import text
from processor.readers.common import first_named, parsing

NAMES = tuple(rf"(n|normal_?){axis}" for axis in "xyz")
PLACES = tuple("xyz")
UNIT_LENGTH = 0.1  # how far from 1 the length of a normal may be in columns without names


def read(path: Path, core: Floats, origin: Floats, tolerance: float) -> Floats:
    """Read unit normals (k, 3) for core points (k, 3), which are coordinates less ``origin``, in their order.

    PLY or a table as text: columns nx, ny, nz by name, or three columns, or six after x, y, z. Raises InputError where
    they are not as many as the core points, have no length, or lie farther than ``tolerance`` from them; without names
    also where they are no unit vectors: coordinates or colours would be taken for normals.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    suffix = path.suffix.lower()
    if suffix == ".ply":
        named, (places, found) = True, _of_ply(path)
    elif suffix in text.SUFFIXES:
        named, places, found = _of_text(path)
    else:
        raise InputError(f"{path}: expected normals as PLY or text ({', '.join(text.SUFFIXES)}), found {suffix!r}")
    if len(found) != len(core):
        raise InputError(f"{path}: expected a normal for each of {len(core)} core points, found {len(found)}")
    if places is not None:
        off = np.linalg.norm(places - origin - core, axis=1)
        if len(off) and not off.max() <= tolerance:
            row = int(np.argmax(np.where(np.isfinite(off), off, np.inf)))
            raise InputError(f"{path}: row {row + 1} lies elsewhere than that core point; expected the same order")
    length = np.linalg.norm(found, axis=1)
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
        unit: Floats = found / length[:, None]
    return unit


def _of_ply(path: Path) -> tuple[Floats | None, Floats]:
    from plyfile import PlyData

    with parsing(path, "PLY"):
        data: Any = PlyData.read(str(path))["vertex"].data
    return _picked(path, data.dtype.names, lambda name: np.asarray(data[name], np.float64))


def _of_text(path: Path) -> tuple[bool, Floats | None, Floats]:
    """Return whether columns have names, places (k, 3) if there are any, and normals (k, 3)."""
    layout = text.sniff(path)
    data = text.numbers(path, layout)
    names = [name.strip("\"' ") for name in layout.header]
    if len(names) == layout.columns and any(first_named(names, one) for one in NAMES):
        return True, *_picked(path, names, lambda name: data[:, names.index(name)])
    if layout.columns == 3:
        return False, None, data
    if layout.columns == 6:
        return False, data[:, :3], data[:, 3:]
    raise InputError(f"{path}: expected columns nx, ny, nz by name, 3 columns or 6; found {layout.columns}")


def _picked(path: Path, names: Any, column: Any) -> tuple[Floats | None, Floats]:
    normal = [first_named(names, one) for one in NAMES]
    if not all(normal):
        raise InputError(f"{path}: expected columns nx, ny, nz, found {', '.join(names)[:80]}")
    place = [first_named(names, one) for one in PLACES]
    found = np.column_stack([column(name) for name in normal])
    return (np.column_stack([column(name) for name in place]) if all(place) else None), found
