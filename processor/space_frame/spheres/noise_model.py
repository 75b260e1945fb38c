"""The noise of ranges as the balls themselves show it, and the scatter of radii about their sizes.

Both are read from all balls of a frame together, for one ball has too few points. What is stated of a scanner only
starts the estimate.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.optimize import nnls

from processor.model import Floats

LEAST_POINTS = 60
CELL_POINTS = 20
NEAREST_MM, RATIO = 1000.0, 1.4  # of the bins of the range
COSINES = np.array([0.15, 0.22, 0.3, 0.4, 0.55, 0.7, 0.85, 1.0 + 1e-9])
MAD = 1.482602218505602
LEAST_MM = 0.02
LIMB_STEP, LIMB_POINTS = 0.05, 40
LIMB = np.arange(0.15, 0.451, LIMB_STEP)
RADII = 10  # a stated scatter of radii is worth as many balls


def variances_of(noise: Floats, cosines: Floats, ranges: Floats) -> Floats:
    """Variances (n,) of ranges by the model's parts (3,)."""
    c2 = np.maximum(cosines, 0.1) ** 2
    found: Floats = noise[0] + noise[1] * ranges**2 / np.sqrt(c2) + noise[2] * (1.0 - c2) / c2
    return found


def noise_model(
    errors: Floats, cosines: Floats, ranges: Floats, weights: Floats, start: Floats
) -> tuple[Floats, float]:
    """Return the variance's parts (3,) (constant, by range^2 / cosine, by tangent^2), and how many points say so.

    ``errors`` (n,) are residuals free of leverage; ``weights`` (n,) > 0 mark those on balls. The scale of each cell of
    range and incidence comes from the median of the residuals' sizes; the parts fit its square and are none of them
    negative. With fewer than 60 points the ``start`` stays, worth 10 points.
    """
    on = weights > 0.0
    e, c, L = np.abs(errors[on]), cosines[on], ranges[on]
    if len(e) < LEAST_POINTS:
        return start, 10.0
    whole = float(MAD * np.median(e))
    band = np.floor(np.log(np.maximum(L, NEAREST_MM) / NEAREST_MM) / np.log(RATIO)).astype(np.int64)
    cell = (band * len(COSINES) + np.searchsorted(COSINES, c, side="right")).astype(np.int16)  # sorted in one pass
    order = np.argsort(cell, kind="stable")
    edges = np.flatnonzero(np.diff(cell[order])) + 1
    rows, variances, counts = [], [], []
    for members in np.split(order, edges):
        if len(members) < CELL_POINTS:
            continue
        scale = MAD * float(np.median(e[members]))
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
    for _ in range(5):  # a variance of n points has the standard deviation sqrt(2.7 / n) of itself by its median
        w = np.sqrt(np.array(counts)) / model
        parts = nnls((A / size) * w[:, None], b * w)[0] / size
        model = np.maximum(A @ parts, 1e-3 * whole**2)
    if not parts[0] + parts[1] > 0.0:
        return np.array([whole**2, 0.0, 0.0]), float(len(e))
    parts[0] = max(parts[0], LEAST_MM**2)
    return parts, float(len(e))


def limb_cosine(errors: Floats, cosines: Floats, ranges: Floats, weights: Floats, noise: Floats, least: float) -> float:
    """Return the cosine of incidence from which on residuals have no bias: ``least`` or more, 0.5 at most.

    Near the limb a wide beam is cut and its mean range is not that of its middle. Bands of the cosine whose median
    residual is off by more than a tenth of the noise, and by more than chance, are left out, and one band beyond them.
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
        spread = MAD * float(np.median(np.abs(here)))
        if middle > max(0.1, 3.0 * 1.2533 / np.sqrt(len(here))) * spread:
            limb = high + LIMB_STEP
    return max(least, min(limb, 0.5))


def radius_scatter(radii: Floats, variances: Floats, sizes: Floats, used_sd: float, stated_sd: float) -> float:
    """Return the likeliest standard deviation of radii about their sizes, mm.

    ``radii`` (k,) and ``variances`` (k,) are of fits with ``used_sd`` as prior. It is taken out again, so that each
    ball says what its points alone do; the stated scatter counts as ten balls. Balls that know little are left out.
    """
    off, own = _off_sizes(radii, variances, sizes, used_sd, stated_sd)
    if not len(off):
        return stated_sd
    grid = stated_sd * np.geomspace(0.2, 2.5, 128)
    total = own[None] + grid[:, None] ** 2
    cost = (np.log(total) + off[None] ** 2 / total).sum(axis=1)
    cost += RADII * (np.log(grid**2) + stated_sd**2 / grid**2)
    return float(grid[np.argmin(cost)])


def radius_offset(
    radii: Floats, variances: Floats, sizes: Floats, used_sd: float, stated_sd: float
) -> tuple[float, float]:
    """Return what radii lie off their sizes in the mean of all balls, mm, and its standard deviation.

    Ranges that are wrong alike at all stations, or means over a wide beam, make every ball too small or too large, and
    no ball alone shows it.
    Arguments are those of :func:`radius_scatter`; ``used_sd`` is also what radii scatter by.
    """
    off, own = _off_sizes(radii, variances, sizes, used_sd, stated_sd)
    weight = 1.0 / (own + used_sd**2)
    total = float(weight.sum())
    return (float((weight * off).sum()) / total, total**-0.5) if total > 0.0 else (0.0, np.inf)


def _off_sizes(
    radii: Floats, variances: Floats, sizes: Floats, used_sd: float, stated_sd: float
) -> tuple[Floats, Floats]:
    """Radii less sizes (j,) by the points alone, and their variances (j,), of balls that know something of it."""
    prior = 1.0 / used_sd**2
    weight = 1.0 / variances - prior
    good = np.isfinite(weight) & (weight > 0.1 * prior)
    own = 1.0 / weight[good]
    off = (radii[good] / variances[good] - sizes[good] * prior) * own - sizes[good]
    near = np.abs(off) < 4.0 * np.sqrt(own + stated_sd**2)
    return off[near], own[near]
