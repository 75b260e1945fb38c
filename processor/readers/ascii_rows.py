"""Rows of numbers in text, piece by piece: used for tables, PTX and the ASCII forms of PLY and PCD."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from functools import partial
from itertools import pairwise
from typing import BinaryIO

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.inner_kernels import inner
from processor.model import Floats, Ints

PIECE_BYTES = 4 << 20  # work, not result: read at once and parsed by the workers in parts
PIECE_ROWS = 1 << 17  # more rows than a worker's part of a piece has
MOST_WORKERS = 4  # work: lines are read and split by one thread, which more would wait for
LEAST_PART = 1 << 16  # bytes: less is parsed sooner than a thread is started
ODD_LIMIT = 4096  # numbers converted by float() before a piece ends
ENDED, FULL, ODD, SHORT_ROW, LONG_ROW = range(5)  # reasons why parsing stopped
LONGEST_LINE = 1 << 20  # bytes: a row of numbers has hundreds; a longer one is no table and would fill the memory
NUMBERS = frozenset(b"+-0123456789.eE")
WORDS = ("nan", "inf", "infinity")
EXACT = 1 << 53  # whole numbers below are exact as float64
SPLITTER = 2.0**27 + 1.0  # halves of a float64 (Dekker 1971)


class _Buffer:
    """Output arrays of one worker."""

    def __init__(self, rows: int, columns: int) -> None:
        self.out = np.empty((rows, columns))
        self.odd = np.empty((ODD_LIMIT, 4), np.int64)


class Rows:
    """The rest of an open file as lines and rows of numbers.

    ``separator`` is None for blanks; ``commas``: numbers may have decimal commas; ``comments``: // and % begin
    comments, as # always does. Raises ValueError, with the number of the line in the file, for unexpected text.
    """

    def __init__(
        self, file: BinaryIO, separator: str | None = None, commas: bool = False, comments: bool = False
    ) -> None:
        self._file = file
        start = file.tell()
        self.size = file.seek(0, os.SEEK_END)  # of the file, bytes
        file.seek(start)
        self._separator = ord(separator) if separator else 0
        self._commas, self._comments = commas, comments
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
        """Return the number of words of the next line that is not blank, without consuming the line."""
        while self._fill():
            line = self._text[self._at : self._at + LONGEST_LINE].tobytes().split(b"\n", 1)[0]
            if line.strip():
                return len(line.split())
            self.skip_line()
        return 0

    def skip_line(self) -> None:
        """Skip one line, blank or not."""
        if self._fill():
            ends = np.flatnonzero(_ends(self._text[self._at : self._at + LONGEST_LINE]))
            end = self._at + int(ends[0]) if len(ends) else len(self._text)
            pair = self._text[end : end + 2].tobytes() == b"\r\n"
            self._at = min(end + 1 + pair, len(self._text))

    def bytes_read(self) -> int:
        """Return how many bytes of the file were read."""
        return self._file.tell()

    def likely_left(self) -> int:
        """Estimate the number of rows to the end of the file from the lines in memory, with a margin of 5 %."""
        if not self._fill():
            return 0
        lines, size = int(count_ends(self._text, self._at, len(self._text))) + 1, len(self._text) - self._at
        return lines + int(1.05 * (self.size - self._file.tell()) * lines / size)

    def pieces(self, columns: Sequence[int], most: int = 2**62, width: int = 0) -> Iterator[Floats]:
        """Yield the numbers (n, k) of some columns of the next rows, at most ``most`` of them, piece by piece.

        A piece is valid until the next one is requested. Rows have ``width`` columns, for 0 any that hold those wanted.
        """
        slots = np.full(max(*columns, width - 1) + 1, -1, np.int64)
        slots[list(columns)] = np.arange(len(columns))
        workers = max(1, min(MOST_WORKERS, os.cpu_count() or 1))
        buffers = [_Buffer(min(most, PIECE_ROWS), len(columns)) for _ in range(workers)]
        with ThreadPoolExecutor(workers) as pool:
            while most > 0 and self._fill():
                parts = self._parts(workers)
                parse = partial(self._parse, slots, width > 0, most)
                rest = zip(buffers[1:], parts[1:], strict=False)
                jobs = [pool.submit(parse, buffer, *part) for buffer, part in rest]
                for i, part in enumerate(parts):
                    reason, rows, end, odds, column = jobs[i - 1].result() if i else parse(buffers[0], *part)
                    if i and rows >= most:
                        break  # the number of rows of the parts before was not known when the job began
                    self._convert_odd(buffers[i], odds)
                    if reason == SHORT_ROW:
                        line = self._at_line(end)
                        more = "" if width else " or more"
                        raise ValueError(f"line {line}: expected {len(slots)} columns{more}, found {column}")
                    if reason == LONG_ROW:
                        line = self._at_line(end)
                        raise ValueError(f"line {line}: expected {width} columns as in other lines, found more")
                    self._at = end
                    most -= rows
                    if rows:
                        yield buffers[i].out[:rows]
                    if reason != ENDED:
                        break  # the rest of the part is parsed next
                for job in jobs:
                    job.result()

    def _parts(self, workers: int) -> list[tuple[int, int]]:
        """Cut the text at ends of lines into one part per worker, or leave it whole where it is short."""
        size = len(self._text) - self._at
        if size < workers * LEAST_PART:
            return [(self._at, len(self._text))]
        cuts = [self._at]
        for i in range(1, workers):
            start = max(cuts[-1], self._at + i * size // workers)
            ends = np.flatnonzero(self._text[start : start + LEAST_PART] == 10)
            if len(ends):
                cuts.append(start + int(ends[0]) + 1)
        return list(pairwise([*cuts, len(self._text)]))

    def _parse(
        self, slots: Ints, exact: bool, most: int, buffer: _Buffer, start: int, stop: int
    ) -> tuple[int, int, int, int, int]:
        most = min(most, len(buffer.out))
        form = self._separator, self._commas, self._comments
        stopped: tuple[int, int, int, int, int] = parse(
            self._text[:stop], start, most, slots, (*form, exact), buffer.out, buffer.odd
        )
        return stopped

    def _convert_odd(self, buffer: _Buffer, odds: int) -> None:
        """Convert the numbers that the kernel left, by ``float()``."""
        for row, slot, first, last in buffer.odd[:odds].tolist():
            buffer.out[row, slot] = self._number(self._text[first:last].tobytes(), first)

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
        """Return the number in the file of the line at a position of ``_text``, by counting from the start."""
        left = self._file.tell() - len(self._text) + place
        self._file.seek(0)
        lines = 1
        while left > 0 and (piece := self._file.read(min(left, PIECE_BYTES))):
            if piece.endswith(b"\r") and left > len(piece):
                piece += self._file.read(1)  # both bytes of a line's end
            lines += int(count_ends(np.frombuffer(piece, np.uint8), 0, len(piece)))
            left -= len(piece)
        return lines

    def _fill(self) -> bool:
        """Read whole lines into ``_text`` where none are left. Returns False at the end of the file."""
        if self._at < len(self._text):
            return True
        piece = self._file.read(PIECE_BYTES)
        if not piece:
            return False
        tail = self._file.readline(LONGEST_LINE + 1)
        if len(tail) > LONGEST_LINE:
            line = self._at_line(len(self._text))
            raise ValueError(f"line {line} or a later one is longer than {LONGEST_LINE} bytes")
        self._text, self._at = np.frombuffer(piece + tail, np.uint8), 0
        return True


def _ends(text: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    ends: npt.NDArray[np.bool_] = (text == 10) | (text == 13)
    return ends


# --- Decimal numbers to float64: compiled, and rounded as by Python's float().


REACH = 60  # largest power of ten in the table


# Separator, 0 for blanks, else a byte that blanks may surround; whether numbers may have decimal commas; whether // and
# % begin comments, as # always does; whether a row has no more columns than slots.
Form = tuple[int, bool, bool, bool]
# Powers of ten, and what float64 lacks of each; compile-time constants: as arguments they cost more than the arithmetic
_POWERS = [Fraction(10) ** e for e in range(-REACH, REACH + 1)]
HIGH, LOW = np.array([(float(power), float(power - Fraction(float(power)))) for power in _POWERS]).T.copy()


@njit(cache=True, nogil=True)
def count_ends(text: npt.NDArray[np.uint8], start: int, stop: int) -> int:
    """Count the lines that end in a part of a text, by LF, CR or both."""
    count = 0
    for at in range(start, stop):
        count += text[at] == 10
    for at in range(start, stop - 1):
        count += (text[at] == 13) & (text[at + 1] != 10)
    if stop > start:
        count += text[stop - 1] == 13
    return count


@inner
def _times_power(digits: np.uint64, power: int) -> float:
    """Return digits * 10**power, rounded once: by exact operations, or else in double-double arithmetic (Dekker)."""
    if digits < EXACT and -22 <= power <= 22:  # both exact, so one rounding
        near = float(digits)
        return float(near / HIGH[REACH - power] if power < 0 else near * HIGH[REACH + power])
    a = float(digits >> np.uint64(32)) * 4294967296.0
    b = float(digits & np.uint64(0xFFFFFFFF))
    top = a + b
    rest = b - (top - a)
    p, q = HIGH[REACH + power], LOW[REACH + power]
    product = top * p
    split = SPLITTER * top
    t1 = split - (split - top)
    t2 = top - t1
    split = SPLITTER * p
    p1 = split - (split - p)
    p2 = p - p1
    error = ((t1 * p1 - product) + t1 * p2 + t2 * p1) + t2 * p2
    return float(product + (error + (top * q + rest * p)))


@inner
def _decimal(text: npt.NDArray[np.uint8], at: int, size: int, commas: bool) -> tuple[int, bool, np.uint64, int, int]:
    """Parse a decimal number: next byte, sign, digits as a whole number, their count, and the power of ten."""
    digits, count, power = np.uint64(0), 0, 0
    negative = False
    if at < size and (text[at] == 45 or text[at] == 43):
        negative = text[at] == 45
        at += 1
    start = at
    while at < size:
        digit = np.uint64(text[at]) - np.uint64(48)
        if digit > 9:
            break
        digits = digits * np.uint64(10) + digit
        at += 1
    count = at - start
    if at < size and (text[at] == 46 or (commas and text[at] == 44)):
        at += 1
        start = at
        while at < size:
            digit = np.uint64(text[at]) - np.uint64(48)
            if digit > 9:
                break
            digits = digits * np.uint64(10) + digit
            at += 1
        power = start - at
        count -= power
    if count > 0 and at + 1 < size and (text[at] == 101 or text[at] == 69):
        sign, exponent, mark = 1, 0, at
        at += 1
        if text[at] == 45 or text[at] == 43:
            sign = -1 if text[at] == 45 else 1
            at += 1
        start = at
        while at < size and 48 <= text[at] <= 57:
            exponent = min(exponent * 10 + (text[at] - 48), 100000)
            at += 1
        if at == start:
            at = mark
        power += sign * exponent
    return at, negative, digits, count, power


@inner
def _is_comment(text: npt.NDArray[np.uint8], at: int, size: int, comments: bool) -> bool:
    c = text[at]
    return c == 35 or (comments and (c == 37 or (c == 47 and at + 1 < size and text[at + 1] == 47)))


@inner
def _after_blanks(text: npt.NDArray[np.uint8], at: int, size: int, separator: int) -> int:
    while at < size and (text[at] == 32 or (text[at] == 9 and separator != 9)):
        at += 1
    return at


@inner
def _line_end(text: npt.NDArray[np.uint8], at: int, size: int, stop: int) -> int:
    """Return the next position of a line's end or of the byte ``stop``."""
    while at < size and text[at] != 10 and text[at] != 13 and text[at] != stop:
        at += 1
    return at


