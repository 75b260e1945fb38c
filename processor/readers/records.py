"""Records of fixed size, and columns filled from pieces: what binary PLY and PCD share."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, BinaryIO

import numpy as np

from processor.model import Floats

PIECE = 1 << 18  # records


def of_records(file: BinaryIO, dtype: Any, wanted: Sequence[str], count: int) -> Iterator[Sequence[Any]]:
    """Give the wanted fields, as columns, of the next ``count`` records of a file, piece by piece."""
    while count > 0:
        data = file.read(min(count, PIECE) * dtype.itemsize)
        records = np.frombuffer(data, dtype, len(data) // dtype.itemsize)
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
        parts = list(piece.T) if isinstance(piece, np.ndarray) else piece
        rows = slice(found, found + len(parts[0]))
        for axis in range(3):
            columns[0][rows, axis] = parts[axis]
        for column, part in zip(columns[1:], parts[3:], strict=True):
            column[rows] = part
        found += len(parts[0])
    if found != count:
        raise ValueError(f"{count} points are declared, but {found} were found")
