"""Where a scan stands by votes of all pairs of like faces: every shift is looked at, so rivals show themselves."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit

from processor.model import Floats
from processor.stitching.planes.samples import Elements, facing

LIKE_COS = float(np.cos(np.radians(10.0)))
PEAKS, LEAST_OF_BEST = 6, 0.5  # shifts kept of a turn, by votes
MOST_VOTERS = 350  # faces of a scan that look one way
SPARE = 20.0  # a direction with few faces votes with less weight


@njit(cache=True, nogil=True)
def cast(a, na, wa, b, nb, wb, like, low, size, votes):  # type: ignore[no-untyped-def]
    """Add the weight of every pair of like faces to the bin of the shift a - b."""
    for i in range(len(a)):
        for j in range(len(b)):
            if na[i, 0] * nb[j, 0] + na[i, 1] * nb[j, 1] + na[i, 2] * nb[j, 2] > like:
                x = int((a[i, 0] - b[j, 0] - low[0]) / size)
                y = int((a[i, 1] - b[j, 1] - low[1]) / size)
                z = int((a[i, 2] - b[j, 2] - low[2]) / size)
                votes[x, y, z] += wa[i] * wb[j]


@njit(cache=True, nogil=True)
def smooth(votes, out):  # type: ignore[no-untyped-def]
    """Sum over 3 x 3 x 3 bins; returns the largest."""
    X, Y, Z = votes.shape
    most = 0.0
    for i in range(1, X - 1):
        for j in range(1, Y - 1):
            for k in range(1, Z - 1):
                if votes[i, j, k] > 0.0:
                    total = 0.0
                    for u in range(-1, 2):
                        for v in range(-1, 2):
                            for w in range(-1, 2):
                                total += votes[i + u, j + v, k + w]
                    out[i, j, k] = total
                    most = max(most, total)
    return most


def voters(places: Elements, weight: Floats) -> tuple[Elements, Floats]:
    """Thin faces that look the same way to MOST_VOTERS or so, each with the weight of those it stands for."""
    group = facing(places.normals)
    kept, weights = [], []
    for one in np.unique(group):
        rows = np.flatnonzero(group == one)
        step = max(1, len(rows) // MOST_VOTERS)
        kept.append(rows[::step])
        weights.append(weight[rows[::step]] * (len(rows) / len(kept[-1])))
    rows = np.concatenate(kept)
    return Elements(places.points[rows], places.normals[rows]), np.concatenate(weights)


def weights(normals: Floats) -> Floats:
    """Weight (n,) of faces by how many look the same way: a wide ground says no more than a few posts."""
    like = (normals @ normals.T > LIKE_COS).sum(axis=1)
    found: Floats = 1.0 / np.sqrt(like + SPARE)
    return found


def shifts(
    a: Elements,
    wa: Floats,
    b: Elements,
    wb: Floats,
    R: Floats,
    bin_mm: float,
    peaks: int = PEAKS,
    least_of_best: float = LEAST_OF_BEST,
) -> tuple[Floats, Floats]:
    """Shifts (k, 3) of b turned by R (3, 3) that most like faces agree with, and their votes (k,), the most first."""
    moved, normals = b.points @ R.T, b.normals @ R.T
    low = a.points.min(axis=0) - moved.max(axis=0) - 2.0 * bin_mm
    high = a.points.max(axis=0) - moved.min(axis=0) + 2.0 * bin_mm
    shape = np.ceil((high - low) / bin_mm).astype(int) + 1
    votes, total = np.zeros(shape), np.zeros(shape)
    cast(a.points, a.normals, wa, moved, normals, wb, LIKE_COS, low, bin_mm, votes)
    most = smooth(votes, total)
    where = np.argwhere(total >= least_of_best * most) if most > 0.0 else np.empty((0, 3), int)
    score = total[tuple(where.T)]
    order = np.argsort(-score, kind="stable")
    where, score = where[order], score[order]
    found: list[int] = []
    free = np.ones(len(where), bool)
    for row in range(len(where)):
        if free[row]:
            found.append(row)
            free &= (np.abs(where - where[row]) > 2).any(axis=1)
            if len(found) >= peaks:
                break
    at = []
    for row in found:  # the middle of the votes around the peak
        i, j, k = where[row]
        block = votes[i - 1 : i + 2, j - 1 : j + 2, k - 1 : k + 2]
        offset = np.array([(block.sum(axis=(1, 2)) @ [-1, 0, 1]), block.sum(axis=(0, 2)) @ [-1, 0, 1],
                           block.sum(axis=(0, 1)) @ [-1, 0, 1]]) / block.sum()  # fmt: skip
        at.append(low + (where[row] + 0.5 + offset) * bin_mm)
    return np.array(at).reshape(-1, 3), score[found]
