"""Temporary folders beside outputs, in which these are made whole before they are moved into place.

A folder is locked as long as its process lives. What a killed process has left is not, and the next one removes it.
"""

from __future__ import annotations

import fcntl
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FOLDER = re.compile(r"\.[0-9a-f]{16}\.steel-scan-check")  # no other program has such names
OLD = "old"  # in a temporary folder: what an output replaces, under its name

_cleared: set[Path] = set()


@contextmanager
def beside(place: Path | None = None) -> Iterator[Path]:
    """Yield a temporary folder in ``place``, None: where the system has such folders; it is removed at the end.

    Only its owner can read it. Raises OSError where none can be made.
    """
    place = Path(tempfile.gettempdir() if place is None else place).absolute()
    if place not in _cleared:  # once a process: a set of scenes has as many files as it is written times
        _cleared.add(place)
        remove_leftovers(place)
    folder, lock = _new(place)
    try:
        yield folder
    finally:
        _put_back(folder)
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def remove_leftovers(place: Path) -> None:
    """Remove the temporary folders in ``place`` whose processes were killed, and put back what was being replaced."""
    with suppress(OSError):
        for folder in [Path(entry) for entry in os.scandir(place) if FOLDER.fullmatch(entry.name)]:
            with suppress(OSError):
                handle = _opened(folder)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    if os.fstat(handle).st_uid == os.geteuid():
                        _put_back(folder)
                        shutil.rmtree(folder, ignore_errors=True)
                finally:
                    os.close(handle)


def _new(place: Path) -> tuple[Path, int]:
    """Make and lock a folder; another process may remove it between the two."""
    while True:
        folder = place / f".{secrets.token_hex(8)}.steel-scan-check"
        folder.mkdir(0o700)
        with suppress(FileNotFoundError):
            handle = _opened(folder)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(handle)
                continue
            except OSError:  # no file system for locks: nothing on it is taken for a leftover
                return folder, handle
            if folder.exists():
                return folder, handle
            os.close(handle)


def _opened(folder: Path) -> int:
    return os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)


def _put_back(folder: Path) -> None:
    for old in (folder / OLD).iterdir() if (folder / OLD).is_dir() else ():
        if not os.path.lexists(folder.parent / old.name):
            os.replace(old, folder.parent / old.name)
