"""Folders that are made whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processor.model import InputError, UsageError
from processor.store.atomic_file import sync
from processor.store.making import beside
from processor.store.output_checks import check_folder


def check_new(folder: Path) -> None:
    """Raise UsageError where a folder exists and is not empty, or is a file; InputError where it cannot be made."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: exists and is not empty; name a new folder")
    check_folder(folder)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that is renamed to ``folder`` at the end, and removed after an error.

    Raises InputError where it cannot be written, as on a full disk.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with beside(folder.parent) as place:
            making = place / "new"
            making.mkdir()
            yield making
            for written in (*making.rglob("*"), making):
                sync(written)
            if folder.exists():
                folder.rmdir()
            os.replace(making, folder)
            sync(folder.parent)
    except OSError as error:
        raise unwritable(folder, error) from error


def unwritable(folder: Path, error: OSError) -> InputError:
    """Return the error of a folder that cannot be written."""
    reason = error.strerror or error
    return InputError(
        f"cannot be written ({reason}); nothing was kept: free the disk or name another folder", path=folder
    )