@njit(cache=True, nogil=True)
def _row_ends(text: npt.NDArray[np.uint8], at: int, size: int, comments: bool) -> bool:
    return at == size or text[at] == 10 or text[at] == 13 or _is_comment(text, at, size, comments)


@inner
def _after_row(text: npt.NDArray[np.uint8], at: int, form: Form) -> int:
    """Skip what follows the last column wanted. Returns the start of the next line, -1 for a column too many."""
    separator, _, comments, exact = form
    size = len(text)
    if exact:
        at = _after_blanks(text, at, size, separator)
        if separator != 0 and at < size and text[at] == separator:  # one behind the last cell
            at = _after_blanks(text, at + 1, size, separator)
        if not _row_ends(text, at, size, comments):
            return -1
    return int(_line_end(text, at, size, 10)) + 1


@inner
def _cell_end(
    text: npt.NDArray[np.uint8], first: int, at: int, form: Form, wanted: bool
) -> tuple[int, int, bool, bool, bool]:
    """Find the end of the cell that begins at ``first`` and was parsed up to ``at``.

    Returns the byte after its words, the next byte, whether there is a cell, whether nothing follows what was parsed,
    and whether the row ends there.
    """
    separator, _, comments, _ = form
    size, parsed = len(text), at
    while at < size:
        c = text[at]
        if c == 10 or c == 13 or c == 32 or c == 9 or (separator != 0 and c == separator):
            break
        if _is_comment(text, at, size, comments):
            break
        at += 1
    last, plain = at, at == parsed
    at = _after_blanks(text, at, size, separator)
    ended = _row_ends(text, at, size, comments)
    found = last > first or not ended
    if separator != 0 and found:
        if wanted and last < at and not ended and text[at] != separator:
            plain = False  # two words in one cell
            at = last = _line_end(text, at, size, separator)
            ended = at == size or text[at] == 10 or text[at] == 13
        elif not wanted:
            while at < size and text[at] != 35 and text[at] != separator and text[at] != 10 and text[at] != 13:
                at += 1
            ended = at == size or text[at] == 10 or text[at] == 13 or text[at] == 35
    return last, at, found, plain, ended


