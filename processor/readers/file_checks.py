"""Checks that the readers of all formats share."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processor.large_arrays import NoRoomError
from processor.model import InputError


@contextmanager
def errors_name_the_file(path: Path, kind: str) -> Iterator[None]:
    """Convert any error of a format's library into an InputError that names the file.

    Readers written in Rust panic with a BaseException, so it is caught too; an interrupt is not.
    """
    try:
        yield
    except (InputError, NoRoomError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        message = (str(error).strip().splitlines() or [""])[0][:200] or type(error).__name__
        raise InputError(f"not a readable {kind} file: {message}; copy or export it again", path=path) from error


def check_declared_points(path: Path, kind: str, declared: int, least_bytes: float, room: int) -> None:
    """Raise InputError if ``declared`` points of at least ``least_bytes`` each do not fit in ``room`` bytes."""
    if declared < 0 or declared * least_bytes > room:
        raise InputError(
            f"the header declares {declared} points, but the file has only {room} bytes for them; "
            f"this {kind} file is cut off or damaged: copy or export it again",
            path=path,
        )


TAIL_BYTES, TAIL_ROWS = 1 << 14, 20  # twenty rows of text, of up to 800 bytes, show the usual number of decimals


def check_last_row(path: Path, kind: str) -> None:
    """Raise InputError if the file ends within a number of its last row: it has no end of line, and fewer decimals.

    The rows before, all with as many decimals in their last column, are the pattern; without it nothing is known.
    """
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - TAIL_BYTES))
        lines = file.read().splitlines(keepends=True)
    if len(lines) <= TAIL_ROWS + 1 or lines[-1].endswith((b"\n", b"\r")):
        return
    # Decimals of the last number of each line; 0 for a whole number, -1 for another word
    matches = [re.search(rb"(?:^|[\s,;])[+-]?\d+(?:[.,](\d*))?\s*$", line) for line in lines[-TAIL_ROWS - 1 :]]
    decimals = [len(match.group(1) or b"") if match else -1 for match in matches]
    if len(set(decimals[:-1])) == 1 and decimals[0] > 0 and 0 <= decimals[-1] < decimals[0]:
        with path.open("rb") as file:
            number = sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 20), b"")) + 1
        text = lines[-1].decode("latin-1").strip()[-40:]
        raise InputError(
            f"not a readable {kind} file: line {number}: expected {decimals[0]} decimals as in the lines "
            f"before, found the end of the file within a row ({text!r}); copy or export it again",
            path=path,
        )
