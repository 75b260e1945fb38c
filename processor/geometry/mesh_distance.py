"""Distances between points and a triangle mesh, and points spread over a mesh.

Two searches answer two questions. :class:`MeshSurface` takes the mesh for a smooth surface: it walks over smooth edges
to the facet that a point's foot lies on, so that a curved face is not mistaken for the plane of one facet.
:class:`FacetGrid` finds the nearest facet that a scanner could see, so that the two sides of a plate are not mixed up.
"""
# Numba infers the types of the kernels' arguments: most stay without annotations.

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from processor.distinct_rows import components
from processor.geometry import nearest_neighbours, point_grid
from processor.geometry.linalg_small import assign_rows
from processor.geometry.point_grid import Cells
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner
from processor.large_arrays import read_only
from processor.model import Bools, Floats, Ints, Labels

LEAST_AREA = 1e-9  # mm2, twice that of a facet; smaller ones are left out

SHARP_COS = 0.94  # facets that meet at more than 20 deg belong to different faces
WALK_STEPS = 24  # from facet to neighbouring facet: in a fine mesh a point moves over fewer; then it is searched anew
CELL_SPACINGS = 2.0  # edge of the cells of samples, in their mean spacing
OUTER_SPACING_MM = 40.0  # of samples, for the outer face of a plate alone
LEAST_RANGE = 5_000  # points per task of a thread
EDGE_MM = 1.0  # a foot up to this far outside the edge of its face still counts as on it
MOST_BULGE_MM = 1.0  # facets with a larger bulge are meant to be flat: no mesh is that coarse
DESIGN_SAMPLES, DESIGN_SPACING_MM = 1_000_000, (8.0, 40.0)  # samples on a whole design; least and greatest spacing
MOST_VOXELS, MOST_ENTRIES = 20_000_000, 40_000_000  # work: int64 and int32, 160 MB each
FULL, EMPTY = 64, 8.0  # a facet's box is halved if it has more voxels than this, and as many times those of the facet
PIECES = 64  # size of the stack of halved boxes
ROUNDING_MM = 1e-6  # more than the errors of rounding of a distance
ON_EDGE = 1e-9  # barycentric coordinates down to its negative are on a facet: no line passes between two of them
GRAZING_COS = 0.02  # cosine of incidence below which a facet is seen edge-on


# --- Points spread over a mesh


@dataclass(frozen=True)
class Samples:
    """Points (m, 3) on a mesh with unit normals (m, 3), and the facet (m,) of each."""

    points: Floats
    normals: Floats
    facet: Ints


def area(vertices: Floats, faces: Ints) -> float:
    """Area of a mesh, mm^2."""
    return 0.5 * float(double_areas(vertices, faces)[1].sum())


def sampled(vertices: Floats, faces: Ints, spacing_mm: float) -> Samples:
    """Spread points over a mesh, one per ``spacing_mm`` squared, in a fixed low-discrepancy pattern."""
    return spread(vertices, faces, lambda area_mm2: max(1, round(area_mm2 / spacing_mm**2)))


def spread(vertices: Floats, faces: Ints, count_of: Callable[[float], int]) -> Samples:
    """Spread ``count_of(area in mm^2)`` points over a mesh in a fixed low-discrepancy pattern."""
    cross, double = double_areas(vertices, faces)
    cumulative = np.cumsum(double)
    count = count_of(0.5 * float(cumulative[-1]))
    facet = np.searchsorted(cumulative, (np.arange(count) + 0.5) / count * cumulative[-1]).astype(np.int64)
    return Samples(_placed(vertices, faces, facet), cross[facet] / double[facet, None], facet)


def has_area(vertices: Floats, faces: Ints) -> Bools:
    """Mark the facets (f,) of a mesh that :func:`of_mesh` does not leave out."""
    return np.asarray(double_areas(vertices, faces)[1] > LEAST_AREA, bool)


