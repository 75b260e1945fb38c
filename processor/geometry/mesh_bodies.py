"""The bodies of a design's mesh: components of those that touch, and places of the surface within another body.

A design is often a set of closed bodies that run into each other. What is inside of another body cannot be scanned.
The winding number of a place is counted along a ray (Jacobson et al. 2013 for its use on sets of bodies); bodies whose
surface is not closed are left out.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from processor.distinct_rows import components as linked
from processor.distinct_rows import distinct
from processor.geometry import mesh_distance
from processor.geometry.mesh_distance import FacetGrid
from processor.geometry.nearest_neighbours import same_places
from processor.geometry.thread_ranges import over_ranges
from processor.model import Bools, Floats, Ints

WELD_MM = 0.01  # vertices nearer to each other are one
TOUCH_MM = 0.5
MOST_BODIES = 12  # of a component
OUTSIDE_MM = 0.5  # above the surface: closer bodies are in contact
JITTER_MM = np.array([1.3e-4, 2.1e-4, 1.7e-4])  # so that no ray meets an edge between two facets
LEAST_RANGE = 2_000  # places per task of a thread
PARTS = 16  # of the room about all bodies along each axis, by which the bodies about a place are found


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

    ``grid`` is of the mesh, ``body`` (f,) are the closed bodies of its facets.
    """
    places = np.ascontiguousarray(points + OUTSIDE_MM * normals + JITTER_MM)
    inside = np.zeros(len(places), np.bool_)
    axis = int(np.argmin(grid.shape))
    about = _boxes(grid.corners, body)
    room = _room(about)
    over_ranges(
        lambda a, b: _inside(grid, body, about, room, places, axis, inside, a, b), len(places), least=LEAST_RANGE
    )
    return inside


class _Room(NamedTuple):
    """Bodies by equal parts of the room about all of them.

    Those whose boxes reach into part k are ``body[start[k] : start[k + 1]]``. ``low`` (3,) is the room's corner,
    ``size`` (3,) that of a part, mm.
    """

    low: Floats
    size: Floats
    start: Ints
    body: Ints


def _room(about: Floats) -> _Room:
    """Sort bodies with boxes (b, 2, 3) into the parts of the room about them; those without a box are in none."""
    known = np.flatnonzero(np.isfinite(about).all(axis=(1, 2)))
    if not len(known):
        return _Room(np.zeros(3), np.ones(3), np.zeros(PARTS**3 + 1, np.int64), np.empty(0, np.int64))
    low, high = about[known, 0].min(axis=0), about[known, 1].max(axis=0)
    size = np.maximum((high - low) / PARTS, 1e-6)
    first = np.clip(np.floor((about[known, 0] - low) / size).astype(np.int64), 0, PARTS - 1)
    last = np.clip(np.floor((about[known, 1] - low) / size).astype(np.int64), 0, PARTS - 1)
    parts, bodies = [], []
    for k, (a, b) in enumerate(zip(first, last, strict=True)):
        i, j, m = np.meshgrid(*(np.arange(a[d], b[d] + 1) for d in range(3)), indexing="ij")
        parts.append(((i * PARTS + j) * PARTS + m).ravel())
        bodies.append(np.full(parts[-1].size, known[k]))
    part, body = np.concatenate(parts), np.concatenate(bodies)
    order = np.argsort(part, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(part, minlength=PARTS**3))])
    return _Room(low, size, start, body[order])


def boxes(vertices: Floats, faces: Ints, body: Ints) -> tuple[Floats, Floats]:
    """Return the corners low and high (b, 3) of boxes about the closed bodies; of other bodies they are empty."""
    about = _boxes(vertices[faces], body)
    return about[:, 0], about[:, 1]


def _boxes(corners: Floats, body: Ints) -> Floats:
    """Return the low and high corners (b, 2, 3) of boxes about the bodies (f,) of facets (f, 3, 3)."""
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


@njit(cache=True, nogil=True)
def _inside(grid, body, about, room, places, axis, inside, first, last):  # type: ignore[no-untyped-def]
    """Mark places first to last - 1 from which a ray along an axis leaves more bodies than it enters.

    Only bodies count whose box, ``about`` (b, 2, 3), contains the place. The ray ends where these boxes end.
    """
    low, size, shape = grid.low, grid.size, grid.shape
    u, v = (axis + 1) % 3, (axis + 2) % 3
    cell = np.empty(3, np.int64)
    held = np.full(len(about), -1, np.int64)  # row of the place that was in the box of each body last
    for row in range(first, last):
        p = places[row]
        end, within, part = -np.inf, True, 0
        for k in range(3):
            at = np.floor((p[k] - room.low[k]) / room.size[k])
            if not -1.0 <= at <= PARTS:  # a little beyond, by rounding, is in the outermost part
                within = False
            part = part * PARTS + int(min(max(at, 0.0), PARTS - 1.0))
        if not within:
            continue
        for i in range(room.start[part], room.start[part + 1]):
            b = room.body[i]
            low_b, high_b = about[b, 0], about[b, 1]
            if not (low_b[axis] <= p[axis] <= high_b[axis] and low_b[u] <= p[u] <= high_b[u]):
                continue
            if low_b[v] <= p[v] <= high_b[v]:
                held[b] = row
                end = max(end, high_b[axis])
        if end < p[axis]:
            continue
        for k in range(3):
            at = (p[k] - low[k]) / size
            within = within and 0.0 <= at < shape[k]
            cell[k] = int(at)
        if not within:
            continue
        winding = 0
        for step in range(cell[axis], min(shape[axis], int((end - low[axis]) / size) + 1)):
            cell[axis] = step
            voxel = (cell[0] * shape[1] + cell[1]) * shape[2] + cell[2]
            for k in range(grid.start[voxel], grid.start[voxel + 1]):
                f = grid.facet[k]
                n = grid.normals[f, axis]
                if body[f] < 0 or held[body[f]] != row or abs(n) < 1e-12:
                    continue
                a, b, c = grid.corners[f, 0], grid.corners[f, 1], grid.corners[f, 2]
                d = (b[u] - a[u]) * (p[v] - a[v]) - (b[v] - a[v]) * (p[u] - a[u])
                e = (c[u] - b[u]) * (p[v] - b[v]) - (c[v] - b[v]) * (p[u] - b[u])
                g = (a[u] - c[u]) * (p[v] - c[v]) - (a[v] - c[v]) * (p[u] - c[u])
                if not ((d >= 0.0 and e >= 0.0 and g >= 0.0) or (d <= 0.0 and e <= 0.0 and g <= 0.0)):
                    continue
                height = a[axis] - ((p[u] - a[u]) * grid.normals[f, u] + (p[v] - a[v]) * grid.normals[f, v]) / n
                if height > p[axis] and int((height - low[axis]) / size) == step:
                    winding += 1 if n > 0.0 else -1
        inside[row] = winding > 0
