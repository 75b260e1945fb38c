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
    on_face = np.where(grid >= 0, piece[grid], -1)
    found = []
    for up, left in WAYS:
        i, k, j, face = _leaving(grid, on_face, up, left)
        ray_i, ray_k, ray_j = (_rays(points[one]) for one in (i, k, j))
        n, at = planes.normal[face], planes.mean[face]
        d = np.einsum("ni,ni->n", n, at)
        following = 2.0 * ray_i - ray_k
        following /= np.linalg.norm(following, axis=1)[:, None]
        following = np.where((j >= 0)[:, None], ray_j, following)
        own, other = np.einsum("ni,ni->n", n, ray_i), np.einsum("ni,ni->n", n, following)
        with np.errstate(divide="ignore", invalid="ignore"):
            near, far = d / own, d / other
        on = np.abs(np.einsum("ni,ni->n", n, points[i]) - d) < ON_SIGMAS * sigma_mm
        a, b = ray_i * near[:, None], following * far[:, None]
        width = np.linalg.norm(b - a, axis=1)
        behind = (j < 0) | (np.linalg.norm(points[j], axis=1) - far > np.maximum(JUMP_SIGMAS * sigma_mm, 0.3 * width))
        good = on & behind & (near > 0.0) & (far > 0.0) & (width < WIDEST * np.linalg.norm(points[i], axis=1))
        found.append((0.5 * (a + b)[good], (b - a)[good], n[good]))
    return Ends(*(np.vstack([one[m] for one in found]) for m in range(3)))


def _leaving(grid: Ints, on_face: Ints, up: int, left: int) -> tuple[Ints, Ints, Ints, Ints]:
    """Return points i (m,) of a face that the next one j leaves, those before them k, and the face; j may be -1.

    Rows end, columns go round. Most neighbours lie on the same face: they are not ends.
    """
    before, after = (np.roll(grid, (way * up, way * left), (0, 1)) for way in (1, -1))
    face = np.where(on_face >= 0, on_face, np.roll(on_face, (up, left), (0, 1)))
    next_face = np.roll(on_face, (-up, -left), (0, 1))
    keep = (grid >= 0) & (before >= 0) & (face >= 0) & ((after < 0) | (next_face != face))
    if up:
        keep[[0, -1]] = False
    return grid[keep], before[keep], after[keep], face[keep]


def _rays(points: Floats) -> Floats:
    found: Floats = points / np.maximum(np.linalg.norm(points, axis=1), 1e-9)[:, None]
    return found
