"""Groups of points by cells of space and of faces, and sums and means over them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from processor.distinct_rows import distinct
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
    return PatchMeans(mean, count, group_sums(place, patch, patches) / count[:, None], noise_variance)


def patch_numbers(place: Floats, size_mm: float) -> Ints:
    """Return the number (n,), from 0, of the square or cube of ``size_mm`` of each point at ``place`` (n, d), mm."""
    index = np.floor(place / size_mm).astype(np.int64)
    index -= index.min(axis=0, initial=0)
    key = np.ravel_multi_index(tuple(index.T), tuple(index.max(axis=0, initial=0) + 1))
    number: Ints = np.unique(key, return_inverse=True)[1].reshape(-1).astype(np.int64)
    return number


def pieces(points: Floats, normals: Floats, side: float) -> Ints:
    """Return the number (k,), from 0, of the piece of a face that each point (k, 3), mm, lies on.

    A piece is a cube of edge ``side``, mm, and a rounded direction of the unit normals (k, 3).
    """
    place = np.floor((points - points.min(axis=0)) / side).astype(np.int64)
    return distinct(np.hstack([place, np.rint(normals).astype(np.int64)])).number


def group_sums(values: Floats, group: Ints, groups: int = 0) -> Floats:
    """Return sums (g, k) of values (n, k) over groups (n,), numbered from 0; of ``groups`` at least."""
    total: Floats = np.stack([np.bincount(group, column, groups) for column in values.T], axis=1)
    return total


def group_means(values: Floats, group: Ints) -> Floats:
    """Means (g, 3) of values (n, 3) in groups (n,)."""
    means: Floats = group_sums(values, group) / np.bincount(group)[:, None]
    return means
