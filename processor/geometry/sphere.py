"""Fits of one sphere to points: algebraic least squares and random sample consensus.

Both are those of paper 001 (Huang et al. 2019), equations 1-4 and 5-15. Every routine subtracts a local origin
first: in squares of georeferenced coordinates the digits of a ball are lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from processor.model import Bools, Floats, Ints


@dataclass(frozen=True)
class Sphere:
    """Centre (3,) and radius in mm, with the covariance (4, 4) of x, y, z and radius."""

    centre: Floats
    radius: float
    covariance: Floats

    @property
    def lowest_sd(self) -> float:
        """Standard deviation in mm of the lowest point's height, centre z - radius, with the correlation of the two."""
        variance = self.covariance[2, 2] + self.covariance[3, 3] - 2.0 * self.covariance[2, 3]
        return float(np.sqrt(max(variance, 0.0)))

    def moved_to(self, other: Sphere) -> Floats:
        """Return the difference (4,) in mm of centre and radius of another sphere."""
        return np.append(other.centre - self.centre, other.radius - self.radius)

    def widened_by(self, moved: Floats, by_chance: Floats | None = None) -> Sphere:
        """Return the sphere whose covariance holds a difference (4,) of centre and radius as one standard deviation.

        With a covariance ``by_chance`` (4, 4) only what is left of the difference beyond that of chance: the square of
        the difference less its mean.
        """
        share = 1.0
        if by_chance is not None:
            free = np.flatnonzero(np.diag(by_chance) > 0.0)
            chi2 = float(moved[free] @ np.linalg.pinv(by_chance[free[:, None], free], hermitian=True) @ moved[free])
            share = max(0.0, 1.0 - len(free) / chi2) if chi2 > 0.0 else 0.0
        return replace(self, covariance=self.covariance + share * np.outer(moved, moved))

    def residuals(self, points: Floats) -> Floats:
        """Signed distances (n,) in mm of points (n, 3) from the surface, outside positive."""
        distance: Floats = lengths(points - self.centre) - self.radius
        return distance


def lengths(vectors: Floats) -> Floats:
    """Lengths (n,) of vectors (n, 3), in a third of the time of numpy.linalg.norm."""
    square: Floats = np.einsum("ni,ni->n", vectors, vectors)
    return np.sqrt(square)


def canonical_order(points: Floats) -> Ints:
    """Rows (n,) that sort points (n, 3) by x, then y, then z: random samples then do not depend on the file's order."""
    order = np.argsort(points[:, 0])
    x = points[order, 0]
    if (x[1:] == x[:-1]).any():  # else a third of the time is enough
        order = np.lexsort((points[:, 2], points[:, 1], points[:, 0]))
    return order.astype(np.int64)


def algebraic(points: Floats) -> Sphere | None:
    """Sphere of least squared algebraic distance to points (n, 3), n >= 4 (paper 001, eq. 12-15).

    None where the points determine no sphere (fewer than four, or all in one plane). The covariance is formal: it
    assumes independent noise and an unbiased model, while this estimator makes partly seen balls too small and gives
    every outlier its full weight. It is NaN for exactly four points, which have no redundancy.
    """
    if len(points) < 4:
        return None
    origin = points.mean(axis=0)
    local = points - origin
    # Scaled to unit size, the columns of eq. 14 are of one magnitude.
    size = float(np.sqrt(np.mean(np.sum(local**2, axis=1))))
    if not size > 0.0:
        return None
    local = local / size
    A = np.column_stack([-2.0 * local, np.ones(len(local))])
    b = -np.sum(local**2, axis=1)
    U, singular, Vt = np.linalg.svd(A, full_matrices=False)
    if singular[3] <= 1e-9 * singular[0]:
        return None
    solution = Vt.T @ ((U.T @ b) / singular)
    centre = solution[:3]
    radius = float(np.sqrt(max(centre @ centre - solution[3], 0.0)))
    if not radius > 0.0:
        return None
    dof = len(points) - 4
    variance = float(np.sum((A @ solution - b) ** 2)) / dof if dof > 0 else float("nan")
    # r^2 = c.c - m, so dr = (c.dc - dm / 2) / r
    J = np.eye(4)
    J[3] = np.append(centre, -0.5) / radius
    half = J @ (Vt.T / singular)
    return Sphere(origin + size * centre, size * radius, variance * size**2 * (half @ half.T))


def through_four(quads: Floats) -> tuple[Floats, Floats]:
    """Centres (m, 3) and radii (m,) of the spheres through four points each, quads (m, 4, 3); NaN where coplanar.

    Paper 001, eq. 10-11 by cofactors; the last cofactor there is misprinted and is a e - b d.
    """
    first = quads[:, 0]
    rows = quads[:, 1:] - first[:, None]
    rhs = 0.5 * np.sum(rows**2, axis=2)
    (a, b, c), (d, e, f), (g, h, i) = (rows[:, k].T for k in range(3))
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    cofactors = np.stack(
        [
            np.stack([e * i - f * h, c * h - b * i, b * f - c * e], axis=1),
            np.stack([f * g - d * i, a * i - c * g, c * d - a * f], axis=1),
            np.stack([d * h - e * g, b * g - a * h, a * e - b * d], axis=1),
        ],
        axis=1,
    )
    size = np.linalg.norm(rows, axis=2).max(axis=1)
    flat = np.abs(det) <= 1e-9 * size**3
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.einsum("mij,mj->mi", cofactors, rhs) / det[:, None]
    offset[flat] = np.nan
    return first + offset, np.linalg.norm(offset, axis=1)


BANDS, SECTORS = 10, 20  # cells of equal area that the visible share of a sphere is counted in


def sphere_cells(points: Floats, centre: Floats) -> Ints:
    """Cell (n,) of a sphere that each point (n, 3) lies in: 200 of equal area, 10 bands in height by 20 sectors."""
    direction = points - centre
    direction = direction / np.maximum(lengths(direction), 1e-300)[:, None]
    band = np.clip(np.floor((direction[:, 2] + 1.0) * (BANDS / 2.0)), 0, BANDS - 1)
    turn = np.arctan2(direction[:, 1], direction[:, 0]) / (2.0 * np.pi) + 0.5
    sector = np.clip(np.floor(turn * SECTORS), 0, SECTORS - 1)
    return np.asarray(band * SECTORS + sector).astype(np.int64)


def visible_fraction(points: Floats, centre: Floats) -> float:
    """Share of the sphere's 200 cells of equal area that hold points (n, 3)."""
    return np.count_nonzero(np.bincount(sphere_cells(points, centre))) / (BANDS * SECTORS)


# --- Random sample consensus for one ball in a crop (paper 001, section 2.2 and table 1)


MINIMAL = 4  # points that determine a sphere
BATCH = 32  # work: draws fitted at once


@dataclass(frozen=True)
class Consensus:
    """The sphere, its inliers (n,), and the numbers of minimal sets tried and needed."""

    sphere: Sphere
    inliers: Bools
    trials: int
    needed: float


def trials_needed(probability: float, inlier_share: float) -> float:
    """Return the number N of minimal sets of which one has no outlier, by probability p: log(1 - p) / log(1 - w^4).

    Infinite for no inliers, 1 for inliers alone. Source: Fischler and Bolles; the adaptive N of paper 001.
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

    None where no four points determine a sphere. Points are put in canonical order before any is drawn, so that the
    result depends on the generator and not on the order of the points. The adaptive N stops soon after the first
    minimal set without outliers, however noisy it is: the result varies with the seed. The covariance is that of the
    last fit.
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
