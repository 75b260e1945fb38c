"""Records to HDF5 groups and back, by walking the fields of their dataclasses.

A field is a dataset of the same name (arrays, numbers, text, lists of text) or a group (a record; a tuple of records
with members 0000, 0001, ..., or as one table where the field is declared as ``joined``). A field that is None is left
out. Text has a fixed length in UTF-8, so no dataset refers to a heap, and sizes are known before data are read.
"""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, lru_cache
from typing import Any, TypeVar

import h5py
import numpy as np

import processor.store.checksums as checksums
import processor.store.joined_records as joined_records
from processor import large_arrays
from processor.model import VOCABULARIES, Reason, RecordError, Word

CHUNK_ROWS = 65_536  # of three float64: 1.5 MB, compressed at once
PLAIN_ITEMS = 1_024  # arrays up to this size are stored plainly
GZIP_LEVEL = 1

_SEALED: ContextVar[dict[str, str] | None] = ContextVar("checksums by paths of a file being written", default=None)

Record = TypeVar("Record")
Hook = Callable[..., Any]


class DecodeError(ValueError):
    """A group that does not hold the expected record; ``problems`` lists all its faults."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("; ".join(problems))
        self.problems = problems


def write_array(group: Any, name: str, array: np.typing.NDArray[np.generic]) -> None:
    """Write an array, one of more than ``PLAIN_ITEMS`` items in chunks of rows, shuffled and compressed."""
    if array.size <= PLAIN_ITEMS:
        _create(group, name, array)
        return
    rows = min(len(array), max(1, CHUNK_ROWS // max(1, math.prod(array.shape[1:]) // 3)))
    _create(
        group,
        name,
        array,
        chunks=(rows, *array.shape[1:]),
        compression="gzip",
        compression_opts=GZIP_LEVEL,
        shuffle=True,
        fletcher32=True,
    )


def _create(group: Any, name: str, data: Any, **options: Any) -> None:
    """Write a dataset with its checksum and close it.

    It is closed so that its place in the file is independent of Python's garbage collection.
    """
    array, path = np.asarray(data), f"{group.name.rstrip('/')}/{name}"
    if not options:
        # As h5py makes it, in a third of the time: a frame's results have a hundred thousand.
        array = np.asarray(array, order="C")
        kind, in_memory = _kinds(array.dtype.str, array.dtype.metadata is not None)
        made = h5py.h5d.create(group.id, name.encode(), kind, _space(array.shape), dcpl=_plain())
        made.write(h5py.h5s.ALL, h5py.h5s.ALL, array, in_memory)
        checksum = checksums.seal(made, path, array, [array])
    elif len(array) <= options["chunks"][0]:
        made = group.create_dataset(name, data=data, **options).id
        checksum = checksums.seal(made, path, array, [array])
    else:
        dataset = group.create_dataset(name, array.shape, array.dtype, **options)
        made = dataset.id
        checksum = checksums.seal(made, path, array, _written(dataset, array, options["chunks"][0]))
    known = _SEALED.get()
    if known is not None:
        known[path] = checksum
    made.close()


@lru_cache(1_024)
def _kinds(dtype: str, is_text: bool) -> tuple[Any, Any]:
    """Return the types in a file and in memory of arrays of a NumPy type, or of text of its length."""
    given = np.dtype(dtype)
    given = h5py.string_dtype("utf-8", given.itemsize) if is_text else given
    return h5py.h5t.py_create(given, logical=True), h5py.h5t.py_create(given)


@lru_cache(1_024)
def _space(shape: tuple[int, ...]) -> Any:
    return h5py.h5s.create_simple(shape)


@cache
def _plain() -> Any:
    """Return h5py's properties of a dataset in one piece, without times."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_obj_track_times(False)
    properties.set_attr_creation_order(0)
    return properties


@contextmanager
def sealing(file: Any) -> Iterator[None]:
    """Give a new file's root group the checksum of all that is written to it within, at the end."""
    known: dict[str, str] = {}
    before = _SEALED.set(known)
    try:
        yield
    finally:
        _SEALED.reset(before)
    checksums.seal_root(file, known)


