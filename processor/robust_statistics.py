"""Robust scales and weights of residuals, and Student's factor for standard deviations of few degrees of freedom."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from processor.model import NORMAL_95, Floats

MAD_TO_SD = 1.4826  # standard deviation of normal values over their median absolute deviation
CHI2_MEDIAN = 0.4549  # median of the chi-square distribution with one degree of freedom
TUKEY = 4.685  # standard deviations at which Tukey's biweight is 0: 95 % efficient for normal errors

CAUCHY = 2.385  # standard deviations at which Cauchy's weight is one half: 95 % efficient for normal errors


def finite_median(values: npt.ArrayLike) -> float:
    """Return the median of the finite values (n,); NaN if there is none."""
    array = np.asarray(values, np.float64)
    finite = array[np.isfinite(array)]
    return float(np.median(finite)) if len(finite) else float("nan")


def robust_sd(residual: Floats, least: float = 0.0) -> float:
    """Return the standard deviation of normal residuals (n,) about 0 by their median size, at least ``least``."""
    return max(MAD_TO_SD * float(np.median(np.abs(residual))), least) if len(residual) else least


def robust_sd_about_median(values: Floats) -> float:
    """Return the standard deviation of normal values (n,) by their median absolute deviation; 0 of no values."""
    return robust_sd(values - np.median(values)) if len(values) else 0.0


def biweight(scaled: Floats) -> Floats:
    """Tukey's weights of residuals, given in units of the size from which the weight is 0."""
    weight: Floats = np.maximum(1.0 - scaled**2, 0.0) ** 2
    return weight


def biweight_slope(scaled: Floats) -> Floats:
    """Return the derivative of the influence, the residual times Tukey's weight, scaled as in :func:`biweight`."""
    square = scaled**2
    slope: Floats = np.where(square < 1.0, (1.0 - square) * (1.0 - 5.0 * square), 0.0)
    return slope


def huber(z: Floats, limit: float) -> Floats:
    """Huber's weights of residuals ``z`` in standard deviations: 1 up to ``limit``, then as their inverse."""
    weight: Floats = np.minimum(1.0, limit / np.maximum(np.abs(z), 1e-9))
    return weight


def cauchy(scaled: Floats) -> Floats:
    """Cauchy's weights of residuals, given in units of the size at which the weight is one half."""
    weight: Floats = 1.0 / (1.0 + scaled**2)
    return weight


def student_factor(dof: Floats | float) -> Floats:
    """Factor of standard deviations known by ``dof`` degrees of freedom, such that 1.96 of them contain 95 %.

    Fewer degrees of freedom than 1 count as 1.
    """
    factor: Floats = stdtrit(np.maximum(dof, 1.0), 0.975) / NORMAL_95
    return factor
