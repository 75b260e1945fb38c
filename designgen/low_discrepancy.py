"""Low-discrepancy sequences: any number of leading terms fills the range evenly."""

from __future__ import annotations

import numpy as np

from processor.model import Floats, Ints

PLASTIC = 1.324717957244746  # the real root of x^3 = x + 1


def van_der_corput(number: int) -> float:
    """Return term ``number`` (from 0) of the van der Corput sequence in base 2: 0, 1/2, 1/4, 3/4, 1/8, ..."""
    value, digit = 0.0, 0.5
    while number:
        value += digit * (number & 1)
        number >>= 1
        digit *= 0.5
    return value


def in_square(number: int | Ints) -> Floats:
    """Return terms ``number`` (from 0) of the R2 sequence in the unit square, (2,) or (n, 2), from its middle."""
    points: Floats = (0.5 + np.multiply.outer(number, [1.0 / PLASTIC, 1.0 / PLASTIC**2])) % 1.0
    return points


def on_sphere(number: int) -> Floats:
    """Return direction ``number`` (from 0), a unit vector (3,): opposite pairs, the first pair near the ends of axis 0.

    The heights of the pairs follow the van der Corput sequence; each pair is turned by 3/8 from the one before.
    """
    pair, second = divmod(number, 2)
    # The start 3/16 and the turn 3/8 were chosen by a search: they cover most of the sides and ends of long boxes.
    height = 1.0 - (van_der_corput(pair) + 0.1875) % 1.0
    radius, angle = np.sqrt(1.0 - height**2), 0.75 * np.pi * pair
    unit = np.array([height, radius * np.cos(angle), radius * np.sin(angle)])
    return -unit if second else unit