def _written(dataset: Any, array: np.typing.NDArray[Any], rows: int) -> Iterator[np.typing.NDArray[Any]]:
    """Write an array chunk by chunk, and yield what was written."""
    for start in range(0, len(array), rows):
        part = np.ascontiguousarray(array[start : start + rows])
        dataset[start : start + rows] = part
        yield part
        large_arrays.release_after(part.nbytes)


def write_text(group: Any, name: str, text: str) -> None:
    """Write a text."""
    data = _encoded(text)
    _create(group, name, np.array(data, _text_type(len(data))))


def write_texts(group: Any, name: str, texts: Sequence[str]) -> None:
    """Write a list of texts, each as long as the longest."""
    data = [_encoded(text) for text in texts]
    _create(group, name, np.array(data, _text_type(max([1, *map(len, data)]))))


def reason_to_json(item: Reason) -> dict[str, Any]:
    """Return a reason as JSON objects, its words and reasons within as well."""
    return {"code": item.code, "values": {name: value_to_json(value) for name, value in item.values.items()}}


def value_to_json(value: Any) -> Any:
    """Return a value of a message as JSON holds it; :func:`value_from_json` reads it."""
    if isinstance(value, Reason):
        return reason_to_json(value)
    if isinstance(value, Word):
        return {"word": str(value), "of": type(value).__name__}
    return [value_to_json(item) for item in value] if isinstance(value, list | tuple) else value


def _reason_from_json(stored: Any) -> Reason:
    """Return the reason that an object of :func:`reason_to_json` holds. Raises KeyError and TypeError for another."""
    return Reason(
        str(stored["code"]), {str(name): value_from_json(value) for name, value in dict(stored["values"]).items()}
    )


def value_from_json(stored: Any) -> Any:
    """Return the value that an object of :func:`value_to_json` holds."""
    if isinstance(stored, dict):
        if "word" not in stored:
            return _reason_from_json(stored)
        return VOCABULARIES[stored["of"]](stored["word"])
    return tuple(value_from_json(item) for item in stored) if isinstance(stored, list) else stored


def _encoded(text: str) -> bytes:
    if "\0" in text:
        raise RecordError(f"expected text without zero characters, found {text[:40]!r}")
    return text.encode("utf-8", "replace")


@lru_cache(1_024)
def _text_type(length: int) -> Any:
    return h5py.string_dtype("utf-8", max(1, length))


def write_record(
    group: Any, record: Any, skip: Collection[str] = (), hooks: Mapping[type, Hook] = types.MappingProxyType({})
) -> None:
    """Write the fields of a record into a group, except those of ``skip``.

    ``hooks`` maps a type of record to another writer. Raises TypeError for a field of a type that cannot be stored.
    """
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        size = value.size if isinstance(value, np.ndarray) else len(value) if isinstance(value, tuple) else 1
        newer_and_empty = field.metadata.get("newer") and not size
        if field.name not in skip and not newer_and_empty:
            _write(group, field.name, value, field.metadata, hooks)


def _write(group: Any, name: str, value: Any, metadata: Any, hooks: Mapping[type, Hook]) -> None:
    if value is None:
        return
    if "shape" in metadata:
        write_array(group, name, value.view(np.uint8) if value.dtype == np.bool_ else value)
    elif "lists" in metadata:
        write_texts(group, name, [json.dumps(row, ensure_ascii=False) for row in value])
    elif "reasons" in metadata:
        rows = (
            [[reason_to_json(item) for item in row] for row in value]
            if metadata["reasons"]
            else map(reason_to_json, value)
        )
        write_texts(group, name, [json.dumps(row, ensure_ascii=False, allow_nan=True) for row in rows])
    elif isinstance(value, str):
        write_text(group, name, value)
    elif isinstance(value, bool):
        _create(group, name, np.uint8(value))
    elif isinstance(value, int):
        _create(group, name, np.int64(value))
    elif isinstance(value, float):
        _create(group, name, np.float64(value))
    elif metadata.get("joined") and value:
        write_record(group.create_group(name), joined_records.joined(value))
    elif isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):
        members = group.create_group(name)
        for i, item in enumerate(value):
            _write(members, f"{i:04d}", item, {}, hooks)
    elif isinstance(value, tuple) and all(isinstance(item, str) for item in value):
        write_texts(group, name, value)
    elif dataclasses.is_dataclass(value):
        hook = hooks.get(type(value))
        member = group.create_group(name)
        if hook:
            hook(member, value)
        else:
            write_record(member, value, hooks=hooks)
    else:
        raise TypeError(f"{group.name}/{name}: a {type(value).__name__} cannot be stored")


