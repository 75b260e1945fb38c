"""The source paper's random sample consensus for one ball in a crop (paper 001, section 2.2 and table 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from processor.geometry.sphere import Mask, Sphere, algebraic, canonical_order, through_four
from processor.model import Floats

MINIMAL = 4
BATCH = 32


@dataclass(frozen=True)
class Consensus:
    """The sphere, the points (n,) it rests on, and how many minimal sets were tried of those called for."""

    sphere: Sphere
    inliers: Mask
    trials: int
    needed: float


def trials_needed(probability: float, inlier_share: float) -> float:
    """Minimal sets N so that one is free of outliers with a probability: log(1 - p) / log(1 - w^4).

    Infinite for no inliers, one for inliers alone. Source: Fischler and Bolles; the adaptive N of paper 001.
    """
    clean = inlier_share**MINIMAL
    if clean <= 0.0:
        return math.inf
    if clean >= 1.0:
        return 1.0
    return max(1.0, math.log(1.0 - probability) / math.log1p(-clean))


def ransac(
    points: Floats,
    rng: np.random.Generator,
    tau_mm: float = 4.0,
    probability: float = 0.99,
    max_trials: int = 10_000,
) -> Consensus | None:
    """Fit a sphere to points (n, 3) by consensus within ``tau_mm`` of the surface, then algebraic least squares.

    None where no four points make a sphere. Points are put in canonical order before any is drawn, so the answer
    depends on the generator and not on the order of the points. The adaptive N stops soon after the first minimal set
    without outliers, however noisy: the answer varies with the seed, and its covariance (of the last fit) is formal.
    """
    order = canonical_order(points)
    local = points[order] - points.mean(axis=0)
    n = len(local)
    if n < MINIMAL:
        return None
    best, best_count = None, 0
    trials, needed = 0, math.inf
    while trials < min(needed, max_trials):
        draws = np.array([rng.choice(n, MINIMAL, replace=False, shuffle=False) for _ in range(BATCH)])
        centres, radii = through_four(local[draws])
        distance = np.linalg.norm(local[None] - centres[:, None], axis=2)
        close = np.abs(distance - radii[:, None]) <= tau_mm
        for mask, count in zip(close, close.sum(axis=1), strict=True):
            trials += 1
            if count > best_count:
                best, best_count = mask, int(count)
                needed = trials_needed(probability, best_count / n)
            if trials >= min(needed, max_trials):
                break
    if best is None:
        return None
    inliers = np.zeros(n, bool)
    inliers[order] = best
    sphere = algebraic(points[inliers])
    return None if sphere is None else Consensus(sphere, inliers, trials, needed)
