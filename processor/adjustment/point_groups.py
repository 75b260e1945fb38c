"""Groups of points: by cells of faces, joined from several parts, and the means over them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.distinct_rows import distinct
from processor.model import Floats, Ints, Labels


def pieces(points: Floats, normals: Floats, side: float) -> Ints:
    """Return the number (k,), from 0, of the piece of a face that each point (k, 3), mm, lies on.

    A piece is a cube of edge ``side``, mm, and a rounded direction of the unit normals (k, 3).
    """
    place = np.floor((points - points.min(axis=0)) / side).astype(np.int64)
    return distinct(np.hstack([place, np.rint(normals).astype(np.int64)])).number


def group_means(values: Floats, group: Ints) -> Floats:
    """Means (g, 3) of values (n, 3) in groups (n,)."""
    count = np.bincount(group)
    total: Floats = np.stack([np.bincount(group, values[:, k]) for k in range(values.shape[1])], axis=1)
    return total / count[:, None]


def joined_numbers(by_part: Sequence[Ints | Labels]) -> Ints:
    """Return the group (n,), from 0, of each of the concatenated points of several parts; no group is of two parts."""
    numbers, before = [np.empty(0, np.int64)], 0
    for group in by_part:
        number = _numbered(group)
        numbers.append(number + before)
        before += int(number.max(initial=-1)) + 1
    return np.concatenate(numbers)


def _numbered(group: Ints | Labels) -> Ints:
    """Return the rank (n,) of each group (n,) among those that there are; small numbers are counted, not sorted."""
    low, high = int(group.min(initial=0)), int(group.max(initial=-1))
    if high - low < len(group):
        rank = np.cumsum(np.bincount(group - low) > 0) - 1
        return np.asarray(rank[group - low], np.int64)
    return np.unique(group, return_inverse=True)[1].reshape(-1).astype(np.int64)
