"""Folders that are replaced as a whole: made under a temporary name, then moved into place."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from processor.model import InputError


@contextmanager
def replacing_folder(out: Path) -> Iterator[Path]:
    """Yield a folder to write into, which replaces ``out`` when all is written and is removed on any error.

    Raises InputError where it cannot be written.
    """
    out = out.absolute()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        making = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise _unwritable(out, error) from error
    try:
        os.chmod(making, 0o755)
        yield making
        _replace(making, out)
    except BaseException as error:
        shutil.rmtree(making, ignore_errors=True)
        if isinstance(error, OSError):
            raise _unwritable(out, error) from error
        if isinstance(error, InputError) and error.path is not None and error.path.is_relative_to(making):
            # The file was in the folder that is removed: the message names the place that it was for.
            raise InputError(error.problem, path=out / error.path.relative_to(making)) from error
        raise


def _unwritable(out: Path, error: OSError) -> InputError:
    return InputError(f"cannot be written ({error.strerror or error}); nothing was changed there", path=out)


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


def _replace(made: Path, out: Path) -> None:
    """Move a folder into the place of another, which is removed only after that."""
    if not out.exists():
        os.replace(made, out)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{out.name}-old-", dir=out.parent))
    os.replace(out, old / "old")
    try:
        os.replace(made, out)
    except OSError:
        os.replace(old / "old", out)
        os.rmdir(old)
        raise
    shutil.rmtree(old, ignore_errors=True)
