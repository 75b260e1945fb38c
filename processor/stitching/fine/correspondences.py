"""Flat pieces that several scans share, and the sums of each scan's points on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.geometry.neighbors import thinned
from processor.model import Floats, Ints
from processor.stitching.coarse import rotations
from processor.stitching.planes import extraction, hashing
from processor.stitching.planes.samples import facing
from processor.stitching.planes.scan_planes import LIMIT_SIGMAS, Cloud

LEVELS = 7
SAME_COS = float(np.cos(np.radians(8.0)))
MOST_NORMALS = 1500
LEAST_POINTS = 6.0  # of a scan on a piece
ACROSS_SHARES = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # of the noise that does not run along the ray
FLAT_SIGMAS, SLACK_SIGMAS = 1.6, 0.5  # scatter of a piece of all scans: by the noise across it, and beside that
LEAST_WEIGHT_SHARE = 0.05  # noise across a face seen at grazing incidence, of the range noise


@dataclass(frozen=True)
class Blocks:
    """What each scan saw of each piece: rows sorted by piece.

    ``sums`` (b, 10) are weighted by 1 / variance, in the scan's cloud's frame; ``kind`` 0 = points on the piece, 1 =
    ends of faces that the piece bounds.
    """

    piece: Ints
    scan: Ints
    sums: Floats
    count: Floats
    kind: Ints
    pieces: int

    def only(self, scans: tuple[int, ...]) -> Blocks:
        """Keep the rows of some scans, on pieces that two or more of them share."""
        row = np.isin(self.scan, scans)
        return shared(Blocks(self.piece[row], self.scan[row], self.sums[row], self.count[row], self.kind[row], 0))


def noise(cloud: Cloud) -> tuple[float, float]:
    """Find variances (across the face, along the ray), mm^2, of the scatter a + b cos^2(incidence) of a cloud's pieces.

    By medians: pieces that are not quite flat are no noise.
    """
    free = cloud.planes.count - 3.0
    keep = free >= 10.0
    v = cloud.planes.variance[keep, 0] * cloud.planes.count[keep] / free[keep]
    c2 = incidence_cos(cloud.planes.mean[keep], cloud.planes.normal[keep], cloud.has_position) ** 2
    if len(v) < 10 or not cloud.has_position:
        return 0.0, max(float(np.median(v)) if len(v) else cloud.sigma_mm**2, 1e-8)
    best = (np.inf, 0.0, 1.0)
    for share in ACROSS_SHARES:
        model = share + (1.0 - share) * c2 + LEAST_WEIGHT_SHARE**2
        size = float(np.median(v / model))
        spread = float(np.median(np.abs(np.log(np.maximum(v, 1e-12) / max(size, 1e-12) / model))))
        best = min(best, (spread, share, size))
    return best[1] * best[2], max((1.0 - best[1]) * best[2], 1e-10)


def incidence_cos(points: Floats, normals: Floats, known: bool) -> Floats:
    """Cosine (n,) between rays from the origin and faces; 1 where the scanner's place is not known."""
    if not known:
        return np.ones(len(points))
    R = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    found: Floats = np.abs(np.einsum("ni,ni->n", points, normals)) / R
    return found


@dataclass(frozen=True)
class Gathered:
    """The cells of all clouds in one table, with the variance of a point across its face."""

    scan: Ints
    sums: Floats
    mean: Floats
    normal: Floats
    variance: Floats
    size_mm: float
    limit_mm: float
    slack_mm: float  # of flat pieces, beyond the noise


def gather(clouds: list[Cloud]) -> Gathered:
    """Put the cells of all clouds in one table."""
    variance = []
    for cloud in clouds:
        a, b = noise(cloud)
        c2 = incidence_cos(cloud.cells.mean, cloud.normal, cloud.has_position) ** 2
        variance.append(np.maximum(a + b * c2, (LEAST_WEIGHT_SHARE**2) * (a + b)))
    return Gathered(
        np.repeat(np.arange(len(clouds)), [len(c.sums) for c in clouds]),
        np.vstack([c.sums for c in clouds]),
        np.vstack([c.cells.mean for c in clouds]),
        np.vstack([c.normal for c in clouds]),
        np.concatenate(variance),
        max(c.cell_mm for c in clouds),
        LIMIT_SIGMAS * max(c.sigma_mm for c in clouds),
        SLACK_SIGMAS * max(c.sigma_mm for c in clouds),
    )


