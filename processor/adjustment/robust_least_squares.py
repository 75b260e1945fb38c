"""Robust least squares on arrays: normal equations, iterated weights, and covariances by the scatter between clusters.

The names are those of all adjustments here: unknowns x (u,), derivative J (n, u) of the observations by them,
``residual`` (n,) of observed less computed, ``weight`` (n,), normal matrix N (u, u), covariance (u, u).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from processor.adjustment.point_groups import group_sums
from processor.model import Floats, Ints


def normal_equations(J: Floats, weight: Floats, observed: Floats) -> tuple[Floats, Floats]:
    """Return the normal matrix N (u, u) and right side (u,) of observations (n,)."""
    weighted = weight[:, None] * J
    return J.T @ weighted, weighted.T @ observed


def inverse_of(N: Floats) -> Floats:
    """Return the pseudo-inverse of a normal matrix N (u, u) of unknowns of any units; 0 where they are undetermined."""
    scale = np.sqrt(np.maximum(np.diag(N), 1e-300))
    inverse: Floats = np.linalg.pinv(N / np.outer(scale, scale), rcond=1e-12) / np.outer(scale, scale)
    return inverse


def reweighted(
    x: Floats,
    weights: Callable[[Floats], Floats],
    solved: Callable[[Floats, Floats], Floats],
    rounds: int,
    is_still: Callable[[Floats], bool],
) -> tuple[Floats, Floats]:
    """Alternate the weights (n,) of the residuals at x, and the unknowns x (u,) solved with them.

    ``solved`` takes x and the weights. Ends after ``rounds`` (> 0), or when a step of x ``is_still``; returns x and the
    last weights.
    """
    for _ in range(rounds):
        weight = weights(x)
        before, x = x, solved(x, weight)
        if is_still(x - before):
            break
    return x, weight


def sandwich(inverse: Floats, gradient: Floats, cluster: Ints) -> Floats:
    """Covariance (u, u) of an estimate by the scatter between clusters of dependent residuals (Liang and Zeger 1986).

    ``inverse`` (u, u) is that of the normal matrix, ``gradient`` (n, u) each row's J times weight and residual,
    ``cluster`` (n,) its number. Scaled for the ``u`` unknowns that the clusters determine.
    """
    sums, count = group_sums(gradient, cluster), len(np.unique(cluster))
    covariance: Floats = inverse @ (sums.T @ sums) @ inverse * (count / max(count - len(inverse), 1))
    return covariance