def double_areas(vertices: Floats, faces: Ints) -> tuple[Floats, Floats]:
    """Return the normals (f, 3) of facets, each as long as twice the facet's area, and these lengths (f,)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    return cross, np.linalg.norm(cross, axis=1)


def _placed(vertices: Floats, faces: Ints, facet: Ints) -> Floats:
    """Place a point (m, 3) on each of the facets (m,): R2 sequence (plastic number), folded onto the triangle."""
    points = np.empty((len(facet), 3))
    _fill_placed(read_only(vertices), read_only(faces), read_only(facet), points)
    return points


@njit(cache=True, nogil=True)
def _fill_placed(vertices, faces, facet, points):  # type: ignore[no-untyped-def]
    for i in range(len(facet)):
        u, v = (0.5 + i * 0.7548776662466927) % 1.0, (0.5 + i * 0.5698402909980532) % 1.0
        if u + v > 1.0:
            u, v = 1.0 - u, 1.0 - v
        a, b, c = faces[facet[i], 0], faces[facet[i], 1], faces[facet[i], 2]
        for k in range(3):
            along = vertices[a, k] + u * (vertices[b, k] - vertices[a, k])
            points[i, k] = along + v * (vertices[c, k] - vertices[a, k])


# --- Distances to the smooth surface


class Facets(NamedTuple):
    """Arrays of a :class:`MeshSurface` that its kernel takes."""

    vertices: Floats
    faces: Ints
    normals: Floats
    neighbours: Ints


class _SampleGrid(NamedTuple):
    """Samples on a mesh in cells, and the facet (m,) of each in the grid's order."""

    cells: Cells
    facet: Labels


@dataclass(frozen=True)
class MeshSurface:
    """A mesh with its facets' unit normals (f, 3), and the facets (f, 3) across each side; -1 across a sharp edge.

    Searches start from samples on the facets, ``count`` (f,) of each: they are sorted when the first search is made.
    """

    vertices: Floats
    faces: Ints
    normals: Floats
    neighbours: Ints  # opposite to each of a facet's vertices
    part_of: Ints  # (f,) number of the smooth face that a facet belongs to
    count: Ints

    def samples(self) -> Floats:
        """Return the samples (m, 3) on the mesh, facet by facet."""
        return _placed(self.vertices, self.faces, np.repeat(np.arange(len(self.faces)), self.count))

    @cached_property
    def _sampled(self) -> _SampleGrid:
        spacing = np.sqrt(area(self.vertices, self.faces) / self.count.sum())
        grid = point_grid.of_points(self.samples(), CELL_SPACINGS * float(spacing))
        facet = np.repeat(np.arange(len(self.faces), dtype=np.int32), self.count)[grid.order]
        return _SampleGrid(grid.cells, facet)

    def nearest(self, points: Floats, reach: float) -> tuple[Ints, Floats]:
        """Facet (n,) of the sample nearest to each of points (n, 3), and its distance (n,), mm.

        The facet is -1 and the distance infinite where there is none nearer than ``reach``.
        """
        cells, facet = self._sampled
        row, distance = nearest_neighbours.nearest_rows(cells, points, reach)
        return np.where(row[:, 0] >= 0, facet[row[:, 0]].astype(np.int64), -1), distance[:, 0]

    def distances(self, points: Floats, reach: float, before: Ints | None = None) -> tuple[Ints, Floats, Floats]:
        """Facet (n,), signed distance (n,) from it, and how far (n,) the foot lies outside its face's edge; mm.

        Facet -1 and NaN where no sample of the surface is within ``reach``. The search starts at the nearest sample and
        walks over smooth edges to the facet that the foot lies on. Points that moved little since an earlier search
        start at the facet ``before`` (n,) of that search instead.
        """
        start = self.nearest(points, reach)[0] if before is None else before
        face = np.full(len(points), -1, np.int64)
        distance, beyond = np.full(len(points), np.nan), np.full(len(points), np.nan)
        facets = Facets(self.vertices, self.faces, self.normals, self.neighbours)
        points = np.ascontiguousarray(points, np.float64)
        walk = partial(feet, facets, points, start, WALK_STEPS, face, distance, beyond)
        over_ranges(walk, len(points), least=LEAST_RANGE)
        return face, distance, beyond

    def only(self, facets: Bools) -> MeshSurface:
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
    """Prepare a mesh; searches start from samples about ``spacing_mm`` apart, which is less than a plate is thick."""
    cross, size = double_areas(vertices, faces)
    used = size > LEAST_AREA
    faces, cross, size = faces[used], cross[used], size[used]
    normals = cross / size[:, None]
    count = np.maximum(1, np.ceil(0.5 * size / spacing_mm**2)).astype(np.int64)
    neighbours = _neighbours(faces, normals)
    # Facets joined by smooth edges have the same number (f,) of a smooth face
    facet, side = np.nonzero(neighbours >= 0)
    number = components(len(neighbours), facet, neighbours[facet, side])
    return MeshSurface(
        vertices=vertices,
        faces=faces,
        normals=normals,
        neighbours=neighbours,
        part_of=number,
        count=count,
    )


