"""Adjustment of all scans' poses at once on the flat pieces they share; every piece's plane is an unknown too.

The points enter by their sums alone: distances from a plane are linear in [p; 1], so that 4 x 4 sums give the normal
equations exactly. A piece's plane is eliminated, and so is one offset a scan and piece, of a standard deviation tau
that the misfits between scans tell: what errors of neighbouring points have in common does not average out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import Floats, Ints
from processor.stitching import octree
from processor.stitching.joint import Blocks

HUBER = 2.5
DROPPED = 6.0  # standard deviations of a scan's misfit on a piece
PRIOR_MM, PRIOR_RAD = 1e4, 1.0  # keep what nothing tells where it is
MEDIAN = 0.6745  # of |z|, z normal
KINDS = 2


@dataclass(frozen=True)
class Solution:
    """Poses T_ref_scan (k, 4, 4), their joint covariance (6k, 6k; rad, mm; turns about the scan's own origin).

    ``misfit`` (b,) of each block in standard deviations, ``offset`` (b,) in mm; ``tau`` of each kind, mm.
    """

    T: Floats
    covariance: Floats
    misfit: Floats
    offset: Floats
    tau: tuple[float, ...]
    weight: Floats
    chi2: float
    free: float


def solve(
    blocks: Blocks,
    T: Floats,
    reference: int,
    *,
    iterations: int = 8,
    robust: bool = True,
    tau: tuple[float, ...] | None = None,
    tolerance_mm: float = 1e-4,
) -> Solution:
    """Adjust poses from a start T (k, 4, 4), the reference held; scans without blocks stay, without covariance.

    ``tau`` given is held, else it is found.
    """
    common = np.zeros(KINDS) if tau is None else np.array(tau)
    weight = np.ones(len(blocks.piece))
    for iteration in range(iterations):
        N, g, z, offset, spread = _normal(blocks, T, common, weight)
        common = _tau(blocks, offset, spread, common) if iteration and tau is None else common
        free = _free(blocks, T, reference)
        step = np.zeros(len(g))
        step[free] = -np.linalg.solve(N[np.ix_(free, free)], g[free])
        T = _stepped(T, step.reshape(-1, 6))
        if robust:
            weight = np.where(np.abs(z) > DROPPED, 1e-6, np.minimum(1.0, HUBER / np.maximum(np.abs(z), 1e-9)))
        if iteration > 2 and np.abs(step.reshape(-1, 6)[:, 3:]).max(initial=0.0) < tolerance_mm:
            break
    N, _, z, offset, spread = _normal(blocks, T, common, weight)
    covariance = np.full(N.shape, np.nan)
    free = _free(blocks, T, reference)
    covariance[np.ix_(free, free)] = np.linalg.inv(N[np.ix_(free, free)])
    own = slice(6 * reference, 6 * reference + 6)
    covariance[own], covariance[:, own] = 0.0, 0.0
    inside = weight > 0.5
    return Solution(
        T, covariance, z, offset, tuple(common.tolist()), weight, float((z[inside] ** 2).sum()), float(inside.sum())
    )


def _free(blocks: Blocks, T: Floats, reference: int) -> Ints:
    """Rows (6m,) of the unknowns: six for every scan with blocks but the reference."""
    scans = [s for s in range(len(T)) if s != reference and (blocks.scan == s).any()]
    return (6 * np.array(scans, np.int64)[:, None] + np.arange(6)).ravel()


def _stepped(T: Floats, step: Floats) -> Floats:
    found = T.copy()
    for s in np.flatnonzero(np.abs(step).sum(axis=1) > 0.0):
        R = rigid.rotation_from_vector(step[s, :3])
        found[s, :3, :3] = R @ T[s, :3, :3]
        found[s, :3, 3] = T[s, :3, 3] + step[s, 3:]
    return found


def _normal(blocks: Blocks, T: Floats, tau: Floats, weight: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return normal matrix, gradient, misfits in sd (b,), in mm (b,), and the variances (b,) of these without tau."""
    k = len(T)
    world = T[blocks.scan]
    W = world @ octree.square(blocks.sums) @ world.transpose(0, 2, 1)
    total = octree.summed(octree.triangle(W) * weight[:, None], blocks.piece, blocks.pieces)
    planes = octree.planes_of(total)
    n, c = planes.normal[blocks.piece], planes.mean[blocks.piece]
    W = _shifted(W, c)
    mass = W[:, 3, 3]
    t2 = tau[blocks.kind] ** 2
    # A common offset of the block's points is eliminated.
    e = W[:, :, 3]
    W = (W - (t2 / (1.0 + t2 * mass))[:, None, None] * e[:, :, None] * e[:, None, :]) * weight[:, None, None]
    axes = planes.axes[blocks.piece]
    b = len(mass)
    Lp = np.zeros((b, 3, 4))
    Lp[:, 0, :3], Lp[:, 1, :3], Lp[:, 2, 3] = axes[:, :, 1], axes[:, :, 2], -1.0
    # Turns about the scan's own origin: q = p - o, and n . (w x q) = w . (q x n).
    arm = c - T[blocks.scan, :3, 3]
    Ls = np.zeros((b, 6, 4))
    Ls[:, 0, 1], Ls[:, 0, 2] = n[:, 2], -n[:, 1]
    Ls[:, 1, 0], Ls[:, 1, 2] = -n[:, 2], n[:, 0]
    Ls[:, 2, 0], Ls[:, 2, 1] = n[:, 1], -n[:, 0]
    Ls[:, :3, 3] = np.cross(arm, n)
    Ls[:, 3:, 3] = n
    rho = np.concatenate([n, np.zeros((b, 1))], axis=1)
    LsW, Wr = Ls @ W, np.einsum("bij,bj->bi", W, rho)
    Hss = LsW @ Ls.transpose(0, 2, 1)
    Hsp = LsW @ Lp.transpose(0, 2, 1)
    Hpp = octree.summed((Lp @ W @ Lp.transpose(0, 2, 1)).reshape(b, 9), blocks.piece, blocks.pieces).reshape(-1, 3, 3)
    gs = np.einsum("bij,bj->bi", Ls, Wr)
    gp = octree.summed(np.einsum("bij,bj->bi", Lp, Wr), blocks.piece, blocks.pieces)
    scale = np.einsum("nii->ni", Hpp)
    Hpp = Hpp + 1e-12 * np.maximum(scale, 1e-12)[:, :, None] * np.eye(3)
    inverse = np.linalg.inv(Hpp)
    A = np.zeros((blocks.pieces, k, 6, 3))
    np.add.at(A, (blocks.piece, blocks.scan), Hsp)
    A = A.reshape(blocks.pieces, 6 * k, 3)
    N = np.zeros((k, k, 6, 6))
    np.add.at(N, (blocks.scan, blocks.scan), Hss)
    N = N.transpose(0, 2, 1, 3).reshape(6 * k, 6 * k)
    AI = A @ inverse
    N = N - np.tensordot(AI, A, axes=([0, 2], [0, 2]))
    g = np.zeros((k, 6))
    np.add.at(g, blocks.scan, gs)
    g = g.ravel() - np.einsum("nij,nj->i", AI, gp)
    N += np.diag(np.tile([PRIOR_RAD**-2] * 3 + [PRIOR_MM**-2] * 3, k))
    # Misfits: a block's mean distance from the plane, and how sure that is beside the plane's own uncertainty.
    mean = e[:, :3] / mass[:, None]
    offset = np.einsum("bi,bi->b", mean, n)
    v = np.einsum("bij,bj->bi", Lp, _one(mean))
    leverage = np.einsum("bi,bij,bj->b", v, inverse[blocks.piece], v) * weight / (1.0 / mass + t2)
    share = np.maximum(1.0 - leverage, 0.02)
    z = offset / np.sqrt((1.0 / mass + t2) * share)
    return N, g, z, offset / np.sqrt(share), 1.0 / mass


def _one(points: Floats) -> Floats:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def _shifted(W: Floats, c: Floats) -> Floats:
    """Sums (b, 4, 4) of points less c (b, 3)."""
    S = np.tile(np.eye(4), (len(c), 1, 1))
    S[:, :3, 3] = -c
    return S @ W @ S.transpose(0, 2, 1)


def _tau(blocks: Blocks, offset: Floats, spread: Floats, before: Floats) -> Floats:
    """Standard deviation of the offsets (mm) of each kind beyond what single points' noise explains."""
    found = before.copy()
    for kind in range(KINDS):
        rows = blocks.kind == kind
        if rows.sum() < 10:
            continue
        r2, v = offset[rows] ** 2, spread[rows]
        low, high = 0.0, float(np.sqrt(np.max(r2)))
        if np.median(r2 / v) <= MEDIAN**2:
            found[kind] = 0.0
            continue
        for _ in range(40):
            middle = 0.5 * (low + high)
            if np.median(r2 / (v + middle**2)) > MEDIAN**2:
                low = middle
            else:
                high = middle
        found[kind] = high
    return found
