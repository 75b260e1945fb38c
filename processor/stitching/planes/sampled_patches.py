"""Patches: a scan's faces sampled on coarse cubes, as the coarse registration votes with and checks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from processor.model import Floats, Ints
from processor.stitching.planes import extraction, grouped_sums
from processor.stitching.planes.scan_planes import Cloud


class Patches(NamedTuple):
    """Centres (n, 3) of patches and their unit normals (n, 3), in the cloud's frame."""

    points: Floats
    normals: Floats


def sample(cloud: Cloud, side_mm: float) -> Patches:
    """Average a cloud's cells over cubes of side ``side_mm``, one patch for each cube and facing direction."""
    where = extraction.cells_of(cloud.mean, side_mm)
    _, first, inverse = np.unique(
        extraction.packed(where, facing(cloud.normal)), return_index=True, return_inverse=True
    )
    inverse = inverse.ravel()
    count = np.bincount(inverse, np.ones(len(inverse)), len(first))
    points = grouped_sums.summed(cloud.mean, inverse, len(first)) / count[:, None]
    normals = grouped_sums.summed(cloud.normal, inverse, len(first))
    return Patches(points, normals / np.linalg.norm(normals, axis=1)[:, None])


def facing(normals: Floats) -> Ints:
    """Return which of the six directions of oblique axes (n,) is nearest to each of normals (n, 3)."""
    components = normals @ OBLIQUE
    axis = np.argmax(np.abs(components), axis=1)
    negative = np.take_along_axis(components, axis[:, None], axis=1)[:, 0] < 0.0
    direction: Ints = 2 * axis + negative
    return direction


def _oblique() -> Floats:
    """Return axes (3, 3) oblique to those of any built structure: no class border runs through a main direction."""
    a, b, c = 0.61, 0.37, 0.83
    X = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    Y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    Z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return np.asarray(X @ Y @ Z, float)


OBLIQUE = _oblique()
