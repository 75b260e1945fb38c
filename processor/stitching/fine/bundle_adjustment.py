"""Adjustment of all scans' poses at once on the flat pieces they share; every piece's plane is an unknown too.

The points enter by their sums alone: distances from a plane are linear in [p; 1], so that 4 x 4 sums give the normal
equations exactly. A piece's plane is eliminated, and so is one offset a scan and piece, of a standard deviation tau
that the misfits between scans tell: what errors of neighbouring points have in common does not average out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry import rigid
from processor.model import Floats, Ints
from processor.stitching.fine.correspondences import Blocks
from processor.stitching.planes import extraction, hashing

HUBER = 2.5
DROPPED = 6.0  # standard deviations of a scan's misfit on a piece
ASIDE, SETTLED = 1e-3, 8  # a weight below which a piece is left aside; rounds until weights have settled
PRIOR_MM, PRIOR_RAD = 1e4, 1.0  # keep what nothing tells where it is
MEDIAN = 0.6745  # of |z|, z normal
KINDS = 2
EVEN, WIDE_SIGMAS = 3, 0.3  # adjustments at first with pieces of much the same weight, by the noise of a point
LEAST_REAL = 0.01  # share of a direction's strength that is taken as real


@dataclass(frozen=True)
class Solution:
    """Poses T_ref_scan (k, 4, 4), their joint covariance (6k, 6k; rad, mm; turns about the scan's own origin).

    ``misfit`` (b,) of each block in standard deviations, ``offset`` (b,) in mm; ``tau`` of each kind: mm, of ends in
    standard deviations of a single one.
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
    iterations: int = 10,
    robust: bool = True,
    tau: tuple[float, ...] | None = None,
    tolerance_mm: float = 1e-4,
    slack_mm: float = 0.0,
) -> Solution:
    """Adjust poses from a start T (k, 4, 4), the reference held; scans without blocks stay, without covariance.

    ``tau`` given is held, else it is found. ``slack_mm`` is how far off the start may be: no piece is dropped for that.
    """
    common = np.zeros(KINDS) if tau is None else np.array(tau)
    if not len(_free(blocks, T, reference)):
        covariance = np.full((6 * len(T), 6 * len(T)), np.nan)
        covariance[6 * reference : 6 * reference + 6] = covariance[:, 6 * reference : 6 * reference + 6] = 0.0
        none = np.empty(0)
        return Solution(T, covariance, none, none, tuple(common.tolist()), none, 0.0, 0.0)
    weight = np.ones(len(blocks.piece))
    wide = _wide(blocks) if robust and tau is None else np.zeros(KINDS)
    for iteration in range(iterations):
        loose = wide if iteration < EVEN else np.zeros(KINDS)
        N, _, g, z, offset, spread = _normal(blocks, T, np.maximum(common, loose), weight)
        common = _tau(blocks, offset, spread, common) if iteration and tau is None else common
        if iteration == EVEN and wide.any():
            weight = _robust(blocks, _forgiving(z, offset, slack_mm))
            continue
        free = _free(blocks, T, reference)
        step = np.zeros(len(g))
        step[free] = -np.linalg.solve(N[np.ix_(free, free)], g[free])
        T = _stepped(T, step.reshape(-1, 6))
        if robust:
            weight = _robust(blocks, _forgiving(z, offset, slack_mm))
        if iteration > EVEN and np.abs(step.reshape(-1, 6)[:, 3:]).max(initial=0.0) < tolerance_mm:
            break
    N, spurious, _, z, offset, spread = _normal(blocks, T, common, weight)
    covariance = np.full(N.shape, np.nan)
    free = _free(blocks, T, reference)
    covariance[np.ix_(free, free)] = _sandwich(N[np.ix_(free, free)], spurious[np.ix_(free, free)])
    own = slice(6 * reference, 6 * reference + 6)
    covariance[own], covariance[:, own] = 0.0, 0.0
    inside = weight > 0.5
    return Solution(
        T, covariance, z, offset, tuple(common.tolist()), weight, float((z[inside] ** 2).sum()), float(inside.sum())
    )


def weights_at(blocks: Blocks, T: Floats, tau: tuple[float, ...]) -> Floats:
    """Return the weights (b,) that blocks have where poses T (k, 4, 4) are held."""
    weight = np.ones(len(blocks.piece))
    for _ in range(SETTLED):
        weight = _robust(blocks, _normal(blocks, T, np.array(tau), weight)[3])
    return weight


def step_without(
    blocks: Blocks, solution: Solution, reference: int, out: npt.NDArray[np.bool_], almost_none: float
) -> Floats:
    """Return how poses would move (6k,) from a solution if blocks ``out`` (b,) counted for ``almost_none``."""
    weight = np.where(out, almost_none, solution.weight)
    N, _, g, _, _, _ = _normal(blocks, solution.T, np.array(solution.tau), weight)
    free = _free(blocks, solution.T, reference)
    step = np.zeros(len(g))
    step[free] = -np.linalg.solve(N[np.ix_(free, free)], g[free])
    return step


