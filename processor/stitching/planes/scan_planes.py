"""A scan as cells with moments and the planar pieces that these form."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from processor.distinct_rows import distinct
from processor.geometry import scan_grid_directions
from processor.model import Floats, Ints, Scan
from processor.stitching.planes import border_exclusion, extraction, grouped_sums
from processor.stitching.planes.extraction import Planes
from processor.stitching.planes.face_ends import Ends, ends_of, grid_of
from processor.stitching.planes.free_space import FreeSpace

POINTS_A_CELL = 5.0
LEVELS = 6
KEPT_BELOW = 2  # cells are kept this many levels finer than the piece they belong to
LIMIT_SIGMAS = 2.5
# Widths of cells of directions, and shares of the pairs of points of a cell that follow each other in range. The
# scanner can be at the origin if fewer pairs than this differ by more than DEPTH_STEP, in the narrowest with enough.
NARROW = ((0.004, 0.1), (0.01, 0.15), (0.03, 0.25))
DEPTH_STEP = 0.05  # of the range


@dataclass(frozen=True)
class Cloud:
    """A scan in its file's frame less ``origin``: the scanner's position if known, else the centroid of the points.

    The cells' moments ``sums`` (m, 10) are relative to the origin; cells on no planar piece are left out. Normals point
    towards the scanner, if its position is known.
    """

    origin: Floats
    has_position: bool
    cell_mm: float
    sigma_mm: float  # estimated scatter across planar pieces
    sums: Floats
    mean: Floats  # (m, 3) of the cells' points
    normal: Floats  # (m, 3) of the pieces that the cells lie on
    planes: Planes  # of the pieces
    ends: Ends  # of the pieces; none without the scan grid
    free_space: FreeSpace | None  # None where the scanner's position is not known


def extract(scan: Scan, cell_mm: float = 0.0) -> Cloud:
    """Segment a scan into cells and planar pieces; ``cell_mm`` 0 = from the density of its points."""
    known = bool(scan.position.size) or _seen_from_origin(scan)
    position = scan.position if scan.position.size else np.zeros(3)
    origin = position if known else scan.origin + scan.points.mean(axis=0)
    finite = np.isfinite(scan.points).all(axis=1)
    points = scan.points + (scan.origin - origin)
    if not finite.all():
        points = points[finite]
    size = cell_mm or cell_size(points)
    cells = extraction.cells_of(points, size)
    first, of_point = grouped_sums.numbered(extraction.packed(cells))
    cells, sums = cells[first], grouped_sums.sums_of_points(points, of_point, len(first))
    sigma = _scatter(cells, sums, size, scan.sigma_mm)
    piece, level = extraction.flat_pieces(cells, sums, size, LIMIT_SIGMAS * sigma, LEVELS)
    on_grid = known and len(scan.grid_row) > 0
    row, column = np.empty(0, np.int64), np.empty(0, np.int64)
    if on_grid:
        row, column = scan.grid_row[finite].astype(np.int64), scan.grid_column[finite].astype(np.int64)
    if known:
        on_piece = np.flatnonzero(piece >= 0)
        rough = extraction.planes_of(grouped_sums.summed(sums[on_piece], piece[on_piece], len(level)))
        clear = border_exclusion.inside(points, grid_of(row, column) if on_grid else None, piece[of_point], rough)
        sums = grouped_sums.sums_of_points(points[clear], of_point[clear], len(first))
    merged, piece_of_merged = _merged(cells, sums, piece, level)
    planes = extraction.planes_of(grouped_sums.summed(merged, piece_of_merged, len(level)))
    if known:
        planes = _facing_scanner(planes)
    ends, unanswered = Ends(), np.empty((0, 3))
    rays = scan_grid_directions.fitted(points, row, column) if on_grid else None
    if rays is not None:
        ends = ends_of(points, row, column, piece[of_point], planes, sigma, rays)
        unanswered = scan_grid_directions.unanswered(rays, row, column)
    return Cloud(
        origin=origin, has_position=known, cell_mm=size, sigma_mm=sigma, sums=merged,
        mean=extraction.scatter(merged)[0], normal=planes.normal[piece_of_merged], planes=planes, ends=ends,
        free_space=FreeSpace.from_rays(points, unanswered) if known else None,
    )  # fmt: skip


def cell_size(points: Floats) -> float:
    """Return the side, mm, of cubes that hold POINTS_A_CELL points on average, empty ones not counted."""
    some = points[:: max(1, len(points) // 400_000)]
    share = len(some) / len(points)
    spread = float(np.quantile(np.linalg.norm(some - np.median(some, axis=0), axis=1), 0.9))
    size = max(spread, 1e-6) / 1024.0
    while size < spread:
        # The subsample occupies fewer cells than the whole cloud: its mean count is scaled to that of all points.
        mean_count = len(some) / grouped_sums.distinct_count(extraction.packed(extraction.cells_of(some, size)))
        if 1.0 + (mean_count - 1.0) / share >= POINTS_A_CELL:
            break
        size *= 2.0**0.5
    return size


def _scatter(cells: Ints, sums: Floats, size: float, sigma_mm: float) -> float:
    """Estimate the scatter of planar places across their planes, mm; at least the scanner's ``sigma_mm``, if known."""
    first, inverse = grouped_sums.numbered(extraction.packed(cells >> 1))
    total = grouped_sums.summed(sums, inverse, len(first))
    variance = np.linalg.eigvalsh(extraction.scatter(total[total[:, 9] >= 12.0])[1])
    flat = variance[(variance[:, 0] < 0.02 * variance[:, 1]) & (variance[:, 1] > (0.1 * size) ** 2), 0]
    estimate = float(np.sqrt(np.quantile(np.maximum(flat, 0.0), 0.75))) if len(flat) else 0.02 * size
    least = sigma_mm if np.isfinite(sigma_mm) else 0.0
    return min(max(estimate, least, 1e-3 * size), 0.15 * size)


