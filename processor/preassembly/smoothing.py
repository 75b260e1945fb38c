"""What a row of noisy values along a part says of the smooth departure behind them, with its covariance.

The departure is taken as a Gaussian process about zero: a straight line and a Matern 3/2 curve, each of unknown size,
the curve of unknown length. Both sizes and the length are averaged over by how well they explain the values (Rasmussen
and Williams, Gaussian Processes for Machine Learning, 2006, eqs. 2.23, 2.24, 2.30), so that a part as designed is told
from one that is not, and the interval knows that they are not known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from processor.model import Floats

SIZES_MM = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
LENGTHS_MM = (400.0, 1200.0, 4000.0)
LEAST_VALUES = 5
LEAST_SHARE = 1e-4  # of a hypothesis, to be counted


@dataclass(frozen=True)
class Smoothed:
    """The departure (k,) at all places and its covariance (k, k); NaN where too few values are known."""

    mean: Floats
    covariance: Floats


def smooth(arc: Floats, value: Floats, variance: Floats) -> Smoothed:
    """Smooth values (k,), NaN = unknown, with variances (k,), at arc lengths (k,) in mm."""
    known = np.isfinite(value) & np.isfinite(variance)
    if known.sum() < LEAST_VALUES:
        return Smoothed(np.full(len(arc), np.nan), np.full((len(arc),) * 2, np.nan))
    middle, half = 0.5 * (arc[0] + arc[-1]), max(0.5 * float(np.ptp(arc)), 1.0)
    x = (arc - middle) / half
    line = 1.0 + np.outer(x, x)
    apart = np.abs(arc[:, None] - arc)
    curves = [_matern(apart / length) for length in LENGTHS_MM]
    # Size 0 has no length; each other size has all of them in equal parts.
    hypotheses = [(a, 0.0, curves[0], 1.0) for a in SIZES_MM]
    hypotheses += [(a, t, curve, 1.0 / len(curves)) for a in SIZES_MM for t in SIZES_MM[1:] for curve in curves]
    y, noise = value[known], np.diag(variance[known])
    logs, factors = [], []
    for a, t, curve, prior in hypotheses:
        kernel = a * a * line + t * t * curve
        factor = cho_factor(kernel[np.ix_(known, known)] + noise, lower=True)
        fit = cho_solve(factor, y)
        logs.append(np.log(prior) - 0.5 * float(y @ fit) - float(np.log(np.diag(factor[0])).sum()))
        factors.append((kernel, factor, fit))
    share = np.exp(np.array(logs) - max(logs))
    share /= share.sum()
    mean, second = np.zeros(len(arc)), np.zeros((len(arc),) * 2)
    for weight, (kernel, factor, fit) in zip(share, factors, strict=True):
        if weight < LEAST_SHARE:
            continue
        to_known = kernel[:, known]
        own = to_known @ fit
        mean += weight * own
        second += weight * (kernel - to_known @ cho_solve(factor, to_known.T) + np.outer(own, own))
    counted = float(share[share >= LEAST_SHARE].sum())
    mean, second = mean / counted, second / counted
    return Smoothed(mean, second - np.outer(mean, mean))


def _matern(apart: Floats) -> Floats:
    found: Floats = (1.0 + np.sqrt(3.0) * apart) * np.exp(-np.sqrt(3.0) * apart)
    return found
