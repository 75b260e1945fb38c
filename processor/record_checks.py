"""What comes in is checked for what it means: ranges, references, uniqueness, poses, lengths of names.

The fields of a record say what their values must be (:class:`processor.model.Meaning`); :func:`problems` walks any
record and those within it, so a new record is checked without further code. Every way in calls it once: the store for
scenes, truths and results, the scan folder and the API for what they have made of files and arrays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from processor import large_arrays
from processor.model import LARGEST_MM, Checked, Fault, InputError, Meaning, Word, did_you_mean

POSE_TOLERANCE = 1e-3  # of R^T R - I
COVARIANCE_TOLERANCE = 1e-6  # of correlations: sums of products of float64 are good to 1e-9 and better
SHOWN = 60  # characters of a value
UNDECLARED = Meaning()  # of a field without a declaration

Record = TypeVar("Record")
Array = npt.NDArray[Any]


def problems(record: Any, where: str = "") -> list[str]:
    """List what is impossible in a record and those within it: place (dataset, row), expected, found.

    Places begin with ``where``, the group of the record.
    """
    return ["/".join((where, *path)) + text for path, text in faults(record)]


def faults(record: Any, path: tuple[str, ...] = (), root: Any = None) -> list[Fault]:
    """List what is impossible in a record and those within it.

    Paths of faults begin with ``path``; references from the root of all are to ``root``, without it to ``record``.
    """
    top = record if root is None else root
    found: list[Fault] = []
    for field in dataclasses.fields(record):
        value, place = getattr(record, field.name), (*path, field.name)
        if dataclasses.is_dataclass(value):
            found += faults(value, place, top)
        elif isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):
            if "reasons" not in field.metadata:
                for i, item in enumerate(value):
                    found += faults(item, (*place, f"{i:04d}"), top)
        else:
            meaning = field.metadata.get("means", UNDECLARED)
            found += [Fault(place, text) for text in _faults(field, value, meaning, record, top)]
    if isinstance(record, Checked) and not found:
        found += [Fault((*path, *fault.path), fault.text) for fault in record.contradictions()]
    return found


def check(record: Record, source: str, files: Mapping[str, str] | None = None) -> Record:
    """Return a scene, or a record of it without references to others, that is possible.

    ``source`` is the input; ``files`` names the file of a field of a scene, as ``{"frame": "design.json"}``.
    Raises InputError that names the file.
    """
    found = faults(record)
    if found:
        first = found[0]
        place = (files or {}).get(first.path[0], source)
        more = f" (and {len(found) - 1} more of the kind)" if len(found) > 1 else ""
        raise InputError(f"{place}: {'.'.join(first.path)}{first.text}{more}; correct the input")
    return record


def _faults(field: dataclasses.Field[Any], value: Any, meaning: Meaning, record: Any, root: Any) -> Iterator[str]:
    if isinstance(value, Word):
        return
    if isinstance(value, str):
        yield from _of_text(value, meaning, record, root)
    elif isinstance(value, tuple):
        if "lists" in field.metadata:
            value = tuple(item for row in value for item in row)
        if all(isinstance(item, str) and not isinstance(item, Word) for item in value):
            yield from _of_texts(value, meaning, record, root)
    elif isinstance(value, np.ndarray) and value.size and value.dtype.kind in "iuf":
        if meaning.pose or (field.name.startswith("T_") and value.shape[-2:] == (4, 4)):
            yield from _of_poses(value, meaning)
        elif meaning.covariance:
            yield from _of_covariances(value)
        else:
            yield from _of_numbers(value, meaning, record, root)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield from _of_numbers(np.asarray(value), meaning, record, root)


# --- texts -----------------------------------------------------------------------------------------------------------


def _of_text(value: str, meaning: Meaning, record: Any, root: Any) -> Iterator[str]:
    if len(value) > meaning.longest:
        yield f": expected at most {meaning.longest} characters, found {len(value)}: {_shown(value)}"
    elif meaning.words and value not in meaning.words:
        like = did_you_mean(value, filter(None, meaning.words))
        yield f": expected one of {', '.join(filter(None, meaning.words))}, found {_shown(value)}{like}"
    elif meaning.among and value and value not in _referred(meaning.among, record, root):
        yield f": expected one of {meaning.among.strip('/')}, found {_shown(value)}"


def _of_texts(values: tuple[str, ...], meaning: Meaning, record: Any, root: Any) -> Iterator[str]:
    known = set(_referred(meaning.among, record, root)) if meaning.among else None
    unlike = getattr(record, meaning.unlike) if meaning.unlike else ()
    seen: set[str] = set()
    for row, value in enumerate(values):
        if len(value) > meaning.longest:
            fault = f"expected at most {meaning.longest} characters, found {len(value)}: {_shown(value)}"
        elif known is not None and value not in known:
            fault = f"expected one of {meaning.among.strip('/')}, found {_shown(value)}"
        elif meaning.unique and value in seen:
            fault = f"expected each once, found {_shown(value)} a second time"
        elif row < len(unlike) and unlike[row] == value:
            fault = f"expected another than in {meaning.unlike}, found {_shown(value)} in both"
        else:
            seen.add(value)
            continue
        yield f", row {row}: {fault}"
        return


def _shown(value: object) -> str:
    text = repr(value) if isinstance(value, str) else f"{value:.9g}" if isinstance(value, float) else str(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


# --- numbers ---------------------------------------------------------------------------------------------------------


def _of_numbers(values: Array, meaning: Meaning, record: Any, root: Any) -> Iterator[str]:
    if meaning is UNDECLARED or _in_range(values, meaning, record, root):
        return
    real = values.dtype.kind == "f"
    if meaning.finite and real:
        yield from _first(values, ~np.isfinite(values), "expected finite numbers")
    elif real and not meaning.infinite:
        yield from _first(values, np.isinf(values), "expected finite numbers, or NaN where unknown")
    low, high = meaning.least, meaning.most
    if meaning.rows_of:
        low, high = meaning.lowest_row, len(_referred(meaning.rows_of, record, root)) - 1
    with np.errstate(invalid="ignore"):
        if low > -np.inf or high < np.inf:
            outside = (values < low) | (values > high)
            yield from _first(values, outside, _interval(low, high, meaning.rows_of))
        if meaning.above > -np.inf:
            yield from _first(values, values <= meaning.above, f"expected numbers above {meaning.above:g}")
    if meaning.among:
        known = np.asarray(_referred(meaning.among, record, root))
        yield from _first(values, ~np.isin(values, known), f"expected one of {meaning.among.strip('/')}")
    if meaning.unlike:
        yield from _first(
            values, values == getattr(record, meaning.unlike), f"expected another than in {meaning.unlike}"
        )
    if meaning.unique:
        first = np.zeros(len(values), bool)
        first[np.unique(values, return_index=True)[1]] = True
        yield from _first(values, ~first, "expected each once")


def _in_range(values: Array, meaning: Meaning, record: Any, root: Any) -> bool:
    """Whether no number of many is impossible, found block by block; False where that is not known."""
    if not values.ndim or len(values) <= large_arrays.BLOCK_ROWS or meaning.among or meaning.unlike or meaning.unique:
        return False
    low, high = meaning.least, meaning.most
    if meaning.rows_of:
        low, high = meaning.lowest_row, len(_referred(meaning.rows_of, record, root)) - 1
    least, most = large_arrays.extremes(values)
    return bool(np.isfinite([least, most]).all()) and low <= least <= most <= high and least > meaning.above


def _interval(low: float, high: float, rows_of: str) -> str:
    if rows_of:
        name = rows_of.strip("/")
        return (
            f"expected rows of {name} ({low:g} to {high:g})" if high >= low else f"expected no row, as {name} is empty"
        )
    if np.isinf(high):
        return f"expected numbers of {low:g} or more"
    return f"expected numbers from {low:g} to {high:g}" if low > -np.inf else f"expected numbers up to {high:g}"


def _first(values: Array, bad: Array, expected: str) -> Iterator[str]:
    """Yield the fault of the first bad value, and how many rows have one."""
    if not bad.any():
        return
    if not values.ndim:
        yield f": {expected}, found {_shown(values.item())}"
        return
    rows = bad.reshape(len(bad), -1).any(axis=1)
    row = int(rows.argmax())
    item = values[row].reshape(-1)[bad[row].reshape(-1)].tolist()[0]
    more = f" ({int(rows.sum())} such rows)" if rows.sum() > 1 else ""
    yield f", row {row}: {expected}, found {_shown(item)}{more}"


def _of_poses(values: Array, meaning: Meaning) -> Iterator[str]:
    poses = values.reshape(-1, 4, 4)
    unknown = np.zeros(len(poses), bool) if meaning.finite else np.isnan(poses).any(axis=(1, 2))
    if meaning.scaled:
        poses = poses.copy()
        with np.errstate(all="ignore"):
            poses[:, :3, :3] /= np.cbrt(np.abs(np.linalg.det(poses[:, :3, :3])))[:, None, None]
    bad = ~are_poses(poses) & ~unknown
    if bad.any():
        row = int(bad.argmax())
        place = f", row {row}" if values.ndim > 2 else ""
        yield (
            f"{place}: expected a rotation and a finite translation above a row of 0, 0, 0, 1, found "
            f"[{'; '.join(', '.join(f'{x:.6g}' for x in line) for line in poses[row].tolist())}]"
        )


def _of_covariances(values: Array) -> Iterator[str]:
    """Yield the first matrix (..., n, n) that is none of a covariance; unknown rows of one are NaN."""
    size = values.shape[-1]
    matrices = values.reshape(-1, size, size)
    with np.errstate(all="ignore"):
        variance = np.diagonal(matrices, axis1=1, axis2=2)
        sd = np.where(variance > 0.0, np.sqrt(variance), 1.0)
        correlation = matrices / sd[:, :, None] / sd[:, None, :]
        lopsided = np.abs(correlation - np.swapaxes(correlation, 1, 2)) > COVARIANCE_TOLERANCE
        bad = np.any(lopsided | np.isinf(matrices) | (variance < 0.0)[:, :, None], axis=(1, 2))
        whole = np.isfinite(correlation).all(axis=(1, 2)) & ~bad
        bad[whole] = np.linalg.eigvalsh(correlation[whole])[:, 0] < -COVARIANCE_TOLERANCE * size
    if bad.any():
        row = int(bad.argmax())
        place = f", row {row}" if values.ndim > 2 else ""
        yield (
            f"{place}: expected a symmetric matrix without a negative or infinite variance, found the variances "
            f"{_shown(', '.join(f'{x:.6g}' for x in variance[row].tolist()))}"
        )


def are_poses(poses: Array) -> npt.NDArray[np.bool_]:
    """Return which of matrices (k, 4, 4) are a rotation and a translation of at most LARGEST_MM."""
    rotation = np.where(np.abs(poses[:, :3, :3]) <= 2.0, poses[:, :3, :3], 0.0)  # no rotation has larger numbers
    off = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2))
    near = (np.abs(poses[:, :3, 3]) <= LARGEST_MM).all(axis=1)
    last = (poses[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
    found: npt.NDArray[np.bool_] = (off < POSE_TOLERANCE) & (np.linalg.det(rotation) > 0) & near & last
    return found


def _referred(path: str, record: Any, root: Any) -> Any:
    """Return what a reference names: a field of the record, or from the root of all where it begins with "/".

    A part of a path that follows a tuple of records names a field of each.
    """
    target = root if path.startswith("/") else record
    for name in path.strip("/").split("."):
        target = [getattr(item, name) for item in target] if isinstance(target, tuple | list) else getattr(target, name)
        if target is None:
            return ()
    return target
