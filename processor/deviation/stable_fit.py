"""Rigid motions of a scan relative to its design: the best fit of all steel, and that of the steel that is stable.

As in deformation monitoring, a structure of which a part moved is related to its design by the largest part that
agrees with one rigid motion. The movements at the core points are combined in blocks, each with up to three orthogonal
directions. A random sample consensus (Fischler and Bolles 1981, scored as by Torr and Zisserman 2000) finds the motion
that the largest area agrees with; iteratively reweighted least squares (Tukey's biweight) refine it. Covariances are
sandwiches over clusters of blocks (Liang and Zeger 1986), for clusters of several sizes: the largest one is taken, as
residuals may agree over any length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.adjustment import robust_least_squares
from processor.adjustment.body_motions import distance_derivative, transform_about, variances
from processor.adjustment.point_groups import group_sums
from processor.deviation.local_translation import Movement
from processor.distinct_rows import distinct
from processor.geometry import rigid
from processor.geometry.m3c2 import Z95
from processor.geometry.mesh_distance import Samples
from processor.model import Floats, Ints
from processor.robust_statistics import CHI2_MEDIAN, TUKEY, biweight, biweight_slope

BLOCKS_ALONG = 40.0  # blocks along the extent of the structure
BLOCK_DIAMETERS = 3.0  # least side of a block
LEVELS = 3  # sizes of blocks, each twice the last: a movement that grows gradually shows in large ones first
LEAST_STRENGTH = 0.005  # share of a block's points along a direction, below which its curvature would count as a face
TRIALS, BLOCKS_A_TRIAL, REFINED = 400, 3, 6  # 1 in 64 is of stable blocks where a quarter is stable
ITERATIONS, CONVERGED_MM = 30, 1e-6  # work: of reweighting, ended by a movement that is rounding
AGREES = 2.5  # standard deviations within which a block agrees with a motion
MOST_CONDITION = 1e10  # of normal equations: float64 leaves six digits
FEWEST_CLUSTERS = 12  # for a sandwich with six unknowns


@dataclass(frozen=True)
class RigidFit:
    """Rigid ``motion`` (4, 4) that the scan has relative to the design, in the core points' frame.

    ``covariance`` (6, 6) is of its rotation about the frame's origin and its translation; both are NaN where the points
    do not determine the motion. ``error_mm`` is the mean over the core points of the standard deviation along their
    normals, of what is determined. ``share`` of the measured area is what the fit rests on.
    """

    motion: Floats
    covariance: Floats
    error_mm: float
    share: float


@dataclass(frozen=True)
class Fits:
    """The best fit of all the area measured, and the fit of its stable part; ``limit_mm`` within which that agrees."""

    best: RigidFit
    stable: RigidFit
    limit_mm: float

    def of(self, name: str) -> RigidFit:
        """Return the fit ``stable`` or ``all``."""
        return self.stable if name == "stable" else self.best

    @property
    def determined(self) -> bool:
        """Whether the points determine both motions."""
        return bool(np.isfinite(self.best.motion).all() and np.isfinite(self.stable.motion).all())


UNDETERMINED = RigidFit(np.full((4, 4), np.nan), np.full((6, 6), np.nan), float("nan"), float("nan"))  # no motion


@dataclass(frozen=True)
class _Blocks:
    """Observations (m,) of block translations: value = J (m, 6) x motion, with variance, area, block and centre.

    Motions are about ``middle`` (3,), rotations in units of 1 / ``arm``. ``first_point`` is a core point of each block,
    ``of_point`` (k,) the block of each core point.
    """

    value: Floats
    J: Floats
    variance: Floats
    area: Floats
    block: Ints
    centre: Floats
    middle: Floats
    arm: float
    side: float
    first_point: Ints
    of_point: Ints


def overlap(diameter_mm: float, spacing_mm: float) -> float:
    """At how many core points, one per ``spacing_mm`` squared, a scanned point counts: their circles overlap."""
    return float(max(1.0, 0.25 * np.pi * (diameter_mm / spacing_mm) ** 2))


def fits(
    core: Samples, moved: Movement, diameter_mm: float, spacing_mm: float, seed: int, view_sd_mm: float = 0.0
) -> Fits:
    """Fit rigid motions to movements at core points, one per ``spacing_mm`` squared.

    ``view_sd_mm`` is the standard deviation of what the points of a view have in common.
    """
    known = np.flatnonzero(np.isfinite(moved.along) & np.isfinite(moved.sd))
    nothing = Fits(UNDETERMINED, UNDETERMINED, float("nan"))
    if len(known) < FEWEST_CLUSTERS:
        return nothing
    error = moved.sd[known] / np.sqrt(moved.count[known])
    places = core.points[known], core.normals[known]
    sd = np.sqrt(overlap(diameter_mm, spacing_mm)) * error
    blocks = _blocks(*places, moved.along[known], sd, diameter_mm)
    if int(blocks.block.max()) + 1 < FEWEST_CLUSTERS:
        return nothing
    wavy, common = _short_range(blocks), view_sd_mm**2
    variance = blocks.variance + wavy + common
    best = _solved(blocks, 1.0 / variance)
    limit = np.maximum(AGREES * np.sqrt(variance), Z95 * float(np.median(error)))
    stable = _consensus(blocks, best, limit, seed)
    levels = [_Level(blocks, blocks.block, _scaled(blocks, stable, np.sqrt(variance), limit))]
    for level in range(1, LEVELS):
        larger = _blocks(*places, moved.along[known], sd, diameter_mm, 2.0**level)
        parent = larger.of_point[blocks.first_point][blocks.block]
        inside = np.bincount(parent, minlength=int(larger.block.max()) + 1)[larger.block]
        scale = np.sqrt(larger.variance + wavy / inside + common)
        scale = _scaled(larger, stable, scale, np.full(len(scale), np.median(limit)))
        levels.append(_Level(larger, parent, scale))
    stable, small = _reweighted(levels, stable), _reweighted(levels[:1], stable)
    share = float(blocks.area[_worst(blocks, stable[None], limit)[0] <= 1.0].sum() / blocks.area.sum())
    worst, scale = _largest(levels, stable), levels[0].sd
    weight = biweight(worst / TUKEY)
    z = np.abs(blocks.value - blocks.J @ stable) / scale
    slope = np.where(z < worst, weight, biweight_slope(z / TUKEY))
    return Fits(
        best=_fit(blocks, best, 1.0 / variance, 1.0 / variance, 1.0, places),
        # What the larger blocks changed shows what is left of movements too small for any block.
        stable=_fit(blocks, stable, weight / scale**2, slope / scale**2, share, places, stable - small),
        limit_mm=float(np.median(limit)),
    )


@dataclass(frozen=True)
class _Level:
    """Blocks of one size, the ``parent`` (m,) of them that each smallest observation is in, and their sd (m,)."""

    blocks: _Blocks
    parent: Ints
    sd: Floats


def _blocks(
    points: Floats, normals: Floats, along: Floats, error: Floats, diameter: float, times: float = 1.0
) -> _Blocks:
    """Combine movements in blocks: weighted least squares of a translation, along its principal directions."""
    middle, extent = points.mean(axis=0), np.ptp(points, axis=0)
    arm = max(0.5 * float(np.linalg.norm(extent)), 1e-6)
    side = times * max(BLOCK_DIAMETERS * diameter, float(extent.max()) / BLOCKS_ALONG)
    found = distinct(_cells(points, side))
    first, block, count = found.first, found.number, found.count
    centre = group_sums(points, block) / count[:, None]
    J = distance_derivative((points - middle) / arm, normals)
    weighted = normals / np.maximum(error, 1e-6)[:, None] ** 2
    b = group_sums(weighted * along[:, None], block)
    # Of a translation (the last three columns) by the motion of the whole
    B = group_sums((weighted[:, :, None] * J[:, None]).reshape(-1, 18), block).reshape(-1, 3, 6)
    w, V = np.linalg.eigh(B[:, :, 3:])
    row, k = np.nonzero(w > LEAST_STRENGTH * w.sum(axis=1)[:, None])
    direction, strength = V[row, :, k], w[row, k]
    value = np.einsum("mi,mi->m", direction, b[row]) / strength
    area = count[row] * strength / np.bincount(row, strength, len(count))[row]
    J = np.einsum("mi,mij->mj", direction, B[row]) / strength[:, None]
    return _Blocks(
        value=value, J=J, variance=1.0 / strength, area=area, block=row, centre=centre, middle=middle,
        arm=arm, side=side, first_point=first, of_point=block,
    )  # fmt: skip


def _cells(points: Floats, side: float) -> Ints:
    # Of a part too small for its blocks there may be no point.
    low = points.min(axis=0) if len(points) else np.zeros(points.shape[1])
    cells: Ints = np.floor((points - low) / side).astype(np.int64)
    return cells


def _short_range(blocks: _Blocks) -> float:
    """Variance of movements from one block to the next beyond that of their noise, mm^2: waviness of the surface."""
    direction = blocks.J[:, 3:]
    sign = np.where(direction[np.arange(len(direction)), np.argmax(np.abs(direction), axis=1)] < 0.0, -1.0, 1.0)
    place = np.hstack([blocks.centre[blocks.block] / blocks.side, 4.0 * sign[:, None] * direction])
    other = cKDTree(place).query(place, k=2)[1][:, 1]
    square = 0.5 * (sign * blocks.value - (sign * blocks.value)[other]) ** 2
    noise = 0.5 * (blocks.variance + blocks.variance[other])
    return max(0.0, float(np.median(square) / CHI2_MEDIAN - np.median(noise)))


def _solved(blocks: _Blocks, weight: Floats) -> Floats:
    """Return the motion (6,) of weighted least squares."""
    N, g = robust_least_squares.normal_equations(blocks.J, weight, blocks.value)
    return np.asarray(np.linalg.lstsq(N, g, rcond=1.0 / MOST_CONDITION)[0])


def _consensus(blocks: _Blocks, best: Floats, limit: Floats, seed: int) -> Floats:
    """Return the motion (6,) that the largest area agrees with, of trials on few blocks, each refined."""
    J, weight = blocks.J, 1.0 / blocks.variance
    count = int(blocks.block.max()) + 1
    sums = np.zeros((count, 6, 7))
    np.add.at(
        sums, blocks.block, weight[:, None, None] * J[:, :, None] * np.hstack([J, blocks.value[:, None]])[:, None]
    )
    size = np.bincount(blocks.block, blocks.area, count)
    rng = np.random.default_rng(seed)
    drawn = sums[rng.choice(count, (TRIALS, BLOCKS_A_TRIAL), p=size / size.sum())].sum(axis=1)
    sound = np.linalg.cond(drawn[:, :, :6]) < MOST_CONDITION
    trials = np.linalg.solve(drawn[sound, :, :6], drawn[sound, :, 6:])[:, :, 0]
    trials = np.vstack([best, trials])
    first = np.argsort(-_scores(blocks, trials, limit), kind="stable")[:REFINED]
    candidates = [best, *(trials[k] for k in first)]
    level = _Level(blocks, blocks.block, limit / AGREES)
    refined = np.array([_reweighted([level], x) for x in candidates])
    return np.asarray(refined[np.argmax(_scores(blocks, refined, limit))])


def _worst(blocks: _Blocks, motions: Floats, scale: Floats) -> Floats:
    """Largest residual (t, m) of motions (t, 6), over ``scale`` (m,), in any direction of each observation's block."""
    residual = np.abs(blocks.value - motions @ blocks.J.T) / scale
    largest = np.maximum.reduceat(residual, np.unique(blocks.block, return_index=True)[1], axis=1)
    worst: Floats = largest[:, np.unique(blocks.block, return_inverse=True)[1].reshape(-1)]
    return worst


