"""Scenes, truths and results in HDF5.

A file has the root attributes ``format``, ``format_version``, ``units`` and ``history`` (JSON list), the text
``provenance`` (JSON) and the groups ``/scene``, ``/truth`` or ``/results``. The points of a scan lie in spatial tiles
(:mod:`processor.store.tiles`), each coordinate a column of its own, with every other column of the scan and its truth
labels in the same order. The same content makes the same bytes.

Files are not trusted: :mod:`processor.store.file_structure_checks` checks their structure before any data are read.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np

import processor.record_checks as meaning
import processor.store.checksums as checksums
import processor.store.codec as codec
import processor.store.file_structure_checks as file_structure_checks
import processor.store.scan_tiles as scan_tiles
from processor import large_arrays
from processor.language.messages import messages
from processor.model import (
    InputError,
    Ints,
    PlainError,
    PointLabels,
    Reason,
    Scan,
    Scene,
    StepRun,
    Truth,
    per_point_fields,
)
from processor.store.codec import DecodeError
from processor.store.whole_output import replacing

FORMATS = {"scene": "processor-scene", "truth": "processor-truth", "results": "processor-results"}
FORMAT_VERSION = "1.5"  # of scenes and truths
READABLE = ("1.2", "1.3", "1.4", FORMAT_VERSION)  # fields added since may be absent
RESULTS_VERSION = "2.5"
RESULTS_READABLE = ("2.0", "2.1", "2.2", "2.3", "2.4", RESULTS_VERSION)
WITHOUT_CHECKSUMS = ("1.2", "1.3", "2.0")
RESULTS_HISTORY = [
    "1.0 to 1.3: one flat record a step",
    "2.0: nested tables; words and reasons with codes",
    "2.1: checksums",
    "2.2: diagnostics of a step",
    "2.3: the components of an inspection as tables",
    "2.4: movements of nodes by both gauges",
    "2.5: risks of wrong decisions beside verdicts",
]
HISTORY = [
    "1.0: first",
    "1.1: grid and surface of each point, scanner poses, whole structures, what was built otherwise",
    "1.2: bottom edges as built, in the truth of arch bridges; limits that the project names; "
    "what a part's mesh is made from",
    "1.3: control points",
    "1.4: checksums",
    "1.5: how coordinates were read, as reasons with codes",
]

# Exceptions of HDF5 and h5py for a damaged file; none of them names the file.
DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, MemoryError, RecursionError)

Record = TypeVar("Record")
Pieces = Callable[[int, str], tuple[tuple[int, ...], Iterator[Any]]]


# --- writing ---------------------------------------------------------------------------------------------------------


@contextmanager
def _new_file(path: Path, kind: str, provenance: Mapping[str, object]) -> Iterator[Any]:
    # HDF5 may abort the process when the disk is full. Small files are made in memory and written as bytes.
    small = kind != "scene"
    driver: dict[str, Any] = {"driver": "core", "backing_store": False} if small else {}
    with replacing(path) as temporary, h5py.File(temporary, "x", libver="earliest", **driver) as file:
        version, history = (RESULTS_VERSION, RESULTS_HISTORY) if kind == "results" else (FORMAT_VERSION, HISTORY)
        header = {"format": FORMATS[kind], "format_version": version, "units": "mm", "history": json.dumps(history)}
        for name, text in header.items():
            file.attrs.create(name, text.encode(), dtype=h5py.string_dtype("utf-8", len(text)))
        with codec.sealing(file):
            codec.write_text(file, "provenance", json.dumps(provenance, sort_keys=True, ensure_ascii=False))
            yield file
        if small:
            file.flush()
            temporary.write_bytes(file.id.get_file_image())
    file_structure_checks.remember(path)


def write_scene(path: Path, scene: Scene, truth: Truth | None, provenance: Mapping[str, object]) -> None:
    """Write a scene, and its truth if there is one.

    ``provenance`` is any JSON object. Points are rounded to 0.0001 mm (0.001 mm beyond an extent of 400 m). Raises
    InputError for points that are not finite, two scans of the same name, and labels that do not fit their scan.
    """
    _check(path, scene)
    orders: dict[str, Ints] = {}

    def write_scan(group: Any, scan: Scan) -> None:
        orders[scan.name] = scan_tiles.write_scan(group, scan)

    with _new_file(path, "scene", provenance) as file:
        codec.write_record(file.create_group("scene"), scene, hooks={Scan: write_scan})
        if truth is not None:
            labels = tuple(_in_order(label, orders, path) for label in truth.labels)
            codec.write_record(file.create_group("truth"), dataclasses.replace(truth, labels=labels))


def _check(path: Path, scene: Scene) -> None:
    names = [scan.name for scan in scene.scans]
    if len(set(names)) != len(names):
        raise InputError(f"expected scans of different names, found {', '.join(sorted(names))}; rename one", path=path)
    for scan in scene.scans:
        blocks = large_arrays.blocks(len(scan.points))
        bad = sum(int(np.count_nonzero(~np.isfinite(scan.points[rows]).all(axis=1))) for rows in blocks)
        if bad or not np.isfinite(scan.origin).all():
            culprit = f"{bad} points" if bad else "an origin"
            raise InputError(f"scan {scan.name!r} has {culprit} with coordinates that are not finite", path=path)


def _in_order(labels: PointLabels, orders: Mapping[str, Ints], path: Path) -> PointLabels:
    order = orders.get(labels.scan)
    if order is None:
        raise InputError(f"the truth has labels of a scan {labels.scan!r}, which is not in the scene", path=path)
    columns = {name: getattr(labels, name) for name in per_point_fields(PointLabels)}
    for name, column in columns.items():
        if len(column) not in (0, len(order)):
            raise InputError(
                f"expected {len(order)} labels ({name}) of the points of {labels.scan!r}, found {len(column)}",
                path=path,
            )
    return dataclasses.replace(labels, **{name: column[order] for name, column in columns.items() if len(column)})


def write_truth(path: Path, truth: Truth, provenance: Mapping[str, object] | None = None) -> None:
    """Write a truth to a file without a scene; its labels keep the order given."""
    with _new_file(path, "truth", provenance or {}) as file:
        codec.write_record(file.create_group("truth"), truth)


def copy_truth(
    src: Path, dst: Path, labels: Callable[[tuple[PointLabels, ...]], tuple[PointLabels, ...]] | None = None
) -> bool:
    """Write the truth of ``src`` to a file ``dst`` without a scene. Returns False, and writes nothing, without a truth.

    ``labels`` maps the labels of the points to those of the copy.
    """
    truth = read_truth(src)
    if truth is None:
        return False
    if labels is not None:
        truth = dataclasses.replace(truth, labels=labels(truth.labels))
    write_truth(dst, truth, read_provenance(src))
    return True


def write_results(path: Path, runs: Sequence[StepRun], provenance: Mapping[str, object]) -> None:
    """Write the results of steps, in the order they ran."""
    with _new_file(path, "results", provenance) as file:
        results = file.create_group("results")
        for i, run in enumerate(runs):
            codec.write_record(results.create_group(f"{i:04d}"), run)


_SOUND: dict[file_structure_checks.State, file_structure_checks.Structure] = {}  # by the state of a file
SETTLED_S = 2.0  # since a file was written
MOST_LISTED = 20  # faults of a file in a message


# --- reading ---------------------------------------------------------------------------------------------------------


@contextmanager
def opened(path: Path, kinds: Sequence[str]) -> Iterator[Any]:
    """Open a file of one of ``kinds`` whose structure is safe to read. Raises InputError for any other, or damage."""
    try:
        structure = _structure(path)
        if structure.error:
            raise OSError(structure.error)
        if structure.faults or structure.known is None:
            raise DecodeError([*structure.faults])
        with file_structure_checks.limited_memory():
            file = h5py.File(path, "r", locking=False)
        with file:
            if file_structure_checks.state_of(os.fstat(file.id.get_vfd_handle())) != structure.state:
                raise DecodeError(["was changed while it was read; wait until it is written, and run again"])
            faults = _header_problems(file, kinds, structure.known)
            if faults:
                raise DecodeError(faults)
            yield file
    except DecodeError as error:
        more = [f"and {len(error.problems) - MOST_LISTED} more"] if len(error.problems) > MOST_LISTED else []
        raise InputError("; ".join([*error.problems[:MOST_LISTED], *more]), path=path) from error
    except checksums.ChecksumError as error:
        raise InputError(str(error), path=path) from error
    except FileNotFoundError:
        raise InputError("no such file", path=path) from None
    except large_arrays.NoRoomError as error:
        raise InputError(f"cannot be read ({error.strerror})", path=path) from error
    except PlainError:  # of what is done with the open file
        raise
    except DAMAGE as error:
        wanted = " or ".join(FORMATS[kind] for kind in kinds)
        raise InputError(
            f"expected a {wanted} file (HDF5), found one that is damaged, cut off or of another kind "
            f"({(str(error).splitlines() or [type(error).__name__])[0]}); make or copy it again",
            path=path,
        ) from error


def _structure(path: Path) -> file_structure_checks.Structure:
    """Return what is known of the structure of a file, which is looked at once while it is as it was.

    A run opens its input several times. A file that was just written may change again within a tick of the disk's
    clock, so it is not remembered.
    """
    status = path.stat()
    state = file_structure_checks.state_of(status)
    if state in _SOUND:
        return _SOUND[state]
    structure = file_structure_checks.of_file(path)
    sound = structure.known is not None and not structure.faults
    if sound and structure.state == state and time.time() - status.st_mtime > SETTLED_S:
        _SOUND[state] = structure
    return structure


def _header_problems(file: Any, kinds: Sequence[str], known: Mapping[str, str | None]) -> list[str]:
    header = {name: _attribute(file, name) for name in ("format", "format_version", "units")}
    wanted = [FORMATS[kind] for kind in kinds]
    if header["format"] not in wanted:
        return [f"expected format {' or '.join(wanted)}, found {header['format'] or 'none'}"]
    faults = []
    results = header["format"] == FORMATS["results"]
    readable = RESULTS_READABLE if results else READABLE
    if header["format_version"] not in readable:
        version = header["format_version"] or "none"
        advice = "; run processor run again" if results else ""
        faults.append(f"expected format_version {' or '.join(readable)}, found {version}{advice}")
    if header["units"] != "mm":
        faults.append(f"expected units mm, found {header['units'] or 'none'}")
    return faults or (
        []
        if str(header["format_version"]) in WITHOUT_CHECKSUMS and not checksums.has_any(file)
        else checksums.root_problems(file, known)
    )


def _attribute(file: Any, name: str) -> str:
    value = file.attrs.get(name, b"")
    return bytes(value).decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _group(file: Any, name: str) -> Any:
    if not isinstance(file.get(name), h5py.Group):
        raise DecodeError([f"/{name}: missing"])
    return file[name]


def read_scene(path: Path, points: bool = True) -> Scene:
    """Read a scene; its points are in the order of their tiles. Raises InputError that lists all faults.

    With ``points`` false the per-point columns of the scans are empty; see :mod:`processor.store.streaming`.
    """
    with opened(path, ["scene"]) as file:
        read_scan = scan_tiles.read_scan if points else scan_tiles.read_scan_alone
        scene = codec.read_record(_group(file, "scene"), Scene, hooks={Scan: read_scan})
        _check_reasons(scene.units_reason, "/scene/units_reason")
        _check_reasons(scene.target_remarks, "/scene/target_remarks")
        if points:
            return _possible(scene, "/scene")
        # Steps look stations up by the numbers of the points: their range is known before any step begins.
        groups = codec.numbered_groups(file["scene"]["scans"]) if scene.scans else []
        extremes = [scan_tiles.extreme_stations(group) for group in groups]
        scans = (dataclasses.replace(s, point_station=e) for s, e in zip(scene.scans, extremes, strict=True))
        _possible(dataclasses.replace(scene, scans=tuple(scans)), "/scene")
        return scene


def _check_reasons(reasons: Sequence[Reason], where: str) -> None:
    """Raise DecodeError for reasons that lack a value of their text, or have one of another kind."""
    for i, reason in enumerate(reasons):
        try:
            messages("en").text(reason)
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise DecodeError([f"{where}, row {i}: expected the values of {reason.code!r} ({error!r})"]) from None


def _possible(record: Record, where: str) -> Record:
    """Return a record of the group ``where`` that is possible in meaning. Raises DecodeError that lists all faults."""
    faults = meaning.problems(record, where)
    if faults:
        raise DecodeError(faults)
    return record


def read_truth(path: Path, labels: bool = True) -> Truth | None:
    """Read the truth from a scene or truth file; None for a scene without truth. For evaluation only.

    With ``labels`` false the labels of the points are not read.
    """
    with opened(path, ["scene", "truth"]) as file:
        if "truth" not in file and _attribute(file, "format") == FORMATS["scene"]:
            return None
        return _possible(
            codec.read_record(_group(file, "truth"), Truth, given={} if labels else {"labels": ()}), "/truth"
        )


def read_results(path: Path, result_classes: Mapping[str, type]) -> tuple[StepRun, ...]:
    """Read results in the order they ran; ``result_classes`` maps a step's name to its Result record.

    Raises InputError for a step that is not among them, and for a damaged file.
    """

    def read_run(group: Any) -> StepRun:
        step = codec.read_text(group, "step")
        if step not in result_classes:
            raise DecodeError([f"{group.name}: results of an unknown step {step!r}"])
        if not isinstance(group.get("result"), h5py.Group):
            raise DecodeError([f"{group.name}/result: missing"])
        result: object = codec.read_record(group["result"], result_classes[step])
        return _possible(codec.read_record(group, StepRun, given={"result": result}), group.name)

    with opened(path, ["results"]) as file:
        return tuple(read_run(group) for group in codec.numbered_groups(_group(file, "results")))


def read_provenance(path: Path) -> dict[str, Any]:
    """Read how a file was made: the JSON object given to the writer."""
    with opened(path, list(FORMATS)) as file:
        return _provenance(file)


def _provenance(file: Any) -> dict[str, Any]:
    try:
        provenance = json.loads(codec.read_text(file, "provenance"))
    except json.JSONDecodeError:
        provenance = None
    if not isinstance(provenance, dict):
        raise DecodeError(["/provenance: expected a JSON object"])
    return provenance


def problems(path: Path) -> list[str]:
    """List all faults of a scene, truth or results file; an empty list means that it can be read."""
    kind = ""

    def attempt(read: Callable[[Path], object]) -> list[str]:
        try:
            read(path)
        except InputError as error:
            cause = error.__cause__
            return cause.problems if isinstance(cause, DecodeError) else [error.problem]
        return []

    def read_header(path: Path) -> None:
        nonlocal kind
        with opened(path, list(FORMATS)) as file:
            kind = _attribute(file, "format")
            _provenance(file)

    faults = attempt(read_header)
    if not kind:  # nothing of it can be read
        return faults
    if kind == FORMATS["scene"]:
        faults += attempt(read_scene)
    if kind != FORMATS["results"]:
        return faults + attempt(read_truth)
    return faults + attempt(_read_run_headers)


def _read_run_headers(path: Path) -> None:
    """Read the fields of each run that are the same for all steps."""
    with opened(path, ["results"]) as file:
        for group in _group(file, "results").values():
            codec.read_record(group, StepRun, given={"result": None}) if isinstance(group, h5py.Group) else None


def damage(path: Path) -> tuple[bool, list[str]]:
    """Return whether a scene, truth or results file has checksums, and list all that is damaged in it.

    All data are read, of any size, and compared with their checksums; a file without them is only tried to be read.
    """
    try:
        with opened(path, list(FORMATS)) as file:
            if checksums.has_any(file):
                return True, checksums.problems(file)
    except InputError as error:
        return True, [error.problem]
    return False, problems(path)


# --- identity --------------------------------------------------------------------------------------------------------


def scene_hash(scene: Scene, pieces: Pieces | None = None) -> str:
    """Return the SHA-256 (hex) of a scene: names, types, shapes and bytes of its fields, in their order.

    It depends on nothing else: not on the truth, the file's name or the versions of the software. ``pieces`` gives the
    per-point columns of a scene that was read without points: for a scan's number and a column's name, the column's
    shape and an iterator over its parts.
    """
    digest = hashlib.sha256()
    _feed(digest, "scene", scene, pieces)
    return digest.hexdigest()


def design_hash(scene: Scene) -> str:
    """Return the SHA-256 (hex) of a scene's design alone; "" of a scene without one."""
    designs = (scene.arch, scene.frame, scene.structure)
    digest = hashlib.sha256()
    for design in designs:
        if design is not None:
            _feed(digest, "design", design, None)
    return digest.hexdigest() if any(design is not None for design in designs) else ""


