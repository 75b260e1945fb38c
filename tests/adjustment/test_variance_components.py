"""Variance between stations and lack of fit, against draws of known size."""

import numpy as np
import pytest
from scipy import stats

from processor.adjustment import variance_components


def drawn(rng, stations, apart, cells=40, points=40):
    """Residuals of cells with points of four stations each, shifted by station."""
    shift = apart * rng.normal(size=stations)
    station = np.concatenate([np.repeat(rng.permutation(stations)[:4], points) for _ in range(cells)])
    cell = np.repeat(np.arange(cells), 4 * points)
    return shift[station] + 0.5 * rng.normal(size=len(station)), station, cell


@pytest.mark.parametrize("apart", [0.0, pytest.param(0.1, marks=pytest.mark.slow), 1.0])
def test_the_variance_between_stations_is_estimated(apart):
    rng = np.random.default_rng(0)
    found = np.array([variance_components.between_stations(*drawn(rng, 9, apart)) for _ in range(300)])
    widened = (stats.t.ppf(0.975, 8) / 1.959964) ** 2
    # Of 300 sets of 9 stations the standard deviation is sqrt(2 / 8 / 300): 3 %. Without any, half of the estimates are
    # negative and count as none; the others are of noise: 0.25 by 40 points in 18 cells.
    assert found.mean() == pytest.approx(widened * apart**2, rel=0.1, abs=1e-3)


def test_one_station_has_no_variance_between_stations():
    rng = np.random.default_rng(1)
    one, cell = np.zeros(500, np.int64), np.arange(500) // 100
    assert variance_components.between_stations(rng.normal(size=500), one, cell) == 0.0


def test_covariance_of_a_line_by_stations_against_draws():
    rng = np.random.default_rng(2)
    x = rng.uniform(-1.0, 1.0, 400)
    station = np.digitize(x + 0.3 * rng.normal(size=400), [-0.5, 0.0, 0.6])
    basis = np.stack([np.ones(400), x], axis=1)
    solve = np.linalg.pinv(basis)
    moved = np.array([solve @ (0.7 * rng.normal(size=4))[station] for _ in range(20_000)])
    np.testing.assert_allclose(
        # A variance of 20,000 draws is known to 1 %.
        variance_components.group_covariance(basis, station, 0.49),
        np.cov(moved.T),
        rtol=0.05,
        atol=5e-3,
    )


def test_lack_of_fit_variance():
    rng = np.random.default_rng(2)
    cell = np.repeat(np.arange(40), 100)
    found = [variance_components.lack_of_fit_variance([(rng.standard_normal(4000), cell)], 0) for _ in range(40)]
    # By noise alone the sum of squares between 40 cells is chi-squared: its mean is 40, its sd sqrt(80).
    assert max(found) < 5.0 * np.sqrt(80.0) / 4000.0
    steps = 0.5 * rng.standard_normal(40)
    stepped = variance_components.lack_of_fit_variance([(rng.standard_normal(4000) + steps[cell], cell)], 0)
    # Steps of 0.5 known to 0.1 each: their mean square to 2 * 0.5 * 0.1 / sqrt(40) = 0.016.
    assert stepped == pytest.approx(float(np.mean(steps**2)), abs=0.05)
    assert variance_components.lack_of_fit_variance([(np.zeros(3), np.arange(3))], 0) == 0.0
