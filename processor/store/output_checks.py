"""Outputs are tried before the work: whether a folder or a file can be written where it is to be."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from processor.model import InputError


def check_folder(out: Path) -> None:
    """Raise InputError where a folder cannot be made; nothing is left of the trial, no parent is made."""
    _try(out, existing_parent(out))


def existing_parent(out: Path) -> Path:
    """Return the nearest folder above a path that is there."""
    place = out.absolute().parent
    while not place.exists() and place != place.parent:
        place = place.parent
    return place


def check_file(path: Path) -> None:
    """Raise InputError where a file cannot be written, also for the lack of its folder."""
    if path.is_dir():
        raise InputError("is a folder; name a file", path=path)
    if not path.absolute().parent.exists():
        raise InputError(f"cannot be written: there is no folder {path.parent}; make it first", path=path)
    _try(path, path.absolute().parent)


def _try(path: Path, place: Path) -> None:
    if not place.is_dir():
        raise InputError(f"cannot be written: {place} is a file; name another place", path=path)
    try:
        os.rmdir(tempfile.mkdtemp(prefix=".trial-", dir=place))
    except OSError as error:
        why = error.strerror or error
        raise InputError(f"cannot be written ({why}); nothing was done: name another place", path=path) from error
