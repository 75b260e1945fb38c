"""Which facet a point belongs to: facets in a hash of voxels, and the nearest that its scanner could see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.defects import facet_kernels
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
    count = facet_kernels.fill(corners, normals, low, size, shape, reach, np.empty(0, np.int64), np.empty(0, np.int64))
    start = np.concatenate([[0], np.cumsum(count)])
    facet = np.empty(start[-1], np.int64)
    facet_kernels.fill(corners, normals, low, size, shape, reach, start, facet)
    return FacetGrid(low, size, shape, start, facet, corners, normals, reach)


def nearest(grid: FacetGrid, points: Floats, scanners: Floats, station: Ints) -> tuple[Ints, Floats]:
    """Facet (n,) that points (n, 3) belong to, -1 for none, and their signed distance (n,) along its normal, mm.

    It is the nearest facet within reach that looks towards the scanner; ``station`` (n,) are rows of ``scanners``
    (k, 3), -1 = unknown: then the nearest facet of all.
    """
    return facet_kernels.nearest(
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
    return facet_kernels.touching(
        grid.low, grid.size, grid.shape, grid.start, grid.facet, grid.corners, vertices, within
    )
