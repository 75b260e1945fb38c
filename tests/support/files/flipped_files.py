"""Bits flipped in a file, one after another, and what a reader makes of it."""

import contextlib
import random

from processor.model import InputError
from tests.support.results.records import assert_equal


@contextlib.contextmanager
def flipped(path, byte, bit):
    """Flip one bit of a file in place, and flip it back afterwards."""

    def flip():
        with path.open("r+b") as file:
            file.seek(byte)
            value = file.read(1)[0]
            file.seek(byte)
            file.write(bytes([value ^ 1 << bit]))

    flip()
    try:
        yield
    finally:
        flip()


def unnoticed(path, read, flips, seed=0):
    """Flip ``flips`` random bits of a file, one at a time.

    Returns how many were noticed (an InputError that names the file) and how many left all values the same, and lists
    the flips that changed a value unnoticed or ended in another error: byte, bit and what happened.
    """
    expected, rng, size = read(path), random.Random(seed), path.stat().st_size
    noticed, same, wrong = 0, 0, []
    for _ in range(flips):
        byte, bit = rng.randrange(size), rng.randrange(8)
        with flipped(path, byte, bit):
            try:
                found = read(path)
            except InputError as error:
                noticed += str(error).startswith(str(path))
                continue
            except Exception as error:
                wrong.append((byte, bit, repr(error)))
                continue
        try:
            assert_equal(found, expected)
            same += 1
        except AssertionError as error:
            wrong.append((byte, bit, " ".join(str(error).split())[:200]))
    return noticed, same, wrong
