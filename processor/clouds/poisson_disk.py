"""Thinning to a least distance: of points nearer to each other the first in the order of the cloud is kept.

No two points that are kept are nearer than the distance, and each point that is left out is within it of one that is
kept (Poisson disk sampling of the cloud by dart throwing in the cloud's order).
"""
# Numba infers the types of the kernel's arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numba import njit

from processor.clouds import slabs
from processor.geometry.point_grid import empty_table, slot_of
from processor.model import Bools, Floats
from processor.writers.cloud import Block, Cloud

FIELD = 21  # bits of a cell's number for each axis; cells that far apart share a number, which costs time alone


def sampled(cloud: Cloud, spacing_mm: float, aside: Path) -> Cloud:
    """Return a cloud whose points are at least ``spacing_mm`` apart; files are put aside below ``aside``."""

    def blocks() -> Iterator[Block]:
        parts = slabs.cut(cloud, aside)
        before = np.empty((0, 3))
        for number in range(len(parts)):
            rows = parts.read(number)
            points = slabs.points_of(rows)
            kept = keep(before, points, spacing_mm)
            yield from slabs.in_blocks(rows[kept])
            # Slabs may be narrower than the distance.
            before = np.concatenate([before, points[kept]])
            before = before[before[:, parts.axis] >= parts.edges[number + 1] - spacing_mm]

    return replace(cloud, blocks=blocks, count=None)


def keep(before: Floats, points: Floats, spacing_mm: float) -> Bools:
    """Mark the points (n, 3) to be kept beside those kept ``before`` (m, 3)."""
    every = np.concatenate([before, points])
    kept = np.zeros(len(every), np.bool_)
    if len(points):
        cell = np.floor((every - every.min(axis=0)) / spacing_mm).astype(np.int64)
        _keep(every, cell, len(before), spacing_mm**2, *empty_table(len(every)), kept)
    marked: Bools = kept[len(before) :]
    return marked


@njit(cache=True, nogil=True)
def _keep(points, cell, fixed, square, keys, heads, kept):  # type: ignore[no-untyped-def]
    """Mark the points (n, 3) that are kept; the first ``fixed`` of them are. Cells are as wide as the distance."""
    following = np.full(len(points), -1, np.int64)
    mask = (1 << FIELD) - 1
    for p in range(len(points)):
        free = True
        if p >= fixed:
            for n in range(27):
                i, j, k = cell[p, 0] + n // 9 - 1, cell[p, 1] + n // 3 % 3 - 1, cell[p, 2] + n % 3 - 1
                at = slot_of(keys, ((i & mask) << (2 * FIELD)) | ((j & mask) << FIELD) | (k & mask))
                q = heads[at]
                while q != -1 and free:
                    x, y, z = points[p, 0] - points[q, 0], points[p, 1] - points[q, 1], points[p, 2] - points[q, 2]
                    free = x * x + y * y + z * z >= square
                    q = following[q]
                if not free:
                    break
        if free:
            key = ((cell[p, 0] & mask) << (2 * FIELD)) | ((cell[p, 1] & mask) << FIELD) | (cell[p, 2] & mask)
            at = slot_of(keys, key)
            keys[at] = key
            following[p] = heads[at]
            heads[at] = p
            kept[p] = True
