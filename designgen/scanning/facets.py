"""Many triangles in one tree of Embree, for rays in any direction.

Embree finds the facet in float32, in the scene's frame less a local origin; the range is that of the facet's plane in
float64. Its test is watertight: rays at a common edge meet either facet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from processor.model import Bools, Floats, Ints

CELLS = 8  # work: cells along each axis whose windows are drawn onto the grid; 512 windows a station cost nothing
FREE_SHARE = 1e-6  # of the size of the scene: some 16 times the resolution of float32
HASH = np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0, 23.0])  # no facets alike by chance: equality is tested


@dataclass(frozen=True, kw_only=True)
class Facets:
    """Triangles (f, 3, 3), mm, their tree about ``middle`` (3,), and balls around them by cells (k, 3) and (k,)."""

    corners: Floats
    middle: Floats
    size: float  # longest side of the box, mm
    same: Ints  # (f,) first facet with the same corners
    tree: Any
    centres: Floats
    radii: Floats

    @classmethod
    def of(cls, corners: Floats) -> Facets:
        """Return triangles (f, 3, 3) with their tree."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        lows, highs = corners.min(axis=1), corners.max(axis=1)
        low, high = lows.min(axis=0), highs.max(axis=0)
        middle, size = 0.5 * (low + high), float((high - low).max())
        tree = EmbreeScene(robust=True)
        TriangleMesh(tree, (corners - middle).astype(np.float32))
        _, first, place = np.unique(
            np.einsum("fk,k->f", corners.reshape(-1, 9), HASH), return_index=True, return_inverse=True
        )
        same = np.where((corners[first[place]] == corners).all(axis=(1, 2)), first[place], np.arange(len(corners)))
        cell = np.clip(CELLS * (0.5 * (lows + highs) - low) / max(size, 1e-300), 0, CELLS - 1).astype(np.int64)
        cell = cell @ (CELLS**2, CELLS, 1)
        order = np.argsort(cell, kind="stable")
        start = np.flatnonzero(np.diff(cell[order], prepend=-1))
        lows, highs = np.minimum.reduceat(lows[order], start), np.maximum.reduceat(highs[order], start)
        return cls(
            corners=corners,
            middle=middle,
            size=size,
            same=same,
            tree=tree,
            centres=0.5 * (lows + highs),
            radii=0.5 * np.linalg.norm(highs - lows, axis=1),
        )

    def first(self, start: Floats, directions: Floats, reach: Floats | None = None) -> Ints:
        """Return the facets (n,) that rays from points (n, 3) or (3,) meet first within ``reach`` (n,); -1 = none."""
        starts = np.broadcast_to((start - self.middle).astype(np.float32), directions.shape)
        ends = None if reach is None else reach.astype(np.float32)
        met: Ints = self.tree.run(starts, directions.astype(np.float32), ends)
        return np.where(met >= 0, self.same[met], -1)

    def free(self, start: Floats, end: Floats) -> Bools:
        """Return whether nothing lies between points (n, 3) and (n, 3), except near the ends."""
        arm = end - start
        length = np.maximum(np.linalg.norm(arm, axis=1), 1e-300)
        unit, margin = arm / length[:, None], FREE_SHARE * self.size
        result: Bools = self.first(start + margin * unit, unit, length - 2.0 * margin) < 0
        return result
