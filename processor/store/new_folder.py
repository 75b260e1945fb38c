"""Folders that are made whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processor.model import InputError, UsageError
from processor.store.atomic_file import sync
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
    making: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        making = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        yield making
        for written in (*making.rglob("*"), making):
            sync(written)
        if folder.exists():
            folder.rmdir()
        os.chmod(making, 0o755)
        os.replace(making, folder)
        sync(folder.parent)
    except BaseException as error:
        if making is not None:
            shutil.rmtree(making, ignore_errors=True)
        if isinstance(error, OSError):
            raise unwritable(folder, error) from error
        raise


def unwritable(folder: Path, error: OSError) -> InputError:
    """Return the error of a folder that cannot be written."""
    reason = error.strerror or error
    return InputError(
        f"cannot be written ({reason}); nothing was kept: free the disk or name another folder", path=folder
    )
