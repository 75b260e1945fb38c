"""Ends of one scan's faces held against the faces of others that bound them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.model import Floats, Ints
from processor.stitching.fine.bundle_adjustment import Solution
from processor.stitching.fine.correspondences import Blocks
from processor.stitching.planes import extraction, hashing
from processor.stitching.planes.scan_planes import Cloud

BEHIND_COS = -0.03  # a face looks away from the scanner
ACROSS_COS = 0.5  # of the way from ray to ray, to the face's normal
SQUARE_COS = 0.85  # the two faces meet at an angle
NEIGHBOURS = 12
ONE_FACE_MM = 10.0  # planes of pieces of one face differ by less where an end is
REACH = 1.9  # of a piece: its half width by its standard deviation, with a little to spare
LEAST_MM = 1.0  # standard deviation of an end, however close the rays
INSIDE = 0.75  # of the width between two rays, half of it to either side and half as much again
MOST_NODES_MM = 4000.0
UNIFORM = 1.0 / 12.0  # variance of a place anywhere in a gap, in gaps
RUN_JUMP = 0.1  # gaps: ends of one run are no farther apart
HARMONICS = 16  # of the pattern that an edge makes with the scanner's rows and columns

LOOSE_MM = 1.0  # standard deviation of a motion that faces alone do not tell
LEVER_MM = 1e4  # a turn counts by what it moves so far off
SHIFT_STEP_MM = 2.0
SLACK_MM = 3.0
MOST_LOOSE = 12


@dataclass(frozen=True)
class Matches:
    """Ends (n, 3) of scans (n,), in their clouds' frames, on pieces (n,) that bound them.

    ``off`` (n,) is how far beyond the piece each lies, ``width`` (n,) the room between its two rays, both across the
    piece; ``normal`` (n, 3) the piece's; ``gap`` and ``edge`` (n,) as of :class:`Ends`.
    """

    piece: Ints
    scan: Ints
    points: Floats
    off: Floats
    width: Floats
    normal: Floats
    gap: Ints
    edge: Ints


def matched(clouds: list[Cloud], blocks: Blocks, T: Floats, gate_mm: float, clear: bool = False) -> Matches:
    """Find the pieces that bound ends of faces.

    A piece bounds an end where it looks away from the end's scanner, stands across, and passes within ``gate_mm`` of
    where the two rays leave room. ``clear`` leaves out ends that two faces, one behind the other as a flange's and the
    web's, may bound: the nearer one taken, the ends of a flange would seem to lie outside of it. Whether two are within
    a gap's width of each other does not depend on where the rays happened to pass, so that what is left is not biased.
    """
    world = extraction.moved(blocks.sums, T[blocks.scan])
    planes = extraction.planes_of(hashing.summed(world, blocks.piece, blocks.pieces))
    # A piece looks at the scanners that saw it; all of a piece see the same side.
    first = np.unique(blocks.piece, return_index=True)[1]
    towards = np.einsum("ni,ni->n", planes.normal, T[blocks.scan[first], :3, 3] - planes.mean)
    normal = planes.normal * np.where(towards < 0.0, -1.0, 1.0)[:, None]
    half = REACH * np.sqrt(planes.variance[:, 1:]) + 2.0 * clouds[0].cell_mm
    found: list[tuple[Ints, Ints, Floats, Floats, Floats, Floats, Ints, Ints]] = []
    for s, cloud in enumerate(clouds):
        if not len(cloud.ends.points) or not np.isfinite(T[s]).all():
            continue
        look = T[s, :3, 3] - planes.mean
        away = np.flatnonzero(np.einsum("ni,ni->n", look, normal) < BEHIND_COS * np.linalg.norm(look, axis=1))
        if not len(away):
            continue
        points = cloud.ends.points @ T[s, :3, :3].T + T[s, :3, 3]
        across = cloud.ends.across @ T[s, :3, :3].T
        faces = cloud.ends.normals @ T[s, :3, :3].T
        k = min(NEIGHBOURS, len(away))
        distance, index = cKDTree(planes.mean[away]).query(points, k=k, distance_upper_bound=MOST_NODES_MM)
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
            apart = np.abs(off - np.take_along_axis(off, best, axis=1))
            room = np.take_along_axis(width, best, axis=1) + 2.0 * gate_mm
            good &= ~(fits & (apart > ONE_FACE_MM) & (apart < room)).any(axis=1)
        rows, best = np.flatnonzero(good), best[:, 0]
        piece = q[rows, best[rows]]
        found.append(
            (piece, np.full(len(rows), s), cloud.ends.points[rows], off[rows, best[rows]], width[rows, best[rows]],
             normal[piece], cloud.ends.gap[rows], cloud.ends.edge[rows])
        )  # fmt: skip
    if not found:
        none = np.empty(0, np.int64)
        return Matches(none, none, np.empty((0, 3)), np.empty(0), np.empty(0), np.empty((0, 3)), none, none)
    return Matches(*(np.concatenate([one[m] for one in found]) for m in range(8)))


def variance(ends: Matches) -> Floats:
    """Variance (n,), mm^2, that each end is weighed by: that of its run's mean, times the ends of the run.

    An end is anywhere in its gap, of variance 1/12 in gaps. But an edge along the scanner's rows or columns, as a post
    is, lies at the same part of one gap all its way: its many ends tell no more than one. What the ends of a run do not
    scatter by within the gap, of the 1/12, they have in common. One that crosses rows and columns in step, as at 45
    degrees, lies at the same part of each gap: see :func:`in_step`. What says more is taken.
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
    found: Floats = ends.width**2 * np.maximum((count * of_mean)[run], in_step(share, edge.ravel()))
    return found


