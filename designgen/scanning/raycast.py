"""Rays of a scanner's angular grid against exact surfaces, in float64.

Every bounding sphere is drawn onto the grid; the rays it covers are intersected with its shape, and the nearest hit of
each ray counts. Rays that meet nothing, as most rays of a scan of a roof, cost nothing. Many triangles are in a tree in
the scene's frame instead (:mod:`designgen.scanning.facets`).

A scanner's frame has its origin at the scanner and z along its axis. Column j has azimuth 2 pi j / columns, counter-
clockwise from x, row i has elevation ``lowest + i step``. Results depend on neither the thread nor the strip.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from designgen.designs.parametric_face import Surface
from designgen.rigid import inverse
from designgen.scanning import angular_bounds, ray_kernels
from designgen.scanning.facets import Facets
from designgen.scanning.surfaces import CONE, DISC, SPHERE, TRIANGLE, Surfaces
from processor.model import Bools, Floats, Ints, Labels, Shorts

WEIGHTS = (-3.0, 4.0)  # bounds of the weights of a net triangle's edges within which a hit on the face is sought
POINTS = {SPHERE: (0,), CONE: (0,), DISC: (0,), TRIANGLE: (0, 3, 6)}  # columns of points in a shape's numbers
VECTORS = {CONE: (ray_kernels.AXIS, ray_kernels.BOW), DISC: (ray_kernels.AXIS,)}  # columns of vectors


class Grid(NamedTuple):
    """A scanner's directions: ``columns`` all around, ``rows`` upward from elevation ``lowest``; rad."""

    step: float
    lowest: float
    rows: int
    columns: int

    def cos_elevations(self) -> Floats:
        """Return the cosines (rows,) of the rows' elevations."""
        cosines: Floats = np.cos(self.lowest + self.step * np.arange(self.rows))
        return cosines

    def directions(self, row: Labels, column: Labels, jitter: Floats | Shorts | None = None) -> Floats:
        """Return unit vectors (n, 3) in the scanner's frame, rotated by ``jitter`` (n, 2), rad, to the left and up."""
        azimuth, elevation = 2.0 * np.pi * column / self.columns, self.lowest + self.step * row
        da, de = (0.0, 0.0) if jitter is None else jitter.T.astype(np.float64)
        cosines_and_sines = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
        formula: Any = ray_kernels.direction
        return np.stack(formula.py_func(*cosines_and_sines, da, de), axis=-1)


@dataclass(frozen=True, kw_only=True)
class View:
    """The surfaces in a scanner's frame, and the strips of the grid with the windows that pieces cover."""

    shapes: ray_kernels.Shapes
    pieces: ray_kernels.Pieces
    strips: tuple[ray_kernels.Strip, ...]
    facets: Facets | None
    facet_shape: Ints  # (f,) their rows of Surfaces
    facet_windows: tuple[Labels, ...]  # of each strip, (b, 5)
    T_scene_scanner: Floats

    def occupied(self) -> list[int]:
        """Return the numbers of the strips in which rays may meet a shape."""
        both = zip(self.strips, self.facet_windows, strict=True)
        return [i for i, (strip, windows) in enumerate(both) if len(strip.windows) or len(windows)]

    def cast(
        self, number: int, grid: Grid, rays: ray_kernels.Rays, beam: ray_kernels.Beam, beside: Labels
    ) -> tuple[Labels, Floats, Floats]:
        """Return shape, range and range of thin shapes of the rays of a strip, see ray_kernels.cast; no near hits."""
        strip = self.strips[number]
        shape, best, thin = ray_kernels.cast(self.shapes, self.pieces, strip, grid, rays, beam, beside)
        if self.facets is not None:
            used = min(strip.width, grid.columns - strip.first)
            ray, count = ray_kernels.covered(self.facet_windows[number], *strip[1:], used, shape.shape[1], beside)
            met = ray >= 0
            near = shape[met], best[met]
            self._meet_facets(strip, grid, rays, ray, np.zeros(count), np.zeros((1, 2)), *near)
            shape[met], best[met] = near
        ray_kernels.hide(shape, best, rays.min_range)
        return shape, best, thin

    def cast_around(
        self, number: int, grid: Grid, rays: ray_kernels.Rays, ray: Labels, angle: Floats, offsets: Floats
    ) -> tuple[Labels, Floats]:
        """Return shape and range of sub-rays about the rays of a strip, see ray_kernels.cast_around; no near hits."""
        strip = self.strips[number]
        shape, best = ray_kernels.cast_around(self.shapes, self.pieces, strip, grid, rays, ray, angle, offsets)
        if self.facets is not None:
            self._meet_facets(strip, grid, rays, ray, angle, offsets, shape.reshape(-1), best.reshape(-1))
        ray_kernels.hide(shape, best, rays.min_range)
        return shape, best

    def _meet_facets(
        self,
        strip: ray_kernels.Strip,
        grid: Grid,
        rays: ray_kernels.Rays,
        ray: Labels,
        angle: Floats,
        offsets: Floats,
        shape: Labels,
        best: Floats,
    ) -> None:
        """Replace shape and range (m k,) of sub-rays where a facet is nearer."""
        assert self.facets is not None
        R, place = np.ascontiguousarray(self.T_scene_scanner[:3, :3]), self.T_scene_scanner[:3, 3]
        directions = ray_kernels.directions(R, strip, grid, rays, ray, angle, offsets)
        facet = self.facets.first(place, directions)
        corners, owner = self.facets.corners, self.facet_shape
        ray_kernels.meet(corners, owner, place, directions, facet, rays.max_range, shape, best)


