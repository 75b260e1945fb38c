"""Distances to a mesh as to a smooth surface: each point against the facet that its foot lies on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints

SHARP_COS = 0.94  # facets that meet at more than 20 deg belong to different faces
WALK_STEPS = 24
OUTER_SPACING_MM = 40.0  # of samples where there is one face only to choose
LEAST_RANGE = 5_000  # points a thread takes at once
EDGE_MM = 1.0  # a foot beyond its face by no more is still on it


@dataclass(frozen=True)
class MeshSurface:
    """A mesh with its facets' unit normals (f, 3), and the facets (f, 3) across each side; -1 across a sharp edge."""

    vertices: Floats
    faces: Ints
    normals: Floats
    neighbours: Ints  # opposite to each of a facet's vertices
    part_of: Ints  # (f,) number of the smooth face that a facet belongs to
    tree: cKDTree
    sample_face: Ints

    def distances(self, points: Floats, reach: float, before: Ints | None = None) -> tuple[Ints, Floats, Floats]:
        """Facet (n,), signed distance (n,) from it, and how far (n,) the foot lies beyond its face's edge; mm.

        Facet -1 and NaN where no sample of the surface is within ``reach``. The search starts at the nearest sample and
        walks over smooth edges to the facet that the foot is on, so that a curved face is not taken for a plane. Points
        that have moved little start where they were ``before`` (n,) instead.
        """
        if before is None:
            found, sample = self.tree.query(points, distance_upper_bound=reach, workers=-1)
            start = np.where(np.isfinite(found), self.sample_face[np.minimum(sample, len(self.sample_face) - 1)], -1)
        else:
            start = before
        face = np.full(len(points), -1, np.int64)
        distance, beyond = np.full(len(points), np.nan), np.full(len(points), np.nan)
        given = (np.ascontiguousarray(points, np.float64), start, self.vertices, self.faces, self.normals)
        walk = partial(feet, *given, self.neighbours, WALK_STEPS, face, distance, beyond)
        over_ranges(walk, len(points), least=LEAST_RANGE)
        return face, distance, beyond

    def only(self, facets: npt.NDArray[np.bool_]) -> MeshSurface:
        """Return the surface of the marked facets (f,) alone, for points up to a plate's thickness and more away."""
        return of_mesh(self.vertices, self.faces[facets], OUTER_SPACING_MM)

    def barycentric(self, points: Floats, face: Ints) -> Floats:
        """Barycentric coordinates (n, 3) of the points' feet on their facets."""
        a, b, c = (self.vertices[self.faces[face, k]] for k in range(3))
        n = np.cross(b - a, c - a)
        square = np.einsum("ni,ni->n", n, n)
        p = points - a
        second = np.einsum("ni,ni->n", np.cross(p, c - a), n) / square
        third = np.einsum("ni,ni->n", np.cross(b - a, p), n) / square
        return np.stack([1.0 - second - third, second, third], axis=1)


def of_mesh(vertices: Floats, faces: Ints, spacing_mm: float = 12.0) -> MeshSurface:
    """Prepare a mesh; samples for the first guess lie about ``spacing_mm`` apart: less than a plate is thick."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    size = np.linalg.norm(cross, axis=1)
    used = size > 1e-9
    faces, a, b, c, cross, size = faces[used], a[used], b[used], c[used], cross[used], size[used]
    normals = cross / size[:, None]
    count = np.maximum(1, np.ceil(0.5 * size / spacing_mm**2)).astype(np.int64)
    owner = np.repeat(np.arange(len(faces)), count)
    i = np.arange(len(owner))
    u, v = (0.5 + i * 0.7548776662466927) % 1.0, (0.5 + i * 0.5698402909980532) % 1.0
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
    samples = a[owner] + u[:, None] * (b - a)[owner] + v[:, None] * (c - a)[owner]
    neighbours = _neighbours(faces, normals)
    tree = cKDTree(samples, balanced_tree=False)
    return MeshSurface(vertices, faces, normals, neighbours, _smooth_faces(neighbours), tree, owner)


def _smooth_faces(neighbours: Ints) -> Ints:
    """Return a number for each facet (f,): one for all that smooth sides join."""
    one, side = np.nonzero(neighbours >= 0)
    links = coo_array((np.ones(len(one), np.int8), (one, neighbours[one, side])), (len(neighbours),) * 2)
    number: Ints = connected_components(links, directed=False)[1].astype(np.int64)
    return number


def on_face(face: Ints, beyond: Floats) -> npt.NDArray[np.bool_]:
    """Mark the points (n,) that have a face and their foot on it, by what :meth:`MeshSurface.distances` found."""
    found: npt.NDArray[np.bool_] = (face >= 0) & (beyond < EDGE_MM)
    return found


def _neighbours(faces: Ints, normals: Floats) -> Ints:
    """Facets (f, 3) across the side opposite to each vertex; -1 for none, for more than one, and across sharp edges."""
    sides = np.sort(np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1).reshape(-1, 2), axis=1)
    order = np.lexsort((sides[:, 1], sides[:, 0]))
    same = (sides[order][1:] == sides[order][:-1]).all(axis=1)
    alone = np.concatenate([[False], same]).astype(int) + np.concatenate([same, [False]]).astype(int) == 1
    pairs = np.flatnonzero(same & alone[1:] & alone[:-1])
    found = np.full(len(sides), -1, np.int64)
    one, two = order[pairs], order[pairs + 1]
    smooth = np.einsum("ni,ni->n", normals[one // 3], normals[two // 3]) > SHARP_COS
    found[one[smooth]], found[two[smooth]] = two[smooth] // 3, one[smooth] // 3
    return found.reshape(-1, 3)


# --- What a mesh leaves out of a curved surface: facets lie inside of a tube by up to their tolerance.


MOST_MM = 1.0  # facets that would bulge by more are meant flat: no mesh is as coarse


@dataclass(frozen=True)
class CurvedFacets:
    """Slopes (f, 3, 3) by corner: of the plane at each corner, over the facet's own, along the three axes."""

    surface: MeshSurface
    slopes: Floats

    def heights(self, feet: Floats, facet: Ints) -> Floats:
        """Height (n,) of the smooth surface over facets (n,) at feet (n, 3) on them; 0 where there is no facet."""
        found = np.zeros(len(feet))
        on = np.flatnonzero(facet >= 0)
        at = facet[on]
        share = np.clip(self.surface.barycentric(feet[on], at), 0.0, 1.0)
        for k in range(3):
            off = feet[on] - self.surface.vertices[self.surface.faces[at, k]]
            found[on] += 0.5 * share[:, k] * np.einsum("ni,ni->n", off, self.slopes[at, k])
        return found


