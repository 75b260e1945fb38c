"""Adjustment of all scans' poses at once on the planar pieces that they share; the planes are unknowns too.

The points enter by their moments alone: distances from a plane are linear in [p; 1], so that 4 x 4 moments give the
normal equations exactly. The plane of each piece is eliminated, and so is one offset for each scan and piece, with a
standard deviation tau estimated from the misfits. It models errors common to neighbouring points, which do not average
out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.optimize import brentq

from processor.adjustment.scanner_class_errors import SCALE_SD, VIEW_SD_MM
from processor.geometry import rigid
from processor.model import Floats, Ints
from processor.stitching.fine.correspondences import FACE_END, KINDS, ON_PIECE, Blocks
from processor.stitching.planes import extraction, grouped_sums
from processor.stitching.planes.extraction import Planes

HUBER_SIGMAS = 2.5  # misfit of a scan on a piece, from which on its weight decreases
REJECTION_SIGMAS = 6.0  # misfit from which on a scan's points on a piece are outliers
REJECTED_WEIGHT, LEAST_INLIER_WEIGHT = 1e-6, 1e-3
REWEIGHTINGS = 8  # at fixed poses
PRIOR_MM, PRIOR_RAD = 1e4, 1.0  # weak priors on the poses: undetermined components stay as they are
MEDIAN_OF_ABS_Z = 0.6745  # z standard normal
COLUMNS = 9  # unknowns of a block: the pose of its scan, the scan's range errors (offset, scale), and its face's
LEAST_FACE_MM, MOST_FACE_MM = 1e-3, 10.0  # standard deviation of the range errors of faces: where none show, at most
EQUAL_ITERATIONS, INITIAL_TAU_SIGMAS = 3, 0.3  # first iterations weight pieces almost equally: tau, by point noise
LEAST_GENUINE_SHARE = 0.01  # of the information in a direction: least that is taken as not spurious
LEAST_BLOCKS = 10  # to estimate tau from
STILL_MM = 1e-4  # largest shift of a pose at convergence


@dataclass(frozen=True)
class Solution:
    """Poses T_ref_scan (k, 4, 4) and their joint covariance (6k, 6k; rad, mm; rotations about each scan's own origin).

    ``offset`` (b,) is the mean distance of a block from its plane, mm; ``weight`` (b,) its robust weight. ``tau`` of
    each kind: mm, for ends in standard deviations of a single one; the last is of the range errors of faces. ``ranges``
    (2k + f,) are the range errors: offsets of scans, mm, their scales, and offsets of faces, mm; ``ranges_sd`` (k,) are
    the standard deviations of the first.
    """

    T: Floats
    covariance: Floats
    offset: Floats
    tau: tuple[float, ...]
    weight: Floats
    ranges: Floats
    ranges_sd: Floats

    @property
    def of_scans(self) -> Floats:
        """Range errors (k, 2) of scans: offset, mm, and scale."""
        k = len(self.T)
        return np.stack([self.ranges[:k], self.ranges[k : 2 * k]], axis=1)


def solve(
    blocks: Blocks,
    T: Floats,
    reference: int,
    *,
    iterations: int = 10,
    robust: bool = True,
    tau: tuple[float, ...] | None = None,
    slack_mm: float = 0.0,
) -> Solution:
    """Adjust poses from initial ones T (k, 4, 4), the reference fixed; scans without blocks keep theirs.

    The covariance of scans without blocks is NaN. ``tau`` is estimated unless given. ``slack_mm`` is the error of the
    initial poses: no piece is rejected for a misfit of this size.
    """
    k = len(T)
    common = np.zeros(KINDS + 1) if tau is None else np.array(tau)
    ranges = np.zeros(2 * k + blocks.faces)
    unknowns = _unknowns(blocks, len(ranges), k, reference)
    poses = unknowns[unknowns < 6 * k]
    if not len(poses):
        covariance = _fixed_reference(np.full((6 * k, 6 * k), np.nan), reference)
        none = np.empty(0)
        return Solution(
            T=T, covariance=covariance, offset=none, tau=tuple(common.tolist()), weight=none, ranges=ranges,
            ranges_sd=np.full(k, VIEW_SD_MM),
        )  # fmt: skip
    weight = np.ones(len(blocks.piece))
    initial = _initial_tau(blocks) if robust and tau is None else np.zeros(KINDS + 1)
    for iteration in range(iterations):
        least = initial if iteration < EQUAL_ITERATIONS else np.zeros(KINDS + 1)
        equations = _linearize(blocks, T, ranges, np.maximum(common, least), weight)
        if iteration and tau is None:
            common[:KINDS] = _estimate_tau(blocks, equations.offset, equations.variance, common)
            common[KINDS] = _estimate_face_sd(equations, unknowns, k, ranges)
        if iteration == EQUAL_ITERATIONS and initial.any():
            weight = _robust_weights(blocks, _with_slack(equations, slack_mm))
            continue
        change = _newton_step(equations, unknowns, ranges, common[KINDS])
        step, ranges = change[: 6 * k].reshape(k, 6), ranges + change[6 * k :]
        T = rigid.moved_about_own_origins(T, step)
        if robust:
            weight = _robust_weights(blocks, _with_slack(equations, slack_mm))
        if iteration > EQUAL_ITERATIONS and np.abs(step[:, 3:]).max(initial=0.0) < STILL_MM:
            break
    equations = _linearize(blocks, T, ranges, common, weight)
    at = np.ix_(unknowns, unknowns)
    C = _sandwich((equations.N + _prior(len(ranges), k, common[KINDS]))[at], equations.spurious[at])
    covariance = np.full((6 * k, 6 * k), np.nan)
    covariance[np.ix_(poses, poses)] = C[: len(poses), : len(poses)]
    return Solution(
        T=T, covariance=_fixed_reference(covariance, reference), offset=equations.offset, tau=tuple(common.tolist()),
        weight=weight, ranges=ranges, ranges_sd=np.sqrt(np.diag(C)[len(poses) : len(poses) + k]),
    )  # fmt: skip


def weights_at(blocks: Blocks, solution: Solution) -> Floats:
    """Return the robust weights (b,) of blocks at the poses and the scans' range errors of a solution."""
    weight, tau = np.ones(len(blocks.piece)), np.array(solution.tau)
    k = len(solution.T)
    ranges = np.concatenate([solution.ranges[: 2 * k], np.zeros(blocks.faces)])
    for _ in range(REWEIGHTINGS):
        weight = _robust_weights(blocks, _linearize(blocks, solution.T, ranges, tau, weight).z)
    return weight


def solve_without(
    blocks: Blocks, solution: Solution, reference: int, out: npt.NDArray[np.bool_], almost_none: float
) -> tuple[Floats, Floats]:
    """Return step (6k,) and covariance (6k, 6k) of the poses if blocks ``out`` (b,) had the weight ``almost_none``.

    The step is one of Newton's from the solution; rows and columns of poses that are not adjusted are 0.
    """
    weight = np.where(out, almost_none, solution.weight)
    ranges, k = solution.ranges, len(solution.T)
    equations = _linearize(blocks, solution.T, ranges, np.array(solution.tau), weight)
    unknowns = _unknowns(blocks, len(ranges), k, reference)
    poses = unknowns[unknowns < 6 * k]
    N = (equations.N + _prior(len(ranges), k, solution.tau[KINDS]))[np.ix_(unknowns, unknowns)]
    covariance = np.zeros((6 * k, 6 * k))
    covariance[np.ix_(poses, poses)] = np.linalg.solve(N, np.eye(len(N), len(poses)))[: len(poses)]
    return _newton_step(equations, unknowns, ranges, solution.tau[KINDS])[: 6 * k], covariance


# Normal equations.


@dataclass(frozen=True)
class _Equations:
    """Reduced normal equations N (6k, 6k), g (6k,) of the poses, and the misfits (b,) of the blocks.

    ``spurious`` (6k, 6k) is the part of N that is due to the uncertainty of the planes' normals. ``z`` are misfits in
    standard deviations, ``offset`` in mm, ``variance`` of the latter without tau.
    """

    N: Floats
    spurious: Floats
    g: Floats
    z: Floats
    offset: Floats
    variance: Floats


class _Coupling(NamedTuple):
    """Rows (b,) of poses and planes to be eliminated, sorted by piece, and their blocks of the normal matrix.

    ``columns`` (b, COLUMNS) are the unknowns of a row; the last, in blocks on no face, is one that is cut off.
    ``Hsp`` (b, COLUMNS, 3) couples them and the plane of the piece; ``inverse`` (p, 3, 3) is that of the planes'
    block, ``gp`` (p, 3) their gradient. ``tilt`` (p, 3, 3) is the covariance of the ``normal`` (p, 3), ``along`` (b,)
    the information of a row on the shift of its scan along the normal.
    """

    piece: Ints
    columns: Ints
    Hsp: Floats
    inverse: Floats
    gp: Floats
    normal: Floats
    tilt: Floats
    along: Floats


def _linearize(blocks: Blocks, T: Floats, ranges: Floats, tau: Floats, weight: Floats) -> _Equations:
    """Build the normal equations at poses T (k, 4, 4) and range errors, with planes and common offsets eliminated.

    The normal of a plane is not known exactly: if it is off, a piece seems to determine shifts along itself as well.
    The part of the normal matrix due to this follows from the uncertainty of the planes.
    """
    k, b = len(T), len(blocks.piece)
    size = 6 * k + len(ranges)
    of_face = np.where(blocks.face < 0, size, 8 * k + blocks.face)
    of_scan = 6 * blocks.scan
    columns = np.column_stack([of_scan[:, None] + np.arange(6), 6 * k + blocks.scan, 7 * k + blocks.scan, of_face])
    errors = np.append(ranges, 0.0)[columns[:, 6:] - 6 * k]
    W = in_world(blocks, T, errors[:, 0] + errors[:, 2], errors[:, 1])
    total = grouped_sums.summed(extraction.triangle(W) * weight[:, None], blocks.piece, blocks.pieces)
    planes = extraction.planes_of(total)
    n, c = planes.normal[blocks.piece], planes.mean[blocks.piece]
    W = _shifted(W, c)
    mass = W[:, 3, 3]
    t2 = tau[blocks.kind] ** 2 * _unit_variance(blocks)
    # A common offset of the block's points is eliminated.
    e = W[:, :, 3]
    W = (W - (t2 / (1.0 + t2 * mass))[:, None, None] * e[:, :, None] * e[:, None, :]) * weight[:, None, None]
    Ls, Lp = _design_matrices(blocks, T, planes)
    rho = np.concatenate([n, np.zeros((b, 4))], axis=1)
    LsW, Wr = Ls @ W, np.einsum("bij,bj->bi", W, rho)
    Hss = LsW @ Ls.transpose(0, 2, 1)
    Hsp = LsW @ Lp.transpose(0, 2, 1)
    LpWLp = (Lp @ W @ Lp.transpose(0, 2, 1)).reshape(b, 9)
    Hpp = grouped_sums.summed(LpWLp, blocks.piece, blocks.pieces).reshape(-1, 3, 3)
    gs = np.einsum("bij,bj->bi", Ls, Wr)
    gp = grouped_sums.summed(np.einsum("bij,bj->bi", Lp, Wr), blocks.piece, blocks.pieces)
    scale = np.einsum("nii->ni", Hpp)
    inverse = np.linalg.inv(Hpp + 1e-12 * np.maximum(scale, 1e-12)[:, :, None] * np.eye(3))
    N, g, spurious = np.zeros((size + 1, size + 1)), np.zeros(size + 1), np.zeros((size + 1, size + 1))
    np.add.at(N, (columns[:, :, None], columns[:, None, :]), Hss)
    np.add.at(g, columns, gs)
    along = np.einsum("bi,bij,bj->b", n, Hss[:, 3:6, 3:6], n)
    tilt = planes.axes[:, :, 1:] @ inverse[:, :2, :2] @ planes.axes[:, :, 1:].transpose(0, 2, 1)
    coupling = _Coupling(
        piece=np.ascontiguousarray(blocks.piece), columns=columns, Hsp=Hsp, inverse=inverse, gp=gp,
        normal=planes.normal, tilt=tilt, along=along,
    )  # fmt: skip
    eliminate(coupling, N, g, spurious)
    # Misfit: the mean distance of a block from the plane; its variance is reduced by the block's leverage on the plane.
    mean = e[:, :3] / mass[:, None]
    offset = np.einsum("bi,bi->b", mean, n)
    v = np.einsum("bij,bj->bi", Lp[:, :, :4], np.concatenate([mean, np.ones((b, 1))], axis=1))
    leverage = np.einsum("bi,bij,bj->b", v, inverse[blocks.piece], v) * weight / (1.0 / mass + t2)
    share = np.maximum(1.0 - leverage, 0.02)
    z = offset / np.sqrt((1.0 / mass + t2) * share)
    return _Equations(
        N=N[:size, :size], spurious=spurious[:size, :size], g=g[:size], z=z, offset=offset / np.sqrt(share),
        variance=1.0 / mass,
    )  # fmt: skip


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
    Ls = np.zeros((b, COLUMNS, 7))
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
def eliminate(coupling, N, g, spurious):  # type: ignore[no-untyped-def]
    """Subtract Hsp Hpp^-1 Hps from N (m, m) and Hsp Hpp^-1 gp from g (m,); add the spurious part of N.

    Sums run over the few scans of each piece; see :class:`_Coupling`.
    """
    piece, columns, Hsp, inverse = coupling.piece, coupling.columns, coupling.Hsp, coupling.inverse
    normal, tilt = coupling.normal, coupling.tilt
    b = len(piece)
    W, pull = np.empty((COLUMNS, 3)), np.empty(3)
    start = 0
    while start < b:
        p = piece[start]
        end = start
        while end < b and piece[end] == p:
            end += 1
        for x in range(start, end):
            s = columns[x, 3]
            for i in range(COLUMNS):
                for j in range(3):
                    W[i, j] = 0.0
                    for m in range(3):
                        W[i, j] += Hsp[x, i, m] * inverse[p, m, j]
                for j in range(3):
                    g[columns[x, i]] -= W[i, j] * coupling.gp[p, j]
            for j in range(3):
                pull[j] = normal[p, 0] * W[3, j] + normal[p, 1] * W[4, j] + normal[p, 2] * W[5, j]
            for i in range(3):
                for j in range(3):
                    spurious[s + i, s + j] += coupling.along[x] * tilt[p, i, j]
            for y in range(start, end):
                t = columns[y, 3]
                shared = 0.0
                for m in range(3):
                    shared += pull[m] * (
                        normal[p, 0] * Hsp[y, 3, m] + normal[p, 1] * Hsp[y, 4, m] + normal[p, 2] * Hsp[y, 5, m]
                    )
                for i in range(COLUMNS):
                    for j in range(COLUMNS):
                        total = 0.0
                        for m in range(3):
                            total += W[i, m] * Hsp[y, j, m]
                        N[columns[x, i], columns[y, j]] -= total
                for i in range(3):
                    for j in range(3):
                        spurious[s + i, t + j] -= shared * tilt[p, i, j]
        start = end


def _shifted(W: Floats, c: Floats) -> Floats:
    """Move the origin of moments (b, 7, 7) to c (b, 3)."""
    S = np.tile(np.eye(7), (len(c), 1, 1))
    S[:, :3, 3] = -c
    shifted: Floats = S @ W @ S.transpose(0, 2, 1)
    return shifted


def _newton_step(equations: _Equations, unknowns: Ints, ranges: Floats, face_mm: float) -> Floats:
    """Return the step of all unknowns; ``ranges`` (2k + f,) are drawn to 0 by their priors."""
    size = len(equations.g)
    prior = _prior(len(ranges), (size - len(ranges)) // 6, face_mm)
    g = equations.g.copy()
    g[size - len(ranges) :] += np.diag(prior)[size - len(ranges) :] * ranges
    step = np.zeros(size)
    step[unknowns] = -np.linalg.solve((equations.N + prior)[np.ix_(unknowns, unknowns)], g[unknowns])
    return step


def _prior(ranges: int, k: int, face_mm: float) -> Floats:
    """Return the information of the priors: weak ones of k poses; range errors of scans by their class, of faces."""
    of_poses = np.tile([PRIOR_RAD**-2] * 3 + [PRIOR_MM**-2] * 3, k)
    of_scans = np.repeat([VIEW_SD_MM**-2, SCALE_SD**-2], k)
    of_faces = np.full(ranges - 2 * k, max(face_mm, LEAST_FACE_MM) ** -2)
    return np.diag(np.concatenate([of_poses, of_scans, of_faces]))


def _unknowns(blocks: Blocks, ranges: int, k: int, reference: int) -> Ints:
    """Return the rows of the unknowns: six for every scan with blocks but the reference, and all range errors."""
    scans = [s for s in range(k) if s != reference and (blocks.scan == s).any()]
    poses = (6 * np.array(scans, np.int64)[:, None] + np.arange(6)).ravel()
    return np.concatenate([poses, 6 * k + np.arange(ranges)])


def _estimate_face_sd(equations: _Equations, unknowns: Ints, k: int, ranges: Floats) -> float:
    """Estimate the standard deviation of the range errors of faces by restricted maximum likelihood.

    With the other unknowns eliminated, the faces' information S and S times their estimate are turned to the axes of S,
    where they are independent.
    """
    if len(ranges) == 2 * k:
        return 0.0
    rest, faces = unknowns[unknowns < 8 * k], np.arange(8 * k, len(equations.g))
    N = equations.N + _prior(len(ranges), k, np.inf)
    half = np.linalg.solve(N[np.ix_(rest, rest)], np.column_stack([N[np.ix_(rest, faces)], equations.g[rest]]))
    S = N[np.ix_(faces, faces)] - N[np.ix_(faces, rest)] @ half[:, :-1]
    pull = S @ ranges[2 * k :] - equations.g[faces] + N[np.ix_(faces, rest)] @ half[:, -1]
    information, axes = np.linalg.eigh(0.5 * (S + S.T))
    information = np.maximum(information, 0.0)
    square = (axes.T @ pull) ** 2

    def slope(variance: float) -> float:
        grown = 1.0 + information * variance
        return float((square / grown**2 - information / grown).sum())

    if slope(0.0) <= 0.0:
        return 0.0
    if slope(MOST_FACE_MM**2) >= 0.0:
        return MOST_FACE_MM
    return float(np.sqrt(brentq(slope, 0.0, MOST_FACE_MM**2)))


def _sandwich(N: Floats, spurious: Floats) -> Floats:
    """Return the covariance of an estimate whose normal matrix N is spurious in part: the larger, the more of it is."""
    L = np.linalg.cholesky(N)
    S = np.linalg.solve(L, np.linalg.solve(L, spurious).T)
    share, V = np.linalg.eigh(0.5 * (S + S.T))
    half = np.linalg.solve(L.T, V) / np.maximum(1.0 - share, LEAST_GENUINE_SHARE)
    covariance: Floats = half @ half.T
    return covariance


def _fixed_reference(covariance: Floats, reference: int) -> Floats:
    """Set the rows and columns of the reference scan to 0, in place."""
    rows = slice(6 * reference, 6 * reference + 6)
    covariance[rows], covariance[:, rows] = 0.0, 0.0
    return covariance


# Weights: robust ones of blocks, and the variance of the offsets common to a block's points.


def _robust_weights(blocks: Blocks, z: Floats) -> Floats:
    """Return weights (b,) by misfits; if fewer than two scans of a piece remain, all get the least of its weights.

    Of two scans it cannot be decided which one is wrong, and a single one would seem to fit without any misfit.
    """
    huber = np.minimum(1.0, HUBER_SIGMAS / np.maximum(np.abs(z), 1e-9))
    weight = np.where(np.abs(z) > REJECTION_SIGMAS, REJECTED_WEIGHT, huber)
    left = np.bincount(blocks.piece, weight > LEAST_INLIER_WEIGHT, blocks.pieces)
    least = np.ones(blocks.pieces)
    np.minimum.at(least, blocks.piece, weight)
    weights: Floats = np.where(left[blocks.piece] < 2, least[blocks.piece], weight)
    return weights


def _with_slack(equations: _Equations, slack_mm: float) -> Floats:
    """Return misfits (b,) by their standard deviations combined with the error of poses not yet adjusted."""
    z, offset = equations.z, equations.offset
    sd = np.hypot(offset / np.where(z == 0.0, 1.0, z), slack_mm)
    reduced: Floats = offset / np.maximum(sd, 1e-300)
    return reduced


def _initial_tau(blocks: Blocks) -> Floats:
    """Return the tau (KINDS,) of the first iterations, so large that no piece weighs more than a few of its points do.

    Else a wall of thousands of points with an object leaning on it would outweigh everything else.
    """
    points = blocks.kind == ON_PIECE
    if not points.any():
        return np.zeros(KINDS + 1)
    sigma = float(np.median(np.sqrt(blocks.count[points] / np.maximum(blocks.sums[points, 9], 1e-300))))
    return np.array([INITIAL_TAU_SIGMAS * sigma, 0.0, 0.0])


def _unit_variance(blocks: Blocks) -> Floats:
    """Return the unit (b,) of tau squared: 1 mm^2 for points, the variance of a single end for ends.

    If an edge runs along the scanner's rows or columns, all its ends have the same error, in shares of a step.
    """
    unit: Floats = np.where(blocks.kind == FACE_END, blocks.count / np.maximum(blocks.sums[:, 9], 1e-300), 1.0)
    return unit


def _estimate_tau(blocks: Blocks, offset: Floats, variance: Floats, before: Floats) -> Floats:
    """Estimate tau of each kind: the variance of offsets beyond that of the point noise, by the median of squares."""
    tau: Floats = before[:KINDS].copy()
    unit = _unit_variance(blocks)
    for kind in range(KINDS):
        rows = blocks.kind == kind
        if rows.sum() < LEAST_BLOCKS:
            continue
        r2, v, u = offset[rows] ** 2, variance[rows], unit[rows]
        low, high = 0.0, float(np.sqrt(np.max(r2 / u)))
        if np.median(r2 / v) <= MEDIAN_OF_ABS_Z**2:
            tau[kind] = 0.0
            continue
        for _ in range(40):
            middle = 0.5 * (low + high)
            if np.median(r2 / (v + middle**2 * u)) > MEDIAN_OF_ABS_Z**2:
                low = middle
            else:
                high = middle
        tau[kind] = high
    return tau
