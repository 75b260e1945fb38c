"""The final fit of a ball against SciPy's least squares, with derivatives by finite differences."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from processor.geometry.sphere import sphere_cells
from processor.space_frame.points.sphere_crops import CropsWithRays
from processor.space_frame.spheres.ball_fit import NodesToFit, fit_final
from processor.space_frame.spheres.records import (
    CELLS,
    CENTRE_CHI2,
    DEGREES,
    POINTS,
    RMS,
    SCALE,
    STATIONS,
    Masks,
    Priors,
    StochasticModel,
)

COUNT, MODEL_POINTS, STEP_MM = 16, 5.0, 1e-2
NOISE = np.array([0.3, 4e-9, 0.1])  # mm^2: constant, by range^2 / cosine, by tangent^2
SHIFT_SD, START = 0.5, np.array([0.0, 0.0, 0.0, 60.0, 0.0, 0.0, 0.0])  # centre, radius, shift of the second station
PRIOR = np.diag([0.01, 0.02, 0.04, 4.0, *[SHIFT_SD**-2] * 3])  # their inverse covariance
# Differences of 1e-2 mm over 60 mm leave 1e-7; the kernel stops after four alternations of scale and fit.
CLOSE = 1e-5


class Ball:
    """Points on a ball of 60.2 mm about (0.5, -0.3, 0.4), half of them from each station; rays may be unknown."""

    def __init__(self, rays_known):
        rng = np.random.default_rng(5)
        self.second = np.arange(COUNT) >= COUNT // 2
        to_ball = np.where(self.second[:, None], [0.8, 0.6, 0.0], [0.0, 1.0, 0.0])  # a component may be 0
        normals = rng.uniform(-0.6, 0.6, (COUNT, 3)) - to_ball
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        self.points = np.array([0.5, -0.3, 0.4]) + 60.2 * normals + rng.normal(0.0, 0.5, (COUNT, 3))
        self.rays, self.ranges = to_ball * rays_known, np.where(self.second, 8000.0, 5000.0) * rays_known

    def residuals(self, x, with_cosines=False):
        w = x[:3] + self.second[:, None] * x[4:] - self.points
        if not self.rays.any():
            e, cosines = np.linalg.norm(w, axis=1) - x[3], np.ones(COUNT)
        else:
            along = (w * self.rays).sum(axis=1)
            root = np.sqrt(x[3] ** 2 - (w**2).sum(axis=1) + along**2)
            e, cosines = root - along, root / x[3]
        return (e, cosines) if with_cosines else e

    def variances(self, x):
        cosines = self.residuals(x, with_cosines=True)[1]
        return NOISE[0] + NOISE[1] * self.ranges**2 / cosines + NOISE[2] * np.tan(np.arccos(cosines)) ** 2

    def jacobian(self, x):
        steps = STEP_MM * np.eye(7)
        return np.array([self.residuals(x + h) - self.residuals(x - h) for h in steps]).T / (2.0 * STEP_MM)

    def hessians(self, x):
        steps = STEP_MM * np.eye(7)
        return np.array([self.jacobian(x + h) - self.jacobian(x - h) for h in steps]) / (2.0 * STEP_MM)


def fitted(ball, model_points=MODEL_POINTS):
    nodes = NodesToFit(
        crops=CropsWithRays(np.array([0, COUNT]), ball.points, ball.rays, ball.ranges, ball.second.astype(np.int32)),
        masks=Masks(np.array([0, 0]), np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0), 0.0, 0.15),
        model=StochasticModel(NOISE, np.array([np.zeros((3, 3)), SHIFT_SD**2 * np.eye(3)])),
        model_points=model_points,
        priors=Priors(PRIOR[None, :3, :3].copy(), START[3:4], PRIOR[3, 3:4]),
        states=START[None, :4],
        first_reach_mm=12.0,
        threads=1,
    )
    return fit_final(nodes)


@pytest.mark.parametrize("rays_known", [True, False])
def test_a_final_fit_is_that_of_scipy_less_the_bias_by_curvature_and_by_unknown_rays(rays_known):
    ball = Ball(rays_known)
    found = fitted(ball)
    x, scale2 = START, 1.0
    for _ in range(12):  # until weights and scale change no more
        variances = scale2 * ball.variances(x)
        x = least_squares(
            lambda x, sd: np.concatenate([ball.residuals(x) / sd, np.sqrt(PRIOR) @ (x - START)]),
            x, args=(np.sqrt(variances),), xtol=1e-14, ftol=1e-14,
        ).x  # fmt: skip
        J, e = ball.jacobian(x), ball.residuals(x)
        C = np.linalg.inv(J.T / variances @ J + PRIOR)
        leverage = np.einsum("ij,jk,ik->i", J, C, J) / variances
        degrees = MODEL_POINTS + COUNT - leverage.sum()
        scale2 = (MODEL_POINTS + scale2 * (e**2 / variances).sum()) / degrees
    assert (np.abs(e) < 3.0 * np.sqrt(variances)).all()  # every point has its full weight
    np.testing.assert_allclose(found.residuals.weights, 1.0)
    np.testing.assert_allclose(found.residuals.errors, e / np.sqrt(1.0 - leverage), rtol=CLOSE, atol=CLOSE)
    chi2 = x[:3] @ PRIOR[:3, :3] @ x[:3]
    expected = [np.sqrt(scale2), degrees, np.sqrt(np.mean(e**2)), chi2]
    np.testing.assert_allclose(found.numbers[0, [SCALE, DEGREES, RMS, CENTRE_CHI2]], expected, rtol=CLOSE)
    cells = len(np.unique(sphere_cells(ball.points - ball.second[:, None] * x[4:], x[:3])))
    np.testing.assert_array_equal(found.numbers[0, [POINTS, CELLS, STATIONS]], [COUNT, cells, 2])
    bound = np.linalg.inv((J.T / variances @ J + PRIOR)[:4, :4])  # stations fixed
    np.testing.assert_allclose(found.bounds[0], bound, atol=CLOSE * bound.max())

    # Box (1971): the bias is -1/2 C J' W trace(C H). Here the shift is left out: it moves the ball by less than 1 %.
    x, C = np.append(x[:4], np.zeros(3)), C[:4, :4]
    variances = scale2 * ball.variances(x)
    trace = np.einsum("pq,piq->i", C, ball.hessians(x)[:4, :, :4])
    x[:4] += 0.5 * C @ ball.jacobian(x)[:, :4].T @ (trace / variances)
    if not rays_known:  # noise across the normal moves points outward by variance / distance
        bias = -C @ ball.jacobian(x)[:, :4].T @ (1.0 / np.linalg.norm(x[:3] - ball.points, axis=1))
        x[:4] -= 0.5 * bias
        C = C + np.outer(bias, bias) / 12.0
    np.testing.assert_allclose(found.states[0], x[:4], atol=CLOSE)
    np.testing.assert_allclose(found.covariances[0], C, atol=CLOSE * C.max())


def test_the_bound_of_a_covariance_counts_points_of_half_a_weight_in_full():
    """What all points of the model could tell; beside the covariance, it shows what the robust weights cost."""
    ball = Ball(True)
    ball.points[5] += 2.88 * (ball.points[5] - [0.5, -0.3, 0.4]) / 60.2
    found = fitted(ball, 1e4)  # the noise is known: a scale of 16 points follows the one that is off
    assert 0.2 < found.residuals.weights[5] < 0.8
    x = np.append(found.states[0], np.zeros(3))
    variances = found.numbers[0, SCALE] ** 2 * ball.variances(x)
    J = ball.jacobian(x)
    bounds = [np.linalg.inv((J.T * w / variances @ J + PRIOR)[:4, :4]) for w in (1.0, found.residuals.weights)]
    # Of x, which the point tells most of. The shifts, in which the derivatives are taken, are not returned: a quarter.
    assert abs(found.bounds[0, 0, 0] - bounds[0][0, 0]) < 0.25 * (bounds[1] - bounds[0])[0, 0]
