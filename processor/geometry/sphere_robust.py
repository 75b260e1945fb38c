"""Robust fit of one sphere to points of which many lie on something else.

The residual is the orthogonal distance or, where the scanner's position is known, the measured range minus the range
at which the ray meets the sphere: noise runs along the ray, and only the second is unbiased for a ball partly seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry.sphere import Mask, Sphere
from processor.model import Floats

TUKEY = 4.685  # in scales: 95 % efficiency under normal noise
WINDOW = 4.0  # in scales: the points the scale is taken from
STEEPEST = 0.3  # cosine of the incidence: beyond it the beam is split at the limb, and angle errors rule
ITERATIONS = 100
UNSETTLED = 40  # steps after which the scale is held and a ray lost at the limb stays lost: else they come and go
LEAST = 6


@dataclass(frozen=True)
class RobustFit:
    """The sphere, the points (n,) of weight > 0, the scale (sd) of their residuals and whether it settled."""

    sphere: Sphere
    inliers: Mask
    scale: float
    converged: bool


def robust_fit(
    points: Floats,
    start: Sphere,
    scale_mm: float,
    radius_mm: float | None = None,
    scanner: Floats | None = None,
) -> RobustFit | None:
    """Fit a sphere to points (n, 3) by Gauss-Newton with Tukey's biweight, from a start within a few scales.

    Parameters
    ----------
    points : (n, 3), mm
    start : where to begin; points farther than a few ``scale_mm`` from it never count.
    scale_mm : first scale of the residuals, an upper limit; the scale is then taken from the median of the
        residuals in a window of 4 scales, so a bulk of points off the sphere on one side does not widen it.
    radius_mm : held radius; its variance and covariances are then 0. None = free.
    scanner : (n, 3), the position each point was seen from, in the frame of the points; None = unknown.

    None where fewer than six points remain, or they do not determine a sphere. The covariance is the sandwich
    A^-1 B A^-1 of an M-estimator (Huber and Ronchetti 2009, eq. 6.6, times n / (n - p)): it takes the residuals for
    independent, and leaves out what is common to all points (registration, a bias of the scanner).
    """
    origin = start.centre
    local = points - origin
    seen_from = None if scanner is None else scanner - origin
    held = radius_mm is not None
    state = np.append(np.zeros(3), start.radius if radius_mm is None else radius_mm)
    free = 3 if held else 4
    scale = scale_mm
    tiny = 1e-12 * max(start.radius, 1.0) + 1e-300
    converged = False
    considered = np.ones(len(points), bool)
    for turn in range(ITERATIONS):
        residual, J = _linearised(local, state, seen_from)
        if turn < UNSETTLED:
            scale = min(scale_mm, max(_scale(residual, scale), tiny))
        else:
            considered &= np.isfinite(residual)
        near = considered & (np.abs(residual) < TUKEY * scale)
        if np.count_nonzero(near) < LEAST:
            return None
        residual, J = residual[near], J[near, :free]
        w = (1.0 - (residual / (TUKEY * scale)) ** 2) ** 2
        N = (J * w[:, None]).T @ J
        if np.linalg.cond(N) > 1e12:
            return None
        step = np.linalg.solve(N, (J * w[:, None]).T @ residual)
        largest = float(np.linalg.norm(step))
        # no further than the start can be wrong by: a flat cap must not throw the ball away
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
    """Return the least covariance (4, 4) that an unbiased estimate may have from the points of a fit (Cramér and Rao).

    Every point on the ball counts in full, with normal noise of the fit's scale; ``points`` (n, 3) and ``scanner``
    (n, 3) are those that were fitted. NaN where the points do not determine the sphere.
    """
    state = np.append(np.zeros(3), fit.sphere.radius)
    on = fit.inliers
    seen_from = None if scanner is None else scanner[on] - fit.sphere.centre
    residual, J = _linearised(points[on] - fit.sphere.centre, state, seen_from)
    free = 3 if radius_held else 4
    J = J[np.isfinite(residual), :free]
    found = np.zeros((4, 4))
    N = J.T @ J
    found[:free, :free] = fit.scale**2 * np.linalg.inv(N) if np.linalg.cond(N) < 1e12 else np.nan
    return found


def _linearised(points: Floats, state: Floats, scanner: Floats | None) -> tuple[Floats, Floats]:
    """Residuals (n,) measured minus model, and the model's derivatives (n, 4); NaN residual = the ray misses."""
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


def _scale(residual: Floats, scale: float) -> float:
    """Scale 1.4826 median |residual| of those within 4 scales."""
    size = np.abs(residual)
    near = size[size <= WINDOW * scale]
    return 1.4826 * float(np.median(near)) if len(near) else scale


def _sandwich(J: Floats, u: Floats, scale: float) -> Floats:
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