def _scores(blocks: _Blocks, motions: Floats, limit: Floats) -> Floats:
    """Area (t,) that agrees with motions (t, 6), less for larger residuals."""
    scores: Floats = np.maximum(0.0, 1.0 - _worst(blocks, motions, limit) ** 2) @ blocks.area
    return scores


def _reweighted(levels: list[_Level], motion: Floats) -> Floats:
    """Refine a motion (6,): blocks lose weight if they, or the larger blocks they are in, do not agree with it."""
    blocks, sd = levels[0].blocks, levels[0].sd
    return robust_least_squares.reweighted(
        motion,
        lambda motion: biweight(_largest(levels, motion) / TUKEY) / sd**2,
        lambda _, weight: _solved(blocks, weight),
        ITERATIONS,
        lambda step: bool(np.abs(step).max() < CONVERGED_MM),
    )[0]


def _largest(levels: list[_Level], motion: Floats) -> Floats:
    """Return the largest residual (m,) in sd of a motion (6,) in any block that each smallest observation is in."""
    largest: Floats = np.zeros(len(levels[0].parent))
    for level in levels:
        worst = np.zeros(int(level.blocks.block.max()) + 1)
        worst[level.blocks.block] = _worst(level.blocks, motion[None], level.sd)[0]
        largest = np.maximum(largest, worst[level.parent])
    return largest


