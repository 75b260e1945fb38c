"""Cluster-robust covariance of fits and variance by scale, against draws of known size."""

import numpy as np
import pytest

from processor.adjustment import clusters


def drawn(rng, groups, apart, each=50):
    """Basis, residuals of the fit, coefficients and clusters of a line with errors shared within clusters."""
    x = np.sort(rng.uniform(-1.0, 1.0, groups * each))
    cluster = np.repeat(np.arange(groups), each)
    value = apart * rng.standard_normal(groups)[cluster] + 0.3 * rng.standard_normal(len(x))
    basis = np.stack([np.ones_like(x), x], axis=1)
    coefficients = np.linalg.lstsq(basis, value, rcond=None)[0]
    return basis, value - basis @ coefficients, coefficients, cluster


@pytest.mark.parametrize("apart", [0.0, 0.5])
def test_errors_shared_within_clusters_are_in_the_intervals(apart):
    rng = np.random.default_rng(3)
    held, white = [], []
    for _ in range(600):
        basis, residual, coefficients, cluster = drawn(rng, 8, apart)
        found = clusters.covariance(basis, residual, cluster)
        sd = np.sqrt(np.diag(found.covariance) * clusters.widening(found.freedom))
        held.append(np.abs(coefficients) <= 1.96 * sd)
        noise = residual @ residual / (len(residual) - 2) * np.linalg.inv(basis.T @ basis)
        white.append(np.abs(coefficients) <= 1.96 * np.sqrt(np.diag(noise)))
    assert 0.92 < np.mean(held) <= 0.985
    assert apart == 0.0 or np.mean(white) < 0.6


def test_weights_count_as_points():
    rng = np.random.default_rng(4)
    basis, residual, _, cluster = drawn(rng, 6, 0.5)
    twice = clusters.covariance(np.vstack([basis, basis]), np.tile(residual, 2), np.tile(cluster, 2))
    weighted = clusters.covariance(basis, residual, cluster, np.full(len(residual), 2.0))
    np.testing.assert_allclose(twice.covariance, weighted.covariance, rtol=1e-9)


def test_one_cluster_determines_nothing():
    found = clusters.covariance(np.ones((10, 1)), np.zeros(10), np.zeros(10, np.int64))
    assert np.isnan(found.covariance).all()
    assert found.freedom == [0.0]


def test_jackknife_of_a_mean_is_its_variance():
    values = np.random.default_rng(5).standard_normal(200)
    without = (values.sum() - values) / 199.0
    assert clusters.jackknife(without[:, None])[0, 0] == pytest.approx(values.var(ddof=1) / 200.0)


def test_variance_by_scale():
    rng = np.random.default_rng(6)
    place = rng.uniform(0.0, 2000.0, (80_000, 2))
    noise = rng.standard_normal(len(place))
    sizes = (50.0, 200.0, 1000.0)
    assert np.abs(clusters.variance_by_scale(place, noise, sizes)).max() < 2e-3
    waves = 0.7 * np.sin(2.0 * np.pi * place[:, 0] / 430.0)
    small, middle, large = clusters.variance_by_scale(place, noise + waves, sizes)
    # The mean of a sine over a patch of size a is smaller by sinc(a / wavelength).
    assert small == pytest.approx(0.245 * np.sinc(50.0 / 430.0) ** 2, rel=0.1)
    assert middle == pytest.approx(0.245 * np.sinc(200.0 / 430.0) ** 2, rel=0.3)
    assert large < 0.02
