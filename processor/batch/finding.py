"""The inputs below a folder: scan folders, scene files, and scan files that lie about."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path

from processor import readers

PROJECT, SCANS = "project.toml", "scans"
MARKS = (PROJECT, "design.json", "design.csv")
RESULTS = ("results.json", "results.h5")
NOT_INPUTS = ("truth.h5", "results.h5", "design.csv", "picks.csv", "deviation.csv", "stations.json")
STATE = ".batch"  # of a batch, in its folder of results
PROSE = (".txt", ".csv", ".asc")  # may be anything
PEEK = 1 << 16
POINT = re.compile(rb"^[^\w+-]*(?:[+-]?\d[\d.,eE+-]*[\s;,|]+){2}[+-]?\d", re.M)


@dataclass(frozen=True)
class Input:
    """One job's input: ``name`` is its path below the root, "." the root itself."""

    name: str
    path: Path
    is_scene: bool = False


@dataclass
class Found:
    """The inputs, and what looks like one and is left out, with the reason."""

    inputs: list[Input] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)


def find(root: Path, out: Path) -> Found:
    """Find every input below ``root``, in the order of their names; nothing in ``out``, and no link is followed.

    A folder with project.toml or a design is one input with all that is in it. So is any other below ``root`` that
    holds scans, in itself or in scans/, and no further inputs; where it does hold some, its scan files are an input
    each, as those of ``root`` are.
    """
    found = Found()
    found.inputs = sorted(_look(root, "", out, found), key=lambda one: os.fsencode(one.name))
    return found


def _look(folder: Path, name: str, out: Path, found: Found) -> list[Input]:
    if folder == out:
        return []
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: os.fsencode(entry.name))
    except OSError as error:
        found.left_out[name or "."] = f"cannot be read ({error.strerror or error})"
        return []
    names = {entry.name for entry in entries}
    if STATE in names or names.issuperset(RESULTS):
        found.left_out[name or "."] = "holds results of an earlier run"
        return []
    if names.intersection(MARKS):
        _name_inner(folder, name, found)
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
                found.left_out[inner] = "a link; the batch follows none"
        elif readers.is_closed(path):
            scans.append(Input(inner, path))
        elif entry.is_dir():
            in_scans = in_scans or (entry.name == SCANS and _holds_scans(path))
            below += _look(path, inner, out, found)
        elif _is_scene(path):
            scenes.append(Input(inner, path, True))
        elif _is_scan(path):
            scans.append(Input(inner, path))
        elif path.suffix.lower() in readers.SUFFIXES and entry.name not in NOT_INPUTS:
            found.left_out[inner] = "holds no rows of coordinates, so it is taken for no scan"
    # scans/ belongs to this folder where nothing else is in it that would be an input of its own.
    only_scans = in_scans and [one.name for one in below] == [f"{name}/{SCANS}".lstrip("/")]
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
        return True  # a scan that cannot be read is to be reported, not passed over
    return bool(POINT.search(head.replace(b"\0", b"")))


def _holds_scans(folder: Path) -> bool:
    try:
        return any(readers.is_closed(one) or _is_scan(one) for one in folder.iterdir())
    except OSError:
        return False


def _name_inner(folder: Path, name: str, found: Found) -> None:
    """Name projects within a scan folder: they are taken as parts of it, and not run."""
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(one for one in folders if not one.startswith("."))
        if PROJECT in files and Path(place) != folder:
            inner = Path(name, Path(place).relative_to(folder))
            found.left_out[str(inner)] = f"lies within the scan folder {name or '.'}"
