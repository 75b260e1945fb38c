"""End points of faces: where one ray of a scanner still hits a face and the next ray passes it.

Scans from the two sides of a bar share none of its side faces. But each scan sees where the faces common to both end,
and there the side faces seen by the other scan begin. An end lies between two rays. It is placed half way in angle,
with the distance of the two rays on the face as the width of a uniform distribution.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from processor import large_arrays
from processor.geometry.scan_grid_directions import Rays
from processor.model import Columns, Floats, Ints
from processor.stitching.planes.extraction import Planes
from processor.stitching.planes.grid_bands import GridBands, Window

DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1))  # steps in row and column of the scan grid
JUMP_SIGMAS = 10.0  # least depth step behind an end
ON_SIGMAS = 3.5  # a point this close to a plane lies on it
SWEEPS = 4  # over the grid, forwards and backwards
WIDEST = 0.02  # of the range: ends between rays farther apart than this on the face carry almost no information


@dataclass(frozen=True)
class Ends(Columns):
    """Ends (n, 3) in the cloud's frame, the step from ray to ray at each (n, 3), and the faces' normals (n, 3).

    ``gap`` (n,) numbers the two rows or columns of the scan grid that an end lies between, ``edge`` (n,) the face
    and the grid direction in which the rays leave it.
    """

    points: Floats = field(default_factory=lambda: np.empty((0, 3)))
    across: Floats = field(default_factory=lambda: np.empty((0, 3)))
    normals: Floats = field(default_factory=lambda: np.empty((0, 3)))
    gap: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    edge: Ints = field(default_factory=lambda: np.empty(0, np.int64))


def ends_of(bands: GridBands, piece_of_cell: Ints, planes: Planes, sigma_mm: float, rays: Rays) -> Ends:
    """Find the ends of the planar pieces of points on a grid; ``piece_of_cell`` (m,) is a row of ``planes`` or -1.

    A bar hit by a single ray of a row has two ends in that row as well. Requiring a second ray would reject bars whose
    edges lie far from the rays, and the remaining ones would come out too wide.
    """
    if not len(planes.count):
        return Ends()
    offset = np.einsum("ni,ni->n", planes.normal, planes.mean)
    limit = ON_SIGMAS * sigma_mm
    on_face = large_arrays.allocate(*bands.shape, dtype=np.int64)
    for window in bands.windows():
        grid, piece = window.grid[window.own], piece_of_cell[window.cell]
        on_face[window.rows][window.own] = np.where(grid >= 0, piece[grid], -1) if len(piece) else -1
    for sweep in range(SWEEPS):
        for window in bands.windows(backwards=sweep % 2 == 1):
            own, way = window.own, -1 if sweep % 2 else 1
            grow(
                window.grid, on_face[window.rows], window.points, planes.normal, offset, limit, own.start, own.stop, way
            )
    parts: list[list[Ends]] = [[] for _ in DIRECTIONS]
    for window in bands.windows():
        for number, of_direction in enumerate(parts):
            of_direction.append(_ends_in(window, on_face[window.rows], number, planes, sigma_mm, rays))
    return Ends.concat([part for of_direction in parts for part in of_direction])


def _ends_in(window: Window, on_face: Ints, number: int, planes: Planes, sigma_mm: float, rays: Rays) -> Ends:
    """Return the ends in the band's own rows where rays leave their faces in direction ``number`` of the grid."""
    row_step, column_step = DIRECTIONS[number]
    points, row, column = window.points, window.row, window.column
    i, j, face = _last_on_face(window.grid, on_face, row_step, column_step)
    own = window.in_band[i]
    i, j, face = i[own], j[own], face[own]
    ray_i, ray_j = _unit(points[i]), _unit(points[j])
    n, at = planes.normal[face], planes.mean[face]
    d = np.einsum("ni,ni->n", n, at)
    following = np.where((j >= 0)[:, None], ray_j, rays.of(row[i] + row_step, column[i] + column_step))
    cos_i, cos_j = np.einsum("ni,ni->n", n, ray_i), np.einsum("ni,ni->n", n, following)
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = d / cos_i, d / cos_j
    on = np.abs(np.einsum("ni,ni->n", n, points[i]) - d) < ON_SIGMAS * sigma_mm
    a, b = ray_i * near[:, None], following * far[:, None]
    width = np.linalg.norm(b - a, axis=1)
    behind = (j < 0) | (np.linalg.norm(points[j], axis=1) - far > np.maximum(JUMP_SIGMAS * sigma_mm, 0.3 * width))
    good = on & behind & (near > 0.0) & (far > 0.0) & (width < WIDEST * np.linalg.norm(points[i], axis=1))
    gap = len(DIRECTIONS) * (row[i] if row_step else column[i]) + number
    # Rays are evenly spaced in angle. On an inclined face the gap beyond an edge is wider than the one before it.
    a, b, near, far = a[good], b[good], near[good], far[good]
    middle = 0.5 * (a + b) - (b - a) * (2.0 / 3.0 * (far - near) / (far + near))[:, None]
    edge = len(DIRECTIONS) * face[good] + number
    return Ends(points=middle, across=b - a, normals=n[good], gap=gap[good], edge=edge)


def _last_on_face(grid: Ints, on_face: Ints, row_step: int, column_step: int) -> tuple[Ints, Ints, Ints]:
    """Return points i (m,), their neighbours j (m,) that lie off the face, and the face (m,); j may be -1.

    The face is that of i, or else that of the point before i. Rows end, columns close the circle. Neighbours on the
    same face, the most frequent case, are left out.
    """
    after, next_face = (np.roll(values, (-row_step, -column_step), (0, 1)) for values in (grid, on_face))
    face = np.where(on_face >= 0, on_face, np.roll(on_face, (row_step, column_step), (0, 1)))
    keep = (grid >= 0) & (face >= 0) & ((after < 0) | (next_face != face))
    if row_step:
        keep[-1 if row_step > 0 else 0] = False
        face[0 if row_step > 0 else -1] = on_face[0 if row_step > 0 else -1]
    return grid[keep], after[keep], face[keep]


def _unit(points: Floats) -> Floats:
    rays: Floats = points / np.maximum(np.linalg.norm(points, axis=1), 1e-9)[:, None]
    return rays


@njit(cache=True, nogil=True)
def grow(grid, on_face, points, normal, offset, limit, first, last, way):  # type: ignore[no-untyped-def]
    """Add points of rows first to last - 1 without a face to that of a grid neighbour if they lie on its plane.

    Planar pieces need a minimum number of points. Without growing, the number of rays that hit a bar would decide
    whether its ends are found, and that number depends on where its edges lie between the rays. ``way`` is 1 for a
    sweep forwards, -1 for one backwards.
    """
    rows, columns = grid.shape
    for a in range(last - first):
        r = first + a if way > 0 else last - 1 - a
        for b in range(-1, columns):
            c = b % columns if way > 0 else (columns - 1 - b) % columns
            i = grid[r, c]
            if i < 0 or on_face[r, c] >= 0:
                continue
            for neighbour in range(2):
                u, v = (r, (c - way) % columns) if neighbour == 0 else (r - way, c)
                if 0 <= u < rows and on_face[u, v] >= 0:
                    f = on_face[u, v]
                    off = -offset[f]
                    for m in range(3):
                        off += normal[f, m] * points[i, m]
                    if abs(off) < limit:
                        on_face[r, c] = f
                        break
