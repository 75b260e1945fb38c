"""Groups of points by cells of faces, and the means over them."""

from __future__ import annotations

import numpy as np

from processor.distinct_rows import distinct
from processor.model import Floats, Ints


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