def _merged(cells: Ints, sums: Floats, piece: Ints, level: Ints) -> tuple[Floats, Ints]:
    """Merge the cells of large pieces, which are many and redundant; returns moments (m, 10) and pieces (m,)."""
    on = np.flatnonzero((piece >= 0) & (sums[:, 9] > 0.0))
    down = np.maximum(level[piece[on]] - KEPT_BELOW, 0)
    key = extraction.packed(cells[on] >> down[:, None])
    inverse = distinct(np.stack([key, piece[on]], axis=1)).number
    count = int(inverse.max()) + 1 if len(inverse) else 0
    piece_of_merged = np.zeros(count, np.int64)
    piece_of_merged[inverse] = piece[on]
    return grouped_sums.summed(sums[on], inverse, count), piece_of_merged


def _facing_scanner(planes: Planes) -> Planes:
    sign = np.where(np.einsum("ni,ni->n", planes.normal, planes.mean) > 0.0, -1.0, 1.0)
    return replace(planes, normal=planes.normal * sign[:, None])


def _seen_from_origin(scan: Scan) -> bool:
    """Return whether the points are consistent with a scanner at the frame's origin (SOCS)."""
    points = scan.points[:: max(1, len(scan.points) // 200_000)] + scan.origin
    R = np.linalg.norm(points, axis=1)
    points, R = points[R > 1e-9], R[R > 1e-9]
    if len(R) < 100:
        return False
    # From its own position a scanner sees a single depth in each narrow direction.
    u = points / R[:, None]
    for width, most in NARROW:
        key = extraction.packed(extraction.cells_of(u, width))
        order = np.lexsort([R, key])
        same = key[order][1:] == key[order][:-1]
        if same.sum() > 0.2 * len(R):
            steps = np.log(R[order][1:] / R[order][:-1]) > DEPTH_STEP
            return float((same & steps).sum()) < most * float(same.sum())
    return False
