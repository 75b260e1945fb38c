"""Rows of numbers in text, piece by piece: what tables, PTX and the ASCII forms of PLY and PCD share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from processor.model import Floats

PIECE_BYTES = 4 << 20
PIECE_ROWS = 1 << 15
LONGEST_LINE = 1 << 20
NUMBERS = frozenset(b"+-0123456789.eE")
WORDS = ("nan", "inf", "infinity")


class Rows:
    """The rest of an open file as lines and rows of numbers.

    ``separator`` is None for blanks; ``commas``: numbers may have decimal commas; ``remarks``: // and % begin remarks,
    as # always does. Raises ValueError, with the line's number in the file, for what does not fit.
    """

    def __init__(
        self, file: BinaryIO, separator: str | None = None, commas: bool = False, remarks: bool = False
    ) -> None:
        self._file = file
        self._separator = ord(separator) if separator else 0
        self._commas, self._remarks = commas, remarks
        self._text = np.empty(0, np.uint8)
        self._at = 0

    def line(self) -> str | None:
        """Return the next line that is not blank; None at the end."""
        while self._fill():
            rest = self._text[self._at : self._at + LONGEST_LINE].tobytes()
            text = rest.replace(b"\r\n", b"\n ").replace(b"\r", b"\n").split(b"\n", 1)[0]
            self._at = min(self._at + len(text) + 1, len(self._text))
            if text.strip():
                return text.decode("utf-8-sig", "replace").strip()
        return None

    def width(self) -> int:
        """Return the count of words of the next line that is not blank, which stays to be read."""
        while self._fill():
            line = self._text[self._at : self._at + LONGEST_LINE].tobytes().split(b"\n", 1)[0]
            if line.strip():
                return len(line.split())
            self.skip_line()
        return 0

    def skip_line(self) -> None:
        """Pass over one line, blank or not."""
        if self._fill():
            ends = np.flatnonzero(_ends(self._text[self._at : self._at + LONGEST_LINE]))
            end = self._at + int(ends[0]) if len(ends) else len(self._text)
            pair = self._text[end : end + 2].tobytes() == b"\r\n"
            self._at = min(end + 1 + pair, len(self._text))

    def most_left(self) -> int:
        """Return how many rows there can be at most to the end of the file."""
        from processor.readers.decimal import count_ends

        found = int(count_ends(self._text, self._at, len(self._text))) + 1
        place = self._file.tell()
        while piece := self._file.read(PIECE_BYTES):
            found += int(count_ends(np.frombuffer(piece, np.uint8), 0, len(piece)))
        self._file.seek(place)
        return found

    def pieces(self, columns: Sequence[int], most: int = 2**62) -> Iterator[Floats]:
        """Give the numbers (n, k) of some columns of the next rows, at most ``most`` of them, piece by piece.

        Each piece is good until the next one is asked for.
        """
        from processor.readers import decimal

        slots = np.full(max(columns) + 1, -1, np.int64)
        slots[list(columns)] = np.arange(len(columns))
        odd = np.empty((decimal.ODD_LIMIT, 4), np.int64)
        out = np.empty((min(most, PIECE_ROWS), len(columns)))
        while most > 0 and self._fill():
            text = self._text
            kinds = (slots, self._separator, self._commas, self._remarks, out, odd, decimal.HIGH, decimal.LOW)
            why, rows, end, odds, column = decimal.parse(text, self._at, min(most, len(out)), *kinds)
            for row, slot, first, last in odd[:odds].tolist():
                out[row, slot] = self._number(text[first:last].tobytes(), first)
            if why == decimal.SHORT_ROW:
                raise ValueError(f"line {self._at_line(end)}: expected {len(slots)} columns or more, found {column}")
            self._at = end
            most -= rows
            if rows:
                yield out[:rows]

    def _number(self, token: bytes, place: int) -> float:
        text = token.decode("latin-1").strip()
        number = text.replace(",", ".") if self._commas else text
        try:
            if not set(token.strip()) <= NUMBERS | set(b",") and number.lower().lstrip("+-") not in WORDS:
                raise ValueError
            return float(number)
        except ValueError:
            raise ValueError(f"line {self._at_line(place)}: expected a number, found {text[:40]!r}") from None

    def _at_line(self, place: int) -> int:
        """Return the number in the file of the line with a place in ``_text``: counted only when asked for."""
        from processor.readers.decimal import count_ends

        left = self._file.tell() - len(self._text) + place
        self._file.seek(0)
        lines = 1
        while left > 0 and (piece := self._file.read(min(left, PIECE_BYTES))):
            if piece.endswith(b"\r") and left > len(piece):
                piece += self._file.read(1)  # both bytes of an end at once
            lines += int(count_ends(np.frombuffer(piece, np.uint8), 0, len(piece)))
            left -= len(piece)
        return lines

    def _fill(self) -> bool:
        """Have whole lines from ``_at`` on. False at the end of the file."""
        if self._at < len(self._text):
            return True
        piece = self._file.read(PIECE_BYTES)
        if not piece:
            return False
        tail = self._file.readline(LONGEST_LINE + 1)
        if len(tail) > LONGEST_LINE:
            line = self._at_line(len(self._text))
            raise ValueError(f"line {line} or one after it is longer than {LONGEST_LINE} bytes")
        self._text, self._at = np.frombuffer(piece + tail, np.uint8), 0
        return True


def _ends(text: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    ends: npt.NDArray[np.bool_] = (text == 10) | (text == 13)
    return ends