def pieces(cells: Gathered, T: Floats, gate_mm: float) -> Blocks:
    """Find the flat pieces of all scans when placed by T (k, 4, 4), to ``gate_mm`` or so."""
    on = np.isfinite(T[cells.scan]).all(axis=(1, 2))
    rows = np.flatnonzero(on)
    scan = cells.scan[rows]
    mean = np.einsum("nij,nj->ni", T[scan, :3, :3], cells.mean[rows]) + T[scan, :3, 3]
    normal = np.einsum("nij,nj->ni", T[scan, :3, :3], cells.normal[rows])
    origin = np.median(mean, axis=0)
    world = T[scan].copy()
    world[:, :3, 3] -= origin
    sums = extraction.moved(cells.sums[rows] / cells.variance[rows][:, None], world)
    where = extraction.cells_of(mean - origin, cells.size_mm)
    limit = float(np.hypot(cells.slack_mm, gate_mm))
    piece, _ = extraction.flat_pieces(
        where, sums, cells.size_mm, limit, LEVELS, 2.0 * LEAST_POINTS, looking(normal), cells.sums[rows, 9], FLAT_SIGMAS
    )
    keep = piece >= 0
    # A cell's own plane must be the piece's: across a wide gate, cubes may hold two faces.
    there = np.flatnonzero(keep)
    planes = extraction.planes_of(hashing.summed(sums[there], piece[there], int(piece.max(initial=-1)) + 1))
    n = planes.normal[piece[there]]
    off = np.einsum("ni,ni->n", mean[there] - origin - planes.mean[piece[there]], n)
    same = (np.abs(np.einsum("ni,ni->n", n, normal[there])) > SAME_COS) & (
        np.abs(off) < 2.0 * np.hypot(cells.limit_mm, gate_mm)
    )
    keep[there[~same]] = False
    rows, scan, piece = rows[keep], scan[keep], piece[keep]
    key = piece * 4096 + scan
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    weighted = hashing.summed(cells.sums[rows] / cells.variance[rows][:, None], inverse.ravel(), len(first))
    count: Floats = np.bincount(inverse.ravel(), cells.sums[rows, 9], len(first)).astype(np.float64)
    enough = count >= LEAST_POINTS
    _, piece = np.unique(piece[first][enough], return_inverse=True)
    piece = piece.ravel()
    return Blocks(piece, scan[first][enough], weighted[enough], count[enough], np.zeros(len(piece), np.int64),
                  int(piece.max()) + 1 if len(piece) else 0)  # fmt: skip


def looking(normals: Floats) -> Ints:
    """Sort normals (n, 3) by the way they look, the structure's main directions first: no border runs through one."""
    axes, _ = rotations.modes(thinned(normals, MOST_NORMALS))
    found = rotations.MOST_MODES + facing(normals)
    if len(axes):
        cosine = normals @ axes.T
        nearest = np.argmax(cosine, axis=1)
        near = np.take_along_axis(cosine, nearest[:, None], axis=1)[:, 0] > rotations.APART_COS
        found[near] = nearest[near]
    return found


def shared(blocks: Blocks) -> Blocks:
    """Keep pieces of two or more scans, and number them anew."""
    _, inverse = np.unique(blocks.piece, return_inverse=True)
    inverse = inverse.ravel()
    keep = np.bincount(inverse)[inverse] >= 2 if len(inverse) else np.zeros(0, bool)
    _, piece = np.unique(inverse[keep], return_inverse=True)
    piece = piece.ravel()
    return Blocks(
        piece, blocks.scan[keep], blocks.sums[keep], blocks.count[keep], blocks.kind[keep],
        int(piece.max()) + 1 if len(piece) else 0,
    )  # fmt: skip


def moved_apart(T: Floats, S: Floats) -> float:
    """How far, mm, the origins of poses (k, 4, 4) moved at most."""
    step = np.linalg.norm(T[:, :3, 3] - S[:, :3, 3], axis=1)
    return float(np.nanmax(step)) if np.isfinite(step).any() else 0.0


def inverted(T: Floats) -> Floats:
    """Invert rigid motions (k, 4, 4)."""
    return np.stack([rigid.invert(one) for one in T])
