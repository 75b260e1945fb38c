"""Covariance of a fit whose residuals are correlated between neighbours, by restricted likelihood.

Points of one scan err together over some distance: by the filter of the scanner, by its sampling, by the shape of the
surface. A sandwich of independent residuals is then too narrow. Here the means of the residuals over cells of the
surface are taken as noise and a Gaussian field of unknown size and correlation length, with the fit's unknowns
eliminated (restricted likelihood, Patterson and Thompson 1971). The covariance is the mean over the posterior of both:
it holds that few cells say little about the field. What a field that is the same everywhere does to a fit no residual
shows: see :mod:`processor.adjustment.scanner_class_errors`.
"""

from __future__ import annotations

import numpy as np

from processor.model import Floats, Ints

LENGTHS = (0.12, 0.3, 0.75)  # correlation lengths in rad: from less than a cell to as long as residuals can show
# Standard deviations of the field, in those of a point's noise: a smaller one adds nothing to the noise, a larger one
# is the shape of another body. Even in the logarithm, the prior that does not depend on a unit.
RATIOS = np.geomspace(0.03, 3.0, 24)
LEAST_WEIGHT = 1e-3  # of a cell: its mean then counts for nothing
LEAST_CELLS = 12  # cells beyond the unknowns that an estimate of two parameters needs


def added_covariance(J: Floats, errors: Floats, weights: Floats, directions: Floats, cell: Ints) -> Floats:
    """Return what correlation of residuals adds to the covariance (p, p) of a fit by least squares.

    Parameters
    ----------
    J : (n, p) derivatives of the residuals by the unknowns
    errors : (n,) residuals of the fit, those of the points used
    weights : (n,) robust weights of the points, so that a stray point that is alone in its cell is no field
    directions : (n, 3) unit normals of the surface at the points: neighbours are near each other in them
    cell : (n,) number of the cell of the surface that each point lies in

    0 where there are too few cells to tell.
    """
    number, cell = np.unique(cell, return_inverse=True)
    cells, unknowns = len(number), J.shape[1]
    if cells < unknowns + LEAST_CELLS:
        return np.zeros((unknowns, unknowns))
    count = np.maximum(np.bincount(cell, weights), LEAST_WEIGHT)
    mean = np.bincount(cell, weights * errors) / count
    noise = float(np.sum(weights * (errors - mean[cell]) ** 2)) / max(float(weights.sum()) - cells, 1.0)
    if not noise > 0.0:
        return np.zeros((unknowns, unknowns))
    root = np.sqrt(count / noise)
    # Weighted means of a cell's derivatives, and what they leave of the means of its residuals.
    A = np.stack([np.bincount(cell, weights * column) for column in J.T], axis=1) / count[:, None] * root[:, None]
    Q, R = np.linalg.qr(A, mode="complete")
    gain = np.linalg.solve(R[:unknowns], Q[:, :unknowns].T) * root
    normal = np.stack([np.bincount(cell, column) for column in directions.T], axis=1)
    normal = normal / np.linalg.norm(normal, axis=1)[:, None]
    angle = np.arccos(np.clip(normal @ normal.T, -1.0, 1.0))
    free = Q[:, unknowns:] * root[:, None]
    left = free.T @ mean
    variances = noise * RATIOS**2
    K = np.exp(-angle / np.array(LENGTHS)[:, None, None])
    size, axes = np.linalg.eigh(free.T @ K @ free)
    square = np.einsum("lij,i->lj", axes, left) ** 2
    spread = 1.0 + variances[None, :, None] * np.maximum(size, 0.0)[:, None]
    likelihood = -0.5 * np.sum(np.log(spread) + square[:, None] / spread, axis=2)
    weight = np.exp(likelihood - likelihood.max())
    total: Floats = np.einsum("lv,v,lpq->pq", weight / weight.sum(), variances, gain @ K @ gain.T)
    return total
