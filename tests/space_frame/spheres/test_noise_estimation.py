"""Noise and scatter of all balls together against the likelihoods that they maximise."""

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

from processor.robust_statistics import MAD_TO_SD
from processor.space_frame.spheres import ball_fit
from processor.space_frame.spheres import stochastic_model as noise

PARTS = np.array([0.3, 4e-9, 0.1])


def test_variances_are_those_of_the_fit_also_at_the_limb():
    cosines, ranges = np.array([1.0, 0.5, 0.1, 0.02]), np.array([0.0, 8000.0, 9000.0, 9000.0])
    # 0.3 + 0.004 R^2 (m) / c + 0.1 (1 / c^2 - 1), by hand; below a cosine of 0.1 as there.
    by_hand = [0.3, 0.3 + 0.512 + 0.3, 0.3 + 3.24 + 9.9, 0.3 + 3.24 + 9.9]
    assert noise.variances_of(PARTS, cosines, ranges) == pytest.approx(by_hand, rel=1e-12)
    in_fit = [ball_fit.variance(PARTS, *one) for one in zip(ranges, np.maximum(cosines, 0.1), strict=True)]
    assert in_fit == pytest.approx(by_hand, rel=1e-12)


def test_parts_of_the_noise_are_the_most_likely_by_the_scatter_of_each_cell():
    """The square of a scale by the median of n points has a relative variance of 2.7 / n, as a gamma variable."""
    rng = np.random.default_rng(3)
    cosines, ranges = (one.ravel() for one in np.meshgrid([0.9, 0.5, 0.25], [5e3, 9e3, 16e3]))
    counts = rng.integers(25, 200, 9)
    variances = noise.variances_of(PARTS, cosines, ranges) * rng.uniform(0.7, 1.3, 9)
    of_point = np.repeat(np.arange(9), counts)
    errors = np.sqrt(variances)[of_point] / MAD_TO_SD * np.where(np.arange(len(of_point)) % 2, 1.0, -1.0)
    of_points = errors, cosines[of_point], ranges[of_point], np.ones(len(of_point))
    found, used = noise.noise_model(*of_points, np.ones(3))

    def deviance(logs):
        model = noise.variances_of(np.exp(logs), cosines, ranges)
        return counts @ (np.log(model) + variances / model)

    best = minimize(deviance, np.log(PARTS), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    assert used == counts.sum()
    # What five reweightings and the minimiser leave is below 1e-6 of the parts.
    np.testing.assert_allclose(found, np.exp(best.x), rtol=1e-5)
    np.testing.assert_array_equal(noise.noise_model(*(one[:59] for one in of_points), np.ones(3))[0], np.ones(3))


def test_scatter_and_mean_offset_of_radii_are_the_most_likely_without_the_prior_of_the_fits():
    rng = np.random.default_rng(6)
    sizes, of_points = np.repeat([50.0, 80.0], 20), rng.uniform(0.05, 0.3, 40) ** 2
    off = 0.2 + rng.normal(0.0, np.sqrt(of_points + 0.25**2))
    prior = 0.4**-2  # of a fit: its radius is the weighted mean of that by the points and of the size
    variances = 1.0 / (1.0 / of_points + prior)
    radii = sizes + off * variances / of_points
    mean, sd = noise.radius_offset(radii, variances, sizes, 0.4, 0.3)
    weights = 1.0 / (of_points + 0.4**2)
    assert mean == pytest.approx(np.average(off, weights=weights), rel=1e-9)  # rounding
    assert sd == pytest.approx(weights.sum() ** -0.5, rel=1e-9)  # rounding

    def deviance(scatter):
        total = of_points + scatter**2
        return (np.log(total) + off**2 / total).sum() + 10.0 * (np.log(scatter**2) + 0.3**2 / scatter**2)

    best = minimize_scalar(deviance, (0.2, 0.3)).x
    # The grid's steps are of 2 %.
    assert noise.radius_scatter(radii, variances, sizes, 0.4, 0.3) == pytest.approx(best, rel=0.011)
