"""Outputs are tried before the work: whether a folder or a file can be written where it is to be."""

from __future__ import annotations

from pathlib import Path

from processor.model import InputError, UsageError
from processor.store.making import beside


def check_folder(out: Path) -> None:
    """Raise InputError where a folder cannot be made; nothing is left of the trial, no parent is made."""
    _try(out, existing_parent(out))


def existing_parent(out: Path) -> Path:
    """Return the nearest folder above a path that is there."""
    place = out.absolute().parent
    while not place.exists() and place != place.parent:
        place = place.parent
    return place


def check_file(path: Path, suffix: str, what: str) -> None:
    """Raise InputError where a file cannot be written, also for the lack of its folder.

    Raises UsageError for another suffix, and for what is there and no plain file: it would be replaced. ``what`` is
    what the file is.
    """
    if path.suffix.lower() != suffix:
        raise UsageError(f"{path}: expected {what} ({suffix}), found {path.suffix or 'no suffix'}; name one with -o")
    if path.exists() and not path.is_file():
        kind = "folder" if path.is_dir() else "device or pipe"
        raise UsageError(f"{path}: is a {kind}; name a file for {what}")
    if not path.absolute().parent.exists():
        raise InputError(f"cannot be written: there is no folder {path.parent}; make it first", path=path)
    _try(path, path.absolute().parent)


def _try(path: Path, place: Path) -> None:
    if not place.is_dir():
        raise InputError(f"cannot be written: {place} is a file; name another place", path=path)
    try:
        with beside(place):
            pass
    except OSError as error:
        why = error.strerror or error
        raise InputError(f"cannot be written ({why}); nothing was done: name another place", path=path) from error
