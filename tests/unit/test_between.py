"""The variance between stations, against draws of known size."""

import numpy as np
import pytest
from scipy import stats

from processor.adjustment import variance_components


def drawn(rng, stations, apart, cells=40, points=60):
    """Residuals of cells that four of the stations see each, a shift a station."""
    shift = apart * rng.normal(size=stations)
    station = np.concatenate([np.repeat(rng.permutation(stations)[:4], points) for _ in range(cells)])
    cell = np.repeat(np.arange(cells), 4 * points)
    return shift[station] + 0.5 * rng.normal(size=len(station)), station, cell


@pytest.mark.parametrize("apart", [0.0, 0.1, 1.0])
def test_the_variance_between_stations_is_found(apart):
    rng = np.random.default_rng(0)
    found = np.array([variance_components.variance(*drawn(rng, 9, apart)) for _ in range(300)])
    widened = (stats.t.ppf(0.975, 8) / 1.959964) ** 2
    # The mean over 300 sets of 9 stations; without any, half of the estimates are negative and count as none.
    assert found.mean() == pytest.approx(widened * apart**2, rel=0.1, abs=1e-3)


def test_one_station_tells_nothing():
    rng = np.random.default_rng(1)
    assert variance_components.variance(rng.normal(size=500), np.zeros(500, np.int64), np.arange(500) // 100) == 0.0


def test_what_stations_add_to_a_line_by_draws():
    rng = np.random.default_rng(2)
    x = rng.uniform(-1.0, 1.0, 400)
    station = np.digitize(x + 0.3 * rng.normal(size=400), [-0.5, 0.0, 0.6])
    basis = np.stack([np.ones(400), x], axis=1)
    solve = np.linalg.pinv(basis)
    moved = np.array([solve @ (0.7 * rng.normal(size=4))[station] for _ in range(20_000)])
    np.testing.assert_allclose(variance_components.added(basis, station, 0.49), np.cov(moved.T), rtol=0.05, atol=5e-3)
    assert variance_components.share(np.array([0, 0, 1, 1])) == 0.5
