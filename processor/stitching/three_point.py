"""Method ``three-point``: pairs of scans by picked common points, chained into one frame. Source: paper 003, eq. 1-2.

The paper's model x_a = t + lambda R x_b has seven parameters. With three points a free scale absorbs a blunder in one
of them without a trace. Six parameters are therefore the default, and the scale is a diagnostic. With seven parameters
all matrices hold the scale: T_a_b = [lambda R, t].
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtri, stdtrit

from processor import diagnostics, large_arrays
from processor.adjustment import data_snooping
from processor.geometry import rigid
from processor.model import NORMAL_95, Floats, Picks, Reason, Scan, reason
from processor.robust_statistics import student_factor
from processor.stitching import poses_with_scale
from processor.stitching.coarse.network import CoarsePoses
from processor.stitching.common_point_checks import LEAST_HEIGHT, units_slip
from processor.stitching.fine.pairs_and_loops import Pair
from processor.stitching.params import Params
from processor.stitching.to_result import Network

LEAST_SD_MM = 1e-6  # of picks without any error, as in tests
BY_CHANCE = 1e-3  # probability that the picks of any pair of a network scatter so much
SCALE_BY_CHANCE = 2.7e-3  # probability of a scale that is called other than 1: three standard deviations, if known

Picked = dict[tuple[int, int], tuple[Floats, Floats]]  # picks (n, 3) in the file frames of both scans, by rows a < b


class TooFewError(ValueError):
    """Fewer than three points, or all on a line, determine no pose; ``shortage`` says which of the two."""

    def __init__(self, shortage: Reason) -> None:
        super().__init__(shortage.code)
        self.shortage = shortage


@dataclass(frozen=True)
class PairFit:
    """Pose of a pair of scans by its picks: T_a_b with the scale where it is free, scale of b in a, and residuals.

    ``covariance`` (6, 6): rotation along a's axes about the origin of b, and shift; with a free scale (7, 7), its
    logarithm last. ``dof`` degrees of freedom are those of ``sd_mm``; ``scaled_sd_mm`` and ``scaled_dof`` are the
    same for the difference of both scans' picks with a free scale.
    """

    T_a_b: Floats
    scale: float
    scale_sd: float
    residuals: Floats  # (n, 3) a less transformed b, mm
    sd_mm: float  # of a picked coordinate of one scan
    covariance: Floats
    dof: int
    scaled_sd_mm: float
    scaled_dof: int
    is_outlier: bool = False  # its picks scatter more than those of the other pairs, beyond chance


def by_pair(picks: Picks | None, scans: Sequence[Scan]) -> Picked:
    """Group picks by pair of scans, the lesser row first."""
    if picks is None:
        return {}
    row = {scan.name: i for i, scan in enumerate(scans)}
    grouped: dict[tuple[int, int], list[tuple[Floats, Floats]]] = {}
    for name_a, name_b, xa, xb in zip(picks.scan_a, picks.scan_b, picks.in_a, picks.in_b, strict=True):
        a, b = row[name_a], row[name_b]
        grouped.setdefault((min(a, b), max(a, b)), []).append((xa, xb) if a < b else (xb, xa))
    return {
        key: (np.array([xa for xa, _ in rows]), np.array([xb for _, xb in rows]))
        for key, rows in sorted(grouped.items())
    }


def stitch(scans: Sequence[Scan], params: Params, reference: int, picked: Picked) -> Network:
    """Register scans in the frame of scan ``reference``, a row of ``scans``, by the picks of their pairs."""
    names = [scan.name for scan in scans]
    origins = np.stack(
        [scan.position if scan.position.size else scan.origin + large_arrays.centroid(scan.points) for scan in scans]
    )
    fits: dict[tuple[int, int], PairFit] = {}
    shortages: dict[tuple[int, int], Reason] = {}
    for (a, b), (in_a, in_b) in picked.items():
        try:
            fits[a, b] = fit_pair(in_a - origins[a], in_b - origins[b], params.scale == "free")
        except TooFewError as error:
            shortages[a, b] = error.shortage
    each = pooled(list(fits.values())) if fits else []
    limit = params.scale_limit_ppm
    pairs = [as_pair(a, b, fit, limit) for (a, b), fit in zip(fits, each, strict=True)]
    _say_pairs(names, each, pairs, picked)
    unused = [
        reason("stitch.pair-not-used", a=names[a], b=names[b], shortage=shortage)
        for (a, b), shortage in shortages.items()
    ]
    of_pairs = [
        reason("stitch.of-pair", a=names[pair.a], b=names[pair.b], reason=single)
        for pair in pairs
        for single in pair.reasons
    ]
    T, covariance, scale_sd, factor = adjust(pairs, len(scans), reference)
    misclosed = () if factor == 1.0 else (reason("stitch.loops-misclose", factor=factor),)
    return Network(
        T=T,
        covariance=covariance,
        origins=origins,
        coarse=CoarsePoses.unrivalled(T),
        pairs=pairs,
        pose_scale_sd=scale_sd,
        unplaced=_unplaced(names, shortages, {row for pair in fits for row in pair}),
        point_mm=float(np.median([fit.sd_mm for fit in each])) if each else float("nan"),
        reasons=(*unused, *misclosed, *of_pairs),
    )


def _say_pairs(names: Sequence[str], fits: Sequence[PairFit], pairs: Sequence[Pair], picked: Picked) -> None:
    """Say what the picks of each pair gave, for diagnostics."""
    for fit, pair in zip(fits, pairs, strict=True):
        of_pair = names[pair.a], names[pair.b]
        with diagnostics.at(", ".join(of_pair)):
            diagnostics.note(
                "three points",
                points=pair.shared,
                rms_mm=pair.residual,
                pick_sd_mm=fit.sd_mm,
                scale_ppm=1e6 * (fit.scale - 1.0),
            )
            for name, points in zip(of_pair, picked[pair.a, pair.b], strict=True):
                with diagnostics.placed(np.eye(4), f"scan {name}"):
                    diagnostics.keep(f"picks in {name}", points)


def _unplaced(
    names: Sequence[str], shortages: Mapping[tuple[int, int], Reason], tied: Collection[int]
) -> tuple[Reason, ...]:
    """Return why each scan of three-point may have no pose: its pairs with too few picks, or no pairs at all."""
    reasons = []
    for row in range(len(names)):
        short = tuple(
            reason("stitch.shortage-with-scan", shortage=shortage, scan=names[a if row == b else b])
            for (a, b), shortage in shortages.items()
            if row in (a, b)
        )
        if short:
            reasons.append(reason("stitch.too-few-picks", shortages=short))
        else:
            reasons.append(reason("stitch.picks-of-unplaced") if row in tied else reason("stitch.no-picks"))
    return tuple(reasons)


def fit_pair(points_a: Floats, points_b: Floats, scale_free: bool) -> PairFit:
    """Fit a pair's picked points (n, 3) of each scan by least squares; raises TooFewError.

    The standard deviation of a pick follows from the redundancy: three points have three degrees of freedom with six
    parameters, two with seven. The scale is the least-squares one of the rotated points.
    """
    n = len(points_a)
    if n < rigid.LEAST_POINTS:
        raise TooFewError(reason("stitch.few-points", points=n))
    middle_a, middle_b = points_a.mean(axis=0), points_b.mean(axis=0)
    a, b = points_a - middle_a, points_b - middle_b
    widths = np.linalg.svd(b, compute_uv=False)
    if widths[0] <= 0.0 or widths[1] < LEAST_HEIGHT * widths[0]:
        raise TooFewError(reason("stitch.points-on-a-line"))
    R = rigid.fit(b, a)[:3, :3]
    rotated = b @ R.T
    scale = float((a * rotated).sum() / (rotated**2).sum())
    used = scale if scale_free else 1.0
    residuals = a - used * rotated
    dof = 3 * n - 6 - scale_free
    # Of a difference, which contains the errors of both scans' picks.
    difference_sd = max(float(np.sqrt((residuals**2).sum() / dof)), LEAST_SD_MM)
    # The scale's standard deviation follows from the residuals of seven parameters, which do not contain its deviation.
    scaled_sd = max(float(np.sqrt(((a - scale * rotated) ** 2).sum() / (3 * n - 7))), LEAST_SD_MM)
    J = rigid.motion(used * rotated)
    if scale_free:
        J = np.concatenate([J, used * rotated[:, :, None]], axis=2)
    J = J.reshape(3 * n, -1)
    T = rigid.transform(used * R, middle_a - used * R @ middle_b)
    # From motions about the centroid of the points to motions about the origin of b, in a.
    covariance = rigid.about_origin(np.linalg.inv(J.T @ J) * difference_sd**2, middle_a - T[:3, 3])
    return PairFit(
        T_a_b=T, scale=scale, scale_sd=scaled_sd / float(np.sqrt((rotated**2).sum())), residuals=residuals,
        sd_mm=difference_sd / np.sqrt(2.0), covariance=covariance, dof=dof,
        scaled_sd_mm=scaled_sd, scaled_dof=3 * n - 7,
    )  # fmt: skip


def pooled(fits: list[PairFit]) -> list[PairFit]:
    """Give all pairs the standard deviation of a pick that is pooled over them.

    Three points leave a pair two or three degrees of freedom: weights by its own standard deviation would be random. A
    pair that scatters beyond chance (F test) keeps its own. Covariances are scaled such that 1.96 standard deviations
    contain 95 %: with few degrees of freedom (Student's t) they are larger than those of the pooled standard deviation.
    """
    used = list(fits)
    while True:
        dof = sum(fit.dof for fit in used)
        sd = float(np.sqrt(sum(fit.dof * fit.sd_mm**2 for fit in used) / dof))
        rest = [max(dof - fit.dof, 1) for fit in used]
        others = [(dof * sd**2 - fit.dof * fit.sd_mm**2) / n for fit, n in zip(used, rest, strict=True)]
        beyond = [
            fit.sd_mm**2 / max(variance, 1e-300) / fdtri(fit.dof, n, 1.0 - BY_CHANCE / len(fits))
            for fit, variance, n in zip(used, others, rest, strict=True)
        ]
        if len(used) < 3 or max(beyond) <= 1.0:
            break
        del used[int(np.argmax(beyond))]
    scaled_dof = sum(fit.scaled_dof for fit in used)
    scaled_sd = float(np.sqrt(sum(fit.scaled_dof * fit.scaled_sd_mm**2 for fit in used) / scaled_dof))
    inliers = {id(fit) for fit in used}
    return [
        _with_sd(fit, sd, dof, scaled_sd, scaled_dof)
        if id(fit) in inliers
        else replace(_with_sd(fit, fit.sd_mm, fit.dof, fit.scaled_sd_mm, fit.scaled_dof), is_outlier=True)
        for fit in fits
    ]


def _with_sd(fit: PairFit, sd: float, dof: int, scaled_sd: float, scaled_dof: int) -> PairFit:
    """Scale the covariances of a pair to standard deviations that are known by so many degrees of freedom."""
    factor = sd / fit.sd_mm * float(student_factor(dof))
    return replace(
        fit, sd_mm=sd, covariance=fit.covariance * factor**2, scale_sd=scaled_sd / fit.scaled_sd_mm * fit.scale_sd,
        scaled_sd_mm=scaled_sd, scaled_dof=scaled_dof,
    )  # fmt: skip


def cause_of_scale(scale: float, sd: float, limit_ppm: float, dof: float = np.inf) -> Reason | None:
    """Return the likely cause of a scale other than 1, or None; ``dof`` degrees of freedom are those of ``sd``."""
    off = 1e6 * abs(scale - 1.0)
    slip = units_slip(scale)
    if slip:
        return reason("stitch.scale-of-units", scale=scale, units=slip)
    if off <= float(stdtrit(dof, 1.0 - 0.5 * SCALE_BY_CHANCE)) * 1e6 * sd:
        return None
    if off > limit_ppm:
        return reason("stitch.scale-by-blunder", scale=scale)
    return reason("stitch.scale", ppm=1e6 * (scale - 1.0), ci95_ppm=1e6 * NORMAL_95 * widened(sd, dof))


def widened(sd: float, dof: float) -> float:
    """Scale a standard deviation known by a few degrees of freedom such that 1.96 of it contain 95 % (Student's t)."""
    return float(student_factor(dof)) * sd


def as_pair(a: int, b: int, fit: PairFit, limit_ppm: float) -> Pair:
    """Convert the fit of scans a and b to a pair of the network, with the likely cause of its scale or scatter."""
    cause = cause_of_scale(fit.scale, fit.scale_sd, limit_ppm, fit.scaled_dof)
    if cause is None and fit.is_outlier:
        cause = reason("stitch.picks-scatter", sd_mm=fit.sd_mm)
    residual = float(np.sqrt((fit.residuals**2).sum(axis=1).mean()))
    return Pair(
        a=a, b=b, shared=len(fit.residuals), T_a_b=fit.T_a_b, covariance=fit.covariance, residual=residual,
        reasons=() if cause is None else (cause,), scale=fit.scale, scale_sd=widened(fit.scale_sd, fit.scaled_dof),
    )  # fmt: skip


def adjust(pairs: list[Pair], count: int, reference: int) -> tuple[Floats, Floats, Floats, float]:
    """Adjust a network of pairs; initial poses are those of the paper's chain.

    Returns poses T_ref_scan (k, 4, 4) and their covariance (6k, 6k), NaN of scans not reached: rotations are about the
    scans' own origins, along the reference's axes; the standard deviations (k,) of the scales in T, 0 where these are
    fixed; and the factor of all standard deviations, 1 unless loops contradict the pairs' covariances.
    """
    T = _chained(pairs, count, reference)
    m = len(pairs[0].covariance) if pairs else 6  # unknowns of a scan
    placed = np.flatnonzero(np.isfinite(T).all(axis=(1, 2))).tolist()
    used = [pair for pair in pairs if pair.a in placed and pair.b in placed]
    unknown = [s for s in placed if s != reference]
    covariance = np.full((m * count, m * count), np.nan)
    fixed = slice(m * reference, m * reference + m)
    covariance[fixed], covariance[:, fixed] = 0.0, 0.0
    rows = np.array([m * s + np.arange(m) for s in unknown], np.int64).ravel()
    for _ in range(10 if len(rows) else 0):
        N, g = np.zeros(covariance.shape), np.zeros(m * count)
        for pair in used:
            A, r, W = _equation(pair, T)
            at = np.concatenate([m * pair.a + np.arange(m), m * pair.b + np.arange(m)])
            N[np.ix_(at, at)] += A.T @ W @ A
            g[at] += A.T @ W @ r
        step = np.zeros(m * count)
        step[rows] = -np.linalg.solve(N[np.ix_(rows, rows)], g[rows])
        for s in unknown:
            d = step[m * s : m * s + m]
            T[s, :3, :3] = np.exp(d[6:].sum()) * rigid.rotation_from_vector(d[:3]) @ T[s, :3, :3]
            T[s, :3, 3] += d[3:6]
        if np.abs(step).max() < 1e-9:
            break
    if len(rows):
        covariance[np.ix_(rows, rows)] = np.linalg.inv(N[np.ix_(rows, rows)])
    factor = _factor(used, T, len(rows))
    covariance *= factor**2
    of_motion = np.arange(m * count).reshape(count, m)[:, :6].ravel()
    scale_sd = np.sqrt(np.diag(covariance)[6::7]) if m == 7 else np.where(np.isfinite(T[:, 0, 0]), 0.0, np.nan)
    return T, covariance[np.ix_(of_motion, of_motion)], scale_sd, factor


def _factor(pairs: list[Pair], T: Floats, unknowns: int) -> float:
    """Return the factor of standard deviations that explains the misclosures of adjusted pairs; 1 if chance does."""
    square = sum(float(r @ W @ r) for _, r, W in (_equation(pair, T) for pair in pairs))
    dof = sum(len(pair.covariance) for pair in pairs) - unknowns
    return float(np.sqrt(square / dof)) if data_snooping.beyond_chance(square, dof) else 1.0


def _chained(pairs: list[Pair], count: int, reference: int) -> Floats:
    """Chain pairs from the reference on, the smallest variance of the shift first (paper 003)."""
    T = np.full((count, 4, 4), np.nan)
    T[reference] = np.eye(4)
    placed = {reference}
    order = sorted(pairs, key=lambda pair: (float(np.trace(pair.covariance[3:6, 3:6])), pair.a, pair.b))
    while pair := next((p for p in order if (p.a in placed) != (p.b in placed)), None):
        if pair.a in placed:
            T[pair.b] = T[pair.a] @ pair.T_a_b
        else:
            T[pair.a] = T[pair.b] @ poses_with_scale.invert(pair.T_a_b)
        placed |= {pair.a, pair.b}
    return T


def _equation(pair: Pair, T: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the derivative by both scans' motions, the misclosure in a's axes, and the weight.

    With m = 6 unknowns per scan, or 7 with its scale: (m, 2m), (m,) and (m, m).
    """
    m, to_a = len(pair.covariance), poses_with_scale.invert(T[pair.a])
    R, S = poses_with_scale.rotation_of(T[pair.a]).T, to_a[:3, :3]
    r = poses_with_scale.difference(to_a @ T[pair.b], pair.T_a_b)[:m]
    arm = T[pair.b, :3, 3] - T[pair.a, :3, 3]
    A = np.zeros((7, 14))
    A[:3, :3], A[:3, 7:10] = -R, R
    A[3:6, 3:6], A[3:6, 10:13] = -S, S
    A[3:6, :3], A[3:6, 6] = S @ rigid.cross_matrix(arm), -S @ arm
    A[6, 6], A[6, 13] = -1.0, 1.0
    A = A[:m, np.concatenate([np.arange(m), 7 + np.arange(m)])]
    weight: Floats = np.asarray(np.linalg.pinv(pair.covariance, rcond=1e-14, hermitian=True), np.float64)
    return A, r, weight
