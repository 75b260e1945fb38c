"""Candidate translations between two scans by a vote of all pairs of patches with like normals, as a Hough transform.

Every translation is considered, so that competing solutions show up as further peaks.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from processor import large_arrays
from processor.model import Floats, Ints
from processor.stitching.planes.sampled_patches import Patches, facing

LIKE_COS = float(np.cos(np.radians(10.0)))  # rotations are known to 5 degrees, normals to as much
MOST_VOTERS = 350  # patches of a scan that face one way
BLOCK = 64  # patches that are compared with all others at once
FEW = 20.0  # a direction with fewer patches than about this has less weight in all


class WeightedPatches(NamedTuple):
    """Patches with the weight (n,) of each."""

    patches: Patches
    weight: Floats


def weighted(patches: Patches) -> WeightedPatches:
    """Weigh patches by how many have like normals: else a wide ground would outvote a few posts."""
    normals = patches.normals
    like = np.empty(len(normals))
    for some in large_arrays.blocks(len(normals), BLOCK):  # all pairs at once would leave the processor's cache
        like[some] = (normals[some] @ normals.T > LIKE_COS).sum(axis=1)
    return WeightedPatches(patches, 1.0 / np.sqrt(like + FEW))


def thinned(every: WeightedPatches) -> WeightedPatches:
    """Keep about MOST_VOTERS patches of each facing direction, with the total weight of the direction."""
    patches, weight = every
    if not len(weight):
        return every
    group = facing(patches.normals)
    selected, weights = [], []
    for direction in np.unique(group):
        rows = np.flatnonzero(group == direction)
        step = max(1, len(rows) // MOST_VOTERS)
        selected.append(rows[::step])
        weights.append(weight[rows[::step]] * (len(rows) / len(selected[-1])))
    rows = np.concatenate(selected)
    return WeightedPatches(Patches(patches.points[rows], patches.normals[rows]), np.concatenate(weights))


def candidate_translations(
    a: WeightedPatches, b: WeightedPatches, R: Floats, bin_mm: float, peaks: int, least_of_best: float
) -> tuple[Floats, Floats]:
    """Return translations (k, 3) of scan b rotated by R (3, 3) and their votes (k,), the best first.

    At most ``peaks`` maxima of the votes, in bins of ``bin_mm``, of at least ``least_of_best`` of the highest one.
    """
    rotated = Patches(b.patches.points @ R.T, b.patches.normals @ R.T)
    low = a.patches.points.min(axis=0) - rotated.points.max(axis=0) - 2.0 * bin_mm
    high = a.patches.points.max(axis=0) - rotated.points.min(axis=0) + 2.0 * bin_mm
    shape = np.ceil((high - low) / bin_mm).astype(int) + 1
    votes, total = np.zeros(shape), np.zeros(shape)
    vote(a, WeightedPatches(rotated, b.weight), low, bin_mm, votes)
    most = smooth(votes, total)
    where = np.argwhere(total >= least_of_best * most) if most > 0.0 else np.empty((0, 3), int)
    score = total[tuple(where.T)]
    order = np.argsort(-score, kind="stable")
    where, score = where[order], score[order]
    rows = _separate(where, peaks)
    translations = [low + (where[row] + 0.5 + _centroid(votes, where[row])) * bin_mm for row in rows]
    return np.array(translations).reshape(-1, 3), score[rows]


def _separate(where: Ints, most: int) -> list[int]:
    """Return the first rows of bins (n, 3) that lie more than two bins apart along some axis, ``most`` at most."""
    rows: list[int] = []
    free = np.ones(len(where), bool)
    for row in range(len(where)):
        if free[row]:
            rows.append(row)
            free &= (np.abs(where - where[row]) > 2).any(axis=1)
            if len(rows) >= most:
                break
    return rows


def _centroid(votes: Floats, bin_: Ints) -> Floats:
    """Return the centroid (3,) of the votes in the 3 x 3 x 3 bins around a peak, in bins from its centre."""
    i, j, k = bin_
    block = votes[i - 1 : i + 2, j - 1 : j + 2, k - 1 : k + 2]
    offset: Floats = np.array([(block.sum(axis=(1, 2)) @ [-1, 0, 1]), block.sum(axis=(0, 2)) @ [-1, 0, 1],
                               block.sum(axis=(0, 1)) @ [-1, 0, 1]]) / block.sum()  # fmt: skip
    return offset


@njit(cache=True, nogil=True)
def vote(a, b, low, size, votes):  # type: ignore[no-untyped-def]
    """Add the weight of every pair of patches with like normals to the bin of the translation a - b."""
    pa, na, wa = a.patches.points, a.patches.normals, a.weight
    pb, nb, wb = b.patches.points, b.patches.normals, b.weight
    for i in range(len(pa)):
        for j in range(len(pb)):
            if na[i, 0] * nb[j, 0] + na[i, 1] * nb[j, 1] + na[i, 2] * nb[j, 2] > LIKE_COS:
                x = int((pa[i, 0] - pb[j, 0] - low[0]) / size)
                y = int((pa[i, 1] - pb[j, 1] - low[1]) / size)
                z = int((pa[i, 2] - pb[j, 2] - low[2]) / size)
                votes[x, y, z] += wa[i] * wb[j]


@njit(cache=True, nogil=True)
def smooth(votes, out):  # type: ignore[no-untyped-def]
    """Sum votes over 3 x 3 x 3 bins around occupied ones into ``out``; returns the largest sum."""
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
