"""Records of fixed size, and columns filled from pieces: what binary PLY and PCD share."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, BinaryIO

import numpy as np

from processor.model import Floats

PIECE_BYTES = 1 << 19  # small enough to stay in a processor's own cache between the passes over it


def of_records(file: BinaryIO, dtype: Any, wanted: Sequence[str], count: int) -> Iterator[Sequence[Any]]:
    """Give the wanted fields, as columns, of the next ``count`` records of a file, piece by piece.

    Each piece is good until the next one is asked for.
    """
    size = dtype.itemsize
    text = bytearray(max(1, min(count, PIECE_BYTES // size)) * size)
    view = memoryview(text)
    while count > 0:
        filled = 0
        while filled < len(view) and (got := file.readinto(view[filled:])):  # type: ignore[attr-defined]
            filled += got
        records = np.frombuffer(text, dtype, min(filled // size, count))
        if not len(records):
            return
        count -= len(records)
        yield [records[name] for name in wanted]


def fill(columns: Sequence[Floats], pieces: Iterable[Any]) -> None:
    """Fill columns, the first of them (n, 3), the others (n,), from pieces: lists of columns, or arrays (m, k).

    Raises ValueError where the pieces hold fewer rows.
    """
    found, count = 0, len(columns[0])
    for piece in pieces:
        if isinstance(piece, np.ndarray):
            rows = slice(found, found + len(piece))
            columns[0][rows] = piece[:, :3]
            parts = list(piece.T)
        else:
            parts = piece
            rows = slice(found, found + len(parts[0]))
            for axis in range(3):
                columns[0][rows, axis] = parts[axis]
        for column, part in zip(columns[1:], parts[3:], strict=True):
            column[rows] = part
        found += len(parts[0])
    if found != count:
        raise ValueError(f"{count} points are declared, but {found} were found")
