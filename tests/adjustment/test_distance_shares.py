"""Shares of significant distances and their intervals, and the counts of a summary, by hand."""

import numpy as np
import pytest

from processor.adjustment import distance_summary
from processor.geometry.m3c2 import Distances

UP = np.array([0.0, 0.0, 1.0])


def test_a_share_of_independent_places_has_the_interval_of_its_count():
    rng = np.random.default_rng(7)
    covered = 0
    for _ in range(200):
        marks = rng.random(400) < 0.05
        found = distance_summary.share(marks, np.outer(np.arange(400.0), [10.0, 0.0, 0.0]), 5.0)
        assert found.low <= found.share <= found.high
        covered += found.low <= 0.05 <= found.high
    assert covered / 200 >= 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / 200)


def test_share_of_correlated_places_has_the_interval_of_one_per_place():
    marks = np.repeat(np.random.default_rng(8).random(100) < 0.3, 50)
    places = np.repeat(np.arange(100.0), 50)[:, None] * [100.0, 0.0, 0.0]
    found = distance_summary.share(marks, places, 60.0)
    alone = distance_summary.share(marks[::50], places[::50], 60.0)
    assert found.high - found.low == pytest.approx(alone.high - alone.low, rel=0.05)  # cells have 1 to 3 places
    none = distance_summary.share(np.zeros(5000, bool), places, 60.0)
    assert none.low == 0.0
    assert 0.02 < none.high < 0.05  # rule of three for 100 cells
    assert np.isnan(distance_summary.share(np.zeros(0, bool), np.zeros((0, 3)), 1.0).share)


def test_the_interval_of_a_share_is_wilsons_for_the_number_that_its_places_are_worth():
    """Wilson (1927): the limits q solve (p - q)^2 = z^2 q (1 - q) / n."""
    marks = np.repeat([True, True, True, False, False, False, False, False], 2)
    places = np.repeat(np.arange(8.0), 2)[:, None] * [100.0, 0.0, 0.0]
    # Pairs of one place are one: eight with the sample variance are worth seven of a known share.
    p, z2 = 3.0 / 8.0, distance_summary.Z95**2
    low, high = np.sort(np.roots([1.0 + z2 / 7.0, -(2.0 * p + z2 / 7.0), p * p]))
    found = distance_summary.share(marks, places, 50.0)
    assert (found.share, found.low, found.high) == pytest.approx((p, low, high), rel=1e-9)  # rounding
    found = distance_summary.share(np.ones(16, bool), places, 50.0)
    assert (found.share, found.low, found.high) == pytest.approx((1.0, 8.0 / (8.0 + z2), 1.0), rel=1e-9)


def test_summary_counts_core_points_without_level_of_detection():
    nan = np.nan
    found = Distances(
        np.array([1.0, -3.0, nan, 2.0]), np.array([0.5, 4.0, nan, nan]), np.array([30, 30, 0, 30]),
        np.array([30, 10, 30, 3]), np.ones(4), np.ones(4),
    )  # fmt: skip
    normals = np.array([UP, UP, [nan] * 3, UP])
    total = distance_summary.of_distances(found, np.arange(12.0).reshape(4, 3), normals, 1.0, 20)
    assert (total.core_points, total.without_lod, total.without_normal) == (4, 2, 1)
    assert (total.few_points, total.significant) == (1, 1)
    assert (total.mean, total.min, total.max, total.rms) == (-1.0, -3.0, 1.0, pytest.approx(np.sqrt(5.0)))
