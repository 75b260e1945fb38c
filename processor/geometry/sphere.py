"""Fits of one sphere to points: algebraic least squares, random sample consensus, and a robust geometric fit.

The first two are those of paper 001 (Huang et al. 2019), equations 1-4 and 5-15. Every routine subtracts a local origin
first: in squares of georeferenced coordinates the digits of a ball are lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from processor.model import Bools, Floats, Ints
from processor.robust_statistics import TUKEY, biweight, robust_sd


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

    def residuals(self, points: Floats) -> Floats:
        """Signed distances (n,) in mm of points (n, 3) from the surface, outside positive."""
        distance: Floats = np.linalg.norm(points - self.centre, axis=1) - self.radius
        return distance


def canonical_order(points: Floats) -> Ints:
    """Rows (n,) that sort points (n, 3) by x, then y, then z: random samples then do not depend on the file's order."""
    return np.lexsort((points[:, 2], points[:, 1], points[:, 0])).astype(np.int64)


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
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-300)[:, None]
    band = np.clip(np.floor((direction[:, 2] + 1.0) * (BANDS / 2.0)), 0, BANDS - 1)
    turn = np.arctan2(direction[:, 1], direction[:, 0]) / (2.0 * np.pi) + 0.5
    sector = np.clip(np.floor(turn * SECTORS), 0, SECTORS - 1)
    return np.asarray(band * SECTORS + sector).astype(np.int64)


def visible_fraction(points: Floats, centre: Floats) -> float:
    """Share of the sphere's 200 cells of equal area that hold points (n, 3)."""
    return len(np.unique(sphere_cells(points, centre))) / (BANDS * SECTORS)


# --- Random sample consensus for one ball in a crop (paper 001, section 2.2 and table 1)


MINIMAL = 4
BATCH = 32


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


# --- Robust geometric fit


LEAST_SCALE = 1e-8  # of the radius: below any noise, above the rounding of points without noise
WINDOW = 4.0  # in scales: residuals within it determine the scale
STEEPEST = 0.3  # cosine of incidence below which the beam is split at the limb, and errors of angles dominate
ITERATIONS = 100
FREE_ITERATIONS = 40  # then the scale is fixed and rays that missed the ball stay out, so that the fit converges
LEAST = 6


@dataclass(frozen=True)
class RobustFit:
    """The sphere, the points (n,) of weight > 0, the scale (sd) of their residuals and whether the fit converged."""

    sphere: Sphere
    inliers: Bools
    scale: float
    converged: bool


def robust_fit(
    points: Floats,
    start: Sphere,
    scale_mm: float,
    radius_mm: float | None = None,
    scanner: Floats | None = None,
) -> RobustFit | None:
    """Fit a sphere to points (n, 3), of which many lie on something else, by Gauss-Newton with Tukey's biweight.

    The residual is the orthogonal distance or, where the scanner's position is known, the measured range minus the
    range at which the ray meets the sphere: noise runs along the ray, and only the second is unbiased for a ball seen
    from one side.

    Parameters
    ----------
    points : (n, 3), mm
    start : initial sphere, within a few scales of the ball; points more than a few ``scale_mm`` off it have weight 0.
    scale_mm : first scale of the residuals, an upper limit. The scale then follows from the median of the residuals in
        a window of 4 scales, so that many points off the sphere on one side do not widen it.
    radius_mm : fixed radius; its variance and covariances are then 0. None = estimated.
    scanner : (n, 3), the position each point was seen from, in the frame of the points; None = unknown.

    None where fewer than six points remain, or they do not determine a sphere. The covariance is the sandwich
    A^-1 B A^-1 of an M-estimator (Huber and Ronchetti 2009, eq. 6.6, times n / (n - p)). It assumes independent
    residuals: errors common to all points (registration, a bias of the scanner) are not included.
    """
    origin = start.centre
    local = points - origin
    seen_from = None if scanner is None else scanner - origin
    state = np.append(np.zeros(3), start.radius if radius_mm is None else radius_mm)
    free = 4 if radius_mm is None else 3
    scale = scale_mm
    tiny = LEAST_SCALE * start.radius
    converged = False
    considered = np.ones(len(points), bool)
    for iteration in range(ITERATIONS):
        residual, J = _linearised(local, state, seen_from)
        if iteration < FREE_ITERATIONS:
            scale = min(scale_mm, max(_scale(residual, scale), tiny))
        else:
            considered &= np.isfinite(residual)
        near = considered & (np.abs(residual) < TUKEY * scale)
        step = _step(residual[near], J[near, :free], scale) if np.count_nonzero(near) >= LEAST else None
        if step is None:
            return None
        largest = float(np.linalg.norm(step))
        # The step is limited: on a flat cap an unlimited one may leave the ball.
        step *= min(1.0, 0.2 * state[3] / max(largest, 1e-300))
        state[:free] += step
        if not 0.0 < state[3] < 1e3 * start.radius or not np.isfinite(state).all():
            return None
        if largest < 1e-10 * state[3]:
            converged = True
            break
    residual, J = _linearised(local, state, seen_from)
    covariance = np.zeros((4, 4))
    covariance[:free, :free] = _sandwich(J[:, :free], residual / scale, scale)
    inliers = np.asarray(np.abs(residual) < TUKEY * scale, bool)
    return RobustFit(Sphere(origin + state[:3], float(state[3]), covariance), inliers, scale, converged)


