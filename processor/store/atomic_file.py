"""Files that are replaced as a whole: written under a temporary name, synced, and moved."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processor.model import InputError
from processor.store.making import beside


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
        system_error = _system_error(error)
        if system_error is None:
            raise
        reason = system_error.strerror or system_error
        message = f"cannot be written ({reason}); free the disk or choose another folder"
        raise InputError(message, path=path) from system_error


def _system_error(error: OSError | RuntimeError) -> OSError | None:
    """Return the error of the operating system that an exception tells; None for another RuntimeError."""
    # HDF5 tells the number of the error in its text alone, and not always by an OSError.
    number = re.search(r"\berrno = (\d+)", str(error))
    if number:
        of_hdf5 = OSError(int(number[1]), os.strerror(int(number[1])))
        of_hdf5.__cause__ = error
        return of_hdf5
    return error if isinstance(error, OSError) else None


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
