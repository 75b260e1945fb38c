"""Core points and their M3C2 distances as CSV, in full precision because coordinates may be large."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from processor.geometry.m3c2 import Distances
from processor.model import Floats
from processor.report.columns import columns
from processor.report.table import csv_of_rows

COLUMNS = columns(
    "x", "y", "z", "distance", "lod95", "significant", "n1", "n2", "std1", "std2", "nx", "ny", "nz"
)  # fmt: skip
ROWS_AT_ONCE = 50_000


def csv_text(origin: Floats, core: Floats, distances: Distances, normals: Floats) -> str:
    """Return as CSV the core points (k, 3), given relative to ``origin`` (3,), with distances and normals (k, 3).

    nan stands where there is none. n1 and std1 are of the reference, n2 and std2 of the compared cloud.
    """
    return csv_of_rows(COLUMNS, _rows(origin, core, distances, normals), full=True)


def _rows(origin: Floats, core: Floats, distances: Distances, normals: Floats) -> Iterator[tuple[Any, ...]]:
    for start in range(0, len(core), ROWS_AT_ONCE):
        part = slice(start, start + ROWS_AT_ONCE)
        significant = distances.significant[part].astype(np.int64)
        numbers = (
            *(core[part] + origin).T, distances.distance[part], distances.lod95[part], significant, distances.n1[part],
            distances.n2[part], distances.std1[part], distances.std2[part], *normals[part].T,
        )  # fmt: skip
        yield from zip(*(column.tolist() for column in numbers), strict=True)