def _wide(blocks: Blocks) -> Floats:
    """Return common offsets (KINDS,) that adjustments begin with: no piece says more than a few of its points do.

    A wall of thousands of points with something leant against it would else be believed before all others.
    """
    points = blocks.kind == 0
    if not points.any():
        return np.zeros(KINDS)
    noise = float(np.median(np.sqrt(blocks.count[points] / np.maximum(blocks.sums[points, 9], 1e-300))))
    return np.array([WIDE_SIGMAS * noise, 0.0])


def _forgiving(z: Floats, offset: Floats, slack_mm: float) -> Floats:
    """Misfits by their standard deviations and a slack: what poses have not yet had the chance to take up is none."""
    found: Floats = offset / np.hypot(offset / np.where(z == 0.0, 1.0, z), slack_mm)
    return found


def _robust(blocks: Blocks, z: Floats) -> Floats:
    """Weights (b,) by misfits; where fewer than two scans of a piece are left, all share the least of the weights.

    One of two scans cannot be told to be the wrong one, and alone it would seem to fit without a misfit.
    """
    weight = np.where(np.abs(z) > DROPPED, 1e-6, np.minimum(1.0, HUBER / np.maximum(np.abs(z), 1e-9)))
    left = np.bincount(blocks.piece, weight > ASIDE, blocks.pieces)
    least = np.ones(blocks.pieces)
    np.minimum.at(least, blocks.piece, weight)
    found: Floats = np.where(left[blocks.piece] < 2, least[blocks.piece], weight)
    return found


def _free(blocks: Blocks, T: Floats, reference: int) -> Ints:
    """Rows (6m,) of the unknowns: six for every scan with blocks but the reference."""
    scans = [s for s in range(len(T)) if s != reference and (blocks.scan == s).any()]
    return (6 * np.array(scans, np.int64)[:, None] + np.arange(6)).ravel()


def _stepped(T: Floats, step: Floats) -> Floats:
    found: Floats = T.copy()
    for s in np.flatnonzero(np.abs(step).sum(axis=1) > 0.0):
        R = rigid.rotation_from_vector(step[s, :3])
        found[s, :3, :3] = R @ T[s, :3, :3]
        found[s, :3, 3] = T[s, :3, 3] + step[s, 3:]
    return found