def in_step(share: Floats, edge: Ints) -> Floats:
    """Variance (n,), in gaps^2, of the mean of an edge's ends, times their number: those at shares (n,) of their gaps.

    Were the edge moved, all shares would move alike and begin anew at the gap's other end. Over all such moves, two
    ends whose shares differ by d have the covariance 1/12 - d (1 - d) / 2, which is the sum over k of
    cos(2 pi k d) / (2 pi^2 k^2). Ends anywhere in their gaps come to 1/12 each, all at one place to 1/12 together.
    """
    count = np.bincount(edge).astype(float)
    total = np.zeros(len(count))
    for k in range(1, HARMONICS + 1):
        turn = 2.0 * np.pi * k * share
        total += (np.bincount(edge, np.cos(turn)) ** 2 + np.bincount(edge, np.sin(turn)) ** 2) / (k * k)
    found: Floats = np.maximum(total / (2.0 * np.pi**2 * count), UNIFORM)[edge]
    return found


def bounded(clouds: list[Cloud], blocks: Blocks, T: Floats, gate_mm: float) -> Blocks:
    """Add the ends of faces to the pieces that bound them, as blocks of kind 1; see :func:`matched`."""
    if not blocks.pieces:
        return blocks
    ends = matched(clouds, blocks, T, gate_mm, clear=True)
    if not len(ends.piece):
        return blocks
    weight = 1.0 / (variance(ends) + LEAST_MM**2)
    key, inverse = np.unique(ends.piece * len(T) + ends.scan, return_inverse=True)
    inverse = inverse.ravel()
    sums = hashing.summed(extraction.sums_of(ends.points) * weight[:, None], inverse, len(key))
    piece = np.concatenate([blocks.piece, key // len(T)])
    order = np.argsort(piece, kind="stable")
    return Blocks(
        piece[order],
        np.concatenate([blocks.scan, key % len(T)])[order],
        np.vstack([blocks.sums, sums])[order],
        np.concatenate([blocks.count, np.bincount(inverse).astype(float)])[order],
        np.concatenate([blocks.kind, np.ones(len(key), np.int64)])[order],
        blocks.pieces,
    )


def settled(clouds: list[Cloud], blocks: Blocks, faces: Solution, reach_mm: float) -> Floats:
    """Move poses along what faces alone do not tell, to where most ends agree; returns T (k, 4, 4).

    ``faces`` is an adjustment without ends. Along each of its loose motions all shifts up to ``reach_mm`` are tried:
    the right one has every true end between its two rays, while ends that are matched wrongly agree on nothing.
    """
    T: Floats = faces.T.copy()
    k = len(T)
    scale = np.tile([LEVER_MM] * 3 + [1.0] * 3, k)
    known: npt.NDArray[np.bool_] = np.asarray(np.isfinite(faces.covariance).all(axis=1))
    C = np.where(known[:, None] & known[None], faces.covariance, 0.0) * scale[:, None] * scale[None]
    value, vector = np.linalg.eigh(C)
    loose = [m for m in range(6 * k - 1, -1, -1) if value[m] > LOOSE_MM**2][:MOST_LOOSE]
    first = np.full(blocks.pieces, -1, np.int64)
    heaviest = np.argsort(blocks.sums[:, 9], kind="stable")
    first[blocks.piece[heaviest]] = blocks.scan[heaviest]  # the last written counts: the heaviest
    for m in loose:
        ends = matched(clouds, blocks, T, reach_mm)
        if not len(ends.piece):
            return T
        motion = (vector[:, m] / scale).reshape(k, 6)
        largest = np.abs(vector[:, m].reshape(k, 6)[:, 3:]).max()
        if largest < 1e-6:
            continue
        motion = motion / largest  # mm of the scan that moves most
        at = np.einsum("nij,nj->ni", T[ends.scan, :3, :3], ends.points) + T[ends.scan, :3, 3]
        rate = np.einsum(
            "ni,ni->n", ends.normal, _moved(motion, T, ends.scan, at) - _moved(motion, T, first[ends.piece], at)
        )
        tell = np.abs(rate) > 0.1
        if tell.sum() < NEIGHBOURS:
            continue
        off, rate, room = ends.off[tell], rate[tell], 0.5 * ends.width[tell] + SLACK_MM
        shifts = np.arange(-reach_mm, reach_mm + SHIFT_STEP_MM, SHIFT_STEP_MM)
        held = np.array([((np.abs(off + rate * shift) < room) / room).sum() for shift in shifts])
        good = np.flatnonzero(held > 0.98 * held.max())
        step = float(shifts[good].mean()) if np.ptp(good) < len(shifts) // 10 else float(shifts[np.argmax(held)])
        for s in range(k):
            T[s, :3, :3] = rigid.rotation_from_vector(step * motion[s, :3]) @ T[s, :3, :3]
            T[s, :3, 3] += step * motion[s, 3:]
    return T


def _moved(motion: Floats, T: Floats, scan: Ints, at: Floats) -> Floats:
    """Return how points ``at`` (n, 3) of scans (n,) move with a motion (k, 6) of the scans about their own origins."""
    found: Floats = np.cross(motion[scan, :3], at - T[scan, :3, 3]) + motion[scan, 3:]
    return found
