"""Where vertical lines meet a mesh: heights and slopes below places in plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Floats, Ints

LEAST_SHARE = 1e-9  # of a facet's area seen from above; less is a wall, which no plumb line meets
MOST_ENTRIES = 20_000_000
ON_EDGE = 1e-9  # barycentric coordinates down to its negative are on the facet


@dataclass(frozen=True)
class Plan:
    """A mesh seen from above, its facets by the cells of a grid that their boxes touch."""

    corners: Floats  # (f, 3, 3) of facets that are no walls
    low: Floats  # (2,) corner of the grid
    cell: float
    shape: tuple[int, int]
    start: Ints  # (cells + 1,) first entry of each cell
    facet: Ints  # facet of each entry

    def heights(self, places: Floats) -> tuple[Floats, Floats]:
        """Height (n,) of the mesh over places (n, 2), and its slopes (n, 2) along x and y; NaN where there is none.

        Where surfaces lie above one another the highest counts.
        """
        height, slope = np.full(len(places), np.nan), np.full((len(places), 2), np.nan)
        index = np.floor((np.nan_to_num(places) - self.low) / self.cell).astype(np.int64)
        inside = ((index >= 0) & (index < self.shape)).all(axis=1) & np.isfinite(places).all(axis=1)
        cells = index[:, 0] * self.shape[1] + index[:, 1]
        for i in np.flatnonzero(inside).tolist():
            entries = self.facet[self.start[cells[i]] : self.start[cells[i] + 1]]
            a, b, c = self.corners[entries].transpose(1, 0, 2)
            u, v = b - a, c - a
            twice = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
            p = places[i] - a[:, :2]
            second = (p[:, 0] * v[:, 1] - p[:, 1] * v[:, 0]) / twice
            third = (u[:, 0] * p[:, 1] - u[:, 1] * p[:, 0]) / twice
            on = (second >= -ON_EDGE) & (third >= -ON_EDGE) & (second + third <= 1.0 + ON_EDGE)
            if on.any():
                z = np.where(on, a[:, 2] + second * u[:, 2] + third * v[:, 2], -np.inf)
                k = int(z.argmax())
                height[i] = z[k]
                normal = np.cross(u[k], v[k])
                slope[i] = -normal[:2] / normal[2]
        return height, slope


def plan(vertices: Floats, faces: Ints) -> Plan:
    """Prepare a mesh of vertices (v, 3) and triangles (f, 3)."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    corners = corners[np.abs(normal[:, 2]) > LEAST_SHARE * np.linalg.norm(normal, axis=1)]
    if not len(corners):
        none = np.zeros(0, np.int64)
        return Plan(corners=corners, low=np.zeros(2), cell=1.0, shape=(0, 0), start=np.zeros(1, np.int64), facet=none)
    low, high = corners[:, :, :2].min(axis=(0, 1)), corners[:, :, :2].max(axis=(0, 1))
    extent = np.maximum(high - low, 1.0)
    cell = float(np.sqrt(extent.prod() / len(corners)))
    while True:
        first = np.floor((corners[:, :, :2].min(axis=1) - low) / cell).astype(np.int64)
        last = np.floor((corners[:, :, :2].max(axis=1) - low) / cell).astype(np.int64)
        shape = np.floor(extent / cell).astype(np.int64) + 1
        counts = (last - first + 1).prod(axis=1)
        if counts.sum() <= MOST_ENTRIES and shape.prod() <= MOST_ENTRIES:
            break
        cell *= 2.0
    facet = np.repeat(np.arange(len(corners)), counts)
    number = np.arange(len(facet)) - np.repeat(np.cumsum(counts) - counts, counts)
    wide = (last - first + 1)[facet, 1]
    cells = (first[facet, 0] + number // wide) * shape[1] + first[facet, 1] + number % wide
    order = np.argsort(cells, kind="stable")
    start = np.searchsorted(cells[order], np.arange(int(shape.prod()) + 1))
    return Plan(
        corners=corners, low=low, cell=cell, shape=(int(shape[0]), int(shape[1])), start=start, facet=facet[order]
    )
