"""Round holes through the plates of a design's bodies, found in its mesh.

A hole is a closed circle in the border of two flat faces that look opposite ways, with the faces outside of both
circles: what a fabricator drills or cuts for a bolt. Blind holes, slots and bores of tubes are none; of a counterbored
hole the narrower bore is one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from processor.distinct_rows import components, distinct
from processor.geometry import circle, rigid
from processor.geometry.nearest_neighbours import same_places
from processor.model import Floats, Ints

FEWEST_CORNERS = 8  # of a polygon that is a circle
ROUND_MM, ROUND_SHARE = 0.05, 0.002  # by which its corners may be off the circle, and as a share of the radius
LEAST_RADIUS_MM, MOST_RADIUS_MM = 3.0, 150.0  # chosen: from M6 on; larger than 300 mm are openings
MOST_DEPTH = 3.0  # in diameters: a deeper one is the bore of a tube
SAME_MM, PARALLEL = 0.1, 0.9999  # by which two ends of one hole may differ: a mesh's error; 0.8 degrees
SAME_PLACE_MM = 1e-3  # rounding: vertices that files give twice


class Hole(NamedTuple):
    """A hole as designed: middle (3,) of its bore, unit axis (3,), radius and depth, mm."""

    middle: Floats
    axis: Floats
    radius: float
    depth: float


class Circle(NamedTuple):
    """A circle in the border of a flat face: centre (3,), the face's outward normal (3,) and radius."""

    centre: Floats
    normal: Floats
    radius: float


def of_body(vertices: Floats, faces: Ints, normals: Floats, plane: Ints) -> list[Hole]:
    """Return the holes of a body with facets ``faces`` (f, 3) of vertices (v, 3) and their unit ``normals`` (f, 3).

    ``plane`` (f,) numbers the flat face that each facet belongs to.
    """
    return list(_through(list(_circles(vertices, faces, normals, plane))))


def _through(circles: list[Circle]) -> Iterator[Hole]:
    """Yield pairs of circles on one axis that bound a bore."""
    if len(circles) < 2:
        return
    centre = np.array([circle.centre for circle in circles])
    normal = np.array([circle.normal for circle in circles])
    radius = np.array([circle.radius for circle in circles])
    for i, one in enumerate(circles):
        off = centre - one.centre
        depth = -off @ one.normal  # the other face lies behind this one
        beside = np.linalg.norm(off + depth[:, None] * one.normal, axis=1)
        fits = (
            (normal @ one.normal < -PARALLEL)
            & (beside < SAME_MM)
            & (np.abs(radius - one.radius) < SAME_MM)
            & (depth > SAME_MM)
            & (depth < 2.0 * MOST_DEPTH * one.radius)
        )
        if fits.any():
            j = int(np.flatnonzero(fits)[np.argmin(depth[fits])])
            if i < j:  # each pair once
                yield Hole(0.5 * (centre[i] + centre[j]), one.normal, one.radius, float(depth[j]))


def _circles(vertices: Floats, faces: Ints, normals: Floats, plane: Ints) -> Iterator[Circle]:
    """Yield the circles that bound flat faces from within."""
    used, where = np.unique(faces, return_inverse=True)
    place = same_places(vertices[used], SAME_PLACE_MM)
    corner = place[where.reshape(faces.shape)]
    spot = np.empty((int(place.max()) + 1, 3))
    spot[place] = vertices[used]
    a, b = corner[:, [0, 1, 2]].ravel(), corner[:, [1, 2, 0]].ravel()
    third, group = corner[:, [2, 0, 1]].ravel(), np.repeat(plane, 3)
    # An edge of two facets of one face is within it; one of a single facet is in its border.
    key = np.stack([group, np.minimum(a, b), np.maximum(a, b)], axis=1)
    edges = distinct(key)
    border = edges.first[edges.count == 1]
    if not len(border):
        return
    ends = np.concatenate([[group[border], a[border]], [group[border], b[border]]], axis=1).T
    node = distinct(ends).number
    start, end = node[: len(border)], node[len(border) :]
    loop = components(int(node.max()) + 1, start, end)[start]
    degree = np.bincount(node)
    order = np.argsort(loop, kind="stable")
    for rows in np.split(order, np.cumsum(np.bincount(loop))[:-1]):
        if len(rows) < FEWEST_CORNERS or (degree[np.concatenate([start[rows], end[rows]])] != 2).any():
            continue
        at = border[rows]
        normal = normals[at[0] // 3]
        one = _fitted(spot[np.concatenate([a[at], b[at]])], normal)
        if one is None:
            continue
        # Facets of a face outside of the circle have their third corner there; those of a disc have it on the circle.
        if (np.linalg.norm(spot[third[at]] - one.centre, axis=1) > one.radius + SAME_MM).all():
            yield one


def _fitted(points: Floats, normal: Floats) -> Circle | None:
    """Fit a circle across ``normal`` to points (k, 3); None where they do not lie on a circle of a hole's size."""
    plane = rigid.axes_across(normal)
    middle = points.mean(axis=0)
    flat = (points - middle) @ plane.T
    found = circle.algebraic(flat)
    if found is None:
        return None
    centre, radius = found
    off = np.abs(np.linalg.norm(flat - centre, axis=1) - radius)
    if not LEAST_RADIUS_MM <= radius <= MOST_RADIUS_MM or off.max() > max(ROUND_MM, ROUND_SHARE * radius):
        return None
    return Circle(middle + centre @ plane, normal, radius)