@cache
def _fields(cls: Any) -> tuple[dict[str, Any], dict[str, dataclasses.Field[Any]]]:
    """Return the types and the fields of a record by their names."""
    return typing.get_type_hints(cls), {field.name: field for field in dataclasses.fields(cls)}


def read_record(
    group: Any,
    cls: type[Record],
    hooks: Mapping[type, Hook] = types.MappingProxyType({}),
    given: Mapping[str, Any] = types.MappingProxyType({}),
) -> Record:
    """Read a record of type ``cls`` from a group; fields in ``given`` are taken from there and not read.

    ``hooks`` maps a type of record to another reader. Raises DecodeError that lists every member that is missing,
    unknown, or not of its field's type and shape.
    """
    problems: list[str] = []
    values = dict(given)
    hints, known = _fields(typing.cast(typing.Hashable, cls))
    problems += [f"{group.name}/{name}: unknown" for name in group if name not in known]
    for name, field in known.items():
        if name in given:
            continue
        try:
            values[name] = _read(group, name, hints[name], field.metadata, hooks)
        except DecodeError as error:
            problems += error.problems
    if problems:
        raise DecodeError(problems)
    try:
        return cls(**values)
    except RecordError as error:
        raise DecodeError([f"{group.name}: {error}"]) from None


def _read(group: Any, name: str, hint: Any, metadata: Any, hooks: Mapping[type, Hook]) -> Any:
    where = f"{group.name}/{name}"
    allowed = [item for item in typing.get_args(hint) if item is not type(None)]
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    if name not in group:
        if union:
            return None
        if "shape" in metadata and metadata.get("newer"):
            return np.empty(0, metadata["dtype"])
        if metadata.get("newer") and typing.get_origin(hint) is tuple:
            return ()
        raise DecodeError([f"{where}: missing"])
    kind = allowed[0] if union else hint
    if "shape" in metadata:
        return read_array(group, name, metadata["dtype"], len(metadata["shape"]))
    if "lists" in metadata:
        return _read_json(group, name, lambda row: tuple(map(str, row)))
    if "reasons" in metadata:
        if "of_text" in metadata and getattr(group[name], "shape", None) == ():
            return metadata["of_text"](read_text(group, name))
        by_row = bool(metadata["reasons"])
        return _read_json(
            group, name, lambda row: tuple(map(_reason_from_json, row)) if by_row else _reason_from_json(row)
        )
    if kind is str or ("words" in metadata and "axis" not in metadata):
        return read_text(group, name)
    if kind in (bool, int, float):
        stored = {bool: "u1", int: "i8", float: "f8"}[kind]
        return kind(_whole(group, name, stored, 0)[()])
    if typing.get_origin(kind) is tuple and issubclass(typing.get_args(kind)[0], str):
        return tuple(_decoded(item, where) for item in _whole(group, name, "S", 1).tolist())
    item = group[name]
    if not isinstance(item, h5py.Group):
        if typing.get_origin(kind) is tuple and item.shape == (0,):
            _whole(group, name, "S", 1)
            return ()
        raise DecodeError([f"{where}: expected a group, found a dataset"])
    if typing.get_origin(kind) is tuple:
        if metadata.get("joined") and "0000" not in item:
            return _read_joined(item, typing.get_args(kind)[0])
        return _read_members(item, typing.get_args(kind)[0], hooks)
    return _read_member(item, kind, hooks)


