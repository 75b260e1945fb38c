"""The field by which unnamed views displace balls: its posterior by dense densities, its scores by their definition."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from processor.adjustment import scanner_class_errors
from processor.space_frame.spheres import unnamed_view_errors as field

ROUNDING = 1e-9  # of sums of float64 over some hundred cells


def ball(place, seed, scale):
    """Residuals of a ball seen from above, and the map from means over its cells to them."""
    rng = np.random.default_rng(seed)
    cells = np.flatnonzero(field.directions()[:, 2] > 0.2)
    weights = rng.uniform(5.0, 20.0, len(cells))
    state = np.column_stack([np.ones(len(cells)), field.directions()[cells]])
    left = np.eye(len(cells)) - state @ np.linalg.solve(state.T * weights @ state, state.T * weights)
    means = left @ rng.normal(0.0, scale, len(cells))
    return field.BallResiduals(np.asarray(place), cells, means, weights, left, noise=0.25)


def test_the_correlation_is_one_in_a_direction_none_at_a_right_angle_and_that_of_the_modes():
    np.testing.assert_allclose(field.correlation(np.array([1.0, 0.0])), [1.0, 0.0], atol=ROUNDING)
    # At 60 degrees, by hand: cos (sin + (pi - pi / 3) cos) / pi.
    assert field.correlation(np.array(0.5)) == pytest.approx(0.5 * (np.sqrt(0.75) + np.pi / 3.0) / np.pi)
    cosine = field.directions() @ field.directions().T
    # The modes leave a hundredth of the variance, in the mean over directions.
    assert np.mean((field.modes() ** 2).sum(axis=1)) == pytest.approx(1.0, abs=0.01)
    assert np.abs(field.modes() @ field.modes().T - field.correlation(cosine)).mean() < 0.01


def test_scores_are_white_in_noise_and_follow_displacements():
    one = ball([0.0, 0.0, 0.0], 1, 1.0)
    columns = [field._score(one._replace(means=one.left[:, k]))[0] for k in range(len(one.cells))]
    by_mean = np.column_stack(columns)  # derivatives of the scores by the mean of each cell before the fit
    white = by_mean * (one.noise / one.weights) @ by_mean.T
    np.testing.assert_allclose(white, np.eye(len(white)), atol=ROUNDING)
    H = field._score(one)[1]
    np.testing.assert_allclose(H, by_mean @ field.modes()[one.cells], atol=ROUNDING * np.abs(H).max())


@pytest.mark.parametrize("scale", [0.1, 1.0])
def test_the_variance_is_the_posterior_mean_over_sizes_and_lengths(scale):
    balls = [ball(place, seed, scale) for seed, place in enumerate(([0.0, 0.0, 0.0], [3000.0, 0.0, 4000.0]))]
    scores = [field._score(one) for one in balls]
    y, H = (np.concatenate(part) for part in zip(*scores, strict=True))
    row = np.repeat([0, 1], [len(one[0]) for one in scores])
    log_p, variance = [], []
    for length in field.LENGTHS_MM:
        same_field = np.where(row[:, None] == row, 1.0, np.exp(-5000.0 / length))  # 3, 4, 5: the balls are 5 m apart
        for sd in field.SD_MM:
            covariance = np.eye(len(y)) + sd**2 * (H @ H.T) * same_field
            log_p.append(
                multivariate_normal(cov=covariance).logpdf(y)
                - np.log(1.0 + (sd / scanner_class_errors.known().view_mm) ** 2)
            )
            variance.append(sd**2)
    p = np.exp(np.array(log_p) - logsumexp(log_p))
    expected = p @ np.array(variance)
    found = field.estimate_field(balls)
    assert found.variance == pytest.approx(expected, rel=1e-6)  # eigenvalues against factors of the same matrices
    weights = (p * variance).reshape(len(field.LENGTHS_MM), -1).sum(axis=1) / expected
    np.testing.assert_allclose(found.weights, weights, rtol=1e-6)
    at_3_m = found.correlation(np.array(3000.0))
    assert at_3_m == pytest.approx(weights @ np.exp(-3000.0 / field.LENGTHS_MM), rel=1e-6)  # as above


def test_without_balls_the_variance_is_that_of_the_class():
    prior = 1.0 / (1.0 + (field.SD_MM / scanner_class_errors.known().view_mm) ** 2)
    assert field.estimate_field([]).variance == pytest.approx(prior @ field.SD_MM**2 / prior.sum())
