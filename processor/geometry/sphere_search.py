"""Search for balls in a whole cloud, without a design or a crop.

Spheres are proposed by four points drawn from one neighbourhood, of many sizes. A ball is accepted if the points within
the noise of its surface far outnumber those beside it, which no plane, edge, tube or volume achieves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry.sphere import (
    RobustFit,
    Sphere,
    algebraic,
    canonical_order,
    robust_fit,
    sphere_cells,
    through_four,
    visible_fraction,
)
from processor.model import Floats

SUBSAMPLE = 8000  # points for proposals and their scores; all points only for the final fit
SEEDS = 300
SETS_PER_SIZE = 2
SIZES = 8  # of neighbourhoods, from 16 points to most of the cloud
LEAST_POINTS = 40  # on a ball; with fewer, balls occur anywhere by chance
REFINED = 40  # best proposals, which are refined
STANDS_OUT = 3.5  # times as dense at the surface as beside it; a tube reaches 2.4
ROUGHEST = 0.05  # noise over radius, above which a ball is not distinguishable from a cluster of points
FACING = 0.975  # median cosine between the cloud's own normals and the ball's
MISFIT = 0.5  # of the scale: cell means of residuals on a ball are noise alone
LEAST_VISIBLE = 0.08  # share of the sphere
LARGEST_SD = 0.05  # of the radius or, where it is fixed, of the centre, in radii
RADIUS_BAND = 0.15  # proposals within this share of a fixed radius


@dataclass(frozen=True)
class Ball:
    """A ball in the cloud, and the share of the points around it that lie on it."""

    fit: RobustFit
    inlier_share: float


def local_noise(points: Floats, neighbours: int = 24, sample: int = 400) -> float:
    """Noise in mm across the surface of points (n, 3), n > 6, from quadrics fitted to neighbourhoods.

    It is a low quantile of the standard deviations: up to half of the neighbourhoods may lie at edges or mixed pixels.
    """
    k = min(neighbours, len(points))
    if k <= 6:
        return float("nan")
    tree = cKDTree(points)
    query = points[:: max(1, len(points) // sample)]
    near = points[tree.query(query, k=k)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("mki,mkj->mij", near, near))[1]
    frame = np.einsum("mki,mij->mkj", near, axes)
    size = np.maximum(np.abs(frame[:, :, 1:]).max(axis=(1, 2)), 1e-300)
    z, x, y = (frame[:, :, i] / size[:, None] for i in range(3))
    A = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=2)
    Q, _ = np.linalg.qr(A)
    left = z - np.einsum("mki,mi->mk", Q, np.einsum("mki,mk->mi", Q, z))
    sd = size * np.sqrt(np.sum(left**2, axis=1) / (k - 6))
    return float(np.quantile(sd, 0.35))


def find_ball(
    points: Floats,
    rng: np.random.Generator,
    least_points: int = LEAST_POINTS,
    radius_mm: float | None = None,
    scanner: Floats | None = None,
) -> Ball | None:
    """Find the clearest ball among points (n, 3), mm, or None.

    ``radius_mm`` fixes the radius; ``scanner`` (n, 3) is the position each point was seen from. Work is bounded:
    proposals come from at most SUBSAMPLE points, so that a ball of a few points in millions is not found. Points are
    put in canonical order, so that the result does not depend on theirs.
    """
    if len(points) < least_points:
        return None
    order = canonical_order(points)
    origin = points.mean(axis=0)
    cloud = points[order] - origin
    few = cloud
    if len(cloud) > SUBSAMPLE:
        few = cloud[np.sort(rng.choice(len(cloud), SUBSAMPLE, replace=False))]
    extent = float(np.linalg.norm(np.ptp(cloud, axis=0)))
    noise = max(local_noise(cloud), 1e-6 * extent)
    tau = 3.0 * noise
    centres, radii = _proposals(few, rng)
    fits = (radii > 4.0 * tau) & (radii < extent)
    if radius_mm is not None:
        fits &= np.abs(radii - radius_mm) < RADIUS_BAND * radius_mm
    centres, radii = centres[fits], radii[fits]
    best = np.argsort(-_scores(few, centres, radii, tau), kind="stable")[:REFINED]
    refined = [_refined(few, Sphere(centres[i], float(radii[i]), np.zeros((4, 4))), tau) for i in best]
    candidates = sorted(
        ((_score(few, ball, tau), i) for i, ball in enumerate(refined) if ball is not None), key=lambda c: (-c[0], c[1])
    )
    seen_from = None if scanner is None else scanner[order] - origin
    for _, i in candidates:
        start = refined[i]
        if start is None:
            continue
        if few is not cloud:
            # All points are used only for a ball that is accepted among the subsample.
            trial = robust_fit(few, start, 2.0 * noise, radius_mm)
            if trial is None or not _stands_out(few, trial, noise, 8):
                continue
            start = trial.sphere
        near = np.flatnonzero(start.residuals(cloud) < 0.6 * start.radius)
        fit = robust_fit(cloud[near], start, 2.0 * noise, radius_mm, None if seen_from is None else seen_from[near])
        if fit is not None and fit.sphere.radius <= extent and _stands_out(cloud[near], fit, noise, least_points):
            off = fit.sphere.residuals(cloud[near])
            share = float(fit.inliers.sum() / max(int(np.count_nonzero(off <= 0.4 * fit.sphere.radius)), 1))
            inliers = np.zeros(len(points), bool)
            inliers[order[near]] = fit.inliers
            ball = Sphere(fit.sphere.centre + origin, fit.sphere.radius, fit.sphere.covariance)
            return Ball(RobustFit(ball, inliers, fit.scale, fit.converged), min(1.0, share))
    return None


def find_balls(
    points: Floats,
    rng: np.random.Generator,
    most: int,
    least_points: int = LEAST_POINTS,
    radius_mm: float | None = None,
    scanner: Floats | None = None,
) -> list[Ball]:
    """Find up to ``most`` balls one after another, as :func:`find_ball`; inliers are of all points (n,).

    Points within 1.5 radii of a ball are not searched again, and balls never overlap, so that mixed pixels and mounts
    around a ball do not make a second one.
    """
    left = np.arange(len(points))
    balls: list[Ball] = []
    for _ in range(2 * most):
        if len(balls) == most:
            break
        candidate = find_ball(points[left], rng, least_points, radius_mm, None if scanner is None else scanner[left])
        if candidate is None:
            break
        ball = candidate.fit.sphere
        inliers = np.zeros(len(points), bool)
        inliers[left[candidate.fit.inliers]] = True
        if all(
            np.linalg.norm(ball.centre - other.fit.sphere.centre) > 0.9 * (ball.radius + other.fit.sphere.radius)
            for other in balls
        ):
            fit = RobustFit(ball, inliers, candidate.fit.scale, candidate.fit.converged)
            balls.append(Ball(fit, candidate.inlier_share))
            left = left[ball.residuals(points[left]) > 0.5 * ball.radius]
        else:
            left = left[~inliers[left]]
    return balls


def _proposals(points: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    n = len(points)
    seeds = rng.choice(n, min(SEEDS, n), replace=False)
    sizes = np.unique(np.geomspace(min(16, n), max(min(16, n), 0.8 * n), SIZES).astype(int))
    quads = []
    for seed in seeds:
        nearest = np.argsort(np.sum((points - points[seed]) ** 2, axis=1), kind="stable")
        draws = rng.random((len(sizes), SETS_PER_SIZE, 4)) * sizes[:, None, None]
        quads.append(nearest[draws.astype(np.int64)].reshape(-1, 4))
    return through_four(points[np.vstack(quads)])


def _scores(points: Floats, centres: Floats, radii: Floats, tau: float) -> Floats:
    """Score (m,): points at the surface less half of those beside it, over every k-th point; 0 for a volume."""
    some = points[:: max(1, len(points) // 3000)]
    squares = np.sum(some**2, axis=1)
    scores = np.empty(len(radii))
    for i in range(0, len(radii), 256):
        c = centres[i : i + 256]
        square = squares - 2.0 * c @ some.T + np.sum(c**2, axis=1)[:, None]
        off = np.abs(np.sqrt(np.maximum(square, 0.0)) - radii[i : i + 256, None])
        scores[i : i + 256] = 1.5 * (off <= tau).sum(axis=1) - 0.5 * (off <= 3.0 * tau).sum(axis=1)
    return scores


def _score(points: Floats, ball: Sphere, tau: float) -> float:
    off = np.abs(ball.residuals(points))
    return 1.5 * np.count_nonzero(off <= tau) - 0.5 * np.count_nonzero(off <= 3.0 * tau)


def _refined(points: Floats, ball: Sphere, tau: float) -> Sphere | None:
    """Algebraic fits to the points near the surface, in a band that narrows to tau."""
    for band in (2.0, 1.5, 1.0, 1.0):
        near = np.abs(ball.residuals(points)) <= band * tau
        fitted = algebraic(points[near])
        if fitted is None:
            return None
        ball = fitted
    return ball


def _stands_out(points: Floats, fit: RobustFit, noise: float, least_points: int) -> bool:
    """Whether a fit is a ball: converged, enough of it visible, smooth, round, and far denser than its surroundings."""
    ball = fit.sphere
    if not fit.converged or np.count_nonzero(fit.inliers) < least_points or noise > ROUGHEST * ball.radius:
        return False
    off = ball.residuals(points)
    if visible_fraction(points[fit.inliers], ball.centre) < LEAST_VISIBLE:
        return False
    if not np.sqrt(np.diag(ball.covariance).max()) <= LARGEST_SD * ball.radius:
        return False
    if _misfit(points[fit.inliers], off[fit.inliers], ball, fit.scale) > MISFIT * fit.scale:
        return False
    if _facing(points, fit) < FACING:
        return False
    # Density in shells of equal width at, outside and inside the surface, by the noise of this fit.
    width = 3.0 * max(fit.scale, noise)
    at = np.count_nonzero(np.abs(off) <= width)
    outside = np.count_nonzero((off > width) & (off <= 3.0 * width))
    inside = np.count_nonzero((off < -width) & (off >= -3.0 * width))
    return bool(at >= STANDS_OUT * max(outside, inside))


def _facing(points: Floats, fit: RobustFit) -> float:
    """Median cosine between the normals of neighbourhoods of points (n, 3), on the ball or not, and its radii.

    Tubes, edges and volumes that only cross the surface have other normals. A neighbourhood is about a tenth of the
    ball's points, so that it is wide compared with the noise at any density.
    """
    stride = max(1, int(fit.inliers.sum()) // 2000)
    some, on = points[::stride], fit.inliers[::stride]
    query = some[on][:: max(1, int(on.sum()) // 200)]
    k = min(len(some), max(8, int(on.sum()) // 10))
    near = some[cKDTree(some).query(query, k=k)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("mki,mkj->mij", near, near))[1][:, :, 0]
    radial = query - fit.sphere.centre
    return float(np.median(np.abs(np.sum(normal * radial, axis=1)) / np.linalg.norm(radial, axis=1)))


def _misfit(points: Floats, residual: Floats, ball: Sphere, scale: float) -> float:
    """Systematic part in mm of the residuals (n,): means of cells beyond noise, median over the points.

    The median is used because a real scan of a good ball departs from the sphere at the limb.
    """
    cell = np.unique(sphere_cells(points, ball.centre), return_inverse=True)[1]
    count = np.bincount(cell)
    mean = np.bincount(cell, residual) / count
    return float(np.median(np.sqrt(np.maximum(mean**2 - scale**2 / count, 0.0))[cell]))