def bound(points: Floats, fit: RobustFit, radius_held: bool = False, scanner: Floats | None = None) -> Floats:
    """Cramér-Rao bound (4, 4) of the covariance of an unbiased estimate from the points of a fit.

    Every inlier has full weight and normal noise of the fit's scale; ``points`` (n, 3) and ``scanner`` (n, 3) are those
    that were fitted. NaN where the points do not determine the sphere.
    """
    state = np.append(np.zeros(3), fit.sphere.radius)
    on = fit.inliers
    seen_from = None if scanner is None else scanner[on] - fit.sphere.centre
    residual, J = _linearised(points[on] - fit.sphere.centre, state, seen_from)
    free = 3 if radius_held else 4
    J = J[np.isfinite(residual), :free]
    covariance = np.zeros((4, 4))
    N = J.T @ J
    covariance[:free, :free] = fit.scale**2 * np.linalg.inv(N) if np.linalg.cond(N) < 1e12 else np.nan
    return covariance


def _linearised(points: Floats, state: Floats, scanner: Floats | None) -> tuple[Floats, Floats]:
    """Residuals (n,), measured minus model, and the model's derivatives (n, 4); NaN where the ray misses the sphere."""
    centre, radius = state[:3], state[3]
    if scanner is None:
        out = points - centre
        distance = np.linalg.norm(out, axis=1)
        J = np.column_stack([out / np.maximum(distance, 1e-300)[:, None], np.ones(len(points))])
        return distance - radius, J
    ray = points - scanner
    length = np.linalg.norm(ray, axis=1)
    ray = ray / np.maximum(length, 1e-300)[:, None]
    to_centre = centre - scanner
    along = np.einsum("ni,ni->n", ray, to_centre)
    off = to_centre - along[:, None] * ray
    under = radius**2 - np.sum(off**2, axis=1)
    met = under > (STEEPEST * radius) ** 2
    root = np.sqrt(np.where(met, under, radius**2))
    J = np.column_stack([ray + off / root[:, None], -radius / root])
    residual = np.where(met, length - (along - root), np.nan)
    return residual, J


def _step(residual: Floats, J: Floats, scale: float) -> Floats | None:
    """Gauss-Newton step (p,) with Tukey's weights; None where the points do not determine a sphere."""
    w = biweight(residual / (TUKEY * scale))
    N = (J * w[:, None]).T @ J
    if np.linalg.cond(N) > 1e12:
        return None
    step: Floats = np.linalg.solve(N, (J * w[:, None]).T @ residual)
    return step


def _scale(residual: Floats, scale: float) -> float:
    """Scale by the residuals within 4 scales."""
    size = np.abs(residual)
    near = size[size <= WINDOW * scale]
    return robust_sd(near) if len(near) else scale


def _sandwich(J: Floats, u: Floats, scale: float) -> Floats:
    """Covariance of the estimate from derivatives J (n, p) and residuals u (n,) in scales."""
    near = np.abs(u) < TUKEY
    J, u = J[near], u[near]
    q = 1.0 - (u / TUKEY) ** 2
    psi, slope = u * q**2, q * (1.0 - 5.0 * (u / TUKEY) ** 2)
    n, p = J.shape
    A = (J * slope[:, None]).T @ J
    B = (J * (psi**2)[:, None]).T @ J
    if np.linalg.cond(A) > 1e12:
        return np.full((p, p), np.nan)
    inverse = np.linalg.inv(A)
    covariance = scale**2 * n / max(n - p, 1) * inverse @ B @ inverse
    symmetric: Floats = 0.5 * (covariance + covariance.T)
    return symmetric
