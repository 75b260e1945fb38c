"""Colours of points, brought to 8 bits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor import large_arrays
from processor.model import Codes

MOST = 255  # of 8 bits
STEP = 256  # of 16 bits a step of 8 bits


def of_columns(columns: Sequence[Any]) -> Codes:
    """Return colours (n, 3) of columns (n,) red, green and blue: to 255, or to 65535 where one is beyond 255.

    Empty without columns, where all are 0, and for numbers that are not colours: not whole, or beyond 65535.
    """
    none = np.empty((0, 3), np.uint8)
    if not columns or not len(columns[0]):
        return none
    bounds = [large_arrays.extremes(column) for column in columns]
    least, most = min(low for low, _ in bounds), max(high for _, high in bounds)
    if not (least >= 0.0 and 0.0 < most < (MOST + 1) * STEP):
        return none
    colour = large_arrays.allocate(len(columns[0]), 3, dtype=np.uint8)
    for rows in large_arrays.blocks(len(colour)):
        parts = [np.asarray(column[rows]) for column in columns]
        if any(part.dtype.kind == "f" and (part != np.rint(part)).any() for part in parts):
            return none
        if most > MOST:
            # Of c in 8 bits some programs write 256 c, others 257 c.
            parts = [np.asarray(part, np.float32) // STEP for part in parts]
        colour[rows] = scaled(parts, 0.0, float(MOST))
    return colour


def scaled(columns: Sequence[Any], low: float, high: float) -> Codes:
    """Return colours (n, 3) of columns (n,) from ``low`` to ``high``."""
    colour = np.empty((len(columns[0]), 3), np.uint8)
    for i, column in enumerate(columns):
        share = (np.asarray(column, np.float32) - low) * (MOST / max(high - low, 1e-12))
        colour[:, i] = np.clip(np.rint(share), 0, MOST)
    return colour
