"""The residual of a point to a sphere, along its ray or orthogonal, and the robust fit of one sphere by it."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from processor.geometry.linalg_small import DEFINITE, factorise, substitute
from processor.geometry.selection import median
from processor.geometry.sphere import Sphere, lengths
from processor.inner_kernels import inner, inner_ieee
from processor.model import Bools, Floats, Ints
from processor.robust_statistics import MAD_TO_SD, TUKEY, biweight, biweight_slope

LEAST_SCALE = 1e-8  # of the radius: below any noise, above the rounding of points without noise
WINDOW = 4.0  # in scales: residuals within it determine the scale
STEEPEST = 0.3  # cosine of incidence below which the beam is split at the limb, and errors of angles dominate
ITERATIONS = 100  # work: a fit that has not converged by then is stated as such
FREE_ITERATIONS = 40  # then the scale is fixed and rays that missed the ball stay out, so that the fit converges
LEAST = 6  # two more than a sphere's unknowns
LONGEST_STEP = 0.2  # of the radius: on a flat cap an unlimited step may leave the ball
SHORTEST_STEP = 1e-10  # of the radius: converged
LARGEST_GROWTH = 1e3  # of the radius
WORST_CONDITION = 1e12  # float64 leaves four digits then: beyond it points do not determine the sphere
NO_FIT, FITTED, CONVERGED = range(3)  # outcomes of the iteration


@dataclass(frozen=True, kw_only=True)
class RobustFit:
    """The sphere, the points (n,) of weight > 0, the scale (sd) of their residuals and whether the fit converged.

    ``residuals`` (n,), mm, are those of the fit: distances or ranges, NaN where a ray misses the sphere, and
    ``derivatives`` (n, 4) theirs by centre and radius.
    """

    sphere: Sphere
    inliers: Bools
    scale: float
    converged: bool
    residuals: Floats
    derivatives: Floats

    def in_place(self, count: int, rows: Ints, origin: Floats) -> RobustFit:
        """Return the fit as one to ``count`` points of which it had these rows (n,), less the origin."""
        inliers, residuals, derivatives = np.zeros(count, bool), np.full(count, np.nan), np.zeros((count, 4))
        inliers[rows], residuals[rows], derivatives[rows] = self.inliers, self.residuals, self.derivatives
        sphere = replace(self.sphere, centre=self.sphere.centre + origin)
        return replace(self, sphere=sphere, inliers=inliers, residuals=residuals, derivatives=derivatives)


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
    state = np.append(np.zeros(3), start.radius if radius_mm is None else radius_mm)
    free = 4 if radius_mm is None else 3
    errors, J = np.empty(len(points)), np.empty((len(points), 4))
    local, rays = np.ascontiguousarray(points - origin), np.zeros((len(points), 3))
    if scanner is not None:
        rays = np.ascontiguousarray(points - scanner)
        rays /= np.maximum(lengths(rays), 1e-300)[:, None]
    outcome, scale = _iterate(local, rays, state, free, scale_mm, start.radius, errors, J)
    if outcome == NO_FIT:
        return None
    covariance = np.zeros((4, 4))
    covariance[:free, :free] = _sandwich(J[:, :free], errors / scale, scale)
    inliers = np.asarray(np.abs(errors) < TUKEY * scale, bool)
    sphere = Sphere(origin + state[:3], float(state[3]), covariance)
    return RobustFit(
        sphere=sphere,
        inliers=inliers,
        scale=scale,
        converged=outcome == CONVERGED,
        residuals=errors,
        derivatives=J,
    )


def bound(fit: RobustFit, free: int) -> Floats:
    """Cramér-Rao bound (4, 4) of the covariance of an unbiased estimate of ``free`` unknowns from the points of a fit.

    Every inlier has full weight and normal noise of the fit's scale. NaN where the points do not determine the sphere.
    """
    J = fit.derivatives[fit.inliers, :free]
    N, covariance = J.T @ J, np.zeros((4, 4))
    covariance[:free, :free] = fit.scale**2 * np.linalg.inv(N) if np.linalg.cond(N) < WORST_CONDITION else np.nan
    return covariance


@njit(cache=True, nogil=True, error_model="numpy")
def residual(px, py, pz, ux, uy, uz, cx, cy, cz, r):  # type: ignore[no-untyped-def]
    """Residual of a point p to a sphere (c, r), the cosine of its incidence, and the residual's derivatives by c and r.

    Along the unit ray u from the scanner, positive where the point lies behind the surface that the ray meets first.
    All numbers are 0 where the ray misses the sphere. With u = 0 the ray is unknown: the distance from the centre less
    the radius, positive outside the sphere, with cosine 1.
    """
    wx, wy, wz = cx - px, cy - py, cz - pz
    if ux == 0.0 and uy == 0.0 and uz == 0.0:
        d = np.sqrt(wx * wx + wy * wy + wz * wz)
        if d < 1e-9:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        return d - r, 1.0, wx / d, wy / d, wz / d, -1.0
    a = ux * wx + uy * wy + uz * wz
    vx, vy, vz = wx - a * ux, wy - a * uy, wz - a * uz
    under = r * r - (vx * vx + vy * vy + vz * vz)
    if under <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    root = np.sqrt(under)
    return root - a, root / r, -ux - vx / root, -uy - vy / root, -uz - vz / root, r / root


@njit(cache=True, nogil=True, error_model="numpy")
def _iterate(points, rays, state, free, largest_scale, radius, errors, J):  # type: ignore[no-untyped-def]
    """Move ``state`` (x, y, z, radius) to the fit; returns the outcome and the scale of the errors (n,) filled."""
    scale, tiny = largest_scale, LEAST_SCALE * radius
    considered, sizes, step = np.ones(len(points), np.bool_), np.empty(len(points)), np.empty(4)
    outcome = FITTED
    for iteration in range(ITERATIONS):
        _linearise(points, rays, state, errors, J)
        if iteration < FREE_ITERATIONS:
            scale = min(largest_scale, max(_scale(errors, sizes, scale), tiny))
        else:
            for i in range(len(points)):
                considered[i] &= np.isfinite(errors[i])
        if not _step(errors, J, considered, free, scale, step):
            return NO_FIT, scale
        length = 0.0
        for a in range(free):
            length += step[a] * step[a]
        length = np.sqrt(length)
        share = min(1.0, LONGEST_STEP * state[3] / max(length, 1e-300))
        for a in range(free):
            state[a] -= share * step[a]
        if not 0.0 < state[3] < LARGEST_GROWTH * radius:
            return NO_FIT, scale
        if length < SHORTEST_STEP * state[3]:
            outcome = CONVERGED
            break
    _linearise(points, rays, state, errors, J)
    return outcome, scale


@njit(cache=True, nogil=True, error_model="numpy")
def _linearise(points, rays, state, errors, J):  # type: ignore[no-untyped-def]
    """Fill residuals (n,) and their derivatives (n, 4); NaN where a ray misses the sphere or meets it too steeply."""
    for i in range(len(points)):
        errors[i], cosine, J[i, 0], J[i, 1], J[i, 2], J[i, 3] = residual(
            points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2],
            state[0], state[1], state[2], state[3],
        )  # fmt: skip
        if not cosine > STEEPEST:
            errors[i] = np.nan
            J[i, 0], J[i, 1], J[i, 2], J[i, 3] = 0.0, 0.0, 0.0, 0.0


@inner
def _scale(errors, sizes, scale):  # type: ignore[no-untyped-def]
    """Return the standard deviation by the median size of the errors (n,) within 4 scales."""
    count = 0
    for i in range(len(errors)):
        if abs(errors[i]) <= WINDOW * scale:
            sizes[count] = abs(errors[i])
            count += 1
    return MAD_TO_SD * median(sizes, count) if count else scale


@inner_ieee
def _step(errors, J, considered, free, scale, step):  # type: ignore[no-untyped-def]
    """Fill the Gauss-Newton step with Tukey's weights; False where the points do not determine a sphere."""
    N, L, near = np.zeros((4, 4)), np.zeros((4, 4)), 0
    for a in range(4):
        step[a] = 0.0
    for i in range(len(errors)):
        if not (considered[i] and abs(errors[i]) < TUKEY * scale):
            continue
        near += 1
        weight = (1.0 - (errors[i] / (TUKEY * scale)) ** 2) ** 2
        for a in range(free):
            step[a] += weight * J[i, a] * errors[i]
            for b in range(a + 1):
                N[a, b] += weight * J[i, a] * J[i, b]
    if near < LEAST or not factorise(N, free, DEFINITE, L):
        return False
    substitute(L, free, step)
    return True


def _sandwich(J: Floats, u: Floats, scale: float) -> Floats:
    """Covariance of the estimate from derivatives J (n, p) and residuals u (n,) in scales."""
    near = np.abs(u) < TUKEY
    J, u = J[near], u[near]
    psi, slope = u * biweight(u / TUKEY), biweight_slope(u / TUKEY)
    n, p = J.shape
    A = (J * slope[:, None]).T @ J
    B = (J * (psi**2)[:, None]).T @ J
    if np.linalg.cond(A) > WORST_CONDITION:
        return np.full((p, p), np.nan)
    inverse = np.linalg.inv(A)
    covariance = scale**2 * n / max(n - p, 1) * inverse @ B @ inverse
    symmetric: Floats = 0.5 * (covariance + covariance.T)
    return symmetric
