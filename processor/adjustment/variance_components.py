"""Variance components of fitted surfaces: between scanner stations, and the lack of fit of the surface's basis.

Between stations: all points of one station share the error of its registration and of its scanner's offset. Within a
cell of a face the stations' mean residuals scatter by more than point noise explains; the surplus, over all cells of a
part, is the variance between stations (DerSimonian and Laird 1986). Many points of few stations then weigh no more than
the number of stations justifies.

Lack of fit: variance between the cell means of a fit's residuals.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.adjustment.point_groups import group_sums
from processor.distinct_rows import distinct
from processor.model import Floats, Ints
from processor.robust_statistics import student_factor

LEAST_POINTS = 25  # of a station in a cell


def between_stations(residual: Floats, station: Ints, cell: Ints) -> float:
    """Variance between stations, mm^2, by residuals (n,); 0 where no cell was seen from two stations.

    The estimate is multiplied by (t / 1.96)^2, with Student's t for the number of stations.
    """
    groups = distinct(np.stack([cell, station], axis=1))
    group, number = groups.number, groups.count
    mean = np.bincount(group, residual) / number
    within = residual - mean[group]
    enough = number >= LEAST_POINTS
    noise = np.bincount(group, within**2) / np.maximum(number - 1, 1)
    w = np.where(enough, number / np.maximum(noise, 1e-12), 0.0)
    cell_of_group = groups.rows[:, 0]
    total, square = np.bincount(cell_of_group, w), np.bincount(cell_of_group, w**2)
    count = np.bincount(cell_of_group, enough)
    several = count >= 2
    if not several.any():
        return 0.0
    middle = np.bincount(cell_of_group, w * mean) / np.where(total > 0.0, total, 1.0)
    scatter = np.bincount(cell_of_group, w * (mean - middle[cell_of_group]) ** 2)
    # Cells have equal weight: more points in a cell add no information on the stations.
    surplus = (scatter - (count - 1))[several]
    weight = (total - square / np.where(total > 0.0, total, 1.0))[several]
    # The variance comes from few stations: widen it so that 1.96 standard deviations cover what Student's t covers.
    widening = float(student_factor(len(np.unique(station[enough[group]])) - 1)) ** 2
    return widening * max(float(np.mean(surplus / weight)), 0.0)


def group_covariance(basis: Floats, group: Ints, variance: float) -> Floats:
    """Covariance (k, k) of a least-squares fit by an error that each group of points shares.

    ``basis`` (n, k) of the fit, ``group`` (n,) the number of each point's group (its station or cell), ``variance`` of
    the shared errors, mm^2.
    """
    inverse = np.linalg.inv(basis.T @ basis)
    by_group = group_sums(basis, group) @ inverse
    covariance: Floats = variance * by_group.T @ by_group
    return covariance


def lack_of_fit_variance(fits: Sequence[tuple[Floats, Ints]], coefficients: int) -> float:
    """Variance of the cells' means about fitted surfaces beyond noise, mm^2, one for all surfaces (method of moments).

    Each fit is its residuals (n,) and their cells (n,), with so many ``coefficients``.
    """
    between = within = 0.0
    dof, points, inside = 0, 0, 0
    for residual, cell in fits:
        number = np.bincount(cell)
        used = number > 0
        mean = np.bincount(cell, residual)[used] / number[used]
        between += float((number[used] * mean**2).sum())
        within += float(((residual - (np.bincount(cell, residual) / np.maximum(number, 1))[cell]) ** 2).sum())
        dof += int(used.sum()) - coefficients
        points += len(residual)
        inside += len(residual) - int(used.sum())
    if dof <= 0 or inside <= 0:
        return 0.0
    noise = within / inside
    return max((between - dof * noise) / points, 0.0)
