"""Core points and their M3C2 distances as CSV, in full precision because coordinates may be large."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from processor import large_arrays
from processor.geometry.m3c2 import Distances
from processor.model import Floats
from processor.report.columns import columns
from processor.report.table import csv_of_rows

COLUMNS = columns(
    "x", "y", "z", "distance", "lod95", "significant", "n1", "n2", "std1", "std2", "nx", "ny", "nz"
)  # fmt: skip
ROWS_AT_ONCE = 50_000  # work, not result: text of some 5 MB


def csv_text(origin: Floats, core: Floats, distances: Distances, normals: Floats) -> str:
    """Return as CSV the core points (k, 3), given relative to ``origin`` (3,), with distances and normals (k, 3).

    nan stands where there is none. n1 and std1 are of the reference, n2 and std2 of the compared cloud.
    """
    return "".join(parts(origin, core, distances, normals))


def parts(origin: Floats, core: Floats, distances: Distances, normals: Floats) -> Iterator[str]:
    """Pass over the text of :func:`csv_text`."""
    yield csv_of_rows(COLUMNS, ())
    for rows in large_arrays.blocks(len(core), ROWS_AT_ONCE):
        one = distances.take(rows)
        numbers = (
            *(core[rows] + origin).T, one.distance, one.lod95, one.significant.astype(np.int64), one.n1, one.n2,
            one.std1, one.std2, *normals[rows].T,
        )  # fmt: skip
        # As the csv module writes numbers, in two thirds of its time: no number needs quotes.
        cells = (map(repr, column.tolist()) for column in numbers)
        yield "\n".join(map(",".join, zip(*cells, strict=True))) + "\n"
