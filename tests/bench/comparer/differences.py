"""Files of results as numbers and texts by their places, and where those of two files differ.

A number is equal if it is within ``tolerance`` of itself, times the larger of the two numbers, or of the largest number
of its vector: a coordinate is as good as the point's, not as its distance from a plane through the origin. Of an array
of one axis the vector is the whole array, of a square matrix the shorter of the row and the column, as of a pose whose
rotation is not to count by its translation. Numbers nearer to each other than FLOOR are equal as well.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import h5py
import numpy as np

FILES = ("results.h5", "results.json", "compare.json", "compare.csv")
TOLERANCE = 1e-9
# Of the tolerance; mm, rad or 1: 1e-10 mm at 1e-9. A coordinate of 30 m has steps of 4e-12 mm in double precision, so a
# difference of coordinates that is zero is some such steps. Of covariances its square.
FLOOR = 0.1
FLOAT32 = 2.0**-22  # two steps of a number that is stored in single precision
# Parts of places: when, by what and from where, and checksums, which tell less than the numbers they are of.
LEFT_OUT = frozenset({"sha256", "software", "format_version", "history", "commit", "created", "seconds", "path"})
VERDICTS = frozenset({"status", "verdict", "flag", "code", "passed", "exit code"})
Values = dict[str, np.ndarray]


@dataclass(frozen=True)
class Difference:
    """A place where two files differ; ``relative`` is nan but of numbers."""

    place: str
    text: str
    relative: float = math.nan

    @property
    def of_verdict(self) -> bool:
        """Whether a status, code or verdict differs."""
        return is_verdict(self.place)


@dataclass(frozen=True)
class Comparison:
    """What differs, and the place of the largest relative difference of a number, allowed or not."""

    differences: tuple[Difference, ...]
    worst: float
    worst_place: str


def is_verdict(place: str) -> bool:
    """Whether a place is that of a status, code or verdict."""
    names = [name for name in re.split("[/:]", place) if not name.isdigit()]
    return bool(names) and names[-1] in VERDICTS


# --- reading ----------------------------------------------------------------------------------------------------------


def values_of(folder: Path) -> Values:
    """Values of the FILES of a folder by ``FILE:place``, without those LEFT_OUT."""
    readers = {".h5": _of_hdf5, ".json": lambda path: _of_json(json.loads(path.read_text("utf-8"))), ".csv": _of_csv}
    files = [folder / name for name in FILES if (folder / name).exists()]
    found = {f"{path.name}:{place}": value for path in files for place, value in readers[path.suffix](path)}
    return {place: value for place, value in found.items() if not LEFT_OUT & set(re.split("[/:@]", place))}


def _of_hdf5(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    with h5py.File(path, "r") as file:
        objects = [("", file)]
        file.visititems(lambda name, item: objects.append((name, item)))
        for name, item in objects:
            for key, value in item.attrs.items():
                yield from _of_stored(f"{name}@{key}", np.asarray(value))
            if isinstance(item, h5py.Dataset):
                yield from _of_stored(name, np.asarray(item[()]))
            elif not len(item):
                yield name, np.array("empty group")


def _of_stored(place: str, value: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield a dataset or attribute; of texts that are JSON what they hold."""
    if value.dtype.kind not in "SO":
        yield place, value
        return
    cells = [cell.decode("utf-8") if isinstance(cell, bytes) else str(cell) for cell in value.ravel()]
    if not any(cell[:1] in ("{", "[") for cell in cells):
        yield place, np.array(cells, dtype=str).reshape(value.shape)
        return
    for row, cell in enumerate(cells):
        where = f"{place}/{row}" if value.shape else place
        try:
            yield from _of_json(json.loads(cell), where)
        except json.JSONDecodeError:
            yield where, np.array(cell)


def _of_json(value: Any, place: str = "") -> Iterator[tuple[str, np.ndarray]]:
    if (array := _array(value)) is not None:
        yield place, array
        return
    for key, item in value.items() if isinstance(value, Mapping) else enumerate(value):
        yield from _of_json(item, f"{place}/{key}" if place else str(key))


def _array(value: Any) -> np.ndarray | None:
    """Return a leaf, or a list of nothing but numbers or texts, as an array; else nothing."""
    if isinstance(value, Mapping):
        return None if value else np.array("{}")
    cells = np.array(value, dtype=object)
    kinds = {type(cell) for cell in cells.ravel()}
    for allowed, dtype in (({bool}, bool), ({int}, np.int64), ({int, float, type(None)}, np.float64), ({str}, str)):
        if kinds <= allowed:
            return cells.astype(dtype)
    return None


