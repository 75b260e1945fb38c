"""Folders that are replaced as a whole: made under a temporary name, then moved into place."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from processor.model import InputError
from processor.store.making import OLD, beside

NEW = "new"


@contextmanager
def replacing_folder(out: Path) -> Iterator[Path]:
    """Yield a folder to write into, which replaces ``out`` when all is written and is removed on any error.

    Raises InputError where it cannot be written.
    """
    out = Path(os.path.abspath(out))
    new = out
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside(out.parent) as folder:
            new = folder / NEW
            new.mkdir()
            yield new
            _replace(new, out, folder / OLD)
    except OSError as error:
        raise InputError(
            f"cannot be written ({error.strerror or error}); nothing was changed there", path=out
        ) from error
    except InputError as error:
        if error.path is None or not error.path.is_relative_to(new):
            raise
        # The file was in the folder that is removed: the message names the place that it was for.
        raise InputError(error.problem, path=out / error.path.relative_to(new)) from error


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8, onto the disk."""
    write_parts(path, (text,))


def write_parts(path: Path, parts: Iterable[str]) -> None:
    """Write a text as UTF-8 part by part, onto the disk."""
    _write(path, (part.encode("utf-8") for part in parts))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file, onto the disk."""
    _write(path, (data,))


def _write(path: Path, parts: Iterable[bytes]) -> None:
    with path.open("wb") as file:
        for part in parts:
            file.write(part)
        file.flush()
        os.fsync(file.fileno())


def _replace(made: Path, out: Path, old: Path) -> None:
    """Move a folder into the place of another, which is moved to the folder ``old`` before; its logs stay."""
    if out.exists():
        for log in filter(is_log, out.iterdir()):
            _link(log, made / log.name)
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


def _link(file: Path, place: Path) -> None:
    """Give a file a second name, so that what is still written to it is there as well; else copy it."""
    try:
        os.link(file, place)
    except OSError:
        shutil.copy2(file, place)
