"""Rows of numbers in text, piece by piece: what tables, PTX and the ASCII forms of PLY and PCD share."""

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

from processor.model import Floats, Ints

PIECE_BYTES = 4 << 20
PIECE_ROWS = 1 << 17  # more than a worker's part of a piece has
MOST_WORKERS = 4
LEAST_PART = 1 << 16
ODD_LIMIT = 4096  # numbers left to float() before a piece ends
ENDED, FULL, ODD, SHORT_ROW = range(4)  # why parsing stopped
LONGEST_LINE = 1 << 20
NUMBERS = frozenset(b"+-0123456789.eE")
WORDS = ("nan", "inf", "infinity")


class _Room:
    """What one worker parses into."""

    def __init__(self, rows: int, columns: int) -> None:
        self.out = np.empty((rows, columns))
        self.odd = np.empty((ODD_LIMIT, 4), np.int64)


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

    def likely_left(self) -> int:
        """Return about how many rows there are to the end of the file, by the lines at hand; rather too many."""
        pass

        if not self._fill():
            return 0
        lines, size = int(count_ends(self._text, self._at, len(self._text))) + 1, len(self._text) - self._at
        place = self._file.tell()
        beyond = self._file.seek(0, os.SEEK_END) - place
        self._file.seek(place)
        return lines + int(1.05 * beyond * lines / size)

    def pieces(self, columns: Sequence[int], most: int = 2**62) -> Iterator[Floats]:
        """Give the numbers (n, k) of some columns of the next rows, at most ``most`` of them, piece by piece.

        Each piece is good until the next one is asked for.
        """
        slots = np.full(max(columns) + 1, -1, np.int64)
        slots[list(columns)] = np.arange(len(columns))
        workers = max(1, min(MOST_WORKERS, os.cpu_count() or 1))
        rooms = [_Room(min(most, PIECE_ROWS), len(columns)) for _ in range(workers)]
        with ThreadPoolExecutor(workers) as pool:
            while most > 0 and self._fill():
                parts = self._parts(workers)
                parse = partial(self._parse, slots, most)
                jobs = [pool.submit(parse, room, *part) for room, part in zip(rooms[1:], parts[1:], strict=False)]
                for i, part in enumerate(parts):
                    why, rows, end, odds, column = jobs[i - 1].result() if i else parse(rooms[0], *part)
                    if i and rows >= most:
                        break  # it was not known before how many rows the parts before it have
                    self._settle(rooms[i], odds)
                    if why == SHORT_ROW:
                        line = self._at_line(end)
                        raise ValueError(f"line {line}: expected {len(slots)} columns or more, found {column}")
                    self._at = end
                    most -= rows
                    if rows:
                        yield rooms[i].out[:rows]
                    if why != ENDED:
                        break  # the rest of it comes next
                for job in jobs:
                    job.result()

    def _parts(self, workers: int) -> list[tuple[int, int]]:
        """Cut the text at ends of lines, into one part a worker where there is enough of it."""
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

    def _parse(self, slots: Ints, most: int, room: _Room, start: int, stop: int) -> tuple[int, int, int, int, int]:
        pass

        found: tuple[int, int, int, int, int] = parse(
            self._text[:stop],
            start,
            min(most, len(room.out)),
            slots,
            self._separator,
            self._commas,
            self._remarks,
            room.out,
            room.odd,
        )
        return found

    def _settle(self, room: _Room, odds: int) -> None:
        for row, slot, first, last in room.odd[:odds].tolist():
            room.out[row, slot] = self._number(self._text[first:last].tobytes(), first)

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
        pass

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


# --- Numbers written in decimal, in rows, to float64: compiled, and rounded as Python's float() rounds.


REACH = 60  # largest power of ten in the table


def _powers() -> tuple[Floats, Floats]:
    exact = [Fraction(10) ** e for e in range(-REACH, REACH + 1)]
    high = [float(one) for one in exact]
    low = [float(one - Fraction(near)) for one, near in zip(exact, high, strict=True)]
    return np.array(high), np.array(low)


HIGH, LOW = _powers()  # constants of what is compiled: as arguments they cost more than the arithmetic


@njit(cache=True, nogil=True)
def count_ends(text: npt.NDArray[np.uint8], start: int, stop: int) -> int:
    """Count the lines that end in a part of a text, by LF, CR or both."""
    found = 0
    for at in range(start, stop):
        found += text[at] == 10
    for at in range(start, stop - 1):
        found += (text[at] == 13) & (text[at + 1] != 10)
    if stop > start:
        found += text[stop - 1] == 13
    return found


@njit(cache=True, nogil=True)
def _times_power(digits: int, power: int) -> float:
    if digits < 9007199254740992 and -22 <= power <= 22:  # both exact, so one rounding
        near = float(digits)
        return float(near / HIGH[REACH - power] if power < 0 else near * HIGH[REACH + power])
    a = float(digits >> np.uint64(32)) * 4294967296.0
    b = float(digits & np.uint64(0xFFFFFFFF))
    top = a + b
    rest = b - (top - a)
    p, q = HIGH[REACH + power], LOW[REACH + power]
    product = top * p
    split = 134217729.0 * top
    t1 = split - (split - top)
    t2 = top - t1
    split = 134217729.0 * p
    p1 = split - (split - p)
    p2 = p - p1
    error = ((t1 * p1 - product) + t1 * p2 + t2 * p1) + t2 * p2
    return float(product + (error + (top * q + rest * p)))


