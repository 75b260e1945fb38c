"""Means of residuals over patches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from processor.model import Floats, Ints


class Patches(NamedTuple):
    """Means (p,) of residuals over patches, number of points (p,) and centres (p, d) of each; ``noise`` variance.

    ``noise`` is the variance of single points within patches, mm^2.
    """

    mean: Floats
    number: Floats
    centre: Floats
    noise: float


def patches(place: Floats, residual: Floats, size_mm: float) -> Patches:
    """Mean residuals over square patches (cubes) of ``size_mm`` of points at ``place`` (n, d)."""
    number = cubes(place, size_mm)
    count = int(number.max(initial=-1)) + 1
    points = np.bincount(number, minlength=count).astype(np.float64)
    mean = np.bincount(number, residual, count) / points
    within = float(((residual - mean[number]) ** 2).sum()) / max(len(residual) - count, 1)
    centre = _sums(place, number, count) / points[:, None]
    return Patches(mean, points, centre, within)


def cubes(place: Floats, size_mm: float) -> Ints:
    """Return the number (n,), from 0, of the square or cube of ``size_mm`` with each point at ``place`` (n, d)."""
    index = np.floor(place / size_mm).astype(np.int64)
    index -= index.min(axis=0, initial=0)
    key = np.ravel_multi_index(tuple(index.T), tuple(index.max(axis=0, initial=0) + 1))
    number: Ints = np.unique(key, return_inverse=True)[1].reshape(-1).astype(np.int64)
    return number


def _sums(values: Floats, number: Ints, count: int) -> Floats:
    """Sum the rows of values (n, k) by their number (n,): (count, k)."""
    return np.stack([np.bincount(number, column, count) for column in values.T], axis=1)
