"""Ends of faces: where one ray of a scanner still meets a face and the next passes it.

Scans from two sides of a bar share none of its sides, but each sees where the faces that both share end, and that is
where the sides begin that the other one sees. An end lies between two rays: half way, with the width between them as
the width of a uniform distribution.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from processor.model import Floats, Ints
from processor.stitching.octree import Planes

WAYS = ((1, 0), (-1, 0), (0, 1), (0, -1))
JUMP_SIGMAS = 10.0
ON_SIGMAS = 3.5
WIDEST = 0.02  # of the range: a step between rays, along the face, beyond which an end says next to nothing


@dataclass(frozen=True)
class Ends:
    """Ends (n, 3) in the cloud's frame, the way across each from ray to ray (n, 3), and the faces' normals (n, 3)."""

    points: Floats = field(default_factory=lambda: np.empty((0, 3)))
    across: Floats = field(default_factory=lambda: np.empty((0, 3)))
    normals: Floats = field(default_factory=lambda: np.empty((0, 3)))


def grid_of(row: Ints, column: Ints) -> Ints:
    """Row of the points at each place of the scanner's grid, -1 = none; columns go round."""
    on = np.flatnonzero((row >= 0) & (column >= 0))
    grid = np.full((int(row.max(initial=0)) + 1, int(column.max(initial=0)) + 1), -1, np.int64)
    grid[row[on], column[on]] = on
    return grid


def ends_of(points: Floats, row: Ints, column: Ints, piece: Ints, planes: Planes, sigma_mm: float) -> Ends:
    """Find ends of the flat pieces of points (n, 3) around their scanner; ``piece`` (n,) is a row of planes or -1."""
    if not len(row) or not len(planes.count):
        return Ends()
    grid = grid_of(row, column)
    R = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    ray = points / R[:, None]
    r, c = np.nonzero(grid >= 0)
    here = grid[r, c]
    turn = grid.shape[1]
    found = []
    for up, left in WAYS:
        inside = (r + up >= 0) & (r + up < grid.shape[0]) & (r - up >= 0) & (r - up < grid.shape[0])
        i = here[inside]
        k = grid[r[inside] - up, (c[inside] - left) % turn]
        j = grid[r[inside] + up, (c[inside] + left) % turn]
        i, k, j = i[k >= 0], k[k >= 0], j[k >= 0]
        face = np.where(piece[i] >= 0, piece[i], piece[k])
        # Most neighbours lie on the same face: they are not ends.
        keep = (face >= 0) & ((j < 0) | (piece[j] != face))
        i, k, j, face = i[keep], k[keep], j[keep], face[keep]
        n, at = planes.normal[face], planes.mean[face]
        d = np.einsum("ni,ni->n", n, at)
        following = 2.0 * ray[i] - ray[k]
        following /= np.linalg.norm(following, axis=1)[:, None]
        following = np.where((j >= 0)[:, None], ray[j], following)
        own, other = np.einsum("ni,ni->n", n, ray[i]), np.einsum("ni,ni->n", n, following)
        with np.errstate(divide="ignore", invalid="ignore"):
            near, far = d / own, d / other
        on = np.abs(np.einsum("ni,ni->n", n, points[i]) - d) < ON_SIGMAS * sigma_mm
        a, b = ray[i] * near[:, None], following * far[:, None]
        width = np.linalg.norm(b - a, axis=1)
        behind = (j < 0) | (R[j] - far > np.maximum(JUMP_SIGMAS * sigma_mm, 0.3 * width))
        good = on & behind & (near > 0.0) & (far > 0.0) & (width < WIDEST * R[i])
        found.append((0.5 * (a + b)[good], (b - a)[good], n[good]))
    return Ends(*(np.vstack([one[m] for one in found]) for m in range(3)))