def of_design(vertices: Floats, faces: Ints) -> MeshSurface:
    """Prepare the mesh of a whole structure, with samples as dense as its area allows."""
    spacing = np.sqrt(area(vertices, faces) / DESIGN_SAMPLES)
    return of_mesh(vertices, faces, float(np.clip(spacing, *DESIGN_SPACING_MM)))


def on_face(face: Ints, beyond: Floats) -> Bools:
    """Mark the points (n,) that have a facet and their foot on its face, by :meth:`MeshSurface.distances`."""
    marked: Bools = (face >= 0) & (beyond < EDGE_MM)
    return marked


def _neighbours(faces: Ints, normals: Floats) -> Ints:
    """Facets (f, 3) across the side opposite to each vertex; -1 for none, for more than one, and across sharp edges."""
    sides = np.sort(np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1).reshape(-1, 2), axis=1)
    order = np.lexsort((sides[:, 1], sides[:, 0]))
    same = (sides[order][1:] == sides[order][:-1]).all(axis=1)
    single = np.concatenate([[False], same]).astype(int) + np.concatenate([same, [False]]).astype(int) == 1
    pairs = np.flatnonzero(same & single[1:] & single[:-1])
    across = np.full(len(sides), -1, np.int64)
    first, second = order[pairs], order[pairs + 1]
    smooth = np.einsum("ni,ni->n", normals[first // 3], normals[second // 3]) > SHARP_COS
    across[first[smooth]], across[second[smooth]] = second[smooth] // 3, first[smooth] // 3
    return across.reshape(-1, 3)


@njit(cache=True, nogil=True)
def feet(facets, points, start, steps, face, distance, beyond, first, last):  # type: ignore[no-untyped-def]
    """Walk from facets ``start`` (n,), -1 = none, over at most ``steps`` facets; for points first to last - 1.

    Writes the facet, the signed distance from it, and how far the foot lies outside its face's edge, mm.
    """
    vertices, faces = facets.vertices, facets.faces
    share = np.empty(3)
    for i in range(first, last):
        at = start[i]
        if at < 0:
            continue
        side = barycentric(points[i], vertices, faces[at], share)
        for _ in range(steps):
            over = facets.neighbours[at, side]
            if not (share[side] < -1e-9 and over >= 0):
                break
            at = over
            side = barycentric(points[i], vertices, faces[at], share)
        a = vertices[faces[at, 0]]
        off = 0.0
        for k in range(3):
            off += (points[i, k] - a[k]) * facets.normals[at, k]
        face[i], distance[i] = at, off
        beyond[i] = -min(share[side], 0.0) * height(vertices, faces[at], side)


@njit(cache=True, nogil=True, inline="always")
def barycentric(point, vertices, corners, share):  # type: ignore[no-untyped-def]
    """Write the barycentric coordinates (3,) of a point's foot on a facet; return the vertex with the smallest one."""
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
    """Return the height of a vertex over the opposite side of its facet."""
    a, b, c = vertices[corners[side]], vertices[corners[(side + 1) % 3]], vertices[corners[(side + 2) % 3]]
    b0, b1, b2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    c0, c1, c2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    n0, n1, n2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    base = np.sqrt((c0 - b0) ** 2 + (c1 - b1) ** 2 + (c2 - b2) ** 2)
    return np.sqrt(n0 * n0 + n1 * n1 + n2 * n2) / max(base, 1e-12)


# --- Height of the curved surface over its mesh: the facets of a tube lie inside it by up to the mesh's tolerance


@dataclass(frozen=True)
class CurvedFacets:
    """Slopes (f, 3, 3) along x, y, z of the tangent plane at each corner of a facet, relative to the facet."""

    surface: MeshSurface
    slopes: Floats

    @cached_property
    def curved(self) -> Bools:
        """Mark the facets (f,) that the smooth surface does not lie in."""
        marks: Bools = np.asarray(self.slopes.any(axis=(1, 2)), bool)
        return marks

    def heights(self, feet: Floats, facet: Ints) -> Floats:
        """Height (n,) of the smooth surface over facets (n,) at feet (n, 3) on them; 0 where there is no facet."""
        height = np.zeros(len(feet))
        rows = np.flatnonzero((facet >= 0) & self.curved[facet])
        at = facet[rows]
        share = np.clip(self.surface.barycentric(feet[rows], at), 0.0, 1.0)
        for k in range(3):
            off = feet[rows] - self.surface.vertices[self.surface.faces[at, k]]
            height[rows] += 0.5 * share[:, k] * np.einsum("ni,ni->n", off, self.slopes[at, k])
        return height


def of_surface(surface: MeshSurface) -> CurvedFacets:
    """Derive the slopes of a mesh's facets; 0 for facets that are flat or meant to be."""
    corners = surface.vertices[surface.faces]
    # Normal at a corner: mean over the facets of the same smooth face about it, weighted by their angles there.
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
    slopes[bulge > MOST_BULGE_MM] = 0.0
    return CurvedFacets(surface, slopes)


# --- Nearest facet that a scanner could see


class FacetGrid(NamedTuple):
    """Facets by the voxels of a dense grid that they come within ``reach`` of."""

    low: Floats  # (3,) corner of the grid
    size: float  # edge of a voxel
    shape: Ints  # (3,)
    start: Ints  # (voxels + 1,) of each voxel's facets
    facet: Labels
    corners: Floats  # (f, 3, 3)
    normals: Floats
    balls: Floats  # (f, 4) centre and radius of a ball about each facet
    reach: float


def facet_grid(vertices: Floats, faces: Ints, normals: Floats, reach: float) -> FacetGrid:
    """Sort facets into voxels about as large as ``reach``, larger where the design is very large.

    They are larger, too, where long thin facets, as of tubes, would be in too many: MOST_ENTRIES in all.
    """
    corners = np.ascontiguousarray(vertices[faces])
    low, high = corners.min(axis=(0, 1)) - reach, corners.max(axis=(0, 1)) + reach
    size = max(float(reach), float(np.prod(high - low) / MOST_VOXELS) ** (1.0 / 3.0))
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    width = double_areas(vertices, faces)[1] / np.maximum(longest, 1e-12)
    while _entries(longest, width, size, reach) > MOST_ENTRIES:
        size *= 1.2
    shape = np.maximum(np.ceil((high - low) / size), 1).astype(np.int64)
    # Of a large design these arrays are the largest there are.
    start = np.zeros(int(np.prod(shape)) + 1, np.int64)
    none = np.empty(0, np.int64), np.empty(0, np.int32)
    np.cumsum(_facets_of_voxels(corners, normals, low, size, shape, reach, *none), out=start[1:])
    facet = np.empty(start[-1], np.int32)
    _facets_of_voxels(corners, normals, low, size, shape, reach, start, facet)
    centre = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1) + ROUNDING_MM
    return FacetGrid(
        low=low, size=size, shape=shape, start=start, facet=facet, corners=corners, normals=normals,
        balls=np.column_stack([centre, radius]), reach=float(reach),
    )  # fmt: skip


def _entries(longest: Floats, width: Floats, size: float, reach: float) -> float:
    """Return about how often facets (f,) with a longest edge and a width across it stand in voxels of a size."""
    about = 2.0 * reach / size + 1.5
    return float(((longest / size + 1.0) * (width / size + about) * about).sum())


def touching(vertices: Floats, faces: Ints, within: float) -> tuple[Ints, Ints]:
    """Pairs of a vertex (k,) and a facet (k,) that come within a distance of each other."""
    cross, double = double_areas(vertices, faces)
    normals = cross / np.maximum(double, 1e-12)[:, None]
    grid = facet_grid(vertices, faces, normals, max(within, float(np.sqrt(0.5 * double.mean()))))
    return _touching(grid, vertices, within)


@njit(cache=True, nogil=True)
def nearest_visible(grid: FacetGrid, points: Floats, scanners: Floats, station: Ints) -> tuple[Ints, Floats]:
    """Facet (n,) of points (n, 3), -1 for none, and their signed distance (n,) along its normal, mm.

    It is the nearest facet within reach that faces the scanner. ``station`` (n,) is the row of ``scanners`` (k, 3) that
    a point was seen from; where it is -1, unknown, the nearest facet of all is taken.
    """
    low, size, shape = grid.low, grid.size, grid.shape
    nearest = np.full(len(points), -1, np.int64)
    distance = np.full(len(points), np.nan)
    last = -1  # neighbours among the points often have the same facet: no other one is farther than that
    for row in range(len(points)):
        p = points[row]
        i, j, m = (p[0] - low[0]) / size, (p[1] - low[1]) / size, (p[2] - low[2]) / size
        if not (0.0 <= i < shape[0] and 0.0 <= j < shape[1] and 0.0 <= m < shape[2]):
            continue
        voxel = (int(i) * shape[1] + int(j)) * shape[2] + int(m)
        best = grid.reach * grid.reach
        k = station[row]
        if last >= 0 and (k < 0 or _faces(grid.normals[last], scanners[k], p)):
            best = min(best, (np.sqrt(square_to(grid.corners[last], p)) + ROUNDING_MM) ** 2)
        near = np.sqrt(best)
        for at in range(grid.start[voxel], grid.start[voxel + 1]):
            f = grid.facet[at]
            ball = grid.balls[f]
            x, y, z, far = p[0] - ball[0], p[1] - ball[1], p[2] - ball[2], ball[3] + near
            if x * x + y * y + z * z > far * far:
                continue
            a, n = grid.corners[f, 0], grid.normals[f]
            off = (p[0] - a[0]) * n[0] + (p[1] - a[1]) * n[1] + (p[2] - a[2]) * n[2]
            if off * off >= best or (k >= 0 and not _faces(n, scanners[k], p)):
                continue
            square = square_to(grid.corners[f], p)
            if square < best:
                best, near, nearest[row], distance[row] = square, np.sqrt(square), f, off
        last = nearest[row]
    return nearest, distance


@njit(cache=True, nogil=True, inline="always")
def _faces(normal, scanner, p):  # type: ignore[no-untyped-def]
    """Whether a facet with a normal (3,) faces the scanner (3,) as seen from a point (3,)."""
    x, y, z = scanner[0] - p[0], scanner[1] - p[1], scanner[2] - p[2]
    return x * normal[0] + y * normal[1] + z * normal[2] >= GRAZING_COS * np.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True)
