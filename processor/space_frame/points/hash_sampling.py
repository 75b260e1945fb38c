"""Points as whole steps of 0.01 mm, and a share of them chosen by a hash of these steps.

The choice of a point depends on its own coordinates alone: not on its place in the file, nor on chunks.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry.thread_ranges import over_ranges
from processor.space_frame.points.source import Source

STEPS_PER_MM = 100.0  # a tenth of the resolution of scanners; 21 bits reach 10.5 m with it
REACH = 2**30  # steps: 10.7 km from the origin; points beyond it, or not a number, are left out
WHOLE = 2**32  # the hash's range: this threshold keeps every point

Steps = npt.NDArray[np.int32]


@njit(cache=True, nogil=True, inline="always")
def hashed(x, y, z):  # type: ignore[no-untyped-def]
    """Mix three integers to 32 even bits (the finaliser of MurmurHash3)."""
    h = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ np.uint64(y)) * np.uint64(0xC2B2AE3D27D4EB4F)
    h = (h ^ (h >> np.uint64(29)) ^ np.uint64(z)) * np.uint64(0xFF51AFD7ED558CCD)
    h = (h ^ (h >> np.uint64(33))) * np.uint64(0xC4CEB9FE1A85EC53)
    return h >> np.uint64(32)


@njit(cache=True, nogil=True)
def sample(points, threshold, sampled, first, last):  # type: ignore[no-untyped-def]
    """Write the steps of points first..last whose hash is below a threshold to ``sampled`` from row ``first``.

    Returns the number of points written.
    """
    n = first
    for i in range(first, last):
        fx, fy, fz = points[i, 0] * 100.0, points[i, 1] * 100.0, points[i, 2] * 100.0
        if not (abs(fx) < REACH and abs(fy) < REACH and abs(fz) < REACH):
            continue
        x, y, z = np.int32(np.rint(fx)), np.int32(np.rint(fy)), np.int32(np.rint(fz))
        if hashed(x, y, z) < threshold:
            sampled[n, 0], sampled[n, 1], sampled[n, 2] = x, y, z
            n += 1
    return n - first


def thinned(source: Source, most: int, threads: int = 0) -> Steps:
    """Return steps (n, 3) of about ``most`` points of a source, or of all if they are fewer; in no certain order."""
    threshold = np.uint64(min(max(round(most / max(source.count, 1) * WHOLE), 0), WHOLE))
    pieces: list[Steps] = []
    for chunk in source.chunks():
        sampled = np.empty((len(chunk.points), 3), np.int32)
        parts: list[Steps] = []

        def run(first: int, last: int, points=chunk.points, sampled=sampled, parts=parts) -> None:  # type: ignore[no-untyped-def]
            number = sample(points, threshold, sampled, first, last)
            parts.append(sampled[first : first + number])

        over_ranges(run, len(chunk.points), threads, least=100_000)
        pieces.extend(part.copy() for part in parts)
    return np.concatenate([np.empty((0, 3), np.int32), *pieces])
