"""Covariance of least-squares fits whose residuals agree over patches: cluster-robust, and by scale of the patches.

Points of one scan share errors of range, of a station's registration, and of the surface's form. Residuals show what
is shared: their sums over clusters (patches, faces, stations) scatter by more than noise explains. The covariance is
the jackknife over clusters, which does not underestimate with few clusters (Bell and McCaffrey 2002, "CR3"). Its number
of degrees of freedom is Satterthwaite's, for Student's t.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from processor.model import NORMAL_95, Floats, Ints


class ClusterCovariance(NamedTuple):
    """Covariance (k, k) of coefficients and degrees of freedom (k,) of their variances; NaN, 0 where undetermined."""

    covariance: Floats
    freedom: Floats


class Patches(NamedTuple):
    """Means (p,) of residuals over patches, number of points (p,) and centres (p, d) of each; ``noise`` variance.

    ``noise`` is the variance of single points within patches, mm^2.
    """

    mean: Floats
    number: Floats
    centre: Floats
    noise: float


def covariance(basis: Floats, residual: Floats, cluster: Ints, weight: Floats | None = None) -> ClusterCovariance:
    """Jackknife covariance over clusters of a (weighted) least-squares fit.

    ``basis`` (n, k) and ``residual`` (n,) are of the fitted points, ``cluster`` (n,) numbers the cluster of each. A
    coefficient that fewer than two clusters determine has no covariance.
    """
    weighted = basis if weight is None else basis * weight[:, None]
    number = np.unique(cluster, return_inverse=True)[1].reshape(-1)
    count, k = int(number.max(initial=-1)) + 1, basis.shape[1]
    gradient = _sums(weighted * residual[:, None], number, count)
    products = _sums((weighted[:, :, None] * basis[:, None, :]).reshape(len(basis), k * k), number, count)
    products = products.reshape(count, k, k)
    normal = products.sum(axis=0)
    undetermined = ClusterCovariance(np.full((k, k), np.nan), np.zeros(k))
    if count < 2 or np.linalg.cond(normal) > 1e14:
        return undetermined
    left = normal - products
    if np.linalg.cond(left).max() > 1e14:  # one cluster alone determines a coefficient
        return undetermined
    moved = np.linalg.solve(left, gradient[:, :, None])[:, :, 0]
    inverse = np.linalg.inv(normal)
    share = np.einsum("ij,gjk,ki->gi", inverse, products, inverse)
    freedom = share.sum(axis=0) ** 2 / np.maximum((share**2).sum(axis=0), 1e-300) - 1.0
    return ClusterCovariance((count - 1) / count * moved.T @ moved, np.maximum(freedom, 1.0))


def jackknife(estimates: Floats) -> Floats:
    """Covariance (k, k) of an estimate by repeating it without one block at a time, ``estimates`` (g, k)."""
    off = estimates - estimates.mean(axis=0)
    found: Floats = (len(estimates) - 1) / len(estimates) * off.T @ off
    return found


def widening(freedom: Floats | float) -> Floats:
    """Factors of variances such that 1.96 standard deviations cover what Student's t does with this ``freedom``."""
    factor: Floats = (stdtrit(np.maximum(freedom, 1.0), 0.975) / NORMAL_95) ** 2
    return factor


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


def variance_by_scale(place: Floats, residual: Floats, sizes_mm: Sequence[float]) -> Floats:
    """Variance (s,) of patches' mean residuals beyond white noise, for each patch size, mm^2; NaN with one patch.

    White residuals give zero (negative by chance) at every size. A size at which the variance falls is the length over
    which residuals agree; what is left at the largest size is common to faces or to the whole scan.
    """
    return np.array([_beyond_noise(patches(place, residual, size)) for size in sizes_mm])


def _beyond_noise(found: Patches) -> float:
    if len(found.mean) < 2:
        return float("nan")
    return float(np.mean(found.mean**2 - found.noise / found.number))


def _sums(values: Floats, number: Ints, count: int) -> Floats:
    """Sum the rows of values (n, k) by their number (n,): (count, k)."""
    return np.stack([np.bincount(number, column, count) for column in values.T], axis=1)