def _scaled(blocks: _Blocks, motion: Floats, sd: Floats, limit: Floats) -> Floats:
    """Return standard deviations (m,) raised to the scale of the residuals of the blocks that agree with a motion."""
    z = (blocks.value - blocks.J @ motion) / sd
    near = _worst(blocks, motion[None], limit)[0] <= 1.0
    return sd * (max(1.0, float(np.sqrt(np.median(z[near] ** 2) / CHI2_MEDIAN))) if near.any() else 1.0)


def _fit(
    blocks: _Blocks,
    motion: Floats,
    weight: Floats,
    slope: Floats,
    share: float,
    places: tuple[Floats, Floats],
    bias: Floats | float = 0.0,
) -> RigidFit:
    """Return a motion (6,) in the core points' frame with its covariance: the largest of sandwiches over clusters.

    The square of a ``bias`` (6,) is added to the covariance.
    """
    J = blocks.J
    N = J.T @ (slope[:, None] * J)
    inverse = np.linalg.pinv(N, rcond=1.0 / MOST_CONDITION, hermitian=True)
    gradient = J * (weight * (blocks.value - J @ motion))[:, None]
    used = weight > 0.0
    scaling = np.diag(np.repeat([1.0 / blocks.arm, 1.0], 3))
    square = np.outer(bias + np.zeros(6), bias + np.zeros(6))
    covariance, error, side = np.full((6, 6), np.nan), -1.0, 1.0
    while True:
        cell = distinct(_cells(blocks.centre[blocks.block[used]] / blocks.side, side)).number
        if cell.max(initial=-1) + 1 < FEWEST_CLUSTERS:
            break
        at_middle = scaling @ (robust_least_squares.sandwich(inverse, gradient[used], cell) + square) @ scaling
        at_origin = rigid.about_origin(at_middle, blocks.middle)
        along = float(np.mean(np.sqrt(variances(distance_derivative(*places), at_origin))))
        if along > error:
            covariance, error = at_origin, along
        side *= 2.0
    if error < 0.0 or not np.linalg.cond(N) < MOST_CONDITION:
        return RigidFit(UNDETERMINED.motion, UNDETERMINED.covariance, error if error >= 0.0 else float("nan"), share)
    return RigidFit(transform_about(scaling @ motion, blocks.middle), covariance, error, share)
