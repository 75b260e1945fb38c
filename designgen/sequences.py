"""Sequences of numbers that fill a range evenly, however many are taken: the first k stay what they are."""

from __future__ import annotations

import numpy as np

from processor.model import Floats

PLASTIC = 1.324717957244746  # the real root of x^3 = x + 1


def van_der_corput(number: int) -> float:
    """Return the share 0..1 of a number from 0, its binary digits mirrored at the point: 0, 1/2, 1/4, 3/4, 1/8, ..."""
    share, place = 0.0, 0.5
    while number:
        share += place * (number & 1)
        number >>= 1
        place *= 0.5
    return share


def in_square(number: int) -> Floats:
    """Return the place (2,) of a number from 0 in the unit square, by the R2 sequence; the first is its middle."""
    found: Floats = (0.5 + number * np.array([1.0 / PLASTIC, 1.0 / PLASTIC**2])) % 1.0
    return found


def on_sphere(number: int) -> Floats:
    """Return the unit vector (3,) of a number from 0: pairs on opposite sides, the first near the ends of axis 0.

    A pair's height goes by the van der Corput sequence, and each stands three eighths of a turn on from the last.
    """
    pair, second = divmod(number, 2)
    # From 3/16, and by 3/8: of such numbers the ones that see most of the sides and ends of long boxes.
    height = 1.0 - (van_der_corput(pair) + 0.1875) % 1.0
    level, turn = np.sqrt(1.0 - height**2), 0.75 * np.pi * pair
    unit = np.array([height, level * np.cos(turn), level * np.sin(turn)])
    return -unit if second else unit