@njit(cache=True, nogil=True)
def parse(
    text: npt.NDArray[np.uint8],
    start: int,
    most: int,
    slots: npt.NDArray[np.int64],
    separator: int,
    commas: bool,
    remarks: bool,
    out: Floats,
    odd: npt.NDArray[np.int64],
) -> tuple[int, int, int, int, int]:
    """Parse rows of ``text`` (bytes of whole lines) from ``start`` into ``out`` (n, k), at most ``most`` of them.

    ``slots[c]`` is the column of ``out`` for column c of the file, -1 for none. ``separator`` is 0 for blanks, else a
    byte with any blanks about it. ``commas``: numbers may have decimal commas. ``remarks``: // and % begin remarks,
    as # always does. Returns why it stopped (ENDED, FULL, ODD, SHORT_ROW), rows, the next byte, the count of numbers
    in ``odd`` (row, slot, first byte, byte after the last) and the column that a short row ends before.
    """
    size, columns = len(text), len(slots)
    at, rows, odds = start, 0, 0
    while at < size:
        if rows == most:
            return FULL, rows, at, odds, 0
        if odds + columns > len(odd):
            return ODD, rows, at, odds, 0
        if text[at] == 10:  # a blank line, or the second byte of an end
            at += 1
            continue
        begin = at
        column, done = 0, False
        while not done:
            if column == columns:  # nothing is asked of the rest of the line
                while at < size and text[at] != 10 and text[at] != 13:
                    at += 1
                at += 1
                break
            while at < size and (text[at] == 32 or (text[at] == 9 and separator != 9)):
                at += 1
            first = at
            # Digits first: most tokens are plain numbers.
            slot = slots[column]
            plain, digits, count, power = slot >= 0, np.uint64(0), 0, 0
            negative = False
            if plain:
                if at < size and (text[at] == 45 or text[at] == 43):
                    negative = text[at] == 45
                    at += 1
                number = at
                while at < size:
                    digit = np.uint64(text[at]) - np.uint64(48)
                    if digit > 9:
                        break
                    digits = digits * np.uint64(10) + digit
                    at += 1
                count = at - number
                if at < size and (text[at] == 46 or (commas and text[at] == 44)):
                    at += 1
                    number = at
                    while at < size:
                        digit = np.uint64(text[at]) - np.uint64(48)
                        if digit > 9:
                            break
                        digits = digits * np.uint64(10) + digit
                        at += 1
                    power = number - at
                    count -= power
                plain = count > 0
                if plain and at + 1 < size and (text[at] == 101 or text[at] == 69):
                    sign, exponent, mark = 1, 0, at
                    at += 1
                    if text[at] == 45 or text[at] == 43:
                        sign = -1 if text[at] == 45 else 1
                        at += 1
                    number = at
                    while at < size and 48 <= text[at] <= 57:
                        exponent = min(exponent * 10 + (text[at] - 48), 100000)
                        at += 1
                    if at == number:
                        at = mark
                    power += sign * exponent
            if plain and at < size and count <= 19 and -REACH <= power <= REACH:
                c = text[at]
                if c == 10 or c == 13 or (c == separator if separator != 0 else c == 32):  # nearly always
                    value = _times_power(digits, power)
                    out[rows, slot] = -value if negative else value
                    column += 1
                    at += 1
                    done = c == 10 or c == 13
                    continue
            # What follows ends the token, or makes it one that is no plain number.
            while at < size:
                c = text[at]
                if c == 10 or c == 13 or c == 35 or c == 32 or c == 9 or (separator != 0 and c == separator):
                    break
                if remarks and (c == 37 or (c == 47 and at + 1 < size and text[at + 1] == 47)):
                    break
                plain = False
                at += 1
            last = at
            while at < size and (text[at] == 32 or (text[at] == 9 and separator != 9)):
                at += 1
            c = text[at] if at < size else np.uint8(10)
            ended = c == 10 or c == 13 or c == 35
            ended = ended or (remarks and (c == 37 or (c == 47 and at + 1 < size and text[at + 1] == 47)))
            if last > first or not ended:
                if slot >= 0:
                    if separator != 0 and last < at and not ended and c != separator:
                        plain = False  # two words in one cell
                        while at < size and text[at] != separator and text[at] != 10 and text[at] != 13:
                            at += 1
                        last = at
                        c = text[at] if at < size else np.uint8(10)
                        ended = c == 10 or c == 13
                    if plain and count <= 19 and -REACH <= power <= REACH:
                        value = _times_power(digits, power)
                        out[rows, slot] = -value if negative else value
                    else:
                        odd[odds, 0], odd[odds, 1], odd[odds, 2], odd[odds, 3] = rows, slot, first, last
                        odds += 1
                elif separator != 0:
                    while at < size and text[at] != separator and text[at] != 10 and text[at] != 13 and text[at] != 35:
                        at += 1
                    c = text[at] if at < size else np.uint8(10)
                    ended = c == 10 or c == 13 or c == 35
                column += 1
            if ended:
                while at < size and text[at] != 10 and text[at] != 13:
                    at += 1
                at += 1
                done = True
            elif separator != 0 and c == separator:
                at += 1
        if column == 0:
            continue
        if column < columns:
            return SHORT_ROW, rows, begin, odds, column
        rows += 1
    return ENDED, rows, at, odds, 0
