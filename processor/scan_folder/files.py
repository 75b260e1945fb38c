"""Names of the files of a scan folder, and the scan files in it."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from processor import readers
from processor.model import InputError, did_you_mean
from processor.scan_folder import node_list

PROJECT = "project.toml"
TRUTH = "truth.h5"
STATIONS = "stations.json"
PICKS = "picks.csv"
CONTROL = "control.csv"
DESIGNS = ("design.json", "design.csv")
SCANS = "scans"
CAD_SUFFIXES = (".step", ".stp", ".ifc")  # made into meshes first, see :mod:`processor.scan_folder.cad`
NOT_SCANS = ("design.csv", PICKS, "deviation.csv", CONTROL, "index.csv")


def node_list_in(folder: Path, excluded: Collection[Path | None]) -> str:
    """Return the name of the one list of a frame's nodes in a folder, by the headings of its columns; "" without one.

    Raises InputError for several.
    """
    excluded = {*excluded, *(folder / name for name in NOT_SCANS)}
    found = [
        path.name
        for path in sorted(folder.iterdir())
        if path not in excluded and not path.name.startswith(".") and node_list.is_node_list(path)
    ]
    if len(found) > 1:
        raise InputError(
            f"{folder}: {' and '.join(found[:3])} are lists of a frame's nodes; state the one that is the design by "
            f"'design' in {PROJECT}, and the scans by [[scan]]"
        )
    return found[0] if found else ""


def missing(path: Path) -> InputError:
    """Return the error of a path that leads nowhere, with the names in its folder that are most like it."""
    near = sorted(one.name for one in path.parent.iterdir()) if path.parent.is_dir() else []
    return InputError(f"there is no such file or folder{did_you_mean(path.name, near)}", path=path)


def existing(path: Path) -> Path:
    """Return a path that leads to something, and has a name: not ``.``. Raises InputError as :func:`missing` has it."""
    if not path.exists():
        raise missing(path)
    return path if path.name not in ("", "..") else path.resolve()


def scan_files(folder: Path, excluded: Collection[Path | None]) -> list[Path]:
    """Return the files in ``folder`` and ``folder/scans`` in a format of scans, open or closed, except ``excluded``."""
    return _scans_in([place for place in (folder, folder / SCANS) if place.is_dir()], excluded)


def scan_files_below(folder: Path, excluded: Collection[Path | None]) -> list[Path]:
    """Return the same; without any there, those in the folders below that are no scan folders themselves."""
    found = scan_files(folder, excluded)
    return found or _scans_in([place for place in sorted(folder.glob("[!.]*")) if belongs(place)], excluded)


def belongs(place: Path) -> bool:
    """Whether a path is a folder that belongs to the scan folder it lies in, and is none of its own."""
    return place.is_dir() and not place.is_symlink() and not (place / PROJECT).exists() and not (place / SCANS).exists()


def _scans_in(places: Collection[Path], excluded: Collection[Path | None]) -> list[Path]:
    paths = [path for place in places for path in sorted(place.iterdir())]
    known = [path for path in paths if path.suffix.lower() in readers.SUFFIXES and path.name not in NOT_SCANS]
    scans = {path for path in known if path not in excluded and path.is_file()}
    return [path for path in paths if path.name[0] != "." and (readers.is_closed(path) or path in scans)]
