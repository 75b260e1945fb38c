"""Distances of a part's scan from its design, for maps: each is the median of the points about a place.

A single point would show the noise of the scanner, not the shape of the steel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry.mesh_distance import MeshSurface, on_face
from processor.geometry.thinning import thinned
from processor.model import Floats

PLACES = 4_000  # of a part, at least, where it has as many points
POINTS = 100_000  # of a part, at least, that are used
A_MEDIAN = 25  # points about a place
SAME_SIDE = 0.9  # least cosine between the normals of the faces below a point and below its place
REACH_MM = 60.0  # from the design, within which points are of the part


class PartResiduals(NamedTuple):
    """Places (r, 3) of a scan in the design's frame, and distances (r,) from its surface there, outward, mm."""

    places: Floats
    distance: Floats


def part_residuals(points: Floats, surface: MeshSurface) -> PartResiduals:
    """Return the distances of a part's points (n, 3), in the frame of its design, from the design's surface."""
    points = thinned(points, POINTS)
    face, distance, beyond = surface.distances(points, REACH_MM)
    near = on_face(face, beyond)
    points, distance, normals = points[near], distance[near], surface.normals[face[near]]
    if not len(points):
        return PartResiduals(points, distance)
    chosen = thinned(np.arange(len(points)), PLACES)
    count = min(A_MEDIAN, len(points))
    about = cKDTree(points).query(points[chosen], k=np.arange(1, count + 1))[1]
    same = np.einsum("rki,ri->rk", normals[about], normals[chosen]) > SAME_SIDE
    return PartResiduals(points[chosen], np.nanmedian(np.where(same, distance[about], np.nan), axis=1))
