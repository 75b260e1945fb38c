"""Statistics of distances: intervals of the least and the greatest hold, and do not depend on the size of blocks."""

import numpy as np
import pytest

from processor import large_arrays
from processor.adjustment import distance_summary, maximum_interval
from processor.geometry.m3c2 import Z95, Distances


def distances(values, sd):
    count = np.full(len(values), 30)
    return Distances(values, np.full(len(values), Z95 * sd), count, count, np.zeros(len(values)), np.zeros(len(values)))


def summarised(values, sd):
    places = 10.0 * np.arange(3.0 * len(values)).reshape(-1, 3)
    return distance_summary.of_distances(distances(values, sd), places, np.ones((len(values), 3)), 1.0, 20)


@pytest.mark.parametrize("bulge", [0.0, 3.0])
def test_intervals_of_the_extremes_hold_the_true_extremes(bulge):
    """2,000 distances with errors of 1 mm, of which 40 lie on a bulge: the interval of one point would miss by far."""
    true = np.zeros(2000)
    true[:40] = bulge * np.linspace(0.5, 1.0, 40)
    least = greatest = alone = 0
    for seed in range(100):
        found = summarised(true + np.random.default_rng(seed).normal(0.0, 1.0, len(true)), 1.0)
        least += found.min_ci95[0] <= true.min() <= found.min_ci95[1]
        greatest += found.max_ci95[0] <= true.max() <= found.max_ci95[1]
        alone += abs(found.max - true.max()) <= Z95
    assert min(least, greatest) >= 91  # of 100 at 95 %: 95 less two standard deviations of 2.2
    assert bulge > 0.0 or alone < 5


def test_the_interval_of_a_distance_that_stands_clear_is_its_own():
    values = np.zeros(500)
    values[7], values[9] = 50.0, -30.0
    found = summarised(values, 0.5)
    assert (found.min, found.max) == (-30.0, 50.0)
    assert found.max_ci95 == pytest.approx((49.02, 50.98), abs=1e-4)  # 1.96 by hand, not 1.959964
    assert found.min_ci95 == pytest.approx((-30.98, -29.02), abs=1e-4)


def test_extremes_by_blocks_are_those_of_the_whole(monkeypatch):
    rng = np.random.default_rng(1)
    values, sd = rng.normal(size=3000), rng.uniform(0.1, 2.0, 3000)
    greatest = maximum_interval.of_independent(values, sd)
    value, low, high = maximum_interval.of_independent(-values, sd)
    monkeypatch.setattr(large_arrays, "BLOCK_ROWS", 97)
    assert maximum_interval.of_extreme(values, sd, 1.0, sign=1) == greatest
    assert maximum_interval.of_extreme(values, sd, 1.0, sign=-1) == (-value, -high, -low)