def crossings(grid: FacetGrid, starts: Floats, ends: Floats, once: bool) -> tuple[Ints, Ints, Floats]:
    """Return where lines from ``starts`` (n, 3) to ``ends`` (n, 3) cross facets: row, facet, and share of the line.

    With ``once``, one crossing of a line is enough. The voxels on a line are visited in order (Amanatides and Woo
    1987).
    """
    # Empty lists whose type Numba infers from the element that is not there.
    rows, facets = [np.int64(0) for _ in range(0)], [np.int64(0) for _ in range(0)]
    shares = [0.0 for _ in range(0)]
    # Of each axis: index of the voxel, its change, share of the line at the voxel's far side, and share per voxel.
    index, step, leaving, per_voxel = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3), np.empty(3)
    for row in range(len(starts)):
        start, ray = starts[row], ends[row] - starts[row]
        entering, left, searched = 0.0, 1.0, True  # shares of the line at which it comes into the grid and leaves it
        for k in range(3):
            low, high = grid.low[k] - start[k], grid.low[k] + grid.shape[k] * grid.size - start[k]
            if abs(ray[k]) > 1e-12:
                entering = max(entering, min(low / ray[k], high / ray[k]))
                left = min(left, max(low / ray[k], high / ray[k]))
            elif low > 0.0 or high < 0.0:
                left = -1.0
        inside = entering < left
        for k in range(3):
            place = (start[k] + entering * ray[k] - grid.low[k]) / grid.size
            index[k] = min(max(int(np.floor(place)), 0), grid.shape[k] - 1)
            step[k] = 1 if ray[k] > 0.0 else -1
            moves = abs(ray[k]) > 1e-12
            per_voxel[k] = grid.size / abs(ray[k]) if moves else np.inf
            to_side = index[k] + 1 - place if ray[k] > 0.0 else place - index[k]
            leaving[k] = entering + to_side * per_voxel[k] if moves else np.inf
        while inside and searched and entering <= 1.0:
            voxel = (index[0] * grid.shape[1] + index[1]) * grid.shape[2] + index[2]
            k = int(np.argmin(leaving))
            for entry in range(grid.start[voxel], grid.start[voxel + 1]):
                share = _crossing(grid.corners[grid.facet[entry]], start, ray)
                if 0.0 < share < 1.0 and entering <= share < leaving[k]:  # a facet is in several voxels
                    rows.append(row)
                    facets.append(grid.facet[entry])
                    shares.append(share)
                    if once:
                        searched = False
                        break
            entering = leaving[k]
            index[k] += step[k]
            leaving[k] += per_voxel[k]
            inside = 0 <= index[k] < grid.shape[k]
    return np.array(rows, np.int64), np.array(facets, np.int64), np.array(shares, np.float64)


