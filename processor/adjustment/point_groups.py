"""Groups of points: by cells of faces, joined from several parts, and the means over them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.distinct_rows import distinct
from processor.large_arrays import allocate, blocks, extremes
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
    numbers, start, before = allocate(sum(map(len, by_part)), dtype=np.int64), 0, 0
    for group in by_part:
        known = distinct_groups(group)
        for rows in blocks(len(group)):
            numbers[start + rows.start : start + rows.stop] = before + np.searchsorted(known, group[rows])
        start, before = start + len(group), before + len(known)
    return numbers


def distinct_groups(group: Ints | Labels) -> Ints:
    """Return the groups (g,) that there are among those of points (n,), ascending; small numbers are counted."""
    if not len(group):
        return np.empty(0, np.int64)
    low, high = (int(one) for one in extremes(group))
    if high - low >= len(group):
        return np.unique(group).astype(np.int64)
    count = np.zeros(high - low + 1, np.int64)
    for rows in blocks(len(group)):
        count += np.bincount(group[rows] - low, minlength=len(count))
    return low + np.flatnonzero(count)
