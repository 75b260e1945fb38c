"""95 % intervals of the greatest of several uncertain values.

The greatest of several values with errors is biased, and the interval of whichever value came out greatest is too
short: of eight it may miss in one case of five. So the interval is a simultaneous band: with 95 % all errors stay
within it, and then the true greatest lies between the greatest lower and the greatest upper side of the band, whichever
value has it. Values that cannot be the greatest are left out; where one stands clear of the others, the band is
1.96 standard deviations, as for any single value.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from processor import large_arrays
from processor.adjustment import normal_draws
from processor.large_arrays import blocks
from processor.model import NORMAL_95, Floats

DRAWS = 10_000  # of the errors, for the width of the band
CLEAR_SD = 4.0  # a value this many standard deviations of their difference below the greatest is not the greatest
EXACT_MM = 1e-9  # rounding: values without an error that are equal stay among the greatest


def of_independent(values: Floats, sd: Floats, axes: int = 1) -> tuple[float, float, float]:
    """Greatest of values (n,), and its 95 % interval (low, high), their correlation unknown.

    The band is widened as for independent errors, which by Sidak's inequality never covers less. ``sd`` (n,) is of the
    value itself, or of each of the ``axes`` of the vector whose length it is.
    """
    return of_extreme(values, sd, 1.0, sign=1, axes=axes)


def of_extreme(
    values: Floats, errors: Floats, sd_per_error: float, sign: int, axes: int = 1
) -> tuple[float, float, float]:
    """Greatest (``sign`` 1) or least (-1) of values (n,) that need not fit in memory, and its 95 % interval.

    As of :func:`of_independent`, with ``errors`` (n,) in place of standard deviations, which are ``sd_per_error`` times
    these: levels of detection. n > 0.
    """
    extreme = large_arrays.extremes(values)[sign > 0]
    limit = sign * extreme - CLEAR_SD * sd_per_error * errors[large_arrays.first_of(values, extreme)] - EXACT_MM

    def near(rows: slice) -> tuple[Floats, Floats]:
        value, sd = sign * values[rows], sd_per_error * errors[rows]
        of_near = value >= limit - CLEAR_SD * sd
        return value[of_near], sd[of_near]

    count = sum(len(near(rows)[0]) for rows in blocks(len(values)))
    factor = float(np.sqrt(chdtri(axes, 1.0 - 0.95 ** (1.0 / count))))
    low = high = -np.inf
    for rows in blocks(len(values)):
        value, sd = near(rows)
        low = max(low, float((value - factor * sd).max(initial=-np.inf)))
        high = max(high, float((value + factor * sd).max(initial=-np.inf)))
    return (extreme, low, high) if sign > 0 else (extreme, -high, -low)


def of_correlated(values: Floats, covariance: Floats, folded: bool = False) -> tuple[float, float, float]:
    """Greatest of values (n,), and its 95 % interval (low, high), by the covariance (n, n) of their errors.

    ``folded``: the values are magnitudes. NaN for the interval where something is unknown.
    """
    if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
        return float(values.max()), float("nan"), float("nan")
    top = int(np.argmax(values))
    var = np.maximum(np.diag(covariance), 0.0)
    difference_sd = np.sqrt(np.maximum(var + var[top] - 2.0 * covariance[top], 0.0))
    if folded:  # the other sign of a value can be the greatest magnitude as well
        difference_sd = np.maximum(difference_sd, np.sqrt(np.maximum(var + var[top] + 2.0 * covariance[top], 0.0)))
    near = values >= values[top] - CLEAR_SD * difference_sd - EXACT_MM
    sd = np.sqrt(var[near])
    reach = _factor(covariance[np.ix_(near, near)]) * sd
    low, high = float((values[near] - reach).max()), float((values[near] + reach).max())
    return float(values[top]), max(low, 0.0) if folded else low, high


def _factor(covariance: Floats) -> float:
    """Return the number of standard deviations within which all errors of a joint draw stay with 95 %."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    noisy = sd > 0.0
    if noisy.sum() < 2:
        return NORMAL_95
    errors = normal_draws.errors_of(covariance[np.ix_(noisy, noisy)], DRAWS)
    return max(NORMAL_95, float(np.quantile(np.abs(errors / sd[noisy]).max(axis=1), 0.95)))
