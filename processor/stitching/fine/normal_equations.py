"""Normal equations of scans' poses and range errors on shared planes, with the planes eliminated.

The points enter by their moments alone: distances from a plane are linear in [p; 1; u], u the unit vector of the ray,
so that 7 x 7 moments give the normal equations exactly. The plane of each piece is eliminated, and so is one offset for
each scan and piece, with a standard deviation tau.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.adjustment.elimination import eliminate
from processor.model import Floats, Ints
from processor.stitching.fine.correspondences import FACE_END, Blocks
from processor.stitching.planes import extraction, grouped_sums
from processor.stitching.planes.extraction import Planes

LEAST_FREE_SHARE = 0.02  # of the variance of a block's misfit: least that its leverage on the plane leaves
RELATIVE_RIDGE = 1e-12  # of a plane's normal matrix: planes that few points determine


@dataclass(frozen=True)
class Equations:
    """Normal equations N (m, m), g (m,), and the misfits (b,) of the blocks.

    The m = 8k + f + d unknowns are the poses of k scans, their range offsets, their scales, and the range errors of f
    faces and of d directions. ``spurious`` (m, m) is the part of N that is due to the uncertainty of the planes'
    normals. ``z`` are misfits in standard deviations, ``offset`` in mm, ``variance`` of the latter without tau.
    """

    N: Floats
    spurious: Floats
    g: Floats
    z: Floats
    offset: Floats
    variance: Floats


def linearize(
    blocks: Blocks, T: Floats, ranges: Floats, tau: Floats, weight: Floats, direction: Ints | None = None
) -> Equations:
    """Build the normal equations at poses T (k, 4, 4) and range errors (2k + f + d,), by weights (b,) of the blocks.

    ``tau`` is the standard deviation of the common offset of a block, by its kind; ``direction`` (b,), 0 to d - 1, the
    one of its scan that a block lies in.
    """
    k = len(T)
    of_face = np.where(blocks.face < 0, len(ranges) - 2 * k, blocks.face)
    columns = np.column_stack(
        [6 * blocks.scan[:, None] + np.arange(6), 6 * k + blocks.scan, 7 * k + blocks.scan, 8 * k + of_face]
        + ([] if direction is None else [8 * k + blocks.faces + direction])
    )
    errors = np.append(ranges, 0.0)[columns[:, 6:] - 6 * k]
    W = in_world(blocks, T, errors[:, 0] + errors[:, 2], errors[:, 1])
    total = grouped_sums.summed(extraction.triangle(W) * weight[:, None], blocks.piece, blocks.pieces)
    planes = extraction.planes_of(total)
    W = _shifted(W, planes.mean[blocks.piece])
    t2 = tau[blocks.kind] ** 2 * unit_variance(blocks)
    by_columns, by_plane = _design_matrices(blocks, T, planes)
    if direction is not None:  # an offset of the ranges, or across the faces where the rays are unknown
        offset = by_columns[:, 6:7].copy()
        offset[~_rays_known(blocks), 0, 3] = 1.0
        by_columns = np.concatenate([by_columns, offset], axis=1)
    # An offset common to a block's points, of variance t2 (b,), is eliminated from the moments (b, 7, 7)
    e, mass = W[:, :, 3], W[:, 3, 3]
    reduced = (W - (t2 / (1.0 + t2 * mass))[:, None, None] * e[:, :, None] * e[:, None, :]) * weight[:, None, None]
    N, g, spurious, inverse = _normal_matrix(
        blocks, planes, reduced, by_columns, by_plane, columns, 6 * k + len(ranges)
    )
    z, offset, variance = _misfits(blocks, planes, W, t2, weight, by_plane, inverse)
    return Equations(N=N, spurious=spurious, g=g, z=z, offset=offset, variance=variance)


def _normal_matrix(
    blocks: Blocks, planes: Planes, W: Floats, Ls: Floats, Lp: Floats, columns: Ints, size: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return N, its spurious part and g of :class:`Equations`, and the inverse (p, 3, 3) of the planes' own block.

    W (b, 7, 7) are the weighted moments about the planes' means; Ls (b, q, 7) and Lp (b, 3, 7) the derivatives by
    the columns and the plane; ``size`` is the number of unknowns. The normal of a plane is not known exactly: if it is
    off, a piece seems to determine shifts along itself as well. This spurious part of N follows from the uncertainty of
    the planes.
    """
    b, n = len(blocks.piece), planes.normal[blocks.piece]
    LsW = Ls @ W
    Wr = np.einsum("bij,bj->bi", W, np.concatenate([n, np.zeros((b, 4))], axis=1))
    Hss = LsW @ Ls.transpose(0, 2, 1)
    LpWLp = (Lp @ W @ Lp.transpose(0, 2, 1)).reshape(b, 9)
    Hpp = grouped_sums.summed(LpWLp, blocks.piece, blocks.pieces).reshape(-1, 3, 3)
    scale = np.einsum("nii->ni", Hpp)
    inverse = np.linalg.inv(Hpp + RELATIVE_RIDGE * np.maximum(scale, RELATIVE_RIDGE)[:, :, None] * np.eye(3))
    # One row and column more than unknowns: the face of blocks that lie on none.
    N, g, spurious = np.zeros((size + 1, size + 1)), np.zeros(size + 1), np.zeros((size + 1, size + 1))
    np.add.at(N, (columns[:, :, None], columns[:, None, :]), Hss)
    np.add.at(g, columns, np.einsum("bij,bj->bi", Ls, Wr))
    Hsp = LsW @ Lp.transpose(0, 2, 1)
    gp = grouped_sums.summed(np.einsum("bij,bj->bi", Lp, Wr), blocks.piece, blocks.pieces)
    piece = np.ascontiguousarray(blocks.piece)
    eliminate(piece, columns, Hsp, inverse, gp, N, g)
    tilt = planes.axes[:, :, 1:] @ inverse[:, :2, :2] @ planes.axes[:, :, 1:].transpose(0, 2, 1)
    along = np.einsum("bi,bij,bj->b", n, Hss[:, 3:6, 3:6], n)
    add_spurious(piece, columns[:, 3], Hsp[:, 3:6], inverse, planes.normal, tilt, along, spurious)
    return N[:size, :size], g[:size], spurious[:size, :size], inverse