def _of_csv(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    names, *rows = csv.reader(path.read_text("utf-8-sig").splitlines())
    for name, *cells in zip(names, *rows, strict=True):
        try:
            yield name, np.array([float(cell) if cell else math.nan for cell in cells])
        except ValueError:
            yield name, np.array(cells, dtype=str)


def renamed(values: Values, names: Mapping[str, str]) -> Values:
    """Values whose places have runs of whole names, ``old``, replaced by ``new``."""
    for old, new in names.items():
        whole = re.compile(rf"(?<![^/:@]){re.escape(old)}(?![^/:@])")
        values = {whole.sub(lambda _, new=new: new, place): value for place, value in values.items()}
    return values


# --- comparing --------------------------------------------------------------------------------------------------------


def compared(
    reference: Values,
    values: Values,
    tolerance: float = TOLERANCE,
    verdicts_alone: bool = False,
    left_out: Sequence[str] = (),
) -> Comparison:
    """Hold values against a reference; ``left_out`` are patterns of places, as of file names."""
    differences: list[Difference] = []
    worst, worst_place = 0.0, ""
    for place in dict.fromkeys((*reference, *values)):
        if (verdicts_alone and not is_verdict(place)) or any(fnmatchcase(place, one) for one in left_out):
            continue
        if place not in reference or place not in values:
            side = "only in the new results" if place in values else "missing"
            differences.append(Difference(place, side))
            continue
        found = _difference(place, reference[place], values[place], tolerance)
        if found is None:
            continue
        if found.relative > worst:
            worst, worst_place = found.relative, place
        if not found.relative <= tolerance:
            differences.append(found)
    return Comparison(tuple(differences), worst, worst_place)


def _difference(place: str, old: np.ndarray, new: np.ndarray, tolerance: float) -> Difference | None:
    if old.shape != new.shape:
        return Difference(place, f"shape {old.shape} -> {new.shape}")
    numeric = [array.dtype.kind in "biuf" for array in (old, new)]
    if not all(numeric) or not (old.dtype.kind == "f" or new.dtype.kind == "f"):
        if any(numeric) != all(numeric):
            return Difference(place, f"{old.dtype} -> {new.dtype}")
        unequal = np.argwhere(old != new)
        return Difference(place, _first(old, new, unequal)) if len(unequal) else None
    relative = relative_differences(old, new, tolerance, "covariance" in place or "variance" in place)
    worst = float(relative.max(initial=0.0))
    return Difference(place, _first(old, new, np.argwhere(relative == worst)), worst) if worst > 0.0 else None


def relative_differences(old: np.ndarray, new: np.ndarray, tolerance: float, squared: bool = False) -> np.ndarray:
    """Differences by what a number is held against; 0 of two nan or infinities, inf where one alone is.

    ``squared`` numbers are variances: FLOOR is that of their roots.
    """
    single = np.float32 in (old.dtype, new.dtype)
    old, new = (np.asarray(array, dtype=float) for array in (old, new))
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.abs(new - old)
        size = np.nan_to_num(np.maximum(np.abs(old), np.abs(new)), nan=0.0, posinf=0.0)
        if size.ndim:
            vector = size.max(axis=-1, keepdims=True, initial=0.0)
            if size.ndim > 1 and size.shape[-1] == size.shape[-2]:
                vector = np.minimum(vector, size.max(axis=-2, keepdims=True, initial=0.0))
            scale = np.maximum(size, vector)
        else:
            scale = size
        relative = np.where(away > 0.0, away / scale, 0.0)
    relative[away <= (FLOOR * tolerance) ** (2 if squared else 1)] = 0.0
    if single:
        relative[relative <= FLOAT32] = 0.0
    equal = (old == new) | (np.isnan(old) & np.isnan(new))
    return np.where(equal, 0.0, np.where(np.isfinite(old) & np.isfinite(new), relative, np.inf))


def _first(old: np.ndarray, new: np.ndarray, places: np.ndarray) -> str:
    at = tuple(places[0].tolist())
    where = f" at {list(at)}" if at else ""
    more = f", {len(places)} of {old.size}" if len(places) > 1 else ""
    return f"{_short(old[at])} -> {_short(new[at])}{where}{more}"


def _short(value: Any) -> str:
    text = repr(value.item() if hasattr(value, "item") else value)
    return text if len(text) <= 60 else text[:57] + "..."
