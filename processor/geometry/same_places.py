"""Vertices that meshes repeat, recognised by their places."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from processor.model import Floats, Ints


def same_places(points: Floats, within_mm: float) -> Ints:
    """Return the number (n,), from 0, of the place of each point (n, 3); points no farther apart have the same one."""
    distinct, place = np.unique(points, axis=0, return_inverse=True)
    place = place.reshape(-1).astype(np.int64)
    pairs = cKDTree(distinct).query_pairs(within_mm, output_type="ndarray") if len(distinct) else np.empty((0, 2))
    if not len(pairs):
        return place
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (len(distinct),) * 2)
    label: Ints = connected_components(links, directed=False)[1].astype(np.int64)
    return label[place]
