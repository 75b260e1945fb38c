"""Crops of a cloud about many places at once."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from processor.model import Floats, Ints

CHUNK = 1 << 20


def nearest_crops(points: Floats, centres: Floats, reaches: Floats) -> list[Ints]:
    """Rows of points (n, 3) within ``reaches`` (k,) of each of centres (k, 3), k arrays in row order, lengths in mm.

    A point in reach of several centres belongs to the nearest. The tree is over the centres, never over the points.
    """
    if len(centres) == 0:
        return []
    tree = cKDTree(centres)
    # just beyond, for the tree's bound is exclusive and a crop is not
    bound = float(reaches.max()) * (1.0 + 1e-9) + 1e-9
    rows, owners = [], []
    for first in range(0, len(points), CHUNK):
        chunk = points[first : first + CHUNK]
        inside = np.flatnonzero(np.all((chunk >= tree.mins - bound) & (chunk <= tree.maxes + bound), axis=1))
        distance, owner = tree.query(chunk[inside], distance_upper_bound=bound, workers=-1)
        near = np.flatnonzero(np.isfinite(distance))
        near = near[distance[near] <= reaches[owner[near]]]
        rows.append(first + inside[near])
        owners.append(owner[near])
    row, owner = np.concatenate([np.empty(0, np.int64), *rows]), np.concatenate([np.empty(0, np.int64), *owners])
    order = np.argsort(owner, kind="stable")
    starts = np.searchsorted(owner[order], np.arange(1, len(centres)))
    return [part.astype(np.int64) for part in np.split(row[order], starts)]
