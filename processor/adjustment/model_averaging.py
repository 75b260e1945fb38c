"""Departures behind noisy values by Bayesian model averaging, when the size of the departures is not known.

Departures are normal about zero with a covariance that depends on their size. Every size is a hypothesis; the estimate
is the average over the hypotheses, weighted by their marginal likelihood (Rasmussen and Williams, Gaussian Processes
for Machine Learning, 2006, eqs. 2.23, 2.24 and 2.30). Departures of the size of the noise are shrunk to zero, large
ones are kept as measured, and the covariance includes the uncertainty of the size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.special import chdtrc

from processor.model import Bools, Floats, Ints

# Chosen: from none through the noise of a mean to a bent part, half a decade apart.
SIZES_MM = (0.0, 0.1, 1.0, 3.0, 10.0, 30.0)
LEAST_SHARE = 1e-4  # a hypothesis of less weight is left out of the average
LEAST_MM = 1e-4  # standard deviation that keeps a covariance invertible where a departure is known to be zero
ROUNDS = 50  # until the weights that each other's rows determine have converged
LENGTHS_MM = (400.0, 1200.0, 4000.0)  # correlation lengths of a curve along a part
LEAST_VALUES = 5  # more than the three that a line and a scatter about it take


@dataclass(frozen=True)
class Estimate:
    """Estimated departures (k,), their covariance (k, k), and the logarithm of the marginal likelihood.

    ``gain`` (k, k) is the derivative of the departures by the values; columns of unknown values are zero. ``tail`` is
    the posterior predictive probability of values at least as far off, see :mod:`.global_test`.
    """

    mean: Floats
    covariance: Floats
    gain: Floats
    log_evidence: float = 0.0
    tail: float = float("nan")

    def not_followed(self, motion: Floats) -> Floats:
        """Part (k, m) of a common ``motion`` (k, m) of departures and values that the estimate does not follow."""
        rest: Floats = motion - self.gain @ motion
        return rest


def estimate(
    value: Floats, noise: Floats, hypotheses: Sequence[tuple[float, Floats]], known: Bools | None = None
) -> Estimate:
    """Estimate departures (k,) from values (n,) with covariance ``noise`` (n, n).

    Values are of the ``known`` (k,) departures, or of all. A hypothesis is its prior weight and the departures'
    covariance (k, k).
    """
    priors = [prior for _, prior in hypotheses]
    logs = log_likelihoods(value, noise, priors, known) + np.log([weight for weight, _ in hypotheses])
    return average(value, noise, priors, logs, known)


def log_likelihoods(value: Floats, noise: Floats, priors: Sequence[Floats], known: Bools | None = None) -> Floats:
    """Logarithm (h,) of the marginal likelihood of values (n,) under each prior, a covariance (k, k)."""
    at = _known_or_all(known, priors)
    logs = []
    for prior in priors:
        factor = cho_factor(prior[np.ix_(at, at)] + noise, lower=True)
        logs.append(-0.5 * float(value @ cho_solve(factor, value)) - float(np.log(np.diag(factor[0])).sum()))
    return np.array(logs)


def average(
    value: Floats, noise: Floats, priors: Sequence[Floats], logs: Floats, known: Bools | None = None
) -> Estimate:
    """Average over hypotheses; ``logs`` (h,) are :func:`log_likelihoods` plus the logarithm of the prior weights."""
    at = _known_or_all(known, priors)
    share = np.exp(logs - logs.max())
    log_evidence = float(logs.max() + np.log(share.sum()))
    share = np.where(share < LEAST_SHARE * share.sum(), 0.0, share)
    share /= share.sum()
    mean, second, gain, tail = np.zeros(len(at)), np.zeros((len(at),) * 2), np.zeros((len(at),) * 2), 0.0
    for weight, prior in zip(share, priors, strict=True):
        if weight:
            factor = cho_factor(prior[np.ix_(at, at)] + noise, lower=True)
            prior_gain = cho_solve(factor, prior[at]).T
            prior_mean = prior_gain @ value
            mean += weight * prior_mean
            second += weight * (prior - prior_gain @ prior[at] + np.outer(prior_mean, prior_mean))
            gain[:, at] += weight * prior_gain
            tail += weight * float(chdtrc(len(value), value @ cho_solve(factor, value)))
    return Estimate(mean, second - np.outer(mean, mean), gain, log_evidence, tail)


def mixture(a: Estimate, b: Estimate) -> Estimate:
    """Average two estimates from disjoint sets of hypotheses, weighted by their evidence."""
    log_evidence = float(np.logaddexp(a.log_evidence, b.log_evidence))
    share = float(np.exp(a.log_evidence - log_evidence))
    difference = a.mean - b.mean
    mean, covariance, gain = (
        share * of_a + (1.0 - share) * of_b
        for of_a, of_b in ((a.mean, b.mean), (a.covariance, b.covariance), (a.gain, b.gain))
    )
    covariance = covariance + share * (1.0 - share) * np.outer(difference, difference)
    return Estimate(mean, covariance, gain, log_evidence, share * a.tail + (1.0 - share) * b.tail)


def with_least_covariance(raw: Estimate, least: Floats) -> Estimate:
    """Raise the covariance (k, k) of an estimate to at least ``least`` in every direction.

    The average over sizes is right where departures of every size are equally frequent. If all departures are of the
    size of the noise, the averaged estimate over-shrinks and its covariance is too small.
    """
    root = np.linalg.cholesky(least + LEAST_MM**2 * np.eye(len(least)))
    inner = solve_triangular(root, solve_triangular(root, raw.covariance, lower=True).T, lower=True)
    value, vector = np.linalg.eigh(0.5 * (inner + inner.T))
    scaled = root @ vector
    return replace(raw, covariance=(scaled * np.maximum(value, 1.0)) @ scaled.T)


def weights_by_others(logs: Floats, prior: Floats, traits: Ints) -> Floats:
    """Weights (e, h) of hypotheses for each of e things, learned from the other things (empirical Bayes).

    ``logs`` (e, h) are the log likelihoods of hypotheses for each thing. ``traits`` (t, h) number what hypotheses have
    in common; the weight of each trait is learned separately: how ends bend, from all of them, however far each is
    shifted. The ``prior`` (h,) counts as one thing more. A thing does not contribute to its own weights; a single thing
    has the prior.
    """
    prior = prior / prior.sum()
    likelihood = np.exp(logs - logs.max(axis=1, keepdims=True))
    weights: Floats = np.tile(prior, (len(logs), 1))
    for _ in range(ROUNDS):
        share = weights * likelihood
        share /= share.sum(axis=1, keepdims=True)
        weights = np.ones_like(share)
        for trait in traits:
            of_trait = trait == np.arange(trait.max() + 1)[:, None]
            posterior, before = share @ of_trait.T, of_trait @ prior
            by_others = (posterior.sum(axis=0) - posterior + before) / len(logs)
            weights *= by_others @ (of_trait / of_trait.sum(axis=1)[:, None])
        weights /= weights.sum(axis=1, keepdims=True)
    return weights


def smooth(chainage: Floats, value: Floats, variance: Floats, pose: Floats) -> Estimate:
    """Smooth values (k,), NaN = unknown, with variances (k,), at chainages (k,) in mm along a part.

    The departure is a straight line and a Gaussian process (Matern 3/2), each of unknown size. ``pose`` (k, k) is the
    covariance of the movement of the values by the part's registration. NaN where fewer than LEAST_VALUES are known.
    """
    known = np.isfinite(value) & np.isfinite(variance)
    if known.sum() < LEAST_VALUES:
        unknown = np.full((len(chainage),) * 2, np.nan)
        return Estimate(np.full(len(chainage), np.nan), unknown, unknown)
    x = (chainage - 0.5 * (chainage[0] + chainage[-1])) / max(0.5 * float(np.ptp(chainage)), 1.0)
    line = 1.0 + np.outer(x, x)
    distance = np.sqrt(3.0) * np.abs(chainage[:, None] - chainage)
    curves = [(1.0 + distance / length) * np.exp(-distance / length) for length in LENGTHS_MM]
    hypotheses = []
    for size in SIZES_MM:
        straight = pose + size**2 * line
        hypotheses.append((1.0, straight))
        # A curve of size 0 has no length; every other size has all lengths with equal weight.
        hypotheses += [(1.0 / len(curves), straight + bend**2 * curve) for bend in SIZES_MM[1:] for curve in curves]
    return estimate(value[known], np.diag(variance[known]), hypotheses, known)


def _known_or_all(known: Bools | None, priors: Sequence[Floats]) -> Bools:
    return np.ones(len(priors[0]), bool) if known is None else known
