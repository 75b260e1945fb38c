"""The places of a scan that votes and checks are taken at: one a coarse cube and direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Floats, Ints
from processor.stitching.planes import extraction, hashing
from processor.stitching.planes.scan_planes import Cloud

MOST_NORMALS = 1500


@dataclass(frozen=True)
class Elements:
    """Places (n, 3) with the unit normal (n, 3) of the face there, in the cloud's frame."""

    points: Floats
    normals: Floats


def elements(cloud: Cloud, side_mm: float) -> Elements:
    """Gather a cloud's cells in cubes of a side, faces that look different ways apart."""
    where = extraction.cells_of(cloud.cells.mean, side_mm)
    # A face's side of the cube by its normal, in axes that no structure is built along.
    group = facing(cloud.normal)
    _, first, inverse = np.unique(extraction.packed(where, group), return_index=True, return_inverse=True)
    inverse = inverse.ravel()
    one = np.ones(len(inverse))
    count = np.bincount(inverse, one, len(first))
    points = hashing.summed(cloud.cells.mean, inverse, len(first)) / count[:, None]
    normals = hashing.summed(cloud.normal, inverse, len(first))
    return Elements(points, normals / np.linalg.norm(normals, axis=1)[:, None])


def facing(normals: Floats) -> Ints:
    """Return which of six ways (n,) each of normals (n, 3) looks most, in axes that no structure is built along."""
    turned = normals @ OBLIQUE
    axis = np.argmax(np.abs(turned), axis=1)
    sign = np.take_along_axis(turned, axis[:, None], axis=1)[:, 0] < 0.0
    found: Ints = 2 * axis + sign
    return found


def _oblique() -> Floats:
    a, b, c = 0.61, 0.37, 0.83
    X = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    Y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    Z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return np.asarray(X @ Y @ Z, float)


OBLIQUE = _oblique()