@inner
def _crossing(corner: Floats, start: Floats, ray: Floats) -> Any:
    """Return the share of a ray (3,) at which it crosses a triangle (3, 3), -1 if it does not."""
    e1x, e1y, e1z = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    e2x, e2y, e2z = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    px, py, pz = ray[1] * e2z - ray[2] * e2y, ray[2] * e2x - ray[0] * e2z, ray[0] * e2y - ray[1] * e2x
    determinant = e1x * px + e1y * py + e1z * pz
    if determinant == 0.0:
        return -1.0
    ax, ay, az = start[0] - corner[0, 0], start[1] - corner[0, 1], start[2] - corner[0, 2]
    u = (ax * px + ay * py + az * pz) / determinant
    if u < -ON_EDGE or u > 1.0 + ON_EDGE:
        return -1.0
    qx, qy, qz = ay * e1z - az * e1y, az * e1x - ax * e1z, ax * e1y - ay * e1x
    v = (ray[0] * qx + ray[1] * qy + ray[2] * qz) / determinant
    if v < -ON_EDGE or u + v > 1.0 + ON_EDGE:
        return -1.0
    return (e2x * qx + e2y * qy + e2z * qz) / determinant


@njit(cache=True, nogil=True)
def _touching(grid: FacetGrid, points: Floats, within: float) -> tuple[Ints, Ints]:
    """Pairs of points and facets that come within a distance of each other."""
    low, size, shape = grid.low, grid.size, grid.shape
    rows, facets = [np.int64(0) for _ in range(0)], [np.int64(0) for _ in range(0)]
    for row in range(len(points)):
        p = points[row]
        i, j, m = int((p[0] - low[0]) / size), int((p[1] - low[1]) / size), int((p[2] - low[2]) / size)
        voxel = (i * shape[1] + j) * shape[2] + m
        for at in range(grid.start[voxel], grid.start[voxel + 1]):
            if square_to(grid.corners[grid.facet[at]], p) < within * within:
                rows.append(row)
                facets.append(np.int64(grid.facet[at]))
    return np.array(rows), np.array(facets)


