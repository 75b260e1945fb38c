"""Assignment of scanned points to the faces of a design, and where it cannot be decided.

A point is compared with its nearest facet, of those that face the scanner where that is known. Near a sharp edge, and
on a plate that is thin against the noise, the nearest facet may be another than the one that was measured. Points whose
feet are so near to another face are left out. The foot of a point, other than its distance, does not depend on the
noise along the normal: points left out by their feet do not bias the mean of the others.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from processor import tiles
from processor.geometry import mesh_distance
from processor.geometry.mesh_distance import SHARP_COS, CurvedFacets, FacetGrid, square_to
from processor.geometry.thread_ranges import over_ranges
from processor.large_arrays import put_aside
from processor.model import Columns, Floats, Ints

LEAST_RANGE = 5_000  # points per task of a thread
AT_ONCE = 100_000  # points whose heights are computed together
# Distance to the next face in standard deviations. The points that noise carries across move the mean of 40 points by
# less than a quarter of its standard error.
SEPARATION = 2.5
OPPOSED = -0.5  # cosine between the normals of a plate's two sides, at most


@dataclass(frozen=True)
class OnSurface(Columns):
    """Points of a scan on the design: foot (n, 3), signed distance (n,) and facet (n,); mm, outward > 0.

    Off the design's faces the distance is NaN and the facet -1. ``clearance`` (n,) is the distance of the foot from the
    nearest face of another direction that could be mistaken for its own, and from half way to an opposed face. ``flat``
    (n,) is the distance from the facet itself, without the height of the curved surface over it.
    """

    feet: Floats
    distance: Floats
    facet: Ints
    clearance: Floats
    flat: Floats


@dataclass(frozen=True)
class Aside(Columns):
    """What cannot be computed quickly of points on the design, where it takes least: rows (m,) of a block of them."""

    rows: Ints
    facet: Ints
    clearance: Floats
    flat: Floats

    @classmethod
    def of(cls, rows: Ints, seen: OnSurface) -> Aside:
        """Return the rows (m,) of a block whose points are ``seen``, in memory."""
        return cls(rows.astype(np.int32), seen.facet[rows].astype(np.int32), seen.clearance[rows], seen.flat[rows])

    def put(self) -> Aside:
        """Put them aside."""
        return Aside(*map(put_aside, vars(self).values()))

    def seen(self, points: Floats, curved: CurvedFacets) -> OnSurface:
        """Return what is known of the points (m, 3) that were put aside."""
        facet, flat = self.facet.astype(np.int64), np.array(self.flat)
        return _on_surface(points, facet, flat, np.array(self.clearance), curved)


def _on_surface(points: Floats, facet: Ints, flat: Floats, clearance: Floats, curved: CurvedFacets) -> OnSurface:
    feet, distance = np.empty(points.shape), np.empty(len(points))
    for rows in tiles.ranges(len(points), AT_ONCE):  # heights take several times the memory of the points
        feet[rows] = points[rows] - flat[rows, None] * curved.surface.normals[facet[rows]]
        distance[rows] = flat[rows] - curved.heights(feet[rows], facet[rows])
    return OnSurface(feet, distance, facet, clearance, flat=flat)


def assigned(points: Floats, scanner: Floats | None, curved: CurvedFacets, grid: FacetGrid) -> OnSurface:
    """Compare points (n, 3), seen from ``scanner`` (n, 3) if known, with their nearest visible facets."""
    surface = curved.surface
    points = np.ascontiguousarray(points)
    facet = np.full(len(points), -1, np.int64)
    over_ranges(lambda a, b: _nearest(grid, points, scanner, facet, a, b), len(points), least=LEAST_RANGE)
    facet, distance, beyond = surface.distances(points, grid.reach, facet)
    used = mesh_distance.on_face(facet, beyond)
    facet, flat = np.where(used, facet, -1), np.where(used, distance, np.nan)
    clearance = np.full(len(points), np.nan)
    seen = _on_surface(points, facet, flat, clearance, curved)
    seen_from = np.empty((0, 3)) if scanner is None else np.ascontiguousarray(scanner)
    measured = _Feet(seen.feet, facet, seen_from)
    over_ranges(lambda a, b: _clear(grid, surface.part_of, measured, clearance, a, b), len(points), least=LEAST_RANGE)
    return seen


def clear(seen: OnSurface, scatter: Floats) -> npt.NDArray[np.bool_]:
    """Mark (n,) the points whose face is decided, given the ``scatter`` (n,) of the distances about them, one sd."""
    with np.errstate(invalid="ignore"):
        marked: npt.NDArray[np.bool_] = (seen.facet >= 0) & (seen.clearance >= SEPARATION * scatter)
    return marked


class _Feet(NamedTuple):
    """Feet (n, 3) on facets (n,), and the scanners (n, 3) or (0, 3) they were seen from."""

    feet: Floats
    facet: Ints
    scanner: Floats


def _nearest(grid: FacetGrid, points: Floats, scanner: Floats | None, facet: Ints, first: int, last: int) -> None:
    """Fill the nearest visible facet of points first to last - 1."""
    if scanner is None:
        seen_from, station = np.zeros((1, 3)), np.full(last - first, -1, np.int64)
    else:
        seen_from, station = np.ascontiguousarray(scanner[first:last]), np.arange(last - first)
    facet[first:last] = mesh_distance.nearest_visible(grid, points[first:last], seen_from, station)[0]


@njit(cache=True, nogil=True)
def _clear(grid, part_of, measured, clearance, first, last):  # type: ignore[no-untyped-def]
    """Fill the clearance of the feet first to last - 1: infinite where no other face is within the grid's reach."""
    low, size, shape = grid.low, grid.size, grid.shape
    known = len(measured.scanner) > 0
    for row in range(first, last):
        at = measured.facet[row]
        if at < 0:
            continue
        clearance[row] = np.inf
        q, n = measured.feet[row], grid.normals[at]
        i, j, m = (q[0] - low[0]) / size, (q[1] - low[1]) / size, (q[2] - low[2]) / size
        if not (0.0 <= i < shape[0] and 0.0 <= j < shape[1] and 0.0 <= m < shape[2]):
            continue
        voxel = (int(i) * shape[1] + int(j)) * shape[2] + int(m)
        best = 2.0 * grid.reach
        for k in range(grid.start[voxel], grid.start[voxel + 1]):
            f = grid.facet[k]
            other = grid.normals[f]
            cosine = n[0] * other[0] + n[1] * other[1] + n[2] * other[2]
            if cosine > SHARP_COS or part_of[f] == part_of[at]:
                continue
            share = 0.5 if cosine < OPPOSED else 1.0
            a = grid.corners[f, 0]
            off = (q[0] - a[0]) * other[0] + (q[1] - a[1]) * other[1] + (q[2] - a[2]) * other[2]
            if share * abs(off) >= best:
                continue
            if known:
                s = measured.scanner[row]
                toward = (s[0] - q[0]) * other[0] + (s[1] - q[1]) * other[1] + (s[2] - q[2]) * other[2]
                if toward <= 0.0:
                    continue
            best = min(best, share * np.sqrt(square_to(grid.corners[f], q)))
        if best < grid.reach:
            clearance[row] = best
