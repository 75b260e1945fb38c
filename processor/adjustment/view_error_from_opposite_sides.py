"""Standard deviation of the errors of views that a merged cloud does not name, from the two sides of plates and bars.

Each view has errors of registration and range of its own. The movement of a plate cancels in the sum of the outward
movements of its two sides. The variance of the sums beyond that of noise is due to the views of the two sides, or to a
thickness other than designed. Half of it is attributed to each side.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from processor.adjustment.point_groups import group_means, pieces
from processor.model import Floats, Ints
from processor.robust_statistics import CHI2_MEDIAN

FEWEST_PLACES = 3  # of a piece
FEWEST_PAIRS = 8  # a variance of 8 is known to 50 % (sqrt(2 / 8)); of fewer the class of the scanner says more
FLOOR_MM = 1e-3  # least noise, for scans without any
BESIDE = 0.25  # of a piece's side, the most by which two sides lie beside each other
OPPOSED = -0.9  # largest cosine between the normals of two sides
SIGNIFICANT = 2.0  # standard errors of a variance, from which on it is significant
MEDIAN_SD = 1.065  # of the median of n values of chi-squared with one degree of freedom, times sqrt(n)


def view_sd(points: Floats, normals: Floats, along: Floats, variance: Floats, side_mm: float) -> float:
    """Return the standard deviation, mm, of the error that the points of one view share; 0 if it is not significant.

    ``along`` (n,) are outward movements at points (n, 3) with unit normals (n, 3), mm, NaN where there is none.
    Their ``variance`` (n,) is from noise, as if they were independent. Pieces have a side of ``side_mm``.

    The variance is that for which the median of the squared sums, over their variances, is as of normal errors: pieces
    with dents do not count for more. It is 0 where few pieces were seen from both sides, and where the median may be
    that of chance.
    """
    known = np.flatnonzero(np.isfinite(along) & np.isfinite(variance))
    if not len(known):
        return 0.0
    points, normals = points[known], normals[known]
    piece = pieces(points, normals, side_mm)
    count = np.bincount(piece)
    mean = np.bincount(piece, along[known]) / count
    noise = np.bincount(piece, variance[known]) / count**2
    pairs = _opposite(group_means(points, piece), group_means(normals, piece), side_mm)
    pairs = pairs[(count[pairs] >= FEWEST_PLACES).all(axis=1)]
    independent = len(np.unique(pairs)) / 2
    if independent < FEWEST_PAIRS:
        return 0.0
    square, noises = mean[pairs].sum(axis=1) ** 2, np.maximum(noise[pairs].sum(axis=1), FLOOR_MM**2)

    def surplus(view_variance: float) -> float:
        return float(np.median(square / (noises + 2.0 * view_variance))) - CHI2_MEDIAN

    if surplus(0.0) <= SIGNIFICANT * MEDIAN_SD / np.sqrt(independent):
        return 0.0
    return float(np.sqrt(brentq(surplus, 0.0, float(square.max()) / CHI2_MEDIAN)))


def _opposite(places: Floats, normals: Floats, reach_mm: float) -> Ints:
    """Return pairs (m, 2) of pieces that are the two sides of one body: each lies behind the other.

    Beside each other, they would differ by how the movement changes along the body.
    """
    pairs = cKDTree(places).query_pairs(reach_mm, output_type="ndarray").astype(np.int64)
    first, second = pairs.T
    between = places[second] - places[first]
    across = np.einsum("mi,mi->m", between, normals[first])
    beside = np.linalg.norm(between - across[:, None] * normals[first], axis=1)
    opposed = np.einsum("mi,mi->m", normals[first], normals[second]) < OPPOSED
    found: Ints = pairs[opposed & (across < 0.0) & (beside < BESIDE * reach_mm)]
    return found