@njit(cache=True, nogil=True)
def _facets_of_voxels(
    corners: Floats, normals: Floats, low: Floats, size: float, shape: Ints, reach: float, start: Ints, out: Labels
) -> Labels:
    """Count the facets of each voxel (voxels,); write them to ``out`` where ``start`` (voxels + 1,) is given.

    A facet belongs to the voxels of its bounding box that its plane comes within ``reach`` of. The box of a long thin
    facet askew is mostly empty: such a facet is halved until boxes are not, and the voxels are those of its pieces.
    """
    count = np.zeros(shape[0] * shape[1] * shape[2], np.int32)
    last = np.full(len(count), -1, np.int32)  # facet that a voxel had last, so that pieces of one count once
    stack = np.empty((PIECES, 3, 3))
    lo, hi = np.empty(3, np.int64), np.empty(3, np.int64)
    half = 0.5 * size
    for f in range(len(corners)):
        n = normals[f]
        span = half * (abs(n[0]) + abs(n[1]) + abs(n[2])) + reach
        assign_rows(stack[0], corners[f])
        left = 1
        while left:
            left -= 1
            piece = stack[left]
            boxed = 1
            for k in range(3):
                least, most = piece[:, k].min() - reach, piece[:, k].max() + reach
                lo[k] = max(0, int((least - low[k]) / size))
                hi[k] = min(shape[k] - 1, int((most - low[k]) / size))
                boxed *= hi[k] - lo[k] + 1
            if left + 2 < PIECES and boxed > FULL and boxed > EMPTY * _voxels_of(piece, size):
                _halved(stack, left)
                left += 2
                continue
            for i in range(lo[0], hi[0] + 1):
                for j in range(lo[1], hi[1] + 1):
                    for m in range(lo[2], hi[2] + 1):
                        off = (
                            (low[0] + i * size + half - corners[f, 0, 0]) * n[0]
                            + (low[1] + j * size + half - corners[f, 0, 1]) * n[1]
                            + (low[2] + m * size + half - corners[f, 0, 2]) * n[2]
                        )
                        voxel = (i * shape[1] + j) * shape[2] + m
                        if abs(off) > span or last[voxel] == f:
                            continue
                        last[voxel] = f
                        if len(start):
                            out[start[voxel] + count[voxel]] = f
                        count[voxel] += 1
    return count