@njit(cache=True, nogil=True)
def parse(
    text: npt.NDArray[np.uint8],
    at: int,
    most: int,
    slots: npt.NDArray[np.int64],
    form: Form,
    out: Floats,
    odd: npt.NDArray[np.int64],
) -> tuple[int, int, int, int, int]:
    """Parse rows of ``text`` (bytes of whole lines) from byte ``at`` into ``out`` (n, k), at most ``most`` of them.

    ``slots[c]`` is the column of ``out`` for column c of the file, -1 for none. Returns why it stopped (ENDED, FULL,
    ODD, SHORT_ROW, LONG_ROW), the number of rows, the next byte, the count of numbers in ``odd`` (row, slot, first
    byte, byte after the last) and the number of columns of a short row.
    """
    separator, commas, _, _ = form
    size, columns = len(text), len(slots)
    rows, odds = 0, 0
    while at < size:
        if rows == most or odds + columns > len(odd):
            return FULL if rows == most else ODD, rows, at, odds, 0
        if text[at] == 10:  # a blank line, or the second byte of a line's end
            at += 1
            continue
        begin, column, ended = at, 0, False
        while not ended:
            if column == columns:
                at = _after_row(text, at, form)
                break
            at = _after_blanks(text, at, size, separator)
            first, slot = at, slots[column]
            plain, value = False, 0.0
            if slot >= 0:
                at, negative, digits, count, power = _decimal(text, at, size, commas)
                plain = 0 < count <= 19 and -REACH <= power <= REACH
                if plain:
                    value = _times_power(digits, power) * (-1.0 if negative else 1.0)
                if plain and at < size:
                    c = text[at]
                    if c == 10 or c == 13 or (c == separator if separator != 0 else c == 32):  # nearly always
                        out[rows, slot] = value
                        column += 1
                        at += 1
                        ended = c == 10 or c == 13
                        continue
            last, at, found, alone, ended = _cell_end(text, first, at, form, slot >= 0)
            if found and slot >= 0 and plain and alone:
                out[rows, slot] = value
            elif found and slot >= 0:
                odd[odds, 0], odd[odds, 1], odd[odds, 2], odd[odds, 3] = rows, slot, first, last
                odds += 1
            column += found
            at = _line_end(text, at, size, 10) + 1 if ended else at + (separator != 0 and text[at] == separator)
        if at < 0:
            return LONG_ROW, rows, begin, odds, column
        if 0 < column < columns:
            return SHORT_ROW, rows, begin, odds, column
        rows += column > 0
    return ENDED, rows, at, odds, 0
