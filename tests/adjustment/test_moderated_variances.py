"""Variances of small groups: what is known of them by all groups, on groups whose law is given."""

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq
from scipy.special import digamma, polygamma

from processor.adjustment import moderated_variances, scanner_class_errors

LAW, COMMON = 12.0, 0.5


def groups(seed, law=LAW, count=400):
    """True variances of groups by a scaled inverse chi-square law, their sums of squares and degrees of freedom."""
    rng = np.random.default_rng(seed)
    dof = rng.integers(1, 30, count).astype(float)
    true = COMMON * law / rng.chisquare(law, count) if np.isfinite(law) else np.full(count, COMMON)
    return rng, true, true * rng.chisquare(dof), dof


def test_means_by_their_moderated_deviation_follow_students_law():
    beyond, number = 0, 0
    for seed in range(20):
        rng, true, square, dof = groups(seed)
        found = moderated_variances.moderated(square, dof)
        t = rng.normal(0.0, np.sqrt(true)) / np.sqrt(found.variance)
        beyond += int((2.0 * stats.t.sf(np.abs(t), found.dof) < 0.01).sum())
        number += len(t)
    assert beyond == pytest.approx(0.01 * number, abs=4.0 * np.sqrt(0.01 * number))  # standard deviations


def test_groups_of_one_variance_have_it():
    _, _, square, dof = groups(2, law=np.inf)
    found = moderated_variances.moderated(square, dof)
    # The common one by 6,000 degrees: 2 %; the law itself is estimated.
    np.testing.assert_allclose(found.variance, COMMON, rtol=0.2)
    assert found.dof.min() > 50.0


def test_the_law_has_the_mean_and_the_variance_of_the_groups_logarithms():
    """Of s^2 with d degrees of freedom, about s0^2 with d0: ln s^2 has trigamma(d / 2) + trigamma(d0 / 2)."""
    dof, square = np.array([6.0, 8.0, 10.0, 12.0]), np.array([1.0, 16.0, 4.0, 90.0])
    logs = np.log(square / dof) - digamma(dof / 2.0) + np.log(dof / 2.0)
    surplus = np.sum((logs - logs.mean()) ** 2) / 3.0 - np.mean(polygamma(1, dof / 2.0))
    law = 2.0 * brentq(lambda y: polygamma(1, y) - surplus, 0.1, 100.0)
    common = np.exp(logs.mean() + digamma(law / 2.0) - np.log(law / 2.0))
    found = moderated_variances.moderated(square, dof)
    np.testing.assert_allclose(found.dof, law + dof, rtol=1e-6)  # where Newton's iteration stops
    np.testing.assert_allclose(found.variance, (law * common + square) / (law + dof), rtol=1e-6)


def test_groups_without_points_have_the_common_variance():
    found = moderated_variances.moderated(np.array([0.0, 20.0]), np.array([0.0, 40.0]))
    assert found.variance[0] == pytest.approx(0.5)
    assert found.dof[0] == moderated_variances.ASSUMED_FREE


@pytest.mark.parametrize("stations", [1, 3, 4, 6])
def test_the_offset_that_few_stations_have_in_common_is_inside_its_interval(stations):
    """Offsets of stations and of their instrument, of the class: seen is only how the stations' own differ."""
    rng, of = np.random.default_rng(stations), scanner_class_errors.known()
    own, instrument = rng.normal(0.0, of.view_mm, (4000, stations)), rng.normal(0.0, of.offset_mm, 4000)
    square = np.sum((own - own.mean(axis=1, keepdims=True)) ** 2, axis=1)
    sd = np.array([scanner_class_errors.mean_offset_sd(stations, one, stations - 1) for one in square.tolist()])
    pull = (own.mean(axis=1) + instrument) / sd
    assert np.mean(np.abs(pull) < 1.96) == pytest.approx(0.95, abs=0.015)  # 4,000 draws: 0.003; by 3 alone 0.81
    assert np.sqrt(np.mean(pull**2)) == pytest.approx(1.0, abs=0.07)  # 0.011; sd is that of single data sets