@inner
def _voxels_of(corner: Floats, size: float) -> Any:
    """Return about how many voxels a triangle (3, 3) and its edges meet."""
    rim = 0.0
    for k in range(3):
        e = corner[(k + 1) % 3] - corner[k]
        rim += np.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    u, v = corner[1] - corner[0], corner[2] - corner[0]
    x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    return 0.5 * np.sqrt(x * x + y * y + z * z) / (size * size) + 3.0 * rim / size


@inner
def _halved(stack: Floats, at: int) -> None:
    """Replace the triangle ``at`` of a stack (p, 3, 3) by two: its longest edge is halved."""
    longest, k = -1.0, 0
    for i in range(3):
        e = stack[at, (i + 1) % 3] - stack[at, i]
        square = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
        if square > longest:
            longest, k = square, i
    a, b = k, (k + 1) % 3
    assign_rows(stack[at + 1], stack[at])
    for axis in range(3):
        middle = 0.5 * (stack[at, a, axis] + stack[at, b, axis])
        stack[at, b, axis] = middle
        stack[at + 1, a, axis] = middle


@inner
def square_to(corner: Floats, p: Floats) -> Any:
    """Return the squared distance of a point (3,) from a triangle (3, 3).

    Source: Ericson, Real-Time Collision Detection, 5.1.5.
    """
    abx, aby, abz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    acx, acy, acz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    apx, apy, apz = p[0] - corner[0, 0], p[1] - corner[0, 1], p[2] - corner[0, 2]
    d1, d2 = abx * apx + aby * apy + abz * apz, acx * apx + acy * apy + acz * apz
    if d1 <= 0.0 and d2 <= 0.0:
        return apx * apx + apy * apy + apz * apz
    bpx, bpy, bpz = p[0] - corner[1, 0], p[1] - corner[1, 1], p[2] - corner[1, 2]
    d3, d4 = abx * bpx + aby * bpy + abz * bpz, acx * bpx + acy * bpy + acz * bpz
    if d3 >= 0.0 and d4 <= d3:
        return bpx * bpx + bpy * bpy + bpz * bpz
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s, t = d1 / (d1 - d3), 0.0
    else:
        cpx, cpy, cpz = p[0] - corner[2, 0], p[1] - corner[2, 1], p[2] - corner[2, 2]
        d5, d6 = abx * cpx + aby * cpy + abz * cpz, acx * cpx + acy * cpy + acz * cpz
        if d6 >= 0.0 and d5 <= d6:
            return cpx * cpx + cpy * cpy + cpz * cpz
        vb = d5 * d2 - d1 * d6
        va = d3 * d6 - d5 * d4
        if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
            s, t = 0.0, d2 / (d2 - d6)
        elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
            w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
            s, t = 1.0 - w, w
        else:
            whole = 1.0 / (va + vb + vc)
            s, t = vb * whole, vc * whole
    x, y, z = apx - s * abx - t * acx, apy - s * aby - t * acy, apz - s * abz - t * acz
    return x * x + y * y + z * z
