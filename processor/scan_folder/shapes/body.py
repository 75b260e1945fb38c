"""A body of a design as a mesh whose facets share their vertices, with its edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from processor.distinct_rows import components, distinct
from processor.geometry.nearest_neighbours import same_places
from processor.model import Floats, Ints

WELD_MM = 1e-4  # vertices nearer to each other are one: far below any edge and far above rounding
SHARP_RAD = np.radians(20.0)  # between the facets on both sides of an edge; curved plates turn less from facet to facet
ROUNDED_MM, FEWEST_ROUNDED = (10.0, 1.0, 0.1), 100  # a few vertices may have such coordinates by their design

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Unsure:
    """A joint, part or node of a guessed design that is not sure, and its place (3,), mm."""

    name: str
    place: Floats


@dataclass(frozen=True)
class Body:
    """Vertices (v, 3), mm, and triangles (f, 3) of a body; facets that meet share their vertices.

    Facets need not be oriented, and the surface need not be closed.
    """

    name: str
    vertices: Floats
    faces: Ints

    @cached_property
    def normals(self) -> Floats:
        """Unit normals (f, 3) of the facets."""
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    @cached_property
    def areas(self) -> Floats:
        """Areas (f,) of the facets, mm2."""
        corners = self.vertices[self.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return np.asarray(0.5 * np.linalg.norm(cross, axis=1))

    @cached_property
    def bounds(self) -> Floats:
        """Least and greatest coordinates (2, 3), mm."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def centre(self) -> Floats:
        """Mean (3,) of the surface, mm."""
        middles = self.vertices[self.faces].mean(axis=1)
        return np.asarray(np.average(middles, axis=0, weights=self.areas))

    @cached_property
    def edges(self) -> tuple[Ints, Ints]:
        """Vertices (e, 2) of each edge and the facets (e, 2) on its sides; -1 where there are not exactly two."""
        pairs = np.sort(self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        found = distinct(pairs)
        ends, count = found.rows, found.count
        order = np.argsort(found.number, kind="stable")
        first = np.cumsum(count) - count
        sides = np.full((len(ends), 2), -1, np.int64)
        two = count == 2
        sides[two] = np.stack([order[first[two]], order[first[two] + 1]], axis=1) // 3
        return ends, sides

    @cached_property
    def open_edges(self) -> int:
        """Number of edges without exactly two facets."""
        return int((self.edges[1][:, 0] < 0).sum())

    @cached_property
    def step_mm(self) -> float:
        """Step of the coordinates where they are rounded to 0.1 mm or more, else 0."""
        for step in ROUNDED_MM if len(self.vertices) >= FEWEST_ROUNDED else ():
            if np.abs(self.vertices / step - np.round(self.vertices / step)).max() < 1e-3:
                return step
        return 0.0

    @cached_property
    def sharp(self) -> Ints:
        """Vertices (s, 2) of the edges where the surface turns, and of those at which it ends."""
        sharp: Ints = self.edges[0][self.turning]
        return sharp

    @cached_property
    def turning(self) -> Mask:
        """Whether an edge (e,) is sharp, or has not exactly two facets."""
        sides = self.edges[1]
        cosine = np.abs(np.einsum("ei,ei->e", self.normals[sides[:, 0]], self.normals[sides[:, 1]]))
        return np.asarray((sides[:, 0] < 0) | (cosine < np.cos(SHARP_RAD)))

    @cached_property
    def faces_between(self) -> Ints:
        """Number (f,) of the face that each facet belongs to: faces end at sharp edges."""
        sides = self.edges[1][~self.turning]
        return components(len(self.faces), *sides.T)

    @cached_property
    def normals_of_faces(self) -> tuple[Ints, Floats, Floats]:
        """Of each face the number (c,) of facets, and the means by area of normals n (c, 3) and of n n^T (c, 3, 3)."""
        label = self.faces_between
        squares = self.normals[:, :, None] * self.normals[:, None]
        weighted = self.areas[:, None] * np.column_stack([np.ones(len(label)), self.normals, squares.reshape(-1, 9)])
        sums = np.stack([np.bincount(label, one) for one in weighted.T], axis=1)
        means = sums[:, 1:] / sums[:, :1]
        return np.bincount(label), means[:, :3], means[:, 3:].reshape(-1, 3, 3)


def welded(name: str, vertices: Floats, faces: Ints) -> Body | None:
    """Return a body without repeated vertices and without facets of no area; None if nothing is left."""
    _, first, place = np.unique(same_places(vertices, WELD_MM), return_index=True, return_inverse=True)
    points, triangles = vertices[first], place.reshape(-1)[faces]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    corners = points[triangles]
    sides = corners[:, [1, 2, 0]] - corners
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    triangles = triangles[area > WELD_MM * np.linalg.norm(sides, axis=2).max(axis=1)] if len(triangles) else triangles
    if not len(triangles):
        return None
    used, renumbered = np.unique(triangles, return_inverse=True)
    return Body(name, points[used], renumbered.reshape(-1, 3).astype(np.int64))


def stacked(name: str, bodies: Sequence[Body]) -> Body:
    """Return one mesh of several bodies, which share no vertices."""
    counts = np.cumsum([0, *(len(body.vertices) for body in bodies)]).tolist()
    faces = [body.faces + first for body, first in zip(bodies, counts, strict=False)]
    return Body(name, np.concatenate([body.vertices for body in bodies]), np.concatenate(faces))
