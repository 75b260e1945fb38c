"""The bodies of a design's mesh: components of those that touch, and places of the surface within another body.

A design is often a set of closed bodies that run into each other. What is inside of another body cannot be scanned.
The winding number of a place is counted along a ray (Jacobson et al. 2013 for its use on sets of bodies); bodies whose
surface is not closed are left out.
"""

from __future__ import annotations

import numpy as np

from processor.distinct_rows import components as linked
from processor.distinct_rows import distinct
from processor.geometry import mesh_distance
from processor.geometry.mesh_distance import FacetGrid
from processor.geometry.nearest_neighbours import same_places
from processor.geometry.thread_ranges import each
from processor.model import Bools, Floats, Ints

WELD_MM = 0.01  # vertices nearer to each other are one
TOUCH_MM = 0.5  # chosen: above chords of round faces, below gaps left on purpose: nearer bodies are one component
MOST_BODIES = 12  # of a component
OUTSIDE_MM = 0.5  # above the surface: closer bodies are in contact
JITTER_MM = np.array([1.3e-4, 2.1e-4, 1.7e-4])  # so that no ray meets an edge between two facets
LEAST_RANGE = 20_000  # places per task of a thread


def welded(vertices: Floats, faces: Ints, body: Ints | None) -> tuple[Floats, Ints]:
    """Return a mesh whose vertices at the same place are one, but not those of different bodies (f,)."""
    corners = faces.ravel()
    key = same_places(vertices, WELD_MM)[corners, None]
    if body is not None:
        key = np.hstack([key, np.repeat(body, 3)[:, None]])
    places = distinct(key)
    return vertices[corners[places.first]], places.number.reshape(faces.shape)


def pieces(faces: Ints) -> Ints:
    """Return the connected piece (f,) of each facet; vertices at one place are one, see :func:`welded`."""
    count = int(faces.max(initial=-1)) + 1
    piece: Ints = linked(count, faces[:, :2].ravel(), faces[:, 1:].ravel())[faces[:, 0]]
    return piece


def component_name(number: int) -> str:
    """Return the name of a component of a mesh whose bodies have no names; the first has the number 0."""
    return f"component-{number + 1}"


def components(vertices: Floats, faces: Ints) -> Ints:
    """Return the component (f,) of each facet of a mesh, numbered in the order of the mesh.

    A component is a set of bodies that touch, or a single body where more than MOST_BODIES touch. ``vertices`` at one
    place are one, see :func:`welded`.
    """
    body = pieces(faces)
    vertex, facet = mesh_distance.touching(vertices, faces, TOUCH_MM)
    body_of_vertex = np.full(len(vertices), -1, np.int64)
    body_of_vertex[faces.ravel()] = np.repeat(body, 3)
    count = int(body.max(initial=-1)) + 1
    group = linked(count, body_of_vertex[vertex], body[facet])
    many = np.bincount(group) > MOST_BODIES
    group = np.where(many[group[body]], count + body, group[body])
    _, first, inverse = np.unique(group, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse.reshape(-1)]


def enclosed(points: Floats, normals: Floats, grid: FacetGrid, body: Ints) -> Bools:
    """Mark the places (n, 3) on a mesh, with unit normals (n, 3), that lie within another body.

    ``grid`` is of the mesh, ``body`` (f,) are the closed bodies of its facets. From a place within, a ray leaves more
    bodies than it enters; only bodies whose boxes contain the place count, and the ray ends where these boxes end.
    """
    places = points + OUTSIDE_MM * normals + JITTER_MM
    longest, axis, about = int(np.argmax(grid.shape)), int(np.argmin(grid.shape)), boxes(grid.corners, body)
    order = np.argsort(places[:, longest], kind="stable")
    places, end = places[order], np.full(len(places), -np.inf)
    for low, high in about[np.isfinite(about).all(axis=(1, 2))]:
        first, last = np.searchsorted(places[:, longest], (low[longest], high[longest]))
        some = places[first:last]
        within = ((some >= low) & (some <= high)).all(axis=1)
        end[first:last][within] = np.maximum(end[first:last][within], high[axis])
    rows = np.flatnonzero(np.isfinite(end))
    starts, ends = places[rows], places[rows]
    ends[:, axis] = end[rows] + OUTSIDE_MM
    parts = [slice(k, k + LEAST_RANGE) for k in range(0, len(rows), LEAST_RANGE)]
    found = each(lambda part: mesh_distance.crossings(grid, starts[part], ends[part], False), parts)
    inside = np.zeros(len(places), bool)
    for part, (row, facet, _) in zip(parts, found, strict=True):
        of, at = body[facet], starts[part][row]
        counted = (of >= 0) & ((at >= about[of, 0]) & (at <= about[of, 1])).all(axis=1)
        leaving = np.sign(grid.normals[facet, axis]) * counted
        inside[rows[part]] = np.bincount(row, leaving, len(starts[part])) > 0.5
    marked = np.empty(len(places), bool)
    marked[order] = inside
    return marked


def boxes(corners: Floats, body: Ints) -> Floats:
    """Return the low and high corners (b, 2, 3) of boxes about the bodies (f,) of facets (f, 3, 3).

    Of bodies that are not closed, -1, there are none.
    """
    count = int(body.max(initial=-1)) + 1
    about = np.stack([np.full((count, 3), np.inf), np.full((count, 3), -np.inf)], axis=1)
    closed = body >= 0
    for corner in range(3):
        np.minimum.at(about[:, 0], body[closed], corners[closed, corner])
        np.maximum.at(about[:, 1], body[closed], corners[closed, corner])
    return about


def closed_bodies(faces: Ints) -> Ints:
    """Return the body (f,) of each facet, -1 if not closed: each edge of a closed one is passed as often either way."""
    first, second = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    facet = np.repeat(np.arange(len(faces)), 3)
    count = int(faces.max()) + 1
    body = linked(count, first, second)[faces[:, 0]]
    edge = np.minimum(first, second) * count + np.maximum(first, second)
    number = np.unique(edge, return_inverse=True)[1].reshape(-1)
    unpaired = np.bincount(number, np.where(first < second, 1.0, -1.0)) != 0.0
    open_ = np.zeros(int(body.max()) + 1, np.bool_)
    open_[body[facet[unpaired[number]]]] = True
    closed: Ints = np.where(open_[body], -1, body).astype(np.int64)
    return closed
