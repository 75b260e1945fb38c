"""Variances of many small groups, moderated by what the groups have in common.

Smyth, Linear models and empirical Bayes methods for assessing differential expression in microarray experiments,
Statistical Applications in Genetics and Molecular Biology 3 (2004), sections 3 and 6.2: the groups' variances are drawn
from a scaled inverse chi-square law, whose variance and degrees of freedom follow from the scatter of their logarithms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import digamma, polygamma

from processor.model import Floats

FEWEST_FREE = 5.0  # degrees of freedom of a group, from which on it shows what groups have in common
FEWEST_GROUPS = 3  # two have a variance, but of one degree of freedom, that says nothing of a law
ASSUMED_FREE = 10.0  # of the law, where too few groups show it: its sd is known to 22 % (sqrt(2 / 10) / 2) then
MOST_FREE = 1e4  # variances of groups differ by chance alone then: their law leaves them 1.4 % (sqrt(2 / 1e4))
NEWTON_STEPS = 50  # work: Smyth's iteration (2004, appendix) converges in a few


class Moderated(NamedTuple):
    """Variances (g,) of groups, and the degrees of freedom (g,) by which they are known."""

    variance: Floats
    dof: Floats


def moderated(square: Floats, dof: Floats) -> Moderated:
    """Moderate the variances of groups by their sums of squares (g,) and degrees of freedom (g,), which may be 0."""
    used = (dof >= FEWEST_FREE) & (square > 0.0)
    common, of_law = float(square.sum() / max(dof.sum(), 1.0)), ASSUMED_FREE
    if used.sum() >= FEWEST_GROUPS:
        half = 0.5 * dof[used]
        e = np.log(square[used] / dof[used]) - digamma(half) + np.log(half)
        surplus = float(np.var(e, ddof=1) - polygamma(1, half).mean())
        of_law = min(2.0 * _inverse_trigamma(surplus), MOST_FREE) if surplus > 0.0 else MOST_FREE
        common = float(np.exp(e.mean() + digamma(0.5 * of_law) - np.log(0.5 * of_law)))
    total = of_law + dof
    return Moderated((of_law * common + square) / total, total)


def by_class(square: float, dof: float, variance: float) -> float:
    """Moderate the variance of one group by that of its class, which counts as ``ASSUMED_FREE`` degrees of freedom."""
    return (ASSUMED_FREE * variance + square) / (ASSUMED_FREE + dof)


def _inverse_trigamma(value: float) -> float:
    """Return the number whose trigamma function has a value above 0 (Newton's iteration of Smyth's appendix)."""
    y = 0.5 + 1.0 / value
    for _ in range(NEWTON_STEPS):
        trigamma = float(polygamma(1, y))
        step = trigamma * (1.0 - trigamma / value) / float(polygamma(2, y))
        y += step
        if abs(step) < 1e-8 * y:
            break
    return y
