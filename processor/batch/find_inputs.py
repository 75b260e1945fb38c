"""The inputs below a folder: scan folders, scene files, and single scan files."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from processor import readers
from processor.model import Reason, reason
from processor.results.file_names import RESULTS_H5, RESULTS_JSON
from processor.scan_folder.files import DESIGNS, NOT_SCANS, PROJECT, SCANS, TRUTH

MARKS = (PROJECT, *DESIGNS)
NOT_INPUTS = (*NOT_SCANS, TRUTH, RESULTS_H5)
STATE = ".batch"  # folder of a batch's state, in that of its results
PROSE = (".txt", ".csv", ".asc")  # may hold anything
PEEK = 1 << 16  # bytes, in which a text of points has a row of numbers
POINT = re.compile(rb"^[^\w+-]*(?:[+-]?\d[\d.,eE+-]*[\s;,|]+){2}[+-]?\d", re.M)


@dataclass(frozen=True)
class Input:
    """One job's input: ``name`` is its path below the root, "." the root itself."""

    name: str
    path: Path
    is_scene: bool = False


def find(root: Path, out: Path) -> tuple[list[Input], dict[str, Reason]]:
    """Find every input below ``root`` outside ``out``, in the order of their names; links are not followed.

    Returned with them are, by name, the reasons why other files and folders are left out.

    A folder with project.toml or a design is one input with all its content. So is any other folder below ``root``
    with scans, in itself or in scans/, and no further inputs. If it has further inputs, each of its scan files is an
    input, as are those of ``root``.
    """
    left_out: dict[str, Reason] = {}
    return sorted(_search(root, "", out, left_out), key=lambda each: os.fsencode(each.name)), left_out


def _search(folder: Path, name: str, out: Path, left_out: dict[str, Reason]) -> list[Input]:
    if folder == out:
        return []
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: os.fsencode(entry.name))
    except OSError as error:
        left_out[name or "."] = reason("batch.unreadable", error=error.strerror or str(error))
        return []
    names = {entry.name for entry in entries}
    if STATE in names or names.issuperset((RESULTS_JSON, RESULTS_H5)):
        left_out[name or "."] = reason("batch.holds-results")
        return []
    if names.intersection(MARKS):
        # Projects within a scan folder are parts of it
        for place, folders, files in os.walk(folder):
            folders[:] = sorted(each for each in folders if not each.startswith("."))
            if PROJECT in files and Path(place) != folder:
                within = Path(name, Path(place).relative_to(folder))
                left_out[str(within)] = reason("batch.in-scan-folder", folder=name or ".")
        return [Input(name or ".", folder)]
    below: list[Input] = []
    scans: list[Input] = []
    scenes: list[Input] = []
    in_scans = False
    for entry in entries:
        inner, path = f"{name}/{entry.name}".lstrip("/"), Path(entry.path)
        if entry.name.startswith("."):
            continue
        if entry.is_symlink():
            if entry.is_dir() or _is_scan(path) or _is_scene(path):
                left_out[inner] = reason("batch.link")
        elif readers.is_closed(path):
            scans.append(Input(inner, path))
        elif entry.is_dir():
            in_scans = in_scans or (entry.name == SCANS and _holds_scans(path))
            below += _search(path, inner, out, left_out)
        elif _is_scene(path):
            scenes.append(Input(inner, path, True))
        elif _is_scan(path):
            scans.append(Input(inner, path))
        elif path.suffix.lower() in readers.SUFFIXES and entry.name not in NOT_INPUTS:
            left_out[inner] = reason("batch.no-coordinates")
    # scans/ belongs to this folder unless something else in it would be a separate input.
    only_scans = in_scans and [each.name for each in below] == [f"{name}/{SCANS}".lstrip("/")]
    if not scenes and ((only_scans and (name or not scans)) or (name and scans and not below)):
        return [Input(name or ".", folder)]
    return [*below, *scenes, *scans]


def _is_scene(path: Path) -> bool:
    return path.suffix.lower() == ".h5" and path.name not in NOT_INPUTS and path.is_file()


def _is_scan(path: Path) -> bool:
    suffix = path.suffix.lower()
    if suffix not in readers.SUFFIXES or path.name in NOT_INPUTS or not path.is_file():
        return False
    if suffix not in PROSE:
        return True
    try:
        with path.open("rb") as file:
            head = file.read(PEEK)
    except OSError:
        return True  # reported later as a scan that cannot be read
    return bool(POINT.search(head.replace(b"\0", b"")))


def _holds_scans(folder: Path) -> bool:
    try:
        return any(readers.is_closed(path) or _is_scan(path) for path in folder.iterdir())
    except OSError:
        return False
