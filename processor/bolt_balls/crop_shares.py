"""Which of the points about a node are kept, where there are more than it has room for: those of the lowest hashes."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from functools import partial

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.bolt_balls.thinning import WHOLE, hashed
from processor.geometry.threads import over_ranges
from processor.model import Labels

STEPS_PER_MM = 1000.0  # gathered coordinates are whole micrometres: sorting them is exact
THRESHOLDS = np.append(WHOLE * 2.0 ** (-0.25 * np.arange(120)), 0.0).astype(np.uint64)  # of hashes


class Kept:
    """What has been gathered so far, as pairs of a node and a point, and what each node still takes."""

    def __init__(self, nodes: int, room: int, threads: int = 0) -> None:
        self.room, self.threads = room, threads
        self.rank = np.zeros(nodes, np.int64)  # of each node's threshold
        self.counts = np.zeros(nodes, np.int64)
        self.pieces = [(np.empty(0, np.int32), np.empty((0, 3), np.int32), np.empty(0, np.int32))]
        self.loose = 0  # pairs added since all were last looked through

    @property
    def thresholds(self) -> npt.NDArray[np.uint64]:
        """Threshold (k,) below which the hashes lie of what a node takes."""
        return THRESHOLDS[self.rank]

    def add(self, owner: Labels, steps: Labels, station: Labels) -> None:
        """Add pairs; all are looked through again when those that came in are as many as there is room for."""
        self.pieces.append((owner, steps, station))
        self.counts += np.bincount(owner, minlength=len(self.counts))
        self.loose += len(owner)
        if self.loose > self.room * len(self.counts) // 4 and (self.counts > self.room).any():
            self.pieces = [self.all()]

    def all(self) -> tuple[Labels, Labels, Labels]:
        """Return owner, steps and station of all pairs that are kept."""
        owner, steps, station = (np.concatenate(parts) for parts in zip(*self.pieces, strict=True))
        self.loose = 0
        if (self.counts > self.room).any():
            rank = np.empty(len(steps), np.int64)
            over_ranges(partial(_ranks, steps, THRESHOLDS, rank), len(steps), self.threads)
            self.rank, self.counts = _lowered(owner, rank, self.rank, self.room, len(THRESHOLDS))
            held = np.flatnonzero(rank >= self.rank[owner])
            owner, steps, station = (np.take(one, held, axis=0) for one in (owner, steps, station))
        return owner, steps, station


@njit(cache=True, nogil=True)
def _ranks(steps, thresholds, found, first, last):  # type: ignore[no-untyped-def]
    """Write the rank (n,) of the lowest threshold that each hash, first..last, still lies below."""
    for i in range(first, last):
        value = hashed(steps[i, 0], steps[i, 1], steps[i, 2])
        low, high = 0, len(thresholds) - 1  # below the first, and never below the last
        while high - low > 1:
            mid = (low + high) // 2
            if value < thresholds[mid]:
                low = mid
            else:
                high = mid
        found[i] = low


@njit(cache=True, nogil=True)
def _lowered(owner, rank, at, room, ranks):  # type: ignore[no-untyped-def]
    """Ranks (k,) from ``at`` on at which each node's points fit its room, and how many they then are."""
    nodes = len(at)
    per = np.zeros((nodes, ranks), np.int64)
    for i in range(len(owner)):
        per[owner[i], rank[i]] += 1
    found, counts = at.copy(), np.zeros(nodes, np.int64)
    for k in range(nodes):
        total = 0
        for r in range(at[k], ranks):
            total += per[k, r]
        while total > room:
            total -= per[k, found[k]]
            found[k] += 1
        counts[k] = total
    return found, counts


@njit(cache=True, nogil=True, inline="always")
def taken(dx, dy, dz, threshold):  # type: ignore[no-untyped-def]
    """Whether a node takes a point at (dx, dy, dz) from it."""
    if threshold >= WHOLE:
        return True
    x, y, z = (
        np.int32(np.rint(dx * STEPS_PER_MM)),
        np.int32(np.rint(dy * STEPS_PER_MM)),
        np.int32(np.rint(dz * STEPS_PER_MM)),
    )
    return hashed(x, y, z) < threshold
