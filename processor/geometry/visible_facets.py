"""Which facet a point belongs to: facets in a hash of voxels, and the nearest that its scanner could see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from processor.model import Floats, Ints

MOST_VOXELS = 20_000_000
PER_VOXEL = 24


@dataclass(frozen=True)
class FacetGrid:
    """Facets by the voxels of a dense grid that they come within ``reach`` of."""

    low: Floats
    size: float
    shape: Ints
    start: Ints  # (voxels + 1,)
    facet: Ints
    corners: Floats  # (f, 3, 3)
    normals: Floats
    reach: float


def grid_of(vertices: Floats, faces: Ints, normals: Floats, reach: float) -> FacetGrid:
    """Put facets into voxels; these are about as large as ``reach``, larger where the design is vast."""
    corners = np.ascontiguousarray(vertices[faces])
    low, high = corners.min(axis=(0, 1)) - reach, corners.max(axis=(0, 1)) + reach
    size = max(reach, float(np.prod(high - low) / MOST_VOXELS) ** (1.0 / 3.0))
    shape = np.maximum(np.ceil((high - low) / size), 1).astype(np.int64)
    count = fill(corners, normals, low, size, shape, reach, np.empty(0, np.int64), np.empty(0, np.int64))
    start = np.concatenate([[0], np.cumsum(count)])
    facet = np.empty(start[-1], np.int64)
    fill(corners, normals, low, size, shape, reach, start, facet)
    return FacetGrid(low, size, shape, start, facet, corners, normals, reach)


def nearest(grid: FacetGrid, points: Floats, scanners: Floats, station: Ints) -> tuple[Ints, Floats]:
    """Facet (n,) that points (n, 3) belong to, -1 for none, and their signed distance (n,) along its normal, mm.

    It is the nearest facet within reach that looks towards the scanner; ``station`` (n,) are rows of ``scanners``
    (k, 3), -1 = unknown: then the nearest facet of all.
    """
    return _nearest(
        grid.low, grid.size, grid.shape, grid.start, grid.facet, grid.corners, grid.normals, grid.reach, points,
        scanners, station,
    )  # fmt: skip


def touching(vertices: Floats, faces: Ints, within: float) -> tuple[Ints, Ints]:
    """Vertices and facets (k,), (k,) that come within a distance of each other."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    span = float(np.median(np.ptp(corners, axis=1).max(axis=1)))
    grid = grid_of(vertices, faces, normals, max(within, 0.25 * span))
    return _touching(grid.low, grid.size, grid.shape, grid.start, grid.facet, grid.corners, vertices, within)


# --- Compiled: the search for the facet of a point.


GRAZING = 0.02  # cosine below which a face is seen from its edge


@njit(cache=True, nogil=True)
def fill(
    corners: Floats, normals: Floats, low: Floats, size: float, shape: Ints, reach: float, start: Ints, out: Ints
) -> Ints:
    """Count the facets of each voxel (voxels,), or with ``start`` write them to ``out``.

    A facet is in a voxel of its box that its plane comes within reach of.
    """
    count = np.zeros(shape[0] * shape[1] * shape[2], np.int64)
    half = 0.5 * size
    for f in range(len(corners)):
        lo, hi = np.empty(3, np.int64), np.empty(3, np.int64)
        for k in range(3):
            least, most = corners[f, :, k].min() - reach, corners[f, :, k].max() + reach
            lo[k] = max(0, int((least - low[k]) / size))
            hi[k] = min(shape[k] - 1, int((most - low[k]) / size))
        n = normals[f]
        span = half * (abs(n[0]) + abs(n[1]) + abs(n[2])) + reach
        for i in range(lo[0], hi[0] + 1):
            for j in range(lo[1], hi[1] + 1):
                for m in range(lo[2], hi[2] + 1):
                    off = (
                        (low[0] + i * size + half - corners[f, 0, 0]) * n[0]
                        + (low[1] + j * size + half - corners[f, 0, 1]) * n[1]
                        + (low[2] + m * size + half - corners[f, 0, 2]) * n[2]
                    )
                    if abs(off) > span:
                        continue
                    voxel = (i * shape[1] + j) * shape[2] + m
                    if len(start):
                        out[start[voxel] + count[voxel]] = f
                    count[voxel] += 1
    return count


@njit(cache=True, nogil=True)
def square_to(corner: Floats, p: Floats) -> Any:
    """Return the squared distance of a point (3,) from a triangle (3, 3).

    After Ericson, Real-Time Collision Detection, 5.1.5.
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


@njit(cache=True, nogil=True)
def _nearest(
    low: Floats,
    size: float,
    shape: Ints,
    start: Ints,
    facet: Ints,
    corners: Floats,
    normals: Floats,
    reach: float,
    points: Floats,
    scanners: Floats,
    station: Ints,
) -> tuple[Ints, Floats]:
    """See :func:`processor.geometry.visible_facets.nearest`."""
    found = np.full(len(points), -1, np.int64)
    distance = np.full(len(points), np.nan)
    for row in range(len(points)):
        p = points[row]
        i, j, m = (p[0] - low[0]) / size, (p[1] - low[1]) / size, (p[2] - low[2]) / size
        if not (0.0 <= i < shape[0] and 0.0 <= j < shape[1] and 0.0 <= m < shape[2]):
            continue
        voxel = (int(i) * shape[1] + int(j)) * shape[2] + int(m)
        best = reach * reach
        k = station[row]
        for at in range(start[voxel], start[voxel + 1]):
            f = facet[at]
            n = normals[f]
            off = (p[0] - corners[f, 0, 0]) * n[0] + (p[1] - corners[f, 0, 1]) * n[1] + (p[2] - corners[f, 0, 2]) * n[2]
            if off * off >= best:
                continue
            if k >= 0:
                x, y, z = scanners[k, 0] - p[0], scanners[k, 1] - p[1], scanners[k, 2] - p[2]
                if x * n[0] + y * n[1] + z * n[2] < GRAZING * np.sqrt(x * x + y * y + z * z):
                    continue
            square = square_to(corners[f], p)
            if square < best:
                best, found[row], distance[row] = square, f, off
    return found, distance


@njit(cache=True, nogil=True)
def _touching(
    low: Floats, size: float, shape: Ints, start: Ints, facet: Ints, corners: Floats, points: Floats, within: float
) -> tuple[Ints, Ints]:
    """Pairs of points and facets that come within a distance of each other."""
    one, two = [np.int64(0) for _ in range(0)], [np.int64(0) for _ in range(0)]
    for row in range(len(points)):
        p = points[row]
        i, j, m = int((p[0] - low[0]) / size), int((p[1] - low[1]) / size), int((p[2] - low[2]) / size)
        voxel = (i * shape[1] + j) * shape[2] + m
        for at in range(start[voxel], start[voxel + 1]):
            if square_to(corners[facet[at]], p) < within * within:
                one.append(row)
                two.append(facet[at])
    return np.array(one), np.array(two)
