"""Robust scales and weights against draws of known size, and Student's factor against its distribution."""

import numpy as np
import pytest
from scipy import stats

from processor import robust_statistics


def test_scale_of_normal_residuals_is_their_standard_deviation_despite_outliers():
    # The median of 100,000 sizes is known to 0.4 %; of 1 % outliers it is that of a share of 0.505: 1.3 % more.
    residual = 0.3 * np.random.default_rng(4).standard_normal(100_000)
    assert robust_statistics.robust_sd(residual) == pytest.approx(0.3, rel=0.01)
    assert robust_statistics.robust_sd(np.append(residual, np.full(1000, 1e6))) == pytest.approx(0.3, rel=0.03)
    assert robust_statistics.robust_sd_about_median(5.0 + residual) == pytest.approx(0.3, rel=0.01)  # 0.4 %


def test_scale_has_a_lower_bound_and_exists_without_residuals():
    assert robust_statistics.robust_sd(np.zeros(5), 0.01) == 0.01
    assert robust_statistics.robust_sd(np.empty(0), 0.01) == 0.01
    assert robust_statistics.robust_sd_about_median(np.empty(0)) == 0.0


def test_biweight_is_one_at_zero_and_zero_from_its_limit():
    weight = robust_statistics.biweight(np.array([0.0, 0.5, -0.5, 1.0, 3.0]))
    np.testing.assert_allclose(weight, [1.0, 0.5625, 0.5625, 0.0, 0.0], rtol=1e-15)  # float64: exact in halves


def test_slope_of_the_biweight_is_the_derivative_of_its_influence():
    z, h = np.array([-3.0, -0.7, 0.0, 0.3, 0.44, 0.6, 0.99, 2.0]), 1e-6
    rise = (z + h) * robust_statistics.biweight(z + h) - (z - h) * robust_statistics.biweight(z - h)
    np.testing.assert_allclose(robust_statistics.biweight_slope(z), rise / (2.0 * h), atol=1e-9)  # h^2 and 1e-16 / h


def test_biweight_mean_is_ninety_five_percent_efficient():
    """Variance of an M-estimate of the mean of normal values: E psi^2 / (E psi')^2, by quadrature."""
    z = np.linspace(-8.0, 8.0, 160_001)
    p = stats.norm.pdf(z) * (z[1] - z[0])
    psi = z * robust_statistics.biweight(z / robust_statistics.TUKEY)
    slope = np.gradient(psi, z)
    # The constant 4.685 is given to four figures.
    assert (p @ slope) ** 2 / (p @ psi**2) == pytest.approx(0.95, abs=1e-3)


def test_widened_standard_deviations_cover_as_students_t():
    for dof in (1.0, 4.0, 30.0):
        reach = 1.959964 * robust_statistics.student_factor(dof)
        assert 2.0 * stats.t.cdf(reach, dof) - 1.0 == pytest.approx(0.95, abs=1e-6)  # the figures of 1.959964