def of_surface(surface: MeshSurface) -> CurvedFacets:
    """Find the slopes of a mesh's facets; 0 for those that are flat, or meant so."""
    corners = surface.vertices[surface.faces]
    # The normal at a corner: of the facets of the same smooth face about it, by the angle that each has there.
    ahead, behind = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    length = np.linalg.norm(ahead, axis=2) * np.linalg.norm(behind, axis=2)
    cosine = np.einsum("fki,fki->fk", ahead, behind) / np.maximum(length, 1e-300)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)).ravel()
    key = surface.faces * (int(surface.part_of.max()) + 1) + surface.part_of[:, None]
    number = np.unique(key.ravel(), return_inverse=True)[1].reshape(-1)
    each = np.repeat(surface.normals, 3, axis=0) * angle[:, None]
    total = np.stack([np.bincount(number, each[:, i]) for i in range(3)], axis=1)
    total = total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]
    normal = total[number].reshape(-1, 3, 3)
    up = np.einsum("fki,fi->fk", normal, surface.normals)
    # A plane with normal m, over a facet with normal n, rises by -(m . d) / (m . n) at d along the facet.
    slopes = -normal / np.maximum(up, 0.5)[:, :, None]
    slopes -= np.einsum("fki,fi->fk", slopes, surface.normals)[:, :, None] * surface.normals[:, None]
    rise = np.abs(np.einsum("fki,fki->fk", slopes, ahead)), np.abs(np.einsum("fki,fki->fk", slopes, behind))
    bulge = np.maximum(*rise).max(axis=1) / 4.0
    slopes[bulge > MOST_MM] = 0.0
    return CurvedFacets(surface, slopes)


# --- Compiled: from a facet near each point over smooth edges to the facet that the point's foot is on.


@njit(cache=True, nogil=True)
def feet(points, start, vertices, faces, normals, neighbours, steps, face, distance, beyond, first, last):  # type: ignore[no-untyped-def]
    """Walk from facets ``start`` (n,), -1 = none, at most ``steps`` facets far; for points first..last.

    Writes the facet, the signed distance from it, and how far the foot lies beyond its face's edge, mm.
    """
    share = np.empty(3)
    for i in range(first, last):
        at = start[i]
        if at < 0:
            continue
        side = barycentric(points[i], vertices, faces[at], share)
        for _ in range(steps):
            over = neighbours[at, side]
            if not (share[side] < -1e-9 and over >= 0):
                break
            at = over
            side = barycentric(points[i], vertices, faces[at], share)
        a = vertices[faces[at, 0]]
        off = 0.0
        for k in range(3):
            off += (points[i, k] - a[k]) * normals[at, k]
        face[i], distance[i] = at, off
        beyond[i] = -min(share[side], 0.0) * height(vertices, faces[at], side)


@njit(cache=True, nogil=True, inline="always")
def barycentric(point, vertices, corners, share):  # type: ignore[no-untyped-def]
    """Write the barycentric coordinates (3,) of a point's foot on a facet; returns the vertex with the least."""
    a, b, c = vertices[corners[0]], vertices[corners[1]], vertices[corners[2]]
    b0, b1, b2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    c0, c1, c2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    p0, p1, p2 = point[0] - a[0], point[1] - a[1], point[2] - a[2]
    n0, n1, n2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    square = n0 * n0 + n1 * n1 + n2 * n2
    share[1] = ((p1 * c2 - p2 * c1) * n0 + (p2 * c0 - p0 * c2) * n1 + (p0 * c1 - p1 * c0) * n2) / square
    share[2] = ((b1 * p2 - b2 * p1) * n0 + (b2 * p0 - b0 * p2) * n1 + (b0 * p1 - b1 * p0) * n2) / square
    share[0] = 1.0 - share[1] - share[2]
    least = 0
    for k in range(1, 3):
        if share[k] < share[least]:
            least = k
    return least


@njit(cache=True, nogil=True, inline="always")
def height(vertices, corners, side):  # type: ignore[no-untyped-def]
    """Height of a facet over the side opposite to a vertex."""
    a, b, c = vertices[corners[side]], vertices[corners[(side + 1) % 3]], vertices[corners[(side + 2) % 3]]
    b0, b1, b2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    c0, c1, c2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    n0, n1, n2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    base = np.sqrt((c0 - b0) ** 2 + (c1 - b1) ** 2 + (c2 - b2) ** 2)
    return np.sqrt(n0 * n0 + n1 * n1 + n2 * n2) / max(base, 1e-12)