def _misfits(
    blocks: Blocks, planes: Planes, W: Floats, t2: Floats, weight: Floats, Lp: Floats, inverse: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the misfits (b,) of :class:`Equations`: in standard deviations, in mm, and the variance without tau.

    A misfit is the mean distance of a block from the plane, W (b, 7, 7) its moments about the plane's mean. The block's
    leverage on the plane reduces its variance.
    """
    mass = W[:, 3, 3]
    mean = W[:, :3, 3] / mass[:, None]
    offset = np.einsum("bi,bi->b", mean, planes.normal[blocks.piece])
    v = np.einsum("bij,bj->bi", Lp[:, :, :4], np.concatenate([mean, np.ones((len(mean), 1))], axis=1))
    leverage = np.einsum("bi,bij,bj->b", v, inverse[blocks.piece], v) * weight / (1.0 / mass + t2)
    free = np.maximum(1.0 - leverage, LEAST_FREE_SHARE)
    return offset / np.sqrt((1.0 / mass + t2) * free), offset / np.sqrt(free), 1.0 / mass


def in_world(blocks: Blocks, T: Floats, error: Floats, scale: Floats) -> Floats:
    """Return the moments (b, 7, 7) of [p; 1; u] at poses T, with ranges R shorter by ``error + scale R``, both (b,)."""
    W = np.empty((len(error), 7, 7))
    W[:, :4, :4], W[:, 4:] = extraction.square(blocks.sums), blocks.rays
    W[:, :4, 4:] = blocks.rays[:, :, :4].transpose(0, 2, 1)
    world = np.zeros_like(W)
    world[:, :4, :4], world[:, 4:, 4:] = T[blocks.scan], T[blocks.scan, :3, :3]
    world[:, :3, 4:] = -error[:, None, None] * world[:, 4:, 4:]
    world[:, :3, :3] *= 1.0 - (scale * _rays_known(blocks))[:, None, None]
    moments: Floats = world @ W @ world.transpose(0, 2, 1)
    return moments


def _rays_known(blocks: Blocks) -> npt.NDArray[np.bool_]:
    """Return whether the rays of each block are known: a range error moves no point of a scanner of unknown place."""
    return np.asarray(np.trace(blocks.rays[:, :, 4:], axis1=1, axis2=2) > 0.0)


def _design_matrices(blocks: Blocks, T: Floats, planes: Planes) -> tuple[Floats, Floats]:
    """Return the derivatives of a point's distance from its plane by its columns (b, 9, 7) and the plane (b, 3, 7).

    They are linear in [p; 1; u], p relative to the mean of the plane, u the unit vector of the ray.
    """
    b = len(blocks.piece)
    n, c, axes = planes.normal[blocks.piece], planes.mean[blocks.piece], planes.axes[blocks.piece]
    Lp = np.zeros((b, 3, 7))
    Lp[:, 0, :3], Lp[:, 1, :3], Lp[:, 2, 3] = axes[:, :, 1], axes[:, :, 2], -1.0
    # Rotations w about the scan's own origin o: q = p - o, and n . (w x q) = w . (q x n).
    arm = c - T[blocks.scan, :3, 3]
    Ls = np.zeros((b, 9, 7))
    Ls[:, 0, 1], Ls[:, 0, 2] = n[:, 2], -n[:, 1]
    Ls[:, 1, 0], Ls[:, 1, 2] = -n[:, 2], n[:, 0]
    Ls[:, 2, 0], Ls[:, 2, 1] = n[:, 1], -n[:, 0]
    Ls[:, :3, 3] = np.cross(arm, n)
    Ls[:, 3:6, 3] = n
    Ls[:, 6, 4:] = -n
    # A scale moves a point along its ray by n . (p + arm) across the plane. Without noise n . p is 0; with it the least
    # squares of the residuals would be sought in scans that are smaller as a whole.
    Ls[:, 7, 3] = -np.einsum("bi,bi->b", n, arm) * _rays_known(blocks)
    Ls[:, 8, 4:] = -n * (blocks.face >= 0)[:, None]
    return Ls, Lp


@njit(cache=True, nogil=True)
def add_spurious(piece, shift, Hsp, inverse, normal, tilt, along, spurious):  # type: ignore[no-untyped-def]
    """Add to ``spurious`` what rows (b,), sorted by piece, seem to determine of shifts by the tilt of their plane.

    The information on the shift (columns ``shift`` (b,) to + 2) along the normal (p, 3), the plane eliminated, is
    spread over the axes by the covariance ``tilt`` (p, 3, 3) of the normal. ``Hsp`` (b, 3, 3) couples shift and plane,
    ``along`` (b,) is the information of a row.
    """
    b = len(piece)
    weighted, pull, start = np.empty(3), np.empty(3), 0
    while start < b:
        p = piece[start]
        end = start
        while end < b and piece[end] == p:
            end += 1
        n0, n1, n2 = normal[p]
        for x in range(start, end):
            for j in range(3):
                for i in range(3):
                    weighted[i] = 0.0
                    for m in range(3):
                        weighted[i] += Hsp[x, i, m] * inverse[p, m, j]
                pull[j] = n0 * weighted[0] + n1 * weighted[1] + n2 * weighted[2]
            for i in range(3):
                for j in range(3):
                    spurious[shift[x] + i, shift[x] + j] += along[x] * tilt[p, i, j]
            for y in range(start, end):
                shared = 0.0
                for m in range(3):
                    shared += pull[m] * (n0 * Hsp[y, 0, m] + n1 * Hsp[y, 1, m] + n2 * Hsp[y, 2, m])
                for i in range(3):
                    for j in range(3):
                        spurious[shift[x] + i, shift[y] + j] -= shared * tilt[p, i, j]
        start = end


def _shifted(W: Floats, c: Floats) -> Floats:
    """Move the origin of moments (b, 7, 7) to c (b, 3)."""
    S = np.tile(np.eye(7), (len(c), 1, 1))
    S[:, :3, 3] = -c
    shifted: Floats = S @ W @ S.transpose(0, 2, 1)
    return shifted


def unit_variance(blocks: Blocks) -> Floats:
    """Return the unit (b,) of tau squared: 1 mm^2 for points, the variance of a single end for ends.

    If an edge runs along the scanner's rows or columns, all its ends have the same error, in shares of a step.
    """
    unit: Floats = np.where(blocks.kind == FACE_END, blocks.count / np.maximum(blocks.sums[:, 9], 1e-300), 1.0)
    return unit
