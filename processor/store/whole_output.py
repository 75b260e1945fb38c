"""Outputs that are written whole or not at all: made under a temporary name, synced to the disk, and moved into place.

Whether a place can be written is tried before the work.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processor.model import InputError, UsageError
from processor.store.making import OLD, beside

NEW = "new"  # in a temporary folder: a folder that is made


# --- files -----------------------------------------------------------------------------------------------------------


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path, and replace ``path`` by it once its content is on the disk.

    Raises InputError where the file cannot be written. On any error the temporary file is removed and ``path`` stays
    unchanged.
    """
    if path.exists() and not path.is_file():
        raise InputError("is a folder, device or pipe; name a file", path=path)
    try:
        with beside(path.parent) as folder:
            yield folder / path.name
            sync(folder / path.name)
            os.replace(folder / path.name, path)
            sync(path.parent)
    except (OSError, RuntimeError) as error:
        # HDF5 tells the number of the error in its text alone, and not always by an OSError.
        number = re.search(r"\berrno = (\d+)", str(error))
        if number is None and not isinstance(error, OSError):
            raise
        cause = OSError(int(number[1]), os.strerror(int(number[1]))) if number else error
        assert isinstance(cause, OSError)
        if number:
            cause.__cause__ = error
        message = f"cannot be written ({cause.strerror or cause}); free the disk or choose another folder"
        raise InputError(message, path=path) from cause


def replace_text(path: Path, text: str) -> None:
    """Write a text file whole, or leave it as it was. Raises InputError if it cannot be written."""
    with replacing(path) as temporary:
        temporary.write_text(text, "utf-8", newline="")


def sync(path: Path) -> None:
    """Wait until a file or folder is written to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


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


# --- folders ---------------------------------------------------------------------------------------------------------


@contextmanager
def whole_folder(out: Path, replaces: bool = False) -> Iterator[Path]:
    """Yield a folder to write into, which becomes ``out`` when all is written, and is removed on any error.

    With ``replaces`` it takes the place of what is there, but for logs, which stay; else that must be empty. Raises
    InputError where it cannot be written, as on a full disk.
    """
    out = Path(os.path.abspath(out))
    new = out
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside(out.parent) as place:
            new = place / NEW
            new.mkdir()
            yield new
            for written in (*new.rglob("*"), new):
                sync(written)
            if replaces:
                _replace(new, out, place / OLD)
            else:
                if out.exists():
                    out.rmdir()
                os.replace(new, out)
            sync(out.parent)
    except OSError as error:
        raise unwritable(out, error) from error
    except InputError as error:
        if error.path is None or not error.path.is_relative_to(new):
            raise
        # The file was in the folder that is removed: the message names the place that it was for.
        raise InputError(error.problem, path=out / error.path.relative_to(new)) from error


def unwritable(folder: Path, error: OSError) -> InputError:
    """Return the error of a folder that cannot be written."""
    why = error.strerror or error
    return InputError(f"cannot be written ({why}); nothing changed: free the disk or name another folder", path=folder)


def _replace(made: Path, out: Path, old: Path) -> None:
    """Move a folder into the place of another, which is moved to the folder ``old`` before; its logs stay.

    A log gets a second name, so that what is still written to it is there as well; else it is copied.
    """
    if out.exists():
        for log in filter(is_log, out.iterdir()):
            try:
                os.link(log, made / log.name)
            except OSError:
                shutil.copy2(log, made / log.name)
        old.mkdir()
        os.replace(out, old / out.name)
    try:
        os.replace(made, out)
    except OSError:
        if old.exists():
            os.replace(old / out.name, out)
        raise


def is_log(path: Path) -> bool:
    """Whether a file in a folder of results is a log, as of the command that writes them."""
    return (path.suffix == ".log" or path.name == "log") and path.is_file() and not path.is_symlink()


def check_new(folder: Path) -> None:
    """Raise UsageError where a folder exists and is not empty, or is a file; InputError where it cannot be made."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: exists and is not empty; name a new folder")
    check_folder(folder)


def check_folder(out: Path) -> None:
    """Raise InputError where a folder cannot be made; nothing is left of the trial, no parent is made."""
    _try(out, existing_parent(out))


def existing_parent(out: Path) -> Path:
    """Return the nearest folder above a path that is there."""
    place = out.absolute().parent
    while not place.exists() and place != place.parent:
        place = place.parent
    return place


def _try(path: Path, place: Path) -> None:
    if not place.is_dir():
        raise InputError(f"cannot be written: {place} is a file; name another place", path=path)
    try:
        with beside(place):
            pass
    except OSError as error:
        why = error.strerror or error
        raise InputError(f"cannot be written ({why}); nothing was done: name another place", path=path) from error