def _normal(
    blocks: Blocks, T: Floats, tau: Floats, weight: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Return normal matrix, what of it is none, gradient, misfits in sd (b,), in mm, and their variances without tau.

    A plane's normal is not known exactly: where it is off, a piece seems to hold scans along itself as well. How much
    of the normal matrix is made up of that follows from the planes' own uncertainty.
    """
    k = len(T)
    world = T[blocks.scan]
    W = world @ extraction.square(blocks.sums) @ world.transpose(0, 2, 1)
    total = hashing.summed(extraction.triangle(W) * weight[:, None], blocks.piece, blocks.pieces)
    planes = extraction.planes_of(total)
    n, c = planes.normal[blocks.piece], planes.mean[blocks.piece]
    W = _shifted(W, c)
    mass = W[:, 3, 3]
    t2 = tau[blocks.kind] ** 2 * _unit2(blocks)
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
    Hpp = hashing.summed((Lp @ W @ Lp.transpose(0, 2, 1)).reshape(b, 9), blocks.piece, blocks.pieces).reshape(-1, 3, 3)
    gs = np.einsum("bij,bj->bi", Ls, Wr)
    gp = hashing.summed(np.einsum("bij,bj->bi", Lp, Wr), blocks.piece, blocks.pieces)
    scale = np.einsum("nii->ni", Hpp)
    Hpp = Hpp + 1e-12 * np.maximum(scale, 1e-12)[:, :, None] * np.eye(3)
    inverse = np.linalg.inv(Hpp)
    own = np.zeros((k, k, 6, 6))
    np.add.at(own, (blocks.scan, blocks.scan), Hss)
    N: Floats = np.ascontiguousarray(own.transpose(0, 2, 1, 3)).reshape(6 * k, 6 * k)
    gradient = np.zeros((k, 6))
    np.add.at(gradient, blocks.scan, gs)
    g, spurious = gradient.ravel(), np.zeros((6 * k, 6 * k))
    along = np.einsum("bi,bij,bj->b", n, Hss[:, 3:, 3:], n)
    tilt = planes.axes[:, :, 1:] @ inverse[:, :2, :2] @ planes.axes[:, :, 1:].transpose(0, 2, 1)
    eliminate(blocks.piece, blocks.scan, Hsp, inverse, gp, planes.normal, tilt, along, N, g, spurious)
    N += np.diag(np.tile([PRIOR_RAD**-2] * 3 + [PRIOR_MM**-2] * 3, k))
    # Misfits: a block's mean distance from the plane, and how sure that is beside the plane's own uncertainty.
    mean = e[:, :3] / mass[:, None]
    offset = np.einsum("bi,bi->b", mean, n)
    v = np.einsum("bij,bj->bi", Lp, _one(mean))
    leverage = np.einsum("bi,bij,bj->b", v, inverse[blocks.piece], v) * weight / (1.0 / mass + t2)
    share = np.maximum(1.0 - leverage, 0.02)
    z = offset / np.sqrt((1.0 / mass + t2) * share)
    return N, spurious, g, z, offset / np.sqrt(share), 1.0 / mass


def _sandwich(N: Floats, spurious: Floats) -> Floats:
    """Covariance of an estimate whose normal matrix N is in part spurious: more, the more of it is."""
    L = np.linalg.cholesky(N)
    S = np.linalg.solve(L, np.linalg.solve(L, spurious).T)
    share, V = np.linalg.eigh(0.5 * (S + S.T))
    half = np.linalg.solve(L.T, V) / np.maximum(1.0 - share, LEAST_REAL)
    found: Floats = half @ half.T
    return found


def _unit2(blocks: Blocks) -> Floats:
    """Return what the squares (b,) of common offsets are counted in: mm^2, of ends the variance of a single one.

    Where an edge runs along the scanner's rows or columns, all its ends err by the same part of a step.
    """
    found: Floats = np.where(blocks.kind == 1, blocks.count / np.maximum(blocks.sums[:, 9], 1e-300), 1.0)
    return found


def _one(points: Floats) -> Floats:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def _shifted(W: Floats, c: Floats) -> Floats:
    """Move the origin of sums (b, 4, 4) to c (b, 3)."""
    S = np.tile(np.eye(4), (len(c), 1, 1))
    S[:, :3, 3] = -c
    found: Floats = S @ W @ S.transpose(0, 2, 1)
    return found


def _tau(blocks: Blocks, offset: Floats, spread: Floats, before: Floats) -> Floats:
    """Find the standard deviation of offsets, mm, of each kind beyond what single points' noise explains."""
    found: Floats = before.copy()
    unit2 = _unit2(blocks)
    for kind in range(KINDS):
        rows = blocks.kind == kind
        if rows.sum() < 10:
            continue
        r2, v, u = offset[rows] ** 2, spread[rows], unit2[rows]
        low, high = 0.0, float(np.sqrt(np.max(r2 / u)))
        if np.median(r2 / v) <= MEDIAN**2:
            found[kind] = 0.0
            continue
        for _ in range(40):
            middle = 0.5 * (low + high)
            if np.median(r2 / (v + middle**2 * u)) > MEDIAN**2:
                low = middle
            else:
                high = middle
        found[kind] = high
    return found


# --- Planes eliminated from the normal equations of all scans' poses: compiled sums over the few scans of each piece.


@njit(cache=True, nogil=True)
def eliminate(piece, scan, Hsp, inverse, gp, normal, tilt, along, N, g, spurious):  # type: ignore[no-untyped-def]
    """Take Hsp Hpp^-1 Hps off N (6k, 6k) and Hsp Hpp^-1 gp off g (6k,); add what of N is seeming to ``spurious``.

    Rows are sorted by ``piece`` (b,): Hsp (b, 6, 3) of a scan's pose and its piece's plane. ``inverse`` (p, 3, 3) of
    Hpp, gp (p, 3), the planes' ``normal`` (p, 3) and the ``tilt`` (p, 3, 3) of these that is not known; ``along`` (b,)
    is how much a row holds its scan along the normal.
    """
    b = len(piece)
    W, pull = np.empty((6, 3)), np.empty(3)
    start = 0
    while start < b:
        p = piece[start]
        end = start
        while end < b and piece[end] == p:
            end += 1
        for x in range(start, end):
            s = 6 * scan[x]
            for i in range(6):
                for j in range(3):
                    W[i, j] = 0.0
                    for m in range(3):
                        W[i, j] += Hsp[x, i, m] * inverse[p, m, j]
                for j in range(3):
                    g[s + i] -= W[i, j] * gp[p, j]
            for j in range(3):
                pull[j] = normal[p, 0] * W[3, j] + normal[p, 1] * W[4, j] + normal[p, 2] * W[5, j]
            for i in range(3):
                for j in range(3):
                    spurious[s + 3 + i, s + 3 + j] += along[x] * tilt[p, i, j]
            for y in range(start, end):
                t = 6 * scan[y]
                held = 0.0
                for m in range(3):
                    held += pull[m] * (
                        normal[p, 0] * Hsp[y, 3, m] + normal[p, 1] * Hsp[y, 4, m] + normal[p, 2] * Hsp[y, 5, m]
                    )
                for i in range(6):
                    for j in range(6):
                        total = 0.0
                        for m in range(3):
                            total += W[i, m] * Hsp[y, j, m]
                        N[s + i, t + j] -= total
                for i in range(3):
                    for j in range(3):
                        spurious[s + 3 + i, t + 3 + j] -= held * tilt[p, i, j]
        start = end
