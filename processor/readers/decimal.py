"""Numbers written in decimal, in rows, to float64: compiled, and rounded as Python's float() rounds.

A number of at most 19 digits is its digits as an integer times a power of ten; the product is formed in twice the
precision of a double (Dekker 1971) from a table of the powers, also in twice the precision. What the kernel cannot
settle so (more digits, powers beyond the table, nan, inf) it leaves to float().
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.model import Floats
from processor.readers.rows import ENDED, FULL, ODD, SHORT_ROW

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
