"""What noisy values say of the departures behind them, when it is not known how large departures may be.

Departures are taken as normal about zero, with a covariance that depends on their size. Every size is a hypothesis;
the answer is the average over all of them, each counted by how well it explains the values (Rasmussen and Williams,
Gaussian Processes for Machine Learning, 2006, eqs. 2.23, 2.24 and 2.30). So a part as designed is told from one that is
not, what is large is taken as measured, and the interval knows that the size is not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from processor.model import Floats, Ints

SIZES_MM = (0.0, 0.1, 1.0, 3.0, 10.0, 30.0)
LEAST_SHARE = 1e-4  # of a hypothesis, to be counted
LEAST_MM = 1e-4  # sd of what is surely nothing, where a covariance has to be turned round
ROUNDS = 50  # until the weights of things that judge each other have settled


@dataclass(frozen=True)
class Believed:
    """Departures (k,) with their covariance (k, k), and the logarithm of how well they explain the values.

    ``gain`` (k, k) is how they follow the values: columns of unknown ones are zero.
    """

    mean: Floats
    covariance: Floats
    gain: Floats
    evidence: float = 0.0

    def left_of(self, moves: Floats) -> Floats:
        """Return how much (k, m) of what ``moves`` (k, m) departures and values alike the mean does not follow."""
        found: Floats = moves - self.gain @ moves
        return found


def weigh(
    value: Floats, noise: Floats, hypotheses: Sequence[tuple[float, Floats]], known: npt.NDArray[np.bool_] | None = None
) -> Believed:
    """Departures (k,) by values (n,) with covariance ``noise`` (n, n) of those that are ``known`` (k,), or of all.

    A hypothesis is its weight beforehand and the departures' covariance (k, k).
    """
    priors = [prior for _, prior in hypotheses]
    logs = explained(value, noise, priors, known) + np.log([before for before, _ in hypotheses])
    return averaged(value, noise, priors, logs, known)


def explained(
    value: Floats, noise: Floats, priors: Sequence[Floats], known: npt.NDArray[np.bool_] | None = None
) -> Floats:
    """Return the logarithm (h,) of how well each prior, a covariance (k, k) of departures, explains values (n,)."""
    at = _all_or(known, priors)
    logs = []
    for prior in priors:
        factor = cho_factor(prior[np.ix_(at, at)] + noise, lower=True)
        logs.append(-0.5 * float(value @ cho_solve(factor, value)) - float(np.log(np.diag(factor[0])).sum()))
    return np.array(logs)


def averaged(
    value: Floats,
    noise: Floats,
    priors: Sequence[Floats],
    logs: Floats,
    known: npt.NDArray[np.bool_] | None = None,
) -> Believed:
    """Average over hypotheses: ``logs`` (h,) is how well each is :func:`explained`, its weight beforehand added."""
    at = _all_or(known, priors)
    share = np.exp(logs - logs.max())
    evidence = float(logs.max() + np.log(share.sum()))
    share = np.where(share < LEAST_SHARE * share.sum(), 0.0, share)
    share /= share.sum()
    mean, second, gain = np.zeros(len(at)), np.zeros((len(at),) * 2), np.zeros((len(at),) * 2)
    for weight, prior in zip(share, priors, strict=True):
        if weight:
            factor = cho_factor(prior[np.ix_(at, at)] + noise, lower=True)
            follows = cho_solve(factor, prior[at]).T
            own = follows @ value
            mean += weight * own
            second += weight * (prior - follows @ prior[at] + np.outer(own, own))
            gain[:, at] += weight * follows
    return Believed(mean, second - np.outer(mean, mean), gain, evidence)


def _all_or(known: npt.NDArray[np.bool_] | None, priors: Sequence[Floats]) -> npt.NDArray[np.bool_]:
    return np.ones(len(priors[0]), bool) if known is None else known


def by_the_others(logs: Floats, before: Floats, traits: Ints) -> Floats:
    """Return the weights (e, h) of hypotheses for each of several things, by what the others of them say.

    ``logs`` (e, h) is how well each hypothesis explains each thing; ``traits`` (t, h) number what hypotheses have in
    common, and each trait is learned apart: how things bend, from all, however far each is shifted. What is believed
    ``before`` (h,) counts as one thing more. Nothing judges itself, and alone all is as before.
    """
    before = before / before.sum()
    likely = np.exp(logs - logs.max(axis=1, keepdims=True))
    weights: Floats = np.tile(before, (len(logs), 1))
    for _ in range(ROUNDS):
        share = weights * likely
        share /= share.sum(axis=1, keepdims=True)
        weights = np.ones_like(share)
        for trait in traits:
            of_trait = trait == np.arange(trait.max() + 1)[:, None]
            own, known = share @ of_trait.T, of_trait @ before
            weights *= ((own.sum(axis=0) - own + known) / len(logs)) @ (of_trait / of_trait.sum(axis=1)[:, None])
        weights /= weights.sum(axis=1, keepdims=True)
    return weights


def either(a: Believed, b: Believed) -> Believed:
    """Believe in the one or the other, each as far as its evidence goes."""
    evidence = float(np.logaddexp(a.evidence, b.evidence))
    share = float(np.exp(a.evidence - evidence))
    apart = a.mean - b.mean
    mean, covariance, gain = (
        share * one + (1.0 - share) * other
        for one, other in ((a.mean, b.mean), (a.covariance, b.covariance), (a.gain, b.gain))
    )
    return Believed(mean, covariance + share * (1.0 - share) * np.outer(apart, apart), gain, evidence)


def no_surer(believed: Believed, least: Floats) -> Believed:
    """Raise the covariance (k, k) of what is believed to one that is ``least`` in every direction.

    The average over sizes is right for parts whose departures are of every size alike. Where all are as large as the
    noise, it draws them towards nothing more often than it owns up to.
    """
    root = np.linalg.cholesky(least + LEAST_MM**2 * np.eye(len(least)))
    inner = solve_triangular(root, solve_triangular(root, believed.covariance, lower=True).T, lower=True)
    value, vector = np.linalg.eigh(0.5 * (inner + inner.T))
    own = root @ vector
    return replace(believed, covariance=(own * np.maximum(value, 1.0)) @ own.T)


# --- The smooth departure behind a row of noisy values along a part: a straight line and a curve, each of unknown size.


LENGTHS_MM = (400.0, 1200.0, 4000.0)  # over which a curve changes
LEAST_VALUES = 5


def smooth(arc: Floats, value: Floats, variance: Floats, pose: Floats) -> Believed:
    """Smooth values (k,), NaN = unknown, with variances (k,), at arc lengths (k,) in mm.

    ``pose`` (k, k) is the covariance of what the part's registration moves them by. NaN where too few are known.
    """
    known = np.isfinite(value) & np.isfinite(variance)
    if known.sum() < LEAST_VALUES:
        nothing = np.full((len(arc),) * 2, np.nan)
        return Believed(np.full(len(arc), np.nan), nothing, nothing)
    x = (arc - 0.5 * (arc[0] + arc[-1])) / max(0.5 * float(np.ptp(arc)), 1.0)
    line = 1.0 + np.outer(x, x)
    apart = np.sqrt(3.0) * np.abs(arc[:, None] - arc)
    curves = [(1.0 + apart / length) * np.exp(-apart / length) for length in LENGTHS_MM]  # Matern 3/2
    hypotheses = []
    for size in SIZES_MM:
        straight = pose + size**2 * line
        hypotheses.append((1.0, straight))
        # A curve of size 0 has no length; each other size has all of them in equal parts.
        hypotheses += [(1.0 / len(curves), straight + bent**2 * curve) for bent in SIZES_MM[1:] for curve in curves]
    return weigh(value[known], np.diag(variance[known]), hypotheses, known)
