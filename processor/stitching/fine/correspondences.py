"""Planar pieces shared by several scans, and the moments of each scan's points on them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.distinct_rows import components
from processor.geometry.thinning import thinned
from processor.model import Columns, Floats, Ints
from processor.stitching.coarse import candidate_rotations
from processor.stitching.fine import noise_model
from processor.stitching.planes import extraction, grouped_sums
from processor.stitching.planes.extraction import Planes
from processor.stitching.planes.sampled_patches import facing
from processor.stitching.planes.scan_planes import LIMIT_SIGMAS, Cloud

ON_PIECE, FACE_END = 0, 1  # kinds of blocks
KINDS = 2  # how many of them
LEVELS = 7  # times that cubes may be joined by eight
SAME_COS = float(np.cos(np.radians(8.0)))  # of pieces of one face: noise of small pieces
MOST_NORMALS = 1500  # work: of a sample that shows the main directions
LEAST_POINTS = 6.0  # of a scan on a piece
FLAT_SIGMAS, SLACK_SIGMAS = 1.6, 0.5  # scatter of a merged piece: by the noise across it, and beside that
MOST_SCANS = 4096  # of a key of piece and scan; the equations take far fewer
PRIOR_DOF = 20.0  # with which a piece's points are taken to scatter as the noise model states


@dataclass(frozen=True)
class Blocks(Columns):
    """The points of each scan on each piece: one row for a scan and piece, sorted by piece.

    ``sums`` (b, 10) are moments weighted by 1 / variance, in the frame of the scan's cloud. ``kind`` is ON_PIECE for
    points on the piece, FACE_END for ends of faces that are bounded by the piece.
    """

    piece: Ints
    scan: Ints
    sums: Floats
    count: Floats
    kind: Ints
    pieces: int
    rays: Floats  # (b, 3, 7) moments of rays u and [p; 1; u], weighted alike; 0 if the scanner's position is unknown
    face: Ints  # of the structure that the piece is on; -1: none of several pieces

    @property
    def faces(self) -> int:
        """Number of faces of several pieces."""
        return int(self.face.max(initial=-1)) + 1

    def weighted(self, weight: Floats) -> Blocks:
        """Multiply the weights of the points by those of their rows (b,)."""
        return replace(self, sums=self.sums * weight[:, None], rays=self.rays * weight[:, None, None])

    def shared(self) -> Blocks:
        """Keep the pieces with two or more rows, and renumber them and their faces."""
        _, inverse = np.unique(self.piece, return_inverse=True)
        inverse = inverse.ravel()
        keep = np.bincount(inverse)[inverse] >= 2 if len(inverse) else np.zeros(0, bool)
        _, piece = np.unique(inverse[keep], return_inverse=True)
        piece = piece.ravel()
        face = np.unique(np.append(self.face[keep], -1), return_inverse=True)[1].ravel()[:-1] - 1
        return replace(self.take(keep), piece=piece, pieces=int(piece.max()) + 1 if len(piece) else 0, face=face)


@dataclass(frozen=True)
class CellTable:
    """The cells of all clouds in one table, with the variance of a point across its face."""

    scan: Ints
    sums: Floats
    mean: Floats
    normal: Floats
    variance: Floats
    known: npt.NDArray[np.bool_]  # of each cell: whether the scanner's position is known
    size_mm: float
    limit_mm: float
    slack_mm: float  # of planar pieces, beyond the noise

    def corrected(self, ranges: Floats) -> CellTable:
        """Return the cells if ranges of each scan were too long by ``ranges`` (k, 2): an offset, mm, and a scale."""
        A = np.tile(np.eye(4), (len(self.scan), 1, 1))
        offset, scale = (ranges[self.scan] * self.known[:, None]).T
        A[:, :3, :3] *= (1.0 - scale)[:, None, None]
        A[:, :3] -= offset[:, None, None] * ray_maps(self.mean)
        sums = extraction.transformed(self.sums, A)
        return replace(self, sums=sums, mean=extraction.scatter(sums)[0])


def ray_maps(points: Floats) -> Floats:
    """Return maps (n, 3, 4) from [p; 1] to the unit vector of the ray to p, to first order about each of ``points``."""
    R = np.maximum(np.linalg.norm(points, axis=1), 1.0)[:, None]
    u = points / R
    across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / R[:, :, None]
    return np.concatenate([across, u[:, :, None]], axis=2)


def gather(clouds: list[Cloud]) -> CellTable:
    """Put the cells of all clouds in one table."""
    sigma = max(cloud.sigma_mm for cloud in clouds)
    return CellTable(
        scan=np.repeat(np.arange(len(clouds)), [len(cloud.sums) for cloud in clouds]),
        sums=np.vstack([cloud.sums for cloud in clouds]),
        mean=np.vstack([cloud.mean for cloud in clouds]),
        normal=np.vstack([cloud.normal for cloud in clouds]),
        variance=np.concatenate([noise_model.variances(cloud) for cloud in clouds]),
        known=np.repeat([cloud.has_position for cloud in clouds], [len(cloud.sums) for cloud in clouds]),
        size_mm=max(cloud.cell_mm for cloud in clouds),
        limit_mm=LIMIT_SIGMAS * sigma,
        slack_mm=SLACK_SIGMAS * sigma,
    )


def segment(cells: CellTable, T: Floats, gate_mm: float, ranges: Floats | None = None) -> Blocks:
    """Segment the scans merged by poses T (k, 4, 4) into planar pieces; faces up to about ``gate_mm`` apart are one.

    ``ranges`` (k, 2) are the range errors of scans, offset and scale, that the segmentation is corrected by; those of
    the blocks stay.
    """
    raw, cells = cells, cells if ranges is None else cells.corrected(ranges)
    rows = np.flatnonzero(np.isfinite(T[cells.scan]).all(axis=(1, 2)))
    scan = cells.scan[rows]
    mean = np.einsum("nij,nj->ni", T[scan, :3, :3], cells.mean[rows]) + T[scan, :3, 3]
    normal = np.einsum("nij,nj->ni", T[scan, :3, :3], cells.normal[rows])
    origin = np.median(mean, axis=0)
    world = T[scan].copy()
    world[:, :3, 3] -= origin
    sums = extraction.transformed(cells.sums[rows] / cells.variance[rows][:, None], world)
    piece, _ = extraction.flat_pieces(
        extraction.cells_of(mean - origin, cells.size_mm), sums, cells.size_mm,
        limit_mm=float(np.hypot(cells.slack_mm, gate_mm)), levels=LEVELS, least=2.0 * LEAST_POINTS,
        group=direction_class(normal), counts=cells.sums[rows, 9], limit_sigmas=FLAT_SIGMAS,
    )  # fmt: skip
    # A cell's own plane must be that of the piece: with a wide gate, cubes may hold two faces.
    on = np.flatnonzero(piece >= 0)
    planes = extraction.planes_of(grouped_sums.summed(sums[on], piece[on], int(piece.max(initial=-1)) + 1))
    n = planes.normal[piece[on]]
    off = np.einsum("ni,ni->n", mean[on] - origin - planes.mean[piece[on]], n)
    same = (np.abs(np.einsum("ni,ni->n", n, normal[on])) > SAME_COS) & (
        np.abs(off) < 2.0 * np.hypot(cells.limit_mm, gate_mm)
    )
    return _blocks(raw, T, rows[on[same]], piece[on[same]])


def _blocks(cells: CellTable, T: Floats, rows: Ints, piece: Ints) -> Blocks:
    """Sum cells ``rows`` (m,) by piece (m,) and scan; scans with too few points on a piece are left out."""
    scan = cells.scan[rows]
    _, first, inverse = np.unique(piece * MOST_SCANS + scan, return_index=True, return_inverse=True)
    weighted = _weighted_sums(cells, rows, inverse.ravel(), len(first))
    count: Floats = np.bincount(inverse.ravel(), cells.sums[rows, 9], len(first)).astype(np.float64)
    enough = count >= LEAST_POINTS
    _, number = np.unique(piece[first][enough], return_inverse=True)
    number = number.ravel()
    pieces = int(number.max()) + 1 if len(number) else 0
    excess = _excess(weighted[enough, :10], count[enough], number, pieces)
    weighted = weighted[enough] / excess[number][:, None]
    sums = weighted[:, :10]
    of_scan = scan[first][enough]
    world = grouped_sums.summed(extraction.transformed(sums, T[of_scan]), number, pieces)
    return Blocks(
        piece=number, scan=of_scan, sums=sums, count=count[enough], kind=np.full(len(number), ON_PIECE), pieces=pieces,
        rays=weighted[:, 10:].reshape(-1, 3, 7), face=_faces(extraction.planes_of(world), cells)[number],
    )  # fmt: skip


def _weighted_sums(cells: CellTable, rows: Ints, group: Ints, count: int) -> Floats:
    """Sum the weighted moments of cells ``rows`` (m,), and those of their rays, by group (m,): (count, 31)."""
    found = np.zeros((count, 31))
    for first in range(0, len(rows), extraction.ROWS):
        own = rows[first : first + extraction.ROWS]
        sums = cells.sums[own] / cells.variance[own][:, None]
        to_ray = ray_maps(cells.mean[own]) * cells.known[own, None, None]
        rays = to_ray @ extraction.square(sums)
        rays = np.concatenate([rays, rays @ to_ray.transpose(0, 2, 1)], axis=2).reshape(len(own), 21)
        grouped_sums.add_rows(np.hstack([sums, rays]), group[first : first + extraction.ROWS], found)
    return found


def _faces(planes: Planes, cells: CellTable) -> Ints:
    """Return the number (p,) of the face that each piece is a part of: pieces of one plane that touch; -1 if alone."""
    p, n = len(planes.mean), planes.normal
    face = np.full(p, -1, np.int64)
    if not p:
        return face
    reach = np.sqrt(3.0 * planes.variance[:, 1:].sum(axis=1)) + cells.size_mm
    near = cKDTree(planes.mean).query_ball_point(planes.mean, 2.0 * reach)  # all that are no larger
    a, b = np.repeat(np.arange(p), [len(row) for row in near]), np.concatenate(near).astype(np.int64)
    way = planes.mean[b] - planes.mean[a]
    one = (
        (np.linalg.norm(way, axis=1) < reach[a] + reach[b])
        & (np.abs(np.einsum("pi,pi->p", n[a], n[b])) > SAME_COS)
        & (np.abs(np.einsum("pi,pi->p", n[a], way)) < cells.limit_mm)
        & (np.abs(np.einsum("pi,pi->p", n[b], way)) < cells.limit_mm)
    )
    joined = components(p, a[one], b[one])
    several = np.bincount(joined)[joined] > 1
    face[several] = np.unique(joined[several], return_inverse=True)[1]
    return face


def _excess(weighted: Floats, count: Floats, piece: Ints, pieces: int) -> Floats:
    """Return the variance (pieces,) of the points about the planes of their scans, by that of the noise; at least 1.

    Rough ground, corroded steel and grazing rays scatter by more than the noise model has it. Taken as being as good
    as the rest, such pieces would have too much weight, and the poses too small a covariance.
    """
    planes = extraction.planes_of(weighted)
    dof = np.bincount(piece, count - 3.0, pieces)
    square = np.bincount(piece, planes.variance[:, 0] * planes.count, pieces)
    excess: Floats = np.maximum((square + PRIOR_DOF) / (dof + PRIOR_DOF), 1.0)
    return excess


def direction_class(normals: Floats) -> Ints:
    """Classify normals (n, 3) by direction: the structure's modes first, so that no class border runs through one."""
    axes, _ = candidate_rotations.normal_modes(thinned(normals, MOST_NORMALS))
    group = candidate_rotations.MOST_MODES + facing(normals)
    if len(axes):
        cosine = normals @ axes.T
        nearest = np.argmax(cosine, axis=1)
        near = np.take_along_axis(cosine, nearest[:, None], axis=1)[:, 0] > candidate_rotations.SEPARATION_COS
        group[near] = nearest[near]
    return group
