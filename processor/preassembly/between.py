"""What the points of one station have in common: they err alike, by its registration and its scanner's offset.

Within a cell of a face the stations' mean residuals scatter by more than the noise of their points explains; the
surplus is the variance between stations (DerSimonian and Laird 1986), taken over all cells of a part. A station moves
what is fitted by the sum of its own points' rows, so many points of few stations are worth no more than these are.
"""

from __future__ import annotations

import numpy as np
from scipy.special import stdtrit

from processor.model import NORMAL_95, Floats, Ints

LEAST_POINTS = 25  # of a station on a face


def variance(residual: Floats, station: Ints, cell: Ints) -> float:
    """Return the variance between stations, mm^2, by residuals (n,); 0 where no cell was seen by two.

    It is the estimate times (t / 1.96)^2 of as many stations as there are.
    """
    key, group = np.unique(np.stack([cell, station], axis=1), axis=0, return_inverse=True)
    group = group.reshape(-1)
    number = np.bincount(group)
    mean = np.bincount(group, residual) / number
    rest = residual - mean[group]
    kept = number >= LEAST_POINTS
    noise = np.bincount(group, rest**2) / np.maximum(number - 1, 1)
    w = np.where(kept, number / np.maximum(noise, 1e-12), 0.0)
    at = key[:, 0]
    total, square = np.bincount(at, w), np.bincount(at, w**2)
    count = np.bincount(at, kept)
    several = count >= 2
    if not several.any():
        return 0.0
    middle = np.bincount(at, w * mean) / np.where(total > 0.0, total, 1.0)
    scatter = np.bincount(at, w * (mean - middle[at]) ** 2)
    # Each cell by itself, then their mean: a cell with many points knows the stations no better than another.
    surplus = (scatter - (count - 1))[several]
    weight = (total - square / np.where(total > 0.0, total, 1.0))[several]
    # A variance known from k stations only: widened so that 1.96 standard deviations hold what Student's t would.
    widened = (float(stdtrit(len(np.unique(station[kept[group]])) - 1, 0.975)) / NORMAL_95) ** 2
    return widened * max(float(np.mean(surplus / weight)), 0.0)


def added(basis: Floats, station: Ints, between: float) -> Floats:
    """Covariance (k, k) that a variance between stations adds to what is fitted with a basis (n, k)."""
    inverse = np.linalg.inv(basis.T @ basis)
    moves = np.stack([np.bincount(station, column) for column in basis.T], axis=1) @ inverse
    found: Floats = between * moves.T @ moves
    return found


def share(station: Ints) -> float:
    """Return the part of a variance between stations that is left in the mean of all points (n,)."""
    number = np.bincount(station)
    return float((number.astype(np.float64) ** 2).sum() / max(len(station), 1) ** 2)
