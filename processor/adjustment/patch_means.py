"""Means of residuals over patches: squares of a plane or cubes of space, all of one size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from processor.model import Floats, Ints


class PatchMeans(NamedTuple):
    """Means (p,) of residuals over patches, mm, number of ``points`` (p,) in each, and their centroids (p, d), mm.

    ``noise_variance`` is that of single points about the means of their patches, mm^2.
    """

    mean: Floats
    points: Floats
    centre: Floats
    noise_variance: float


def patch_means(place: Floats, residual: Floats, size_mm: float) -> PatchMeans:
    """Average residuals (n,), mm, over patches of ``size_mm`` of points at ``place`` (n, d), mm."""
    patch = patch_numbers(place, size_mm)
    patches = int(patch.max(initial=-1)) + 1
    count = np.bincount(patch, minlength=patches).astype(np.float64)
    mean = np.bincount(patch, residual, patches) / count
    noise_variance = float(((residual - mean[patch]) ** 2).sum()) / max(len(residual) - patches, 1)
    centre = np.stack([np.bincount(patch, column, patches) for column in place.T], axis=1) / count[:, None]
    return PatchMeans(mean, count, centre, noise_variance)


def patch_numbers(place: Floats, size_mm: float) -> Ints:
    """Return the number (n,), from 0, of the square or cube of ``size_mm`` of each point at ``place`` (n, d), mm."""
    index = np.floor(place / size_mm).astype(np.int64)
    index -= index.min(axis=0, initial=0)
    key = np.ravel_multi_index(tuple(index.T), tuple(index.max(axis=0, initial=0) + 1))
    number: Ints = np.unique(key, return_inverse=True)[1].reshape(-1).astype(np.int64)
    return number
