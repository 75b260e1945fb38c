"""Intervals of the greatest of several values against closed forms."""

import numpy as np
import pytest
from scipy.stats import chi, norm

from processor.adjustment.maximum_interval import CLEAR_SD, of_correlated, of_independent


@pytest.mark.parametrize("axes", [1, 3])
def test_the_band_of_independent_values_is_that_of_all_that_can_be_the_greatest(axes):
    values, sd = np.array([10.0, 9.9, 9.8, 2.0]), np.array([0.2, 0.3, 0.1, 0.2])  # the last cannot
    factor = chi.ppf(0.95 ** (1.0 / 3.0), axes)
    expected = (10.0, 9.8 - factor * 0.1, 9.9 + factor * 0.3)
    assert of_independent(values, sd, axes) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("correlation", "folded"), [(0.0, False), (0.8, False), (0.8, True)])
def test_correlated_values_are_compared_by_the_sd_of_their_difference(correlation, folded):
    """Two of sd 0.1 differ by 0.1 sqrt(2 - 2 r); magnitudes also by 0.1 sqrt(2 + 2 r), signs unknown."""
    covariance = 0.01 * np.array([[1.0, correlation], [correlation, 1.0]])
    reach = CLEAR_SD * 0.1 * np.sqrt(2.0 + 2.0 * correlation * (1.0 if folded else -1.0))
    alone = of_correlated(np.array([10.0, 10.0 - 1.001 * reach]), covariance, folded)
    assert alone == pytest.approx((10.0, 10.0 - 0.1 * norm.ppf(0.975), 10.0 + 0.1 * norm.ppf(0.975)), rel=1e-9)
    both = of_correlated(np.array([10.0, 10.0 - 0.999 * reach]), covariance, folded)
    if correlation == 0.0:  # 10,000 draws: the quantile has a standard error of 0.02
        assert (both[2] - 10.0) / 0.1 == pytest.approx(norm.ppf(0.5 + 0.5 * np.sqrt(0.95)), abs=0.06)
    assert both[2] - alone[2] > 0.005
