"""Edge constraints: ends of one scan's faces on the pieces of other scans that bound these faces."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.model import Columns, Floats, Ints
from processor.stitching.fine.bundle_adjustment import Solution
from processor.stitching.fine.correspondences import FACE_END, Blocks
from processor.stitching.planes import extraction, grouped_sums
from processor.stitching.planes.extraction import Planes
from processor.stitching.planes.scan_planes import Cloud

BEHIND_COS = -0.03  # a piece faces away from the scanner
ACROSS_COS = 0.5  # between the step from ray to ray and the piece's normal
SQUARE_COS = 0.85  # the two faces meet at an angle
NEIGHBOURS = 12  # chosen: pieces looked at near an end, and ends at least that must see a motion
ONE_FACE_MM = 10.0  # planes of two pieces of one face differ by less at an end
REACH = 1.9  # half width of a piece by its standard deviation, with a margin
LEAST_MM = 1.0  # standard deviation of an end, however close the rays
INSIDE = 0.75  # of the width between two rays: half of it on either side, and half as much again
MOST_DISTANCE_MM = 4000.0  # of a piece's centre from an end
UNIFORM = 1.0 / 12.0  # variance of a uniform position in a gap, in gaps squared
RUN_JUMP = 0.1  # gaps: consecutive ends of one run are no farther apart
HARMONICS = 16  # of the pattern that an edge makes with the scanner's rows and columns

LOOSE_MM = 1.0  # standard deviation of a motion that faces alone do not determine
LEVER_MM = 1e4  # a rotation counts as the shift at this distance
SHIFT_STEP_MM = 2.0  # of shifts tried: less than the room of an end
SLACK_MM = 3.0  # chosen: of an end's room: noise and edges that are not sharp add to the gap of rays
MOST_LOOSE = 12  # work: motions, each of which costs a search for ends
LEAST_RATE = 0.1  # shift of an end across its piece, by the size of the motion


@dataclass(frozen=True)
class Matches(Columns):
    """Ends (n, 3) of scans (n,), in their clouds' frames, on pieces (n,) that bound them.

    ``off`` (n,) is how far beyond the piece each lies, ``width`` (n,) the distance between its two rays, both across
    the piece; ``normal`` (n, 3) is that of the piece; ``gap`` and ``edge`` (n,) are those of :class:`Ends`.
    """

    piece: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    scan: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    points: Floats = field(default_factory=lambda: np.empty((0, 3)))
    off: Floats = field(default_factory=lambda: np.empty(0))
    width: Floats = field(default_factory=lambda: np.empty(0))
    normal: Floats = field(default_factory=lambda: np.empty((0, 3)))
    gap: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    edge: Ints = field(default_factory=lambda: np.empty(0, np.int64))


def with_ends(clouds: list[Cloud], blocks: Blocks, T: Floats, gate_mm: float) -> Blocks:
    """Add the ends of faces to the pieces that bound them, as blocks of kind FACE_END; see :func:`match`."""
    if not blocks.pieces:
        return blocks
    ends = match(clouds, blocks, T, gate_mm, clear=True)
    if not len(ends.piece):
        return blocks
    weight = 1.0 / (variance(ends) + LEAST_MM**2)
    key, inverse = np.unique(ends.piece * len(T) + ends.scan, return_inverse=True)
    inverse = inverse.ravel()
    sums = grouped_sums.summed(extraction.sums_of(ends.points) * weight[:, None], inverse, len(key))
    u = ends.points / np.linalg.norm(ends.points, axis=1)[:, None]
    y = np.hstack([ends.points, np.ones((len(u), 1)), u])
    rays = grouped_sums.summed((weight[:, None, None] * u[:, :, None] * y[:, None]).reshape(-1, 21), inverse, len(key))
    piece, scan = np.divmod(key, len(T))
    of_ends = Blocks(
        piece=piece, scan=scan, sums=sums, count=np.bincount(inverse).astype(float), kind=np.full(len(key), FACE_END),
        pieces=blocks.pieces, rays=rays.reshape(-1, 3, 7), face=np.full(len(key), -1),
    )  # fmt: skip
    both = Blocks.concat([blocks, of_ends])
    return both.take(np.argsort(both.piece, kind="stable"))


def match(clouds: list[Cloud], blocks: Blocks, T: Floats, gate_mm: float, clear: bool = False) -> Matches:
    """Find the pieces that bound ends of faces.

    A piece bounds an end if it faces away from the end's scanner, stands across the face, and passes within ``gate_mm``
    of the interval between the two rays. ``clear`` rejects ends that two faces one behind the other may bound, such as
    those of a flange and the web: with the nearer one taken, ends of a flange would seem to lie outside of it. Whether
    two faces are within a gap's width of each other does not depend on where the rays passed, so that this selection
    introduces no bias.
    """
    world = extraction.transformed(blocks.sums, T[blocks.scan])
    planes = extraction.planes_of(grouped_sums.summed(world, blocks.piece, blocks.pieces))
    # A piece faces the scanners that saw it; all of them see the same side.
    first = np.unique(blocks.piece, return_index=True)[1]
    towards = np.einsum("ni,ni->n", planes.normal, T[blocks.scan[first], :3, 3] - planes.mean)
    normal = planes.normal * np.where(towards < 0.0, -1.0, 1.0)[:, None]
    half = REACH * np.sqrt(planes.variance[:, 1:]) + 2.0 * clouds[0].cell_mm
    parts = list[Matches]()
    for s, cloud in enumerate(clouds):
        if not len(cloud.ends.points) or not np.isfinite(T[s]).all():
            continue
        look = T[s, :3, 3] - planes.mean
        away = np.flatnonzero(np.einsum("ni,ni->n", look, normal) < BEHIND_COS * np.linalg.norm(look, axis=1))
        if len(away):
            rows, piece, off, width = _match_scan(cloud, T[s], planes, normal, half, away, gate_mm, clear)
            parts.append(
                Matches(
                    piece=piece, scan=np.full(len(rows), s), points=cloud.ends.points[rows], off=off, width=width,
                    normal=normal[piece], gap=cloud.ends.gap[rows], edge=cloud.ends.edge[rows],
                )
            )  # fmt: skip
    return Matches.concat(parts)


def _match_scan(
    cloud: Cloud, T: Floats, planes: Planes, normal: Floats, half: Floats, away: Ints, gate_mm: float, clear: bool
) -> tuple[Ints, Ints, Floats, Floats]:
    """Match the ends of one scan at its pose T (4, 4) to the pieces ``away``, which face away from it.

    Returns rows of ends (m,), pieces (m,), and the distances and widths (m,) across these.
    """
    points = cloud.ends.points @ T[:3, :3].T + T[:3, 3]
    across = cloud.ends.across @ T[:3, :3].T
    faces = cloud.ends.normals @ T[:3, :3].T
    k = min(NEIGHBOURS, len(away))
    distance, index = cKDTree(planes.mean[away]).query(points, k=k, distance_upper_bound=MOST_DISTANCE_MM)
    distance, index = distance.reshape(len(points), k), index.reshape(len(points), k)
    q = away[np.minimum(index, len(away) - 1)]
    y = points[:, None] - planes.mean[q]
    off = np.einsum("nki,nki->nk", y, normal[q])
    width = np.einsum("ni,nki->nk", across, normal[q])
    length = np.linalg.norm(across, axis=1)[:, None]
    fits = (
        np.isfinite(distance)
        & (width > ACROSS_COS * length)
        & (np.abs(np.einsum("ni,nki->nk", faces, normal[q])) < SQUARE_COS)
        & (np.abs(np.einsum("nki,nki->nk", y, planes.axes[q, :, 1])) < half[q, 0])
        & (np.abs(np.einsum("nki,nki->nk", y, planes.axes[q, :, 2])) < half[q, 1])
    )
    cost = np.where(fits & (np.abs(off) < INSIDE * width + gate_mm), np.abs(off), np.inf)
    best = np.argmin(cost, axis=1)[:, None]
    good = np.isfinite(np.take_along_axis(cost, best, axis=1)[:, 0])
    if clear:
        spacing = np.abs(off - np.take_along_axis(off, best, axis=1))
        room = np.take_along_axis(width, best, axis=1) + 2.0 * gate_mm
        good &= ~(fits & (spacing > ONE_FACE_MM) & (spacing < room)).any(axis=1)
    rows, best = np.flatnonzero(good), best[:, 0]
    return rows, q[rows, best[rows]], off[rows, best[rows]], width[rows, best[rows]]


def variance(ends: Matches) -> Floats:
    """Return the variance (n,), mm^2, by which each end is weighted: that of its run's mean, times the run's length.

    The position of an end in its gap is uniform, with variance 1/12 in gaps squared. But an edge along the scanner's
    rows or columns, such as a post's, lies at the same position in one gap all the way: its many ends carry the
    information of one. The part of the 1/12 that is missing in the scatter of a run is common to its ends. An edge that
    crosses rows and columns in step, as at 45 degrees, lies at the same position in each gap: see :func:`in_step`. The
    larger of the two is used.
    """
    share = ends.off / np.maximum(ends.width, 1e-9)
    order = np.lexsort([share, ends.gap, ends.scan])
    same = (
        (np.diff(ends.scan[order]) == 0) & (np.diff(ends.gap[order]) == 0) & (np.abs(np.diff(share[order])) < RUN_JUMP)
    )
    run = np.empty(len(order), np.int64)
    run[order] = np.cumsum(np.concatenate([[0], ~same]))
    count = np.bincount(run).astype(float)
    mean = np.bincount(run, share) / count
    scatter = np.bincount(run, (share - mean[run]) ** 2) / np.maximum(count - 1.0, 1.0)
    of_mean = np.maximum(UNIFORM - scatter, UNIFORM / count)
    key = np.stack([ends.scan, ends.piece, ends.edge])
    _, edge = np.unique(key, axis=1, return_inverse=True)
    weighted: Floats = ends.width**2 * np.maximum((count * of_mean)[run], in_step(share, edge.ravel()))
    return weighted


def in_step(share: Floats, edge: Ints) -> Floats:
    """Return the variance (n,), in gaps squared, of the mean of an edge's ends, times their number.

    ``share`` (n,) is the position of each end in its gap. If the edge moved, all positions would change alike and
    wrap around at the end of the gap. Over all such motions two ends at positions that differ by d have the covariance
    1/12 - d (1 - d) / 2, the sum over k of cos(2 pi k d) / (2 pi^2 k^2). For ends at uniform positions this gives 1/12
    each, for ends all at one position 1/12 together.
    """
    count = np.bincount(edge).astype(float)
    total = np.zeros(len(count))
    for k in range(1, HARMONICS + 1):
        turn = 2.0 * np.pi * k * share
        total += (np.bincount(edge, np.cos(turn)) ** 2 + np.bincount(edge, np.sin(turn)) ** 2) / (k * k)
    scaled: Floats = np.maximum(total / (2.0 * np.pi**2 * count), UNIFORM)[edge]
    return scaled


def resolve_loose_motions(clouds: list[Cloud], blocks: Blocks, faces: Solution, reach_mm: float) -> Floats:
    """Shift poses along motions that faces alone do not determine, to where most ends agree; returns T (k, 4, 4).

    ``faces`` is an adjustment without ends. Along each of its loose motions all shifts up to ``reach_mm`` are tried.
    At the right one every correctly matched end lies between its two rays; wrongly matched ends agree on no shift.
    """
    T = faces.T
    heaviest = np.full(blocks.pieces, -1, np.int64)  # scan with the largest weight on each piece
    order = np.argsort(blocks.sums[:, 9], kind="stable")
    heaviest[blocks.piece[order]] = blocks.scan[order]  # the last one written remains
    for motion in _loose_motions(faces):
        ends = match(clouds, blocks, T, reach_mm)
        if not len(ends.piece):
            return T
        at = np.einsum("nij,nj->ni", T[ends.scan, :3, :3], ends.points) + T[ends.scan, :3, 3]
        relative = _velocity(motion, T, ends.scan, at) - _velocity(motion, T, heaviest[ends.piece], at)
        rate = np.einsum("ni,ni->n", ends.normal, relative)
        sensitive = np.abs(rate) > LEAST_RATE
        if sensitive.sum() < NEIGHBOURS:
            continue
        # The shift with the most ends between their rays; the middle of the shifts that are almost as good
        off, room = ends.off[sensitive], 0.5 * ends.width[sensitive] + SLACK_MM
        speed = rate[sensitive]
        shifts = np.arange(-reach_mm, reach_mm + SHIFT_STEP_MM, SHIFT_STEP_MM)
        support = np.array([((np.abs(off + speed * shift) < room) / room).sum() for shift in shifts])
        good = np.flatnonzero(support > 0.98 * support.max())
        step = float(shifts[good].mean()) if np.ptp(good) < len(shifts) // 10 else float(shifts[np.argmax(support)])
        T = rigid.moved_about_own_origins(T, step * motion)
    return T


def _loose_motions(faces: Solution) -> list[Floats]:
    """Return motions (k, 6) with a standard deviation over LOOSE_MM, the largest first; their largest shift is 1."""
    k = len(faces.T)
    scale = np.tile([LEVER_MM] * 3 + [1.0] * 3, k)
    known: npt.NDArray[np.bool_] = np.asarray(np.isfinite(faces.covariance).all(axis=1))
    C = np.where(known[:, None] & known[None], faces.covariance, 0.0) * scale[:, None] * scale[None]
    value, vector = np.linalg.eigh(C)
    loose = [m for m in range(6 * k - 1, -1, -1) if value[m] > LOOSE_MM**2][:MOST_LOOSE]
    motions = []
    for m in loose:
        largest = np.abs(vector[:, m].reshape(k, 6)[:, 3:]).max()
        if largest >= 1e-6:
            motions.append((vector[:, m] / scale).reshape(k, 6) / largest)
    return motions


def _velocity(motion: Floats, T: Floats, scan: Ints, at: Floats) -> Floats:
    """Return the velocity (n, 3) of points ``at`` (n, 3) of scans (n,) under a motion (k, 6) about scans' origins."""
    velocity: Floats = np.cross(motion[scan, :3], at - T[scan, :3, 3]) + motion[scan, 3:]
    return velocity
