"""A scan as stitching sees it: sums of its points in small cells, and the flat pieces they make up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import scanner_rays as grid_rays
from processor.model import Floats, Ints, Scan
from processor.stitching.coarse.free_space import Sight
from processor.stitching.planes import borders, extraction, hashing
from processor.stitching.planes.edges import Ends, ends_of, grid_of
from processor.stitching.planes.extraction import Planes

POINTS_A_CELL = 5.0
LEVELS = 6
KEPT_BELOW = 2  # cells are kept this many levels finer than the piece they belong to
LIMIT_SIGMAS = 2.5
NARROW = ((0.004, 0.1), (0.01, 0.15), (0.03, 0.25))  # widths of directions, and how many may hold two depths
APART = 0.05  # of the range


@dataclass(frozen=True)
class Cloud:
    """A scan in its own frame less ``origin``: the scanner where it is known, else the middle of the points.

    The cells' ``sums`` (m, 10) are relative to the origin. ``piece`` (m,) is the row of
    ``planes`` that a cell lies on; cells of none are left out. Normals look at the scanner.
    """

    name: str
    origin: Floats
    has_position: bool
    cell_mm: float
    sigma_mm: float  # scatter of flat pieces, as found
    sums: Floats
    cells: Planes
    piece: Ints
    level: Ints  # (k,) of each piece
    planes: Planes
    normal: Floats  # (m, 3) of the cells: their pieces'
    ends: Ends  # of the pieces; none where the scanner's grid is not known
    sight: Sight | None  # None where the scanner's place is not known


def cell_size(points: Floats) -> float:
    """Side of a cube, mm, such that those with points hold POINTS_A_CELL on average."""
    some = points[:: max(1, len(points) // 400_000)]
    share = len(some) / len(points)
    spread = float(np.quantile(np.linalg.norm(some - np.median(some, axis=0), axis=1), 0.9))
    size = max(spread, 1e-6) / 1024.0
    while size < spread:
        # A thinned cloud fills fewer cells; what counts is the mean number in an occupied cell of the whole.
        held = len(some) / hashing.distinct_count(extraction.packed(extraction.cells_of(some, size)))
        if 1.0 + (held - 1.0) / share >= POINTS_A_CELL:
            break
        size *= 2.0**0.5
    return size


def prepared(scan: Scan, cell_mm: float = 0.0) -> Cloud:
    """Take a scan apart into cells and flat pieces; ``cell_mm`` 0 = by the scan's density."""
    known = bool(scan.position.size) or _seen_from_origin(scan)
    position = scan.position if scan.position.size else np.zeros(3)
    origin = position if known else scan.origin + scan.points.mean(axis=0)
    finite = np.isfinite(scan.points).all(axis=1)
    points = scan.points + (scan.origin - origin)
    if not finite.all():
        points = points[finite]
    size = cell_mm or cell_size(points)
    cells = extraction.cells_of(points, size)
    first, of_point = hashing.numbered(extraction.packed(cells))
    sums = hashing.sums_of_points(points, of_point, len(first))
    cells = cells[first]
    sigma = _scatter(cells, sums, size, scan.sigma_mm)
    piece, level = extraction.flat_pieces(cells, sums, size, LIMIT_SIGMAS * sigma, LEVELS)
    on_grid = known and len(scan.grid_row) > 0
    if on_grid:
        row, column = scan.grid_row[finite].astype(np.int64), scan.grid_column[finite].astype(np.int64)
        held = np.flatnonzero(piece >= 0)
        rough = extraction.planes_of(hashing.summed(sums[held], piece[held], len(level)))
        sure = borders.inside(points, grid_of(row, column), piece[of_point], rough)
        sums = hashing.sums_of_points(points[sure], of_point[sure], len(first))
    on = np.flatnonzero((piece >= 0) & (sums[:, 9] > 0.0))
    # Cells of large pieces are put together: there are many, and they say little that a coarser one does not.
    down = np.maximum(level[piece[on]] - KEPT_BELOW, 0)
    key = extraction.packed(cells[on] >> down[:, None])
    _, inverse = np.unique(np.stack([key, piece[on]], axis=1), axis=0, return_inverse=True)
    inverse = inverse.ravel()
    count = int(inverse.max()) + 1 if len(inverse) else 0
    kept = hashing.summed(sums[on], inverse, count)
    of = np.zeros(count, np.int64)
    of[inverse] = piece[on]
    planes = extraction.planes_of(hashing.summed(kept, of, len(level)))
    if known:
        turn = np.where(np.einsum("ni,ni->n", planes.normal, planes.mean) > 0.0, -1.0, 1.0)
    else:
        turn = np.ones(len(planes.normal))
    planes = Planes(planes.count, planes.mean, planes.normal * turn[:, None], planes.variance, planes.axes)
    ends, lost = Ends(), np.empty((0, 3))
    if on_grid:
        rays = grid_rays.fitted(points, row, column)
        if rays is not None:
            ends = ends_of(points, row, column, piece[of_point], planes, sigma, rays)
            lost = grid_rays.unanswered(rays, row, column)
    return Cloud(
        scan.name, origin, known, size, sigma, kept, extraction.planes_of(kept), of, level, planes,
        planes.normal[of], ends,
        Sight.of(points, lost) if known else None,
    )  # fmt: skip


def _scatter(cells: Ints, sums: Floats, size: float, said: float) -> float:
    """Scatter of flat places across their planes, mm: what is said of the scanner, or more where more is found."""
    first, inverse = hashing.numbered(extraction.packed(cells >> 1))
    total = hashing.summed(sums, inverse, len(first))
    variance = np.linalg.eigvalsh(extraction.scatter(total[total[:, 9] >= 12.0])[1])
    flat = variance[(variance[:, 0] < 0.02 * variance[:, 1]) & (variance[:, 1] > (0.1 * size) ** 2), 0]
    found = float(np.sqrt(np.quantile(np.maximum(flat, 0.0), 0.75))) if len(flat) else 0.02 * size
    least = said if np.isfinite(said) else 0.0
    return min(max(found, least, 1e-3 * size), 0.15 * size)


def _seen_from_origin(scan: Scan) -> bool:
    """Whether the points can have been seen from the frame's origin: then that is where the scanner was (SOCS)."""
    points = scan.points[:: max(1, len(scan.points) // 200_000)] + scan.origin
    R = np.linalg.norm(points, axis=1)
    points, R = points[R > 1e-9], R[R > 1e-9]
    if len(R) < 100:
        return False
    # What lies behind something in the same narrow direction was not seen from there.
    u = points / R[:, None]
    for width, most in NARROW:
        key = extraction.packed(extraction.cells_of(u, width))
        order = np.lexsort([R, key])
        same = key[order][1:] == key[order][:-1]
        if same.sum() > 0.2 * len(R):
            apart = np.log(R[order][1:] / R[order][:-1]) > APART
            return float((same & apart).sum()) < most * float(same.sum())
    return False
