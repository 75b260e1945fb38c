"""Method ``three-point``: pairs of scans by picked common points, chained into one frame. Source: paper 003, eq. 1-2.

The paper's model x_a = t + lambda R x_b has seven parameters. A free scale takes up a blunder in one of three points
without a trace, so six are the default, and scale is a diagnostic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f
from scipy.stats import t as student

from processor.geometry import rigid
from processor.model import NORMAL_95, Floats, Picks, Scan
from processor.stitching import frames
from processor.stitching.fine.pair_checks import Pair

LEAST_POINTS = 3
LEAST_SD_MM = 1e-6  # of picks without any error, as tests make them
UNIT_SLIPS = (
    (1000.0, "m and mm"),
    (304.8, "feet and mm"),
    (39.3701, "inches and m"),
    (25.4, "inches and mm"),
    (12.0, "inches and feet"),
    (10.0, "cm and mm"),
    (3.28084, "feet and m"),
)
BY_CHANCE = 1e-3  # that picks of a network scatter so much in one pair
SCALE_BY_CHANCE = 2.7e-3  # that a scale of 1 is doubted: beyond three standard deviations, were these known
LEAST_HEIGHT = 1e-3  # of a triangle, by its longest side: nearer to a line than that is a line


@dataclass(frozen=True)
class Tie:
    """One pair from picks: T_a_b (rotation and shift), scale of b in a, and how well the points agree.

    ``covariance`` (6, 6): turn about a's axes at the middle of the points, and shift, carried to turns about b's
    origin; NaN where three points leave nothing to judge by and no standard deviation was given.
    """

    T_a_b: Floats
    scale: float
    scale_sd: float
    residuals: Floats  # (n, 3) a less b moved, mm
    sd_mm: float  # of a picked coordinate of one scan
    covariance: Floats
    free: int  # freedoms that the standard deviation is known by
    left_mm: float  # the same of a difference of two scans' picks, by what a free scale leaves
    left_free: int
    apart: bool = False  # its picks scatter more than those of the other pairs, beyond chance


class TooFewError(ValueError):
    """Fewer than three points, or all on a line: a pose cannot be told."""


def tie(points_a: Floats, points_b: Floats, scale_free: bool) -> Tie:
    """Fit a pair's picked points (n, 3) of each scan, least squares; raises TooFewError.

    With six parameters three points leave three freedoms, with seven two: the standard deviation of a pick comes from
    these. The scale is (sum of spreads in a) / (in b), the least-squares one by the moved points where it is free.
    """
    n = len(points_a)
    if n < LEAST_POINTS:
        raise TooFewError(f"{n} common points")
    middle_a, middle_b = points_a.mean(axis=0), points_b.mean(axis=0)
    a, b = points_a - middle_a, points_b - middle_b
    widths = np.linalg.svd(b, compute_uv=False)
    if widths[0] <= 0.0 or widths[1] < LEAST_HEIGHT * widths[0]:
        raise TooFewError("all common points on a line")
    R = rigid.fit(b, a)[:3, :3]
    moved = b @ R.T
    scale = float((a * moved).sum() / (moved**2).sum())
    used = scale if scale_free else 1.0
    residuals = a - used * moved
    free = 3 * n - 6 - scale_free
    both = max(float(np.sqrt((residuals**2).sum() / free)), LEAST_SD_MM)  # of a difference: both scans' picks are in it
    sd = both / np.sqrt(2.0)
    # The scale's own standard deviation by what seven parameters leave: what a scale is off by is not in it.
    left = max(float(np.sqrt(((a - scale * moved) ** 2).sum() / (3 * n - 7))), LEAST_SD_MM)
    scale_sd = left / float(np.sqrt((moved**2).sum()))
    J = rigid.motion(moved).reshape(-1, 6)
    own = np.linalg.inv(J.T @ J) * both**2
    T = rigid.transform(R, middle_a - used * R @ middle_b)
    # Turns about the middle of the points -> about b's origin in a.
    covariance = rigid.about_origin(own, middle_a - T[:3, 3])
    if scale_free:  # what the scale takes up of the way from b's origin to the points, the shift has to answer for
        way = R @ middle_b
        covariance[3:, 3:] += (both**2 / float((moved**2).sum())) * np.outer(way, way)
    return Tie(T, scale, scale_sd, residuals, sd, covariance, free, left, 3 * n - 7)


def pooled(ties: list[Tie]) -> list[Tie]:
    """Give all pairs the standard deviation of a pick that they have together.

    Three points leave a pair two or three freedoms: its own standard deviation may be anything, and pairs weighed by it
    would be weighed by luck. A pair that scatters beyond chance keeps its own. Covariances are such that 1.96 standard
    deviations hold 95 %: with few freedoms (Student) more than the pooled one.
    """
    used = list(ties)
    while True:
        free = sum(one.free for one in used)
        sd = float(np.sqrt(sum(one.free * one.sd_mm**2 for one in used) / free))
        others = [(free * sd**2 - one.free * one.sd_mm**2) / max(free - one.free, 1) for one in used]
        beyond = [
            one.sd_mm**2 / max(rest, 1e-300) / f.isf(BY_CHANCE / len(ties), one.free, max(free - one.free, 1))
            for one, rest in zip(used, others, strict=True)
        ]
        if len(used) < 3 or max(beyond) <= 1.0:
            break
        del used[int(np.argmax(beyond))]
    kept = {id(one) for one in used}
    left_free = sum(one.left_free for one in used)
    left = float(np.sqrt(sum(one.left_free * one.left_mm**2 for one in used) / left_free))
    found = []
    for one in ties:
        apart = id(one) not in kept
        freedoms, of = (one.free, one.sd_mm) if apart else (free, sd)
        factor = of / one.sd_mm * float(student.isf(0.025, freedoms)) / NORMAL_95
        own = (one.left_mm, one.left_free) if apart else (left, left_free)
        found.append(
            replace(
                one, sd_mm=of, scale_sd=own[0] / one.left_mm * one.scale_sd, covariance=one.covariance * factor**2,
                left_mm=own[0], left_free=own[1], apart=apart,
            )
        )  # fmt: skip
    return found


def verdict(scale: float, sd: float, limit_ppm: float, free: float = np.inf) -> str:
    """Say what a scale other than 1 means, or nothing; ``free`` are the freedoms that ``sd`` is known by."""
    off = 1e6 * abs(scale - 1.0)
    slip = units_slip(scale)
    if slip:
        return f"scale {scale:.5g}: units mixed up ({slip})?"
    if off <= float(student.isf(0.5 * SCALE_BY_CHANCE, free)) * 1e6 * sd:
        return ""
    if off > limit_ppm:
        return f"scale {scale:.6f}: a blunder in the picks"
    width = 1e6 * NORMAL_95 * widened(sd, free)
    return f"scale {1e6 * (scale - 1.0):+.0f} ± {width:.0f} ppm: temperature (12 ppm a kelvin), instrument or picks"


def widened(sd: float, free: float) -> float:
    """Return a standard deviation such that 1.96 of it hold 95 %, of one that is known by a few freedoms alone."""
    return float(student.isf(0.025, free)) / NORMAL_95 * sd


def units_slip(scale: float) -> str:
    """Name the two units that a scale is the ratio of, to 2 %, or nothing."""
    return next(
        (units for ratio, units in UNIT_SLIPS if min(abs(scale / ratio - 1.0), abs(scale * ratio - 1.0)) < 0.02), ""
    )


def as_pair(a: int, b: int, found: Tie) -> Pair:
    """Write a tie as a pair of the network."""
    residual = float(np.sqrt((found.residuals**2).sum(axis=1).mean()))
    return Pair(a, b, len(found.residuals), found.T_a_b, found.covariance, residual, 0.0)


def adjusted(pairs: list[Pair], count: int, reference: int) -> tuple[Floats, Floats]:
    """Poses T_ref_scan (k, 4, 4) and their covariance (6k, 6k) of a network of pairs; NaN of scans it does not reach.

    The first poses are the paper's chain, from the reference on by the surest pairs; then all pairs are adjusted.
    Turns about the scans' own origins, along the reference's axes.
    """
    T = np.full((count, 4, 4), np.nan)
    T[reference] = np.eye(4)
    done = {reference}
    order = sorted(pairs, key=lambda one: (float(np.trace(one.covariance[3:, 3:])), one.a, one.b))
    while True:
        one = next((p for p in order if (p.a in done) != (p.b in done)), None)
        if one is None:
            break
        if one.a in done:
            T[one.b] = T[one.a] @ one.T_a_b
            done.add(one.b)
        else:
            T[one.a] = T[one.b] @ rigid.invert(one.T_a_b)
            done.add(one.a)
    used = [one for one in pairs if one.a in done and one.b in done]
    free = sorted(done - {reference})
    covariance = np.full((6 * count, 6 * count), np.nan)
    own = slice(6 * reference, 6 * reference + 6)
    covariance[own], covariance[:, own] = 0.0, 0.0
    rows = np.array([6 * s + np.arange(6) for s in free], np.int64).ravel()
    if not len(rows):
        return T, covariance
    for _ in range(10):
        N, g = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
        for one in used:
            A, r, W = _equation(one, T)
            at = np.concatenate([6 * one.a + np.arange(6), 6 * one.b + np.arange(6)])
            N[np.ix_(at, at)] += A.T @ W @ A
            g[at] += A.T @ W @ r
        step = np.zeros(6 * count)
        step[rows] = -np.linalg.solve(N[np.ix_(rows, rows)], g[rows])
        for s in free:
            d = step[6 * s : 6 * s + 6]
            T[s, :3, :3] = rigid.rotation_from_vector(d[:3]) @ T[s, :3, :3]
            T[s, :3, 3] += d[3:]
        if np.abs(step).max() < 1e-9:
            break
    covariance[np.ix_(rows, rows)] = np.linalg.inv(N[np.ix_(rows, rows)])
    return T, covariance


def _equation(one: Pair, T: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the derivative (6, 12) by both scans' motions, the misclosure (6,) in a's axes, and the weight."""
    R = T[one.a, :3, :3]
    now = rigid.invert(T[one.a]) @ T[one.b]
    r = frames.difference(now, one.T_a_b)
    arm = T[one.b, :3, 3] - T[one.a, :3, 3]
    A = np.zeros((6, 12))
    A[:3, :3], A[:3, 6:9] = -R.T, R.T
    A[3:, 3:6], A[3:, 9:] = -R.T, R.T
    A[3:, :3] = R.T @ rigid.cross_matrix(arm)
    weight: Floats = np.asarray(np.linalg.pinv(one.covariance, rcond=1e-14, hermitian=True), np.float64)
    return A, r, weight


# --- Picked common points of a scene, by pair of scans.


Picked = dict[tuple[int, int], tuple[Floats, Floats, tuple[str, ...]]]


def by_pair(picks: Picks | None, scans: Sequence[Scan]) -> Picked:
    """Gather picks by rows of two scans, the lesser first: points (n, 3) in each scan's file frame, and their names."""
    if picks is None:
        return {}
    row = {scan.name: i for i, scan in enumerate(scans)}
    found: dict[tuple[int, int], list[tuple[Floats, Floats, str]]] = {}
    for name_a, name_b, point, xa, xb in zip(
        picks.scan_a, picks.scan_b, picks.points, picks.in_a, picks.in_b, strict=True
    ):
        a, b = row[name_a], row[name_b]
        found.setdefault((min(a, b), max(a, b)), []).append((xa, xb, point) if a < b else (xb, xa, point))
    return {
        key: (np.array([r[0] for r in rows]), np.array([r[1] for r in rows]), tuple(r[2] for r in rows))
        for key, rows in sorted(found.items())
    }