def _read_json(group: Any, name: str, decode: Callable[[Any], Any]) -> tuple[Any, ...]:
    """Read texts of JSON, each mapped by ``decode``."""
    where = f"{group.name}/{name}"
    try:
        return tuple(decode(json.loads(_decoded(item, where))) for item in _whole(group, name, "S", 1).tolist())
    except (json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise DecodeError([f"{where}: expected JSON ({error})"]) from None


def _read_member(group: Any, kind: Any, hooks: Mapping[type, Hook]) -> Any:
    hook = hooks.get(kind)
    return hook(group) if hook else read_record(group, kind, hooks)


def _read_joined(group: Any, kind: Any) -> tuple[Any, ...]:
    """Read a table of records; files of before version 2.3 of results hold a group for each instead."""
    try:
        return joined_records.split(read_record(group, joined_records.table_of(kind)), kind)
    except RecordError as error:
        raise DecodeError([f"{group.name}: {error}"]) from None


def numbered_groups(group: Any) -> list[Any]:
    """Return the groups 0000, 0001, ... of a group. Raises DecodeError for other content."""
    expected = [f"{i:04d}" for i in range(len(group))]
    members = [group[name] for name in expected] if list(group) == expected else []
    if len(members) != len(expected) or not all(isinstance(member, h5py.Group) for member in members):
        raise DecodeError([f"{group.name}: expected groups 0000, 0001, ..."])
    return members


def _read_members(group: Any, kind: Any, hooks: Mapping[type, Hook]) -> tuple[Any, ...]:
    problems: list[str] = []
    items = []
    for member in numbered_groups(group):
        try:
            items.append(_read_member(member, kind, hooks))
        except DecodeError as error:
            problems += error.problems
    if problems:
        raise DecodeError(problems)
    return tuple(items)


def read_array(group: Any, name: str, dtype: type, ndim: int) -> Any:
    """Read an array with ``ndim`` axes, bool from uint8; an absent optional array is empty, with any number of axes."""
    stored = np.dtype(np.uint8 if dtype is np.bool_ else dtype).str[1:]
    return _whole(group, name, stored, ndim, empty_of_any=True)


def column(group: Any, name: str, dtype: type, ndim: int = 1) -> Any:
    """Return the dataset of a column, to be read in slices; an absent optional column is empty."""
    return sliced(_dataset(group, name, np.dtype(dtype).str[1:], ndim))


def sliced(dataset: Any) -> checksums.Column:
    """Return a dataset to be read in slices. Raises DecodeError for damage; reading does so by ChecksumError."""
    try:
        return checksums.Column(dataset)
    except checksums.ChecksumError as error:
        raise DecodeError([str(error)]) from None


def read_text(group: Any, name: str) -> str:
    """Read a text."""
    return _decoded(_whole(group, name, "S", 0)[()], f"{group.name}/{name}")


def _decoded(data: bytes, where: str) -> str:
    try:
        return bytes(data).decode("utf-8")
    except UnicodeDecodeError:
        raise DecodeError([f"{where}: not UTF-8 text"]) from None


def _whole(group: Any, name: str, stored: str, ndim: int, *, empty_of_any: bool = False) -> Any:
    """Read a dataset of a type, with a check of its checksum; of an empty one, the number of axes may be any."""
    try:
        return checksums.read(_dataset(group, name, stored, ndim, empty_of_any=empty_of_any))
    except checksums.ChecksumError as error:
        raise DecodeError([str(error)]) from None


def _dataset(group: Any, name: str, stored: str, ndim: int, *, empty_of_any: bool = False) -> Any:
    where = f"{group.name}/{name}"
    if name not in group:
        raise DecodeError([f"{where}: missing"])
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset):
        raise DecodeError([f"{where}: expected a dataset, found a group"])
    dtype, axes = dataset.dtype, dataset.ndim
    actual = dtype.kind + ("" if dtype.kind == "S" else str(dtype.itemsize))
    fits = axes == ndim or (empty_of_any and dataset.size == 0)
    if actual != stored or not fits or dtype.byteorder == ">":
        raise DecodeError([f"{where}: expected type {stored} with {ndim} axes, found {dtype.str} with {axes}"])
    return dataset
