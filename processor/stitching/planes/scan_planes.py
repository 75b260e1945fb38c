"""A scan as cells with moments and the planar pieces that these form."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from processor import large_arrays
from processor.distinct_rows import distinct
from processor.geometry import scan_grid_directions
from processor.geometry.scan_grid_directions import Rays
from processor.model import Floats, Ints, Labels, Scan
from processor.stitching.planes import border_exclusion, extraction, grouped_sums
from processor.stitching.planes.extraction import Planes
from processor.stitching.planes.face_ends import Ends, ends_of
from processor.stitching.planes.free_space import FreeSpace
from processor.stitching.planes.grid_bands import GridBands

POINTS_A_CELL = 5.0  # a plane takes three, and two show its scatter
MOST_CELLS_OF_SCAN, MOST_CELLS = 400_000, 2_400_000  # of one scan and of all, occupied: cells of more points are larger
LEVELS = 6  # times that cubes may be joined by eight
KEPT_BELOW = 2  # cells are kept this many levels finer than the piece they belong to
LIMIT_SIGMAS = 2.5  # chosen: scatter by the noise, above which points are on no plane; leaves room for rough steel
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


def points_a_cell(scan: Scan, of_all: int) -> float:
    """Return how many points a cell of a scan holds on average, if all scans have ``of_all`` points.

    Cells of large scans hold more, so that the number of cells, and the memory that they take, has a bound.
    """
    return max(POINTS_A_CELL, len(scan.points) / MOST_CELLS_OF_SCAN, of_all / MOST_CELLS)


def extract(scan: Scan, cell_mm: float = 0.0, a_cell: float = POINTS_A_CELL) -> Cloud:
    """Segment a scan into cells and planar pieces; ``cell_mm`` 0 = cells of ``a_cell`` points on average."""
    known = bool(scan.position.size) or _seen_from_origin(scan)
    position = scan.position if scan.position.size else np.zeros(3)
    origin = position if known else scan.origin + large_arrays.centroid(scan.points)
    points, row, column = _about(scan, origin)
    size = cell_mm or cell_size(points, a_cell)
    keys, of_point = grouped_sums.number_of_rows(
        lambda rows: extraction.packed(extraction.cells_of(points[rows], size)), len(points)
    )
    cells, sums = extraction.unpacked(keys), grouped_sums.sums_of_points(points, of_point, len(keys))
    sigma = _scatter(cells, sums, size, scan.sigma_mm)
    piece, level = extraction.flat_pieces(cells, sums, size, LIMIT_SIGMAS * sigma, LEVELS)
    bands = GridBands.of(points, row, column, of_point) if known and len(row) else None
    if known:
        on_piece = np.flatnonzero(piece >= 0)
        rough = extraction.planes_of(grouped_sums.summed(sums[on_piece], piece[on_piece], len(level)))
        clear = border_exclusion.inside(points, of_point, bands, piece, rough)
        sums = grouped_sums.sums_of_points(points, of_point, len(keys), clear)
    merged, piece_of_merged = _merged(cells, sums, piece, level)
    planes = extraction.planes_of(grouped_sums.summed(merged, piece_of_merged, len(level)))
    if known:
        # Normals point to the scanner
        sign = np.where(np.einsum("ni,ni->n", planes.normal, planes.mean) > 0.0, -1.0, 1.0)
        planes = replace(planes, normal=planes.normal * sign[:, None])
    ends, rays = Ends(), None
    if bands is not None and (rays := scan_grid_directions.fitted(points, row, column)) is not None:
        ends = ends_of(bands, piece, planes, sigma, rays)
    return Cloud(
        origin=origin, has_position=known, cell_mm=size, sigma_mm=sigma, sums=merged,
        mean=extraction.scatter(merged)[0], normal=planes.normal[piece_of_merged], planes=planes, ends=ends,
        free_space=FreeSpace.from_rays(points, _unanswered(bands, rays)) if known else None,
    )  # fmt: skip


def _about(scan: Scan, origin: Floats) -> tuple[Floats, Labels, Labels]:
    """Return the finite points (n, 3) of a scan less ``origin`` (3,), and their rows and columns (n,) of its grid."""
    finite, count = large_arrays.allocate(len(scan.points), dtype=np.bool_), 0
    for rows in large_arrays.blocks(len(scan.points)):
        finite[rows] = np.isfinite(scan.points[rows]).all(axis=1)
        count += np.count_nonzero(finite[rows])
    points, count = large_arrays.allocate(count, 3), 0
    for rows in large_arrays.blocks(len(scan.points)):
        part = scan.points[rows][finite[rows]] + (scan.origin - origin)
        points[count : count + len(part)] = part
        count += len(part)
    if count == len(finite) or not len(scan.grid_row):
        return points, scan.grid_row, scan.grid_column
    return points, large_arrays.chosen(scan.grid_row, finite), large_arrays.chosen(scan.grid_column, finite)


def _unanswered(bands: GridBands | None, rays: Rays | None) -> Iterator[Floats]:
    """Yield the directions (m, 3) of rays without a return, band by band."""
    if bands is not None and rays is not None:
        for window in bands.windows():
            yield scan_grid_directions.unanswered(
                rays, window.grid[window.own] < 0, window.rows.start + window.own.start
            )


def cell_size(points: Floats, a_cell: float = POINTS_A_CELL) -> float:
    """Return the side, mm, of cubes that hold ``a_cell`` points on average, empty ones not counted."""
    some = large_arrays.every(points, max(1, len(points) // 400_000))
    share = len(some) / len(points)
    spread = float(np.quantile(np.linalg.norm(some - np.median(some, axis=0), axis=1), 0.9))
    size = max(spread, 1e-6) / 1024.0
    while size < spread:
        # The subsample occupies fewer cells than the whole cloud: its mean count is scaled to that of all points.
        mean_count = len(some) / grouped_sums.distinct_count(extraction.packed(extraction.cells_of(some, size)))
        if 1.0 + (mean_count - 1.0) / share >= a_cell:
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


def _seen_from_origin(scan: Scan) -> bool:
    """Return whether the points are consistent with a scanner at the frame's origin (SOCS)."""
    points = large_arrays.every(scan.points, max(1, len(scan.points) // 200_000)) + scan.origin
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
