"""Checks of the arguments of the Python interface: each error states what was expected and what came."""

from __future__ import annotations

import math
import os
from collections.abc import Collection
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from processor import large_arrays
from processor.model import Floats, Ints, UsageError

LEAST_EXTENT_MM = 2.0  # nothing that is scanned is smaller: the coordinates are in metres
MOST_RATIO = 30.0  # of the extents of two inputs of one thing; beyond it their units differ


def path_of(value: Any, name: str, others: str = "") -> Path:
    """Return a path. Raises UsageError for another object than a text or a path; ``others`` are named beside it."""
    path = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if isinstance(path, str) and "\0" not in path:
        return Path(path)
    found = type(value).__name__ if not isinstance(path, str) else "a text with a zero byte"
    raise UsageError(f"{name}: expected a path (text or pathlib.Path){others}, got {found}")


def length_of(value: Any, name: str, *, zero: bool = False, unit: str = " in mm") -> float:
    """Return a finite length above 0, or with ``zero`` 0 as well. Raises UsageError for anything else.

    Arrays of one number without an axis are lengths as well; True, texts and complex numbers are none.
    """
    number = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if isinstance(number, Real) and not isinstance(number, bool):
        try:
            length = float(number)
        except OverflowError:  # a whole number beyond the largest float
            length = math.inf
        if math.isfinite(length) and (length > 0.0 or (zero and length == 0.0)):
            return length
    wanted = "0 or a positive length" if zero else "a positive length"
    raise UsageError(f"{name}: expected {wanted}{unit}, got {_shown(value)}")


def _shown(value: Any) -> str:
    return f"an array of shape {value.shape}" if isinstance(value, np.ndarray) and value.ndim else repr(value)[:80]


def points_of(values: npt.ArrayLike, name: str, least: int, in_mm: bool = True) -> Floats:
    """Return an array of points (n, 3). Raises ValueError for another shape, too few, and with ``in_mm`` for metres."""
    points = finite(values, name)
    if points.ndim != 2 or points.shape[1] != 3:
        unit = " in mm" if in_mm else ""
        raise ValueError(f"{name}: expected an array (n, 3) of coordinates{unit}, got shape {points.shape}")
    if len(points) < least:
        raise ValueError(f"{name}: expected {least} points or more, got {len(points)}")
    if not in_mm or len(points) == 1:
        return points
    extent = extent_of(points)
    if extent == 0.0:
        raise ValueError(f"{name}: expected points at different places, got {len(points)} that all coincide")
    if extent < LEAST_EXTENT_MM:
        raise ValueError(
            f"{name}: span {extent:.4g}; expected coordinates in mm, these seem to be in metres: multiply them by 1000"
        )
    return points


def extent_of(points: Floats) -> float:
    """Longest side of the box around points (n, 3) along the axes."""
    return float(large_arrays.span(points).max())


def positions_of(values: npt.ArrayLike, name: str, shape: tuple[int, ...]) -> Floats:
    """Return the scanner's position for each point: (3,) for all, or one of ``shape`` (n, 3)."""
    positions = finite(values, name)
    if positions.shape not in ((3,), shape):
        raise ValueError(f"{name}: expected shape (3,) or {shape}, got {positions.shape}")
    return np.broadcast_to(positions, shape)


def normals_of(values: npt.ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Return unit normals of ``shape`` (k, 3). Raises ValueError for another shape or length."""
    normals = finite(values, "normals")
    if normals.shape != shape:
        raise ValueError(f"normals: expected shape {shape}, one normal per core point; got {normals.shape}")
    length = np.linalg.norm(normals, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > 1e-6)
    if len(wrong):
        raise ValueError(
            f"normals: expected unit vectors, got {len(wrong)} of {len(normals)} of another length, the first"
            f" {length[wrong[0]]:.6g} in row {wrong[0]}; divide each by its length"
        )
    return normals


def faces_of(values: npt.ArrayLike, corners: Floats, least_area_mm2: float) -> Ints:
    """Return the triangles (f, 3) of a mesh as rows of ``corners`` (v, 3).

    Raises ValueError for another shape or type, rows that are not there, and where no triangle has an area.
    """
    try:
        triangles = np.asarray(values)
    except ValueError:  # rows of different lengths
        raise ValueError("faces: expected an array (f, 3) of whole numbers, got rows of different lengths") from None
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise ValueError(f"faces: expected an array (f, 3) of whole numbers, got {triangles.dtype} {triangles.shape}")
    if not len(triangles):
        raise ValueError("faces: expected triangles, got none")
    if triangles.min() < 0 or triangles.max() >= len(corners):
        raise ValueError(f"faces: expected numbers of vertices from 0 to {len(corners) - 1}")
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    if not (np.linalg.norm(np.cross(b - a, c - a), axis=1) > least_area_mm2).any():
        raise ValueError(
            f"faces: expected triangles with an area, got {len(triangles)} whose corners coincide or lie on a line"
        )
    return triangles.astype(np.int64)


def finite(values: Any, name: str) -> Floats:
    """Return an array of finite real numbers. Raises ValueError for any other, and for one with masked values."""
    try:
        given = np.asanyarray(values)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected numbers in rows of one length, got {type(values).__name__}") from None
    if np.ma.is_masked(given):
        raise ValueError(f"{name}: expected numbers, got a masked array; leave the masked rows out")
    if given.dtype.kind == "O" and given.size and all(map(_is_number, given.flat)):
        given = given.astype(np.float64)
    if given.dtype.kind not in "iuf":
        came = given.dtype if isinstance(values, np.ndarray) else type(values).__name__
        raise ValueError(f"{name}: expected numbers, got {came}")
    array = np.asarray(given, np.float64)
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise ValueError(f"{name}: expected finite numbers, got {bad} of {array.size} that are NaN or infinite")
    return array


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def text_of(value: Any, name: str, known: Collection[str] = ()) -> str:
    """Return a text, one of ``known`` where these are given. Raises UsageError for anything else."""
    if not isinstance(value, str) or (known and value not in known):
        wanted = f"one of {', '.join(known)}" if known else "a text"
        raise UsageError(f"{name}: expected {wanted}, got {_shown(value)}")
    return value


def function_of(value: Any, name: str) -> None:
    """Raise UsageError for what cannot be called."""
    if not callable(value):
        raise UsageError(f"{name}: expected a function of one text, got {_shown(value)}")


def seed_of(value: Any) -> int:
    """Return a seed. Raises UsageError for anything else than a whole number from 0."""
    if isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 0:
        return int(value)
    raise UsageError(f"seed: expected a whole number from 0, got {_shown(value)}")
