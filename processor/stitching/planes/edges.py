"""Ends of faces: where one ray of a scanner still meets a face and the next passes it.

Scans from two sides of a bar share none of its sides, but each sees where the faces that both share end, and that is
where the sides begin that the other one sees. An end lies between two rays: half way, with the width between them as
the width of a uniform distribution.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from processor.geometry.scanner_rays import Rays
from processor.model import Floats, Ints
from processor.stitching.planes.extraction import Planes

WAYS = ((1, 0), (-1, 0), (0, 1), (0, -1))
JUMP_SIGMAS = 10.0
ON_SIGMAS = 3.5
SWEEPS = 4  # over the grid, there and back
WIDEST = 0.02  # of the range: a step between rays, along the face, beyond which an end says next to nothing


@dataclass(frozen=True)
class Ends:
    """Ends (n, 3) in the cloud's frame, the way across each from ray to ray (n, 3), and the faces' normals (n, 3).

    ``gap`` (n,) numbers the two rows or columns of the scanner's grid that an end lies between, ``edge`` (n,) the face
    and the way that its ray leaves it.
    """

    points: Floats = field(default_factory=lambda: np.empty((0, 3)))
    across: Floats = field(default_factory=lambda: np.empty((0, 3)))
    normals: Floats = field(default_factory=lambda: np.empty((0, 3)))
    gap: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    edge: Ints = field(default_factory=lambda: np.empty(0, np.int64))


def grid_of(row: Ints, column: Ints) -> Ints:
    """Row of the points at each place of the scanner's grid, -1 = none; columns go round."""
    on = np.flatnonzero((row >= 0) & (column >= 0))
    grid = np.full((int(row.max(initial=0)) + 1, int(column.max(initial=0)) + 1), -1, np.int64)
    grid[row[on], column[on]] = on
    return grid


@njit(cache=True, nogil=True)
def grow(grid, on_face, points, normal, offset, limit):  # type: ignore[no-untyped-def]
    """Let points of no face, beside one of a face on the scanner's grid, join it where they lie on its plane.

    Flat pieces need some points: how many rays met a bar would else decide whether its ends are found, and with that,
    where between the rays these lie.
    """
    rows, columns = grid.shape
    for sweep in range(SWEEPS):
        way = 1 if sweep % 2 == 0 else -1
        for a in range(rows):
            r = a if way > 0 else rows - 1 - a
            for b in range(-1, columns):
                c = b % columns if way > 0 else (columns - 1 - b) % columns
                i = grid[r, c]
                if i < 0 or on_face[r, c] >= 0:
                    continue
                for beside in range(2):
                    u, v = (r, (c - way) % columns) if beside == 0 else (r - way, c)
                    if 0 <= u < rows and on_face[u, v] >= 0:
                        f = on_face[u, v]
                        off = -offset[f]
                        for m in range(3):
                            off += normal[f, m] * points[i, m]
                        if abs(off) < limit:
                            on_face[r, c] = f
                            break


def ends_of(points: Floats, row: Ints, column: Ints, piece: Ints, planes: Planes, sigma_mm: float, rays: Rays) -> Ends:
    """Find ends of the flat pieces of points (n, 3) around their scanner; ``piece`` (n,) is a row of planes or -1.

    A bar that a single ray of a row met has two ends there as well: to ask for a second one would leave out those whose
    edges lie far from the rays, and the others would seem wider than they are.
    """
    if not len(row) or not len(planes.count):
        return Ends()
    grid = grid_of(row, column)
    on_face = np.where(grid >= 0, piece[grid], -1)
    d = np.einsum("ni,ni->n", planes.normal, planes.mean)
    grow(grid, on_face, np.ascontiguousarray(points), planes.normal, d, ON_SIGMAS * sigma_mm)
    found = []
    for way, (up, left) in enumerate(WAYS):
        i, j, face = _leaving(grid, on_face, up, left)
        ray_i, ray_j = _unit(points[i]), _unit(points[j])
        n, at = planes.normal[face], planes.mean[face]
        d = np.einsum("ni,ni->n", n, at)
        following = np.where((j >= 0)[:, None], ray_j, rays.of(row[i] + up, column[i] + left))
        own, other = np.einsum("ni,ni->n", n, ray_i), np.einsum("ni,ni->n", n, following)
        with np.errstate(divide="ignore", invalid="ignore"):
            near, far = d / own, d / other
        on = np.abs(np.einsum("ni,ni->n", n, points[i]) - d) < ON_SIGMAS * sigma_mm
        a, b = ray_i * near[:, None], following * far[:, None]
        width = np.linalg.norm(b - a, axis=1)
        behind = (j < 0) | (np.linalg.norm(points[j], axis=1) - far > np.maximum(JUMP_SIGMAS * sigma_mm, 0.3 * width))
        good = on & behind & (near > 0.0) & (far > 0.0) & (width < WIDEST * np.linalg.norm(points[i], axis=1))
        gap = len(WAYS) * (row[i] if up else column[i]) + way
        # Rays part evenly by angle, not along a face that leans away: the gaps beyond an edge are wider than before it.
        a, b, near, far = a[good], b[good], near[good], far[good]
        middle = 0.5 * (a + b) - (b - a) * (2.0 / 3.0 * (far - near) / (far + near))[:, None]
        found.append((middle, b - a, n[good], gap[good], len(WAYS) * face[good] + way))
    return Ends(*(np.concatenate([one[m] for one in found]) for m in range(5)))


def _leaving(grid: Ints, on_face: Ints, up: int, left: int) -> tuple[Ints, Ints, Ints]:
    """Return points i (m,) of a face that the next one j leaves, and the face; j may be -1.

    The face is i's own, or that of the one before. Rows end, columns go round. Most neighbours lie on the same face:
    they are not ends.
    """
    after, next_face = (np.roll(one, (-up, -left), (0, 1)) for one in (grid, on_face))
    face = np.where(on_face >= 0, on_face, np.roll(on_face, (up, left), (0, 1)))
    keep = (grid >= 0) & (face >= 0) & ((after < 0) | (next_face != face))
    if up:
        keep[-1 if up > 0 else 0] = False
        face[0 if up > 0 else -1] = on_face[0 if up > 0 else -1]
    return grid[keep], after[keep], face[keep]


def _unit(points: Floats) -> Floats:
    found: Floats = points / np.maximum(np.linalg.norm(points, axis=1), 1e-9)[:, None]
    return found
