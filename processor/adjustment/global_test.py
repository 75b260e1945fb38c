"""Global tests: whether residuals contradict the noise model that the intervals rest on.

The weighted sum of squared residuals of a fit is chi-square distributed (Baarda 1968), over its degrees of freedom F
distributed where the noise is estimated as well. A fit that is averaged over hypotheses has the mean of their tail
probabilities, weighted as the hypotheses are. This posterior predictive probability falls below a with a probability of
2 a at most (Meng, Annals of Statistics 22 (1994), 1142). All tests of one result have BY_CHANCE together (Bonferroni).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import fdtrc

from processor.model import Floats

BY_CHANCE = 1e-3  # probability that noise as modelled makes any test of one result fail
PREDICTIVE = 2.0  # largest probability, over a, that a posterior predictive probability falls below a (Meng)


def tail(square: Floats | float, dof: float, noise_dof: float) -> Floats:
    """Probability of a weighted sum of squares of at least ``square``; 1 without degrees of freedom.

    ``noise_dof`` is that of the estimated noise.
    """
    if dof <= 0 or noise_dof <= 0:
        return np.ones_like(square, dtype=np.float64)
    probability: Floats = np.asarray(fdtrc(dof, noise_dof, np.asarray(square) / dof), np.float64)
    return probability


def contradicted(probability: Floats) -> npt.NDArray[np.bool_]:
    """Mark the tests (m,) of one result that fail, by their tail probabilities; NaN = not tested."""
    tested = max(int(np.isfinite(probability).sum()), 1)
    failed: npt.NDArray[np.bool_] = probability < BY_CHANCE / (PREDICTIVE * tested)
    return failed
