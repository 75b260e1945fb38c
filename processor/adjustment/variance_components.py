"""What the points of one station have in common: they err alike, by its registration and its scanner's offset.

Within a cell of a face the stations' mean residuals scatter by more than the noise of their points explains; the
surplus is the variance between stations (DerSimonian and Laird 1986), taken over all cells of a part. A station moves
what is fitted by the sum of its own points' rows, so many points of few stations are worth no more than these are.
"""

from __future__ import annotations

from collections.abc import Sequence

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


# --- What a fitted surface does not follow, by its points' rests: the means of cells, and the next shape in order.


def lack_of_fit_variance(fits: Sequence[tuple[Floats, Ints]], numbers: int) -> float:
    """Return the variance of cells' means about fitted surfaces beyond noise, mm^2, for all surfaces together.

    A fit is the rests (n,) of its points and their cells (n,); each surface has so many ``numbers``. By moments: the
    sum of squares between the cells less what noise would give it.
    """
    between = within = 0.0
    freedom, points, inside = 0, 0, 0
    for rest, cell in fits:
        number = np.bincount(cell)
        kept = number > 0
        mean = np.bincount(cell, rest)[kept] / number[kept]
        between += float((number[kept] * mean**2).sum())
        within += float(((rest - (np.bincount(cell, rest) / np.maximum(number, 1))[cell]) ** 2).sum())
        freedom += int(kept.sum()) - numbers
        points += len(rest)
        inside += len(rest) - int(kept.sum())
    if freedom <= 0 or inside <= 0:
        return 0.0
    noise = within / inside
    return max((between - freedom * noise) / points, 0.0)


def third_order(basis: Floats, rest: Floats) -> Floats:
    """Return how far a face departs at the joint by the next shapes its numbers do not follow, with variances (2, 2).

    The numbers follow a bend along the part; the third Legendre polynomial, 1 at the joint, is the simplest shape that
    they do not, alike all across the face and from one side to the other. ``basis`` (n, 8) and ``rest`` (n,) are those
    of the points of the face's zone, see :func:`processor.preassembly.ends.faces.basis`.
    Where the zone is evenly seen these shapes and the numbers' have nothing in common: variance 7 sigma^2 / n.
    """
    t = 1.0 - 2.0 * np.abs(basis[:, 1])
    shapes = (0.5 * (5.0 * t**3 - 3.0 * t))[:, None] * np.stack([np.ones_like(t), basis[:, 2]], axis=1)
    own = shapes - basis @ np.linalg.lstsq(basis, shapes, rcond=None)[0]
    inverse = np.linalg.inv(own.T @ own)
    noise = float(rest @ rest) / max(len(rest) - basis.shape[1], 1)
    return np.stack([inverse @ (own.T @ rest), noise * np.diag(inverse)], axis=1)


def excess(departures: Floats) -> float:
    """Return the variance of departures (n, 2), each with its variance by noise, beyond what noise explains."""
    return max(float(np.mean(departures[:, 0] ** 2 - departures[:, 1])), 0.0)
