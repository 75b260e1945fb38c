"""Checks that the readers of all formats share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processor.model import InputError


@contextmanager
def errors_name_the_file(path: Path, kind: str) -> Iterator[None]:
    """Convert any error of a format's library into an InputError that names the file.

    Readers written in Rust panic with a BaseException, so it is caught too; an interrupt is not.
    """
    try:
        yield
    except (InputError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        message = (str(error).strip().splitlines() or [""])[0][:200] or type(error).__name__
        raise InputError(f"{path}: not a readable {kind} file: {message}; copy or export it again") from error


def check_declared_points(path: Path, kind: str, declared: int, least_bytes: float, room: int) -> None:
    """Raise InputError if ``declared`` points of at least ``least_bytes`` each do not fit in ``room`` bytes."""
    if declared < 0 or declared * least_bytes > room:
        raise InputError(
            f"{path}: the header declares {declared} points, but the file has only {room} bytes for them; "
            f"this {kind} file is cut off or damaged: copy or export it again"
        )
