"""Sparse voxels of points, in blocks: memory grows with the scanned surface alone.

Sums are of whole steps in 64-bit integers: exact, and so the same in any order.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.point_grid import EMPTY, FREE, slot_of
from processor.model import Floats, Ints
from processor.space_frame.points.hash_sampling import STEPS_PER_MM, Steps

BITS = 3  # a block is 8 voxels wide
SIDE = 1 << BITS
FIELD = 21  # bits of a key for each axis
OFFSET = 1 << (FIELD - 1)


class Voxels(NamedTuple):
    """Occupied voxels in the order of their blocks.

    ``cells`` (v, 3) are voxel numbers, ``means`` (v, 3) of their points in mm, ``counts`` (v,). Block b holds the rows
    ``starts[b]`` to ``starts[b + 1]``; ``beside`` (b, 27) are the rows of the blocks around it, -1 = none.
    """

    size_mm: float
    cells: Ints
    means: Floats
    counts: Ints
    blocks: Ints  # (b, 3)
    starts: Ints  # (b + 1,)
    beside: Ints  # (b, 27)

    @property
    def number(self) -> int:
        """Number of voxels."""
        return len(self.cells)


@njit(cache=True, nogil=True)
def accumulate(steps, size, keys, sums):  # type: ignore[no-untyped-def]
    """Add points to the table of voxels; returns the rows done, and stops when the table is half full."""
    used = 0
    room = len(keys) // 2
    for i in range(len(steps)):
        if used >= room:
            return i
        x, y, z = (
            np.int64(steps[i, 0]) + (OFFSET * size),
            np.int64(steps[i, 1]) + (OFFSET * size),
            np.int64(steps[i, 2]) + (OFFSET * size),
        )
        a, b, c = x // size, y // size, z // size
        key = (
            ((((a >> BITS) << (FIELD - BITS)) | (b >> BITS)) << (FIELD - BITS) | (c >> BITS)) << (3 * BITS)
            | ((a & (SIDE - 1)) << (2 * BITS))
            | ((b & (SIDE - 1)) << BITS)
            | (c & (SIDE - 1))
        )
        at = slot_of(keys, key)
        if keys[at] == FREE:
            keys[at] = key
            used += 1
        sums[at, 0] += 1
        sums[at, 1] += x - a * size
        sums[at, 2] += y - b * size
        sums[at, 3] += z - c * size
    return len(steps)


def gathered(steps: Steps, size_mm: float, least: int) -> Voxels:
    """Return the voxels of ``size_mm`` with at least ``least`` of the points given as steps (n, 3)."""
    size = round(size_mm * STEPS_PER_MM)
    slots = 1 << max(14, int(len(steps) // 4).bit_length())
    while True:
        keys, sums = np.full(slots, FREE, np.int64), np.zeros((slots, 4), np.int64)
        done = accumulate(steps, size, keys, sums)
        if done == len(steps):
            break
        slots *= 4
    rows = np.flatnonzero(sums[:, 0] >= least)
    rows = rows[np.argsort(keys[rows])]
    keys, sums = keys[rows], sums[rows]
    inner, block_key = keys & ((1 << 3 * BITS) - 1), keys >> 3 * BITS
    block_keys, starts = np.unique(block_key, return_index=True)
    width = FIELD - BITS
    blocks = np.stack(
        [block_keys >> 2 * width, block_keys >> width & ((1 << width) - 1), block_keys & ((1 << width) - 1)], axis=1
    )
    within = np.stack([inner >> 2 * BITS, inner >> BITS & (SIDE - 1), inner & (SIDE - 1)], axis=1)
    sizes = np.diff(np.append(starts, len(keys)))
    cells = np.repeat(blocks, sizes, axis=0) * SIDE + within - OFFSET
    means = cells * size_mm + sums[:, 1:] / (sums[:, :1] * STEPS_PER_MM)
    return Voxels(
        size_mm=size_mm,
        cells=cells,
        means=means,
        counts=sums[:, 0].copy(),
        blocks=blocks - (OFFSET >> BITS),
        starts=np.append(starts, len(keys)),
        beside=_beside(blocks, block_keys, width),
    )


def _beside(blocks: Ints, keys: Ints, width: int) -> Ints:
    """Rows (b, 27) of the blocks about each, x slowest."""
    rows = np.full((len(blocks), 27), EMPTY, np.int64)
    for i in range(27):
        around = blocks + np.array([i // 9 - 1, i // 3 % 3 - 1, i % 3 - 1])
        key = (around[:, 0] << width | around[:, 1]) << width | around[:, 2]
        at = np.minimum(np.searchsorted(keys, key), max(len(keys) - 1, 0))
        rows[:, i] = np.where(keys[at] == key, at, EMPTY) if len(keys) else EMPTY
    return rows
