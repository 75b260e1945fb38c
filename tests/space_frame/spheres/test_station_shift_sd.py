"""The standard deviation of stations' shifts against dense densities of the residuals."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from processor.space_frame.points.sphere_crops import CropsWithRays
from processor.space_frame.spheres.records import Priors
from processor.space_frame.spheres.stochastic_model import GRID, _cost_range, shift_sd

BALLS, SIZE, NOISE = 6, 60.0, 0.09  # number, mm and mm^2
STATION = np.repeat(np.arange(3, dtype=np.int32), 10)  # of the points of a ball
PRIOR = np.diag([0.01, 0.02, 0.04, 4.0])  # inverse covariance of centre and radius


def ball(rng, true_sd):
    """State, weights and points of a ball, and the densities of its residuals for each sd: linear in all unknowns."""
    n = len(STATION)
    state, weights = rng.normal([0.0, 0.0, 0.0, SIZE], [3.0, 3.0, 3.0, 0.3]), rng.uniform(0.3, 1.0, n)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    shifts = rng.normal(0.0, true_sd, (3, 3))
    off = (normals * shifts[STATION]).sum(axis=1) + rng.normal(0.0, np.sqrt(NOISE), n)
    J = -np.column_stack([normals, np.ones(n)])
    mean = J @ (state - [0.0, 0.0, 0.0, SIZE])
    fixed = np.diag(NOISE / weights) + J @ np.linalg.inv(PRIOR) @ J.T
    shifted = np.where(STATION[:, None] == STATION, normals @ normals.T, 0.0)
    densities = [multivariate_normal(mean, fixed + sd**2 * shifted).logpdf(off) for sd in GRID]
    return state, weights, state[:3] + (state[3] + off)[:, None] * normals, densities


def arguments(true_sd):
    rng = np.random.default_rng(4)
    states, weights, points, densities = zip(*(ball(rng, true_sd) for _ in range(BALLS)), strict=True)
    points, ends = np.concatenate(points), len(STATION) * np.arange(BALLS + 1)
    zeros = np.zeros_like(points)  # rays are unknown: a residual is the distance from the centre less the radius
    crops = CropsWithRays(ends, points, zeros, zeros[:, 0].copy(), np.tile(STATION, BALLS))
    priors = Priors(np.tile(PRIOR[:3, :3], (BALLS, 1, 1)), np.full(BALLS, SIZE), np.full(BALLS, PRIOR[3, 3]))
    usable, noise = np.ones(BALLS, bool), np.array([NOISE, 0.0, 0.0])
    return (crops, np.concatenate(weights), np.array(states), usable, noise, priors), np.array(densities)


def test_costs_are_minus_twice_the_log_densities_of_residuals_whose_stations_are_shifted():
    given, densities = arguments(1.0)
    costs, several = np.zeros((BALLS, len(GRID))), np.zeros(BALLS, np.uint8)
    _cost_range(*given, costs, several, 0, BALLS)
    assert several.all()
    # Costs and densities differ by what does not depend on the sd. Rounding, of matrices of condition 1e5.
    np.testing.assert_allclose(costs - costs[:, :1], -2.0 * (densities - densities[:, :1]), rtol=1e-9, atol=1e-9)


def test_the_sd_is_the_vertex_of_the_costs_and_0_without_evidence():
    given, densities = arguments(1.0)
    total = densities.sum(axis=0)
    best = int(np.argmax(total))
    x, y = np.log(GRID[best - 1 : best + 2]), total[best - 1 : best + 2]
    a, b, _ = np.linalg.solve(np.vander(x), y)
    # Rounding, as above.
    assert shift_sd(*given, threads=1) == pytest.approx(np.exp(-0.5 * b / a), rel=1e-9)
    assert shift_sd(*arguments(0.0)[0], threads=1) == 0.0
