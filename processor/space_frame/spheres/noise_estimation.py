"""Noise of ranges, estimated from the residuals on all spheres, and the scatter of radii about their sizes.

All spheres of a frame are used together, because one sphere has too few points. Values stated for the scanner only
start the estimate.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.optimize import nnls

from processor.model import Floats
from processor.robust_statistics import MAD_TO_SD

LEAST_POINTS = 60
CELL_POINTS = 20
NEAREST_MM, RATIO = 1000.0, 1.4  # of the bins of the range
COSINES = np.array([0.15, 0.22, 0.3, 0.4, 0.55, 0.7, 0.85, 1.0 + 1e-9])
LEAST_MM = 0.02
LIMB_STEP, LIMB_POINTS = 0.05, 40
LIMB = np.arange(0.15, 0.451, LIMB_STEP)
RADII = 10  # the stated scatter of radii has the weight of as many spheres


def variances_of(noise: Floats, cosines: Floats, ranges: Floats) -> Floats:
    """Variances (n,) of ranges by the model's parts (3,)."""
    c2 = np.maximum(cosines, 0.1) ** 2
    variances: Floats = noise[0] + noise[1] * ranges**2 / np.sqrt(c2) + noise[2] * (1.0 - c2) / c2
    return variances


def noise_model(
    errors: Floats, cosines: Floats, ranges: Floats, weights: Floats, start: Floats
) -> tuple[Floats, float]:
    """Return the variance's parts (3,) (constant, by range^2 / cosine, by tangent^2), and the number of points used.

    ``errors`` (n,) are residuals corrected for leverage; ``weights`` (n,) > 0 mark those on spheres. The scale of each
    cell of range and incidence is estimated by the median absolute residual; non-negative parts are fitted to its
    square. With fewer than 60 points the ``start`` is returned, with the weight of 10 points.
    """
    on = weights > 0.0
    e, c, L = np.abs(errors[on]), cosines[on], ranges[on]
    if len(e) < LEAST_POINTS:
        return start, 10.0
    whole = float(MAD_TO_SD * np.median(e))
    band = np.floor(np.log(np.maximum(L, NEAREST_MM) / NEAREST_MM) / np.log(RATIO)).astype(np.int64)
    # 16 bits: sorted in one pass
    cell = (band * len(COSINES) + np.searchsorted(COSINES, c, side="right")).astype(np.int16)
    order = np.argsort(cell, kind="stable")
    edges = np.flatnonzero(np.diff(cell[order])) + 1
    rows, variances, counts = [], [], []
    for members in np.split(order, edges):
        if len(members) < CELL_POINTS:
            continue
        scale = MAD_TO_SD * float(np.median(e[members]))
        cos, far = float(np.median(c[members])), float(np.median(L[members]))
        rows.append([1.0, far * far / cos, (1.0 - cos * cos) / (cos * cos)])
        variances.append(max(scale, LEAST_MM) ** 2)
        counts.append(len(members))
    if len(rows) < 4:
        return np.array([max(whole, LEAST_MM) ** 2, 0.0, 0.0]), float(len(e))
    A, b = np.array(rows), np.array(variances)
    model = np.full(len(b), whole**2)
    parts = np.array([whole**2, 0.0, 0.0])
    size = np.abs(A).max(axis=0)
    for _ in range(5):  # a variance by the median of n points has the relative standard deviation sqrt(2.7 / n)
        w = np.sqrt(np.array(counts)) / model
        parts = nnls((A / size) * w[:, None], b * w)[0] / size
        model = np.maximum(A @ parts, 1e-3 * whole**2)
    if not parts[0] + parts[1] > 0.0:
        return np.array([whole**2, 0.0, 0.0]), float(len(e))
    parts[0] = max(parts[0], LEAST_MM**2)
    return parts, float(len(e))


def limb_cosine(errors: Floats, cosines: Floats, ranges: Floats, weights: Floats, noise: Floats, least: float) -> float:
    """Return the least cosine of incidence at which residuals have no bias: from ``least`` to 0.5.

    Near the limb a wide beam is cut, and its mean range differs from that of its centre. Bands of the cosine are left
    out whose median residual exceeds a tenth of the noise and its own standard error, and one band beyond them.
    """
    on = (weights > 0.0) & (cosines < LIMB[-1])
    c = cosines[on]
    u = errors[on] / np.sqrt(variances_of(noise, c, ranges[on]))
    limb = least
    for low, high in pairwise(LIMB.tolist()):
        here = np.sort(u[(c >= low) & (c < high)])
        if len(here) < LIMB_POINTS:
            continue
        middle = abs(float(np.median(here)))
        spread = MAD_TO_SD * float(np.median(np.abs(here)))
        if middle > max(0.1, 3.0 * 1.2533 / np.sqrt(len(here))) * spread:
            limb = high + LIMB_STEP
    return max(least, min(limb, 0.5))


def radius_scatter(radii: Floats, variances: Floats, sizes: Floats, used_sd: float, stated_sd: float) -> float:
    """Return the most likely standard deviation of radii about their sizes, mm.

    ``radii`` (k,) and ``variances`` (k,) come from fits with a prior of sd ``used_sd``. The prior is removed first, so
    that only the points contribute. The stated scatter has the weight of ten spheres. Spheres with little information
    are left out.
    """
    off, variance = _off_sizes(radii, variances, sizes, used_sd, stated_sd)
    if not len(off):
        return stated_sd
    grid = stated_sd * np.geomspace(0.2, 2.5, 128)
    total = variance[None] + grid[:, None] ** 2
    cost = (np.log(total) + off[None] ** 2 / total).sum(axis=1)
    cost += RADII * (np.log(grid**2) + stated_sd**2 / grid**2)
    return float(grid[np.argmin(cost)])


def radius_offset(
    radii: Floats, variances: Floats, sizes: Floats, used_sd: float, stated_sd: float
) -> tuple[float, float]:
    """Return the mean deviation of all radii from their sizes, mm, and its standard deviation.

    A range error common to all stations, or a wide beam, makes every sphere too small or too large; a single sphere
    does not show it. Arguments are those of :func:`radius_scatter`; ``used_sd`` is also the scatter of radii.
    """
    off, variance = _off_sizes(radii, variances, sizes, used_sd, stated_sd)
    weight = 1.0 / (variance + used_sd**2)
    total = float(weight.sum())
    return (float((weight * off).sum()) / total, total**-0.5) if total > 0.0 else (0.0, np.inf)


def _off_sizes(
    radii: Floats, variances: Floats, sizes: Floats, used_sd: float, stated_sd: float
) -> tuple[Floats, Floats]:
    """Radii less sizes (j,) from the points alone, and their variances (j,), of spheres with enough information."""
    by_points, variance = without_prior(radii, variances, sizes, used_sd)
    off = by_points - sizes
    near = np.abs(off) < 4.0 * np.sqrt(variance + stated_sd**2)
    return off[near], variance[near]


def without_prior(radii: Floats, variances: Floats, sizes: Floats, used_sd: float) -> tuple[Floats, Floats]:
    """Return radii (k,) by the points alone and their variances, mm^2; NaN where the prior, of ``used_sd``, decides."""
    prior = 1.0 / used_sd**2
    weight = 1.0 / variances - prior
    variance = 1.0 / np.where(weight > 0.1 * prior, weight, np.nan)
    return (radii / variances - sizes * prior) * variance, variance