def _feed(digest: Any, name: str, value: Any, pieces: Pieces | None, scan: int = 0) -> None:
    if isinstance(value, np.ndarray):
        kind = value.dtype.newbyteorder("<")
        digest.update(f"{name}:{kind.str}{value.shape};".encode())
        for rows in large_arrays.blocks(len(value)) if value.ndim else ((),):
            part = np.ascontiguousarray(value[rows], kind)
            digest.update(part.data if part.size else b"")
    elif dataclasses.is_dataclass(value):
        digest.update(f"{name}:{type(value).__name__}(".encode())
        for field in dataclasses.fields(value):
            newer = field.metadata.get("newer", False)
            if not field.metadata.get("hashed", True):
                continue
            if pieces is not None and isinstance(value, Scan) and field.name in per_point_fields(Scan):
                shape, parts = pieces(scan, field.name)
                if newer and not shape[0]:
                    continue
                kind = np.dtype(field.metadata["dtype"]).newbyteorder("<")
                digest.update(f"{field.name}:{kind.str}{shape};".encode())
                for part in parts:
                    digest.update(np.ascontiguousarray(part, kind).data)
                continue
            item = getattr(value, field.name)
            if field.metadata.get("hashed_as_text"):
                item = messages("en").text(item)
            absent = item is None or (isinstance(item, np.ndarray | tuple) and not np.size(item))
            if not newer or not absent:
                _feed(digest, field.name, item, pieces)
        digest.update(b")")
    elif isinstance(value, tuple):
        digest.update(f"{name}:tuple{len(value)}(".encode())
        for i, item in enumerate(value):
            _feed(digest, "", item, pieces, i)
        digest.update(b")")
    else:
        text = value.hex() if isinstance(value, float) else str(value)
        digest.update(f"{name}:{type(value).__name__}{len(text)}:{text};".encode())