def view(
    surfaces: Surfaces, T_scanner_scene: Floats, grid: Grid, width: int, side: int, reach: float, spread: float
) -> View:
    """Transform surfaces into a scanner's frame and draw their bounding spheres onto its grid.

    A strip has ``width`` columns; ``side`` columns on either side are cast with it, to find its edges. ``reach`` is the
    greatest range (mm), ``spread`` the largest angle (rad) between a ray and its nominal direction.
    """
    R, t = T_scanner_scene[:3, :3], T_scanner_scene[:3, 3]
    facets, shape_of = surfaces.facets, surfaces.piece_shape
    drawn = np.ones(len(shape_of), bool) if facets is None else surfaces.kind[shape_of] != TRIANGLE
    numbers = surfaces.numbers.copy() if drawn.any() else surfaces.numbers
    for kind in POINTS:
        if kind == TRIANGLE and facets is not None:
            continue  # facets stay in the scene's frame
        rows = np.flatnonzero(surfaces.kind == kind)
        for columns, shift in ((POINTS[kind], t), (VECTORS.get(kind, ()), np.zeros(3))):
            for c in columns:
                numbers[rows, c : c + 3] = numbers[rows, c : c + 3] @ R.T + shift
    cuts = surfaces.cuts.copy()
    cuts[:, :3] = cuts[:, :3] @ R.T

    def windows_of(centres: Floats, radii: Floats) -> list[Labels]:
        covered = angular_bounds.grid_windows(
            centres, radii, reach, spread + grid.step, grid.step, grid.lowest, grid.rows, grid.columns, side
        )
        windows, start = angular_bounds.by_strip(covered, width, -(-grid.columns // width), side)
        return [windows[start[i] : start[i + 1]] for i in range(len(start) - 1)]

    centres, radii = surfaces.piece_centre[drawn] @ R.T + t, surfaces.piece_radius[drawn]
    strips = windows_of(centres, radii)
    facet_windows = [np.empty((0, 5), np.int32)] * len(strips)
    if facets is not None:
        facet_windows = windows_of(facets.centres @ R.T + t, facets.radii)
    return View(
        shapes=ray_kernels.Shapes(surfaces.kind, numbers, cuts, surfaces.cut_start),
        pieces=ray_kernels.Pieces(shape_of[drawn], centres, radii),
        strips=tuple(
            ray_kernels.Strip(windows=windows, first=i * width, width=width, side=side)
            for i, windows in enumerate(strips)
        ),
        facets=facets,
        facet_shape=np.flatnonzero(surfaces.kind == TRIANGLE),
        facet_windows=tuple(facet_windows),
        T_scene_scanner=inverse(T_scanner_scene),
    )


def refine_hits(
    view: View, surfaces: Surfaces, T_scanner_scene: Floats, shape: Labels, ray: Floats, t: Floats
) -> tuple[Floats, Floats]:
    """Return ranges (n,), mm, and cosines of incidence (n,) of rays (n, 3) that meet shapes (n,) near ranges t (n,).

    Patches are met on their own surfaces instead of their nets. The range is NaN where the search does not converge, as
    at the edge of a patch at grazing incidence.
    """
    range_, normal = t.copy(), np.empty((len(t), 3))
    plain = surfaces.patch[shape] < 0
    points = ray[plain] * t[plain, None]
    normal[plain] = ray_kernels.normals(view.shapes.kind, view.shapes.numbers, shape[plain], points)
    if view.facets is not None:
        facet = plain & (surfaces.kind[shape] == TRIANGLE)
        normal[facet] = normal[facet] @ T_scanner_scene[:3, :3].T
    if not plain.all():
        curved = ~plain
        range_[curved], normal[curved] = _on_patches(surfaces, T_scanner_scene, shape[curved], ray[curved], t[curved])
    return range_, np.minimum(np.abs(np.einsum("ni,ni->n", ray, normal)), 1.0)


def _on_patches(
    surfaces: Surfaces, T_scanner_scene: Floats, shape: Labels, ray: Floats, t: Floats, tolerance_mm: float = 1e-5
) -> tuple[Floats, Floats]:
    """Return ranges (n,) at which rays meet the patches' own surfaces, starting from their nets, and normals (n, 3)."""
    result, normal = t.copy(), np.empty((len(t), 3))
    R, origin = T_scanner_scene[:3, :3], -T_scanner_scene[:3, :3].T @ T_scanner_scene[:3, 3]
    patch = surfaces.patch[shape]
    order = np.argsort(patch, kind="stable")
    edges = np.flatnonzero(np.diff(patch[order])) + 1
    for rows in np.split(order, edges):
        at, triangle = surfaces.patches[patch[rows[0]]].at, shape[rows]
        assert at is not None, "a face of triangles has no other surface"
        d = ray[rows] @ R  # in the scene's frame
        corners, pq = surfaces.numbers[triangle, :9].reshape(-1, 3, 3), surfaces.corner_pq[triangle]
        edge, pq_edges = corners[:, 1:] - corners[:, :1], pq[:, 1:] - pq[:, :1]
        # Newton with the derivatives of the net's triangle: dx = edge^T w for d(p, q) = pq_edges^T w.
        inverse, regular = _inverse(edge[:, 0], edge[:, 1], -d)
        range_ = t[rows].copy()
        weights = np.einsum("nij,nj->ni", inverse, origin + range_[:, None] * d - corners[:, 0])[:, :2]
        now, met, error = np.empty((len(rows), 2)), np.empty((len(rows), 3)), np.full(len(rows), np.inf)
        live: Any = slice(None)  # rays that have not converged: mostly all or none
        for _ in range(12):
            now[live] = pq[live, 0] + np.einsum("ni,nij->nj", weights[live], pq_edges[live])
            met[live] = at(now[live, 0], now[live, 1])
            residual = origin + range_[live, None] * d[live] - met[live]
            error[live] = np.sqrt(np.einsum("ni,ni->n", residual, residual))
            step = np.einsum("nij,nj->ni", inverse[live], residual)
            # Without bounds, a grazing ray may leave the range in which the face's function is defined.
            weights[live] = np.clip(weights[live] + step[:, :2], *WEIGHTS)
            range_[live] += step[:, 2]
            more = np.flatnonzero(error >= 0.1 * tolerance_mm)
            if not len(more):
                break
            live = more if len(more) < len(rows) else live
        range_[~(error < tolerance_mm) | ~regular] = np.nan
        result[rows], normal[rows] = range_, _normals(at, now, met, pq_edges) @ R.T
    return result, normal


def _inverse(a: Floats, b: Floats, c: Floats) -> tuple[Floats, Bools]:
    """Return inverses (n, 3, 3) of matrices with columns a, b and unit vectors c (n, 3), and which (n,) are regular.

    The inverse of a singular matrix is 0.
    """
    inverse = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = np.einsum("ni,ni->n", a, inverse[:, 0])
    regular = np.abs(volume) > 1e-12 * np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    inverse[~regular], volume[~regular] = 0.0, 1.0
    inverse /= volume[:, None, None]
    return inverse, regular


def _normals(at: Surface, pq: Floats, points: Floats, pq_edges: Floats) -> Floats:
    """Return unit normals (n, 3) of a patch at pq (n, 2), its ``points``, by differences along ``pq_edges``."""
    fraction = 1e-5  # of the net's edges, which bend by a few degrees at most: 1e-6 rad of the normal
    first, second = (at(*(pq + fraction * pq_edges[:, k]).T) - points for k in range(2))
    normal = np.cross(first, second)
    unit: Floats = normal / np.sqrt(np.einsum("ni,ni->n", normal, normal))[:, None]
    return unit
