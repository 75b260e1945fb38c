"""Adjustment of all scans' poses at once on the planar pieces that they share; the planes are unknowns too.

Newton steps on the normal equations of :mod:`processor.stitching.fine.normal_equations`, with robust weights. Points of
one scan on one piece share an offset, the standard deviation tau of which is estimated from the misfits: it models
errors common to neighbouring points, which do not average out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from processor.adjustment import scanner_class_errors
from processor.geometry import rigid
from processor.model import Floats, Ints
from processor.robust_statistics import huber
from processor.stitching.fine.correspondences import KINDS, ON_PIECE, Blocks
from processor.stitching.fine.normal_equations import Equations, linearize, unit_variance

HUBER_SIGMAS = 2.5  # misfit of a scan on a piece, from which on its weight decreases
REJECTION_SIGMAS = 6.0  # misfit from which on a scan's points on a piece are outliers
REJECTED_WEIGHT, LEAST_INLIER_WEIGHT = 1e-6, 1e-3  # nothing, not singular; left out below
REWEIGHTINGS = 8  # at fixed poses
PRIOR_MM, PRIOR_RAD = 1e4, 1.0  # weak priors on the poses: undetermined components stay as they are
MEDIAN_OF_ABS_Z = 0.6745  # z standard normal
LEAST_FACE_MM, MOST_COMMON_MM = 1e-3, 10.0  # standard deviation of the range errors of faces: where none show, at most
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
    unknowns = unknowns_of(blocks, len(ranges), k, reference)
    poses = unknowns[unknowns < 6 * k]
    if not len(poses):
        covariance = _fixed_reference(np.full((6 * k, 6 * k), np.nan), reference)
        none = np.empty(0)
        return Solution(
            T=T, covariance=covariance, offset=none, tau=tuple(common.tolist()), weight=none, ranges=ranges,
            ranges_sd=np.full(k, scanner_class_errors.known().view_mm),
        )  # fmt: skip
    weight = np.ones(len(blocks.piece))
    initial = _initial_tau(blocks) if robust and tau is None else np.zeros(KINDS + 1)
    for iteration in range(iterations):
        least = initial if iteration < EQUAL_ITERATIONS else np.zeros(KINDS + 1)
        equations = linearize(blocks, T, ranges, np.maximum(common, least), weight)
        if iteration and tau is None:
            common[:KINDS] = _estimate_tau(blocks, equations.offset, equations.variance, common)
            if blocks.faces:
                N = equations.N + np.diag(prior_information(len(ranges), k, np.inf))
                rest, rows = unknowns[unknowns < 8 * k], 8 * k + np.arange(blocks.faces)
                common[KINDS] = np.sqrt(variance_of_errors(N, equations.g, ranges[2 * k :], rest, rows))
        if iteration == EQUAL_ITERATIONS and initial.any():
            weight = _robust_weights(blocks, _with_slack(equations, slack_mm))
            continue
        change = np.zeros(6 * k + len(ranges))
        N, g = _with_priors(equations, unknowns, ranges, common[KINDS])
        change[unknowns] = -np.linalg.solve(N, g)
        step, ranges = change[: 6 * k].reshape(k, 6), ranges + change[6 * k :]
        T = rigid.moved_about_own_origins(T, step)
        if robust:
            weight = _robust_weights(blocks, _with_slack(equations, slack_mm))
        if iteration > EQUAL_ITERATIONS and np.abs(step[:, 3:]).max(initial=0.0) < STILL_MM:
            break
    equations = linearize(blocks, T, ranges, common, weight)
    N, _ = _with_priors(equations, unknowns, ranges, common[KINDS])
    C = _genuine_covariance(N, equations.spurious[np.ix_(unknowns, unknowns)])
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
        weight = _robust_weights(blocks, linearize(blocks, solution.T, ranges, tau, weight).z)
    return weight


def _with_priors(equations: Equations, unknowns: Ints, ranges: Floats, face_mm: float) -> tuple[Floats, Floats]:
    """Return the normal equations of ``unknowns`` with their priors, which draw ``ranges`` (2k + f,) to 0."""
    first = len(equations.g) - len(ranges)
    prior, g = prior_information(len(ranges), first // 6, face_mm), equations.g.copy()
    g[first:] += prior[first:] * ranges
    return (equations.N + np.diag(prior))[np.ix_(unknowns, unknowns)], g[unknowns]


def prior_information(ranges: int, k: int, face_mm: float) -> Floats:
    """Return the information (8k + f,) of the priors: weak ones of k poses; range errors by class, and of faces."""
    of_poses = np.tile([PRIOR_RAD**-2] * 3 + [PRIOR_MM**-2] * 3, k)
    of_scans = np.repeat([scanner_class_errors.known().view_mm ** -2, scanner_class_errors.known().scale ** -2], k)
    of_faces = np.full(ranges - 2 * k, max(face_mm, LEAST_FACE_MM) ** -2)
    return np.concatenate([of_poses, of_scans, of_faces])


def unknowns_of(blocks: Blocks, ranges: int, k: int, reference: int) -> Ints:
    """Return the rows of the unknowns: six for every scan with blocks but the reference, and all range errors."""
    scans = [s for s in range(k) if s != reference and (blocks.scan == s).any()]
    poses = (6 * np.array(scans, np.int64)[:, None] + np.arange(6)).ravel()
    return np.concatenate([poses, 6 * k + np.arange(ranges)])


def variance_of_errors(N: Floats, g: Floats, errors: Floats, rest: Ints, own: Ints) -> float:
    """Estimate the common variance of some unknowns, the ``errors`` (e,), by restricted maximum likelihood, mm2.

    N (m, m) and g (m,) are normal equations at these, ``own`` (e,) their rows, and ``rest`` those of all others. With
    these eliminated, the errors' information S and S times their estimate are turned to the axes of S, where they are
    independent.
    """
    half = np.linalg.solve(N[np.ix_(rest, rest)], np.column_stack([N[np.ix_(rest, own)], g[rest]]))
    S = N[np.ix_(own, own)] - N[np.ix_(own, rest)] @ half[:, :-1]
    pull = S @ errors - g[own] + N[np.ix_(own, rest)] @ half[:, -1]
    information, axes = np.linalg.eigh(0.5 * (S + S.T))
    information = np.maximum(information, 0.0)
    square = (axes.T @ pull) ** 2

    def slope(variance: float) -> float:
        grown = 1.0 + information * variance
        return float((square / grown**2 - information / grown).sum())

    if slope(0.0) <= 0.0:
        return 0.0
    if slope(MOST_COMMON_MM**2) >= 0.0:
        return MOST_COMMON_MM**2
    return float(brentq(slope, 0.0, MOST_COMMON_MM**2))


def _genuine_covariance(N: Floats, spurious: Floats) -> Floats:
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
    weight = np.where(np.abs(z) > REJECTION_SIGMAS, REJECTED_WEIGHT, huber(z, HUBER_SIGMAS))
    left = np.bincount(blocks.piece, weight > LEAST_INLIER_WEIGHT, blocks.pieces)
    least = np.ones(blocks.pieces)
    np.minimum.at(least, blocks.piece, weight)
    weights: Floats = np.where(left[blocks.piece] < 2, least[blocks.piece], weight)
    return weights


def _with_slack(equations: Equations, slack_mm: float) -> Floats:
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


def _estimate_tau(blocks: Blocks, offset: Floats, variance: Floats, before: Floats) -> Floats:
    """Estimate tau of each kind: the variance of offsets beyond that of the point noise, by the median of squares."""
    tau: Floats = before[:KINDS].copy()
    unit = unit_variance(blocks)
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
