"""Universal kriging of a face's departures: a trend and what the trend does not follow, of unknown size and length.

Departures are a linear trend plus a Gaussian process (Matern 5/2). Size and correlation length of the process are
hypotheses. The estimate is the average over them, weighted by their restricted likelihood (Cressie, Statistics for
Spatial Data, 1993, ch. 3; Harville 1974), so its covariance includes that size and length are not known. Where the
trend fits, size 0 has nearly all weight and the estimate is that of least squares.
"""

# Numba infers the types of the kernel's arguments: it stays without annotations.

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numba import njit

from processor.adjustment import global_test
from processor.adjustment.model_averaging import weights_by_others
from processor.model import Floats

SIZES_MM = (0.03, 0.1, 0.3, 1.0, 3.0)  # chosen: half a decade apart, from a mesh's error to a plate's waves
LENGTHS_MM = (100.0, 200.0, 400.0)  # chosen: by factors of two, up to a zone's length
# A process of size 0 has no length; every other size has all lengths with equal weight.
HYPOTHESES = ((0.0, LENGTHS_MM[0]), *product(SIZES_MM, LENGTHS_MM))
PRIOR = np.array([0.5, *(0.5 / (len(HYPOTHESES) - 1),) * (len(HYPOTHESES) - 1)])  # none: 0.5
LEAST_SHARE = 1e-4  # a hypothesis of less weight is left out of the average


class Means(NamedTuple):
    """Means (c,) of departures over patches at ``place`` (c, 2), mm, their variances by noise, and the trend (c, k).

    The noise is known by ``dof`` degrees of freedom. Coefficients of the trend are expected within ``trend_sd`` of
    ``trend_mean`` (k,): patches may not determine all of them.
    """

    place: Floats
    value: Floats
    variance: Floats
    trend: Floats
    dof: float = np.inf
    trend_mean: Floats | float = 0.0
    trend_sd: float = np.inf


class Kriged(NamedTuple):
    """Coefficients of the trend and the process at the wanted places (k + m,), with covariance (k + m, k + m)."""

    mean: Floats
    covariance: Floats


class Hypotheses(NamedTuple):
    """The estimates by every hypothesis: means (h, k + m), covariances (h, k + m, k + m), log likelihoods (h,).

    ``tails`` (h,) are the probabilities of residuals at least as large, see :mod:`.global_test`.
    """

    means: Floats
    covariances: Floats
    logs: Floats
    tails: Floats


def by_hypotheses(means: Means, at: Floats) -> Hypotheses:
    """Estimate the trend and the process at places (m, 2) by each of HYPOTHESES."""
    apart, to_wanted = _distances(means.place, means.place), _distances(at, means.place)
    among = _distances(at, at)
    of_length = {
        length: [_matern(distance / length) for distance in (apart, to_wanted, among)] for length in LENGTHS_MM
    }
    found = [_by_one(means, size**2, *of_length[length]) for size, length in HYPOTHESES]
    return Hypotheses(*(np.array(column) for column in zip(*found, strict=True)))


def learned_weights(every: Sequence[Hypotheses]) -> Floats:
    """Weights (f, h) of the hypotheses for each of f faces, learned from the other faces."""
    numbers = np.arange(len(HYPOTHESES))[None]
    return weights_by_others(np.array([one.logs for one in every]), PRIOR, numbers)


def average(found: Hypotheses, weights: Floats = PRIOR) -> Kriged:
    """Average over hypotheses with prior weights (h,)."""
    share = _shares(found, weights)
    mean = np.einsum("h,hk->k", share, found.means)
    off = found.means - mean
    within = np.einsum("h,hkl->kl", share, found.covariances)
    return Kriged(mean, within + np.einsum("h,hk,hl->kl", share, off, off))


def tail(found: Hypotheses, weights: Floats) -> float:
    """Posterior predictive probability of residuals at least as large, with prior weights (h,)."""
    return float(_shares(found, weights) @ found.tails)


def _shares(found: Hypotheses, weights: Floats) -> Floats:
    share = weights * np.exp(found.logs - found.logs.max())
    share = np.where(share < LEAST_SHARE * share.sum(), 0.0, share)
    shares: Floats = share / share.sum()
    return shares


def _by_one(
    means: Means, variance: float, apart: Floats, to_wanted: Floats, among: Floats
) -> tuple[Floats, Floats, float, float]:
    """Mean (k + m,) and covariance (k + m, k + m) by one hypothesis, its restricted log likelihood and its tail.

    ``apart`` (c, c), ``to_wanted`` (m, c) and ``among`` (m, m) are correlations of the process, of this ``variance``,
    between patches and wanted places.
    """
    columns, count = means.trend.shape[1], len(means.value)
    system = np.empty((count, count + columns + 1 + len(among)))
    np.multiply(apart, variance, out=system[:, :count])
    system[np.diag_indices(count)] += means.variance
    system[:, count:] = np.hstack([means.trend, means.value[:, None], variance * to_wanted.T])
    products = _eliminated(system, count)
    trend, value, wanted = slice(0, columns), columns, slice(columns + 1, None)
    expected = np.broadcast_to(means.trend_mean, columns) / means.trend_sd**2
    precision = products[trend, trend] + np.eye(columns) / means.trend_sd**2
    of_values = products[trend, value] + expected
    inverse = np.linalg.inv(precision)
    coefficients = inverse @ of_values
    by_trend = products[wanted, trend]
    rest = products[value, value] + expected @ np.broadcast_to(means.trend_mean, columns) - coefficients @ of_values
    log = -float(np.log(np.diag(system)).sum()) - 0.5 * float(np.linalg.slogdet(precision)[1] + rest)
    of_process = variance * among - products[wanted, wanted] + by_trend @ inverse @ by_trend.T
    both = -inverse @ by_trend.T
    covariance = np.block([[inverse, both], [both.T, of_process]])
    process = products[wanted, value] - by_trend @ coefficients
    beyond = float(global_test.tail(float(rest), count - columns, means.dof))
    return np.concatenate([coefficients, process]), covariance, log, beyond


@njit(cache=True, nogil=True)
def _eliminated(system, count):  # type: ignore[no-untyped-def]
    """Products (m, m) of the columns behind a covariance (n, n) in a ``system`` (n, n + m), weighed by its inverse.

    The covariance becomes its Cholesky factor. LAPACK's own depends, in the last digits, on the number of threads.
    """
    columns = system.shape[1]
    for i in range(count):  # row by row: the one that changes stays in the cache
        for k in range(i):
            factor = system[k, i]
            for j in range(i, columns):
                system[i, j] -= factor * system[k, j]
        scale = 1.0 / np.sqrt(system[i, i])
        for j in range(i, columns):
            system[i, j] *= scale
    extra = columns - count
    products = np.zeros((extra, extra))
    for k in range(count):
        for i in range(extra):
            for j in range(extra):
                products[i, j] += system[k, count + i] * system[k, count + j]
    return products


def _distances(a: Floats, b: Floats) -> Floats:
    apart: Floats = np.linalg.norm(a[:, None] - b[None], axis=2)
    return apart


def _matern(distance: Floats) -> Floats:
    scaled = np.sqrt(5.0) * distance
    correlation: Floats = (1.0 + scaled + scaled**2 / 3.0) * np.exp(-scaled)
    return correlation
