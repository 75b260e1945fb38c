"""The end face of an open part, a ring as thin as its plates, by maximum likelihood of the points near it.

Noise moves points of the ring over its edges and points of the walls into it. A margin wide enough to separate them
would leave little of a plate of 25 mm, so each point is weighted by the probability that it is of the ring. In the
plane across the ring, x outward along the part and e inward from the wall's outer face, the density of points is a
mixture:

    ring    rho_r phi(x - x0) (Phi(e) - Phi(e - t))
    walls   (rho_o phi(e) + rho_i phi(e - t)) Phi(x0 - x)

with phi and Phi of the noise's standard deviation, t the thickness, and the densities rho counted on the walls and the
ring. A small uniform share stands for outliers. x0, linear in the basis (1, u, v and their products), is found by
Fisher scoring.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from processor.model import Bools, Floats, Ints
from processor.preassembly.ends import plate_sides
from processor.robust_statistics import robust_sd_about_median

REACH = 4.0  # standard deviations from ring and walls
LEAST_REACH_MM = 3.0  # of a quiet scan too: a cut edge is rough by less
SECTORS = 24  # of the ring
OUTLIER_SHARE = 0.005  # of the points, uniform over the window
LEAST_POINTS = 40  # five a coefficient of the ring
FLOOR_MM = 0.01  # of the noise


@dataclass(frozen=True)
class Ring:
    """Coefficients (k,) of the basis and their covariance (k, k); empty without an answer."""

    coefficients: Floats
    covariance: Floats


class _Densities(NamedTuple):
    """Points a mm across, per unit of the ring's length, up to a common factor."""

    ring: float
    outer: float
    inner: float


NO_RING = Ring(np.empty(0), np.empty((0, 0)))


def fit(x: Floats, e: Floats, thickness: Floats, basis: Floats, sigma_mm: float) -> Ring:
    """Fit the ring to points near it: x, e, the plate's thickness (n,) each, and the basis (n, k).

    Leave out points near the corners, where walls meet, before. NO_RING where it cannot be fitted.
    """
    sigma = max(sigma_mm, FLOOR_MM)
    start = _start(x, e, thickness, basis, sigma)
    if start is None:
        return NO_RING
    coefficients, on_ring = start
    reach = max(REACH * sigma, LEAST_REACH_MM)
    off = x - basis @ coefficients
    near = (np.abs(off) < reach) & (e > -reach) & (e < thickness + reach)
    densities = _densities(off, e, thickness, on_ring, reach)
    x, e, t, basis = x[near], e[near], thickness[near], basis[near]
    window = basis @ coefficients  # fixed: the window stays where the start has the ring
    covariance = np.full((len(coefficients),) * 2, np.nan)
    for _ in range(40):
        x0 = basis @ coefficients
        ring, wall, outlier, mass = _mixture(x - x0, e, t, sigma, densities, reach, x0 - window)
        z, total, edge = (x - x0) / sigma, ring + wall + outlier, (densities.outer + densities.inner) / mass
        of_ring, of_wall, hazard = ring / total, wall / total, _phi(-z) / np.maximum(ndtr(-z), 1e-300)
        slope = (of_ring * z + of_wall * hazard) / sigma
        # Minus the second derivative of log(density / mass), point by point (Louis 1982).
        bend = (of_ring * (1.0 - z**2) - of_wall * hazard * z) / sigma**2 + slope**2 - edge**2
        information = basis.T @ (basis * bend[:, None])
        if np.linalg.eigvalsh(information).min() <= 0.0:  # far from the maximum: as if memberships were known
            information = basis.T @ (basis * (of_ring / sigma**2)[:, None])
        if np.linalg.cond(information) > 1e12:
            return NO_RING
        covariance = np.linalg.inv(information)
        step = covariance @ (basis.T @ (slope - edge))
        coefficients = coefficients + step
        sigma = max(float(np.sqrt((of_ring * z**2).sum() / of_ring.sum())) * sigma, FLOOR_MM)
        if np.abs(step).max() < 1e-3 * np.sqrt(np.diag(covariance)).min():
            break
    if np.abs(basis @ coefficients - window).max() > reach:
        return NO_RING  # the solution left the points that are surely of the ring
    return Ring(coefficients, covariance)


def sectors(basis: Floats) -> Ints:
    """Sector of the ring (n,), 0 to SECTORS - 1, of points by their basis (n, k)."""
    turn = np.arctan2(basis[:, 2], basis[:, 1]) / (2.0 * np.pi) + 0.5
    sector: Ints = np.minimum(np.floor(SECTORS * turn), SECTORS - 1).astype(np.int64)
    return sector


def _start(x: Floats, e: Floats, thickness: Floats, basis: Floats, sigma: float) -> tuple[Floats, Bools] | None:
    """Least squares on points that are surely of the ring by their place across it, and a mark of them."""
    margin = np.minimum(3.0 * sigma + 1.0, 0.35 * thickness)
    inside = (e > margin) & (e < thickness - margin)
    used = inside.copy()
    # Sector by sector, so that the slope of the ring does not mix it with other layers: it may be centimetres off.
    used[inside] = plate_sides.outer_surface(x[inside], basis[inside, :3], sectors(basis[inside]))
    coefficients = np.zeros(basis.shape[1])
    for _ in range(8):
        if used.sum() < LEAST_POINTS:
            return None
        coefficients = np.asarray(np.linalg.lstsq(basis[used], x[used], rcond=None)[0], np.float64)
        residual = x - basis @ coefficients
        # About the median: points of walls pull inward only.
        sd = max(robust_sd_about_median(residual[used]), FLOOR_MM)
        now = inside & (np.abs(residual) < 3.5 * sd + 0.01)
        if (now == used).all():
            break
        used = now
    return coefficients, used


def _densities(off: Floats, e: Floats, thickness: Floats, on_ring: Bools, reach: float) -> _Densities:
    margin = np.minimum(reach, 0.35 * thickness)
    inside = (e > margin) & (e < thickness - margin)
    width = float((thickness - 2.0 * margin).mean())
    ring = float((on_ring & inside).sum()) / width
    deep = (off < -reach) & (off > -reach - 30.0)
    outer, inner = (float((deep & (np.abs(at) < reach)).sum()) / 30.0 for at in (e, e - thickness))
    return _Densities(max(ring, 1e-9), outer, inner)


def _mixture(
    off: Floats, e: Floats, t: Floats, sigma: float, rho: _Densities, reach: float, shift: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Densities (n,) of ring, walls and outliers, and the mass of all of them in the window; ``shift`` of the ring."""
    across = ndtr(e / sigma) - ndtr((e - t) / sigma)
    ring = rho.ring * _phi(off / sigma) / sigma * across
    wall = (rho.outer * _phi(e / sigma) + rho.inner * _phi((e - t) / sigma)) / sigma * ndtr(-off / sigma)
    mass = rho.ring * t + (rho.outer + rho.inner) * (reach + shift)
    outlier = OUTLIER_SHARE * mass / (2.0 * reach * (t + 2.0 * reach))
    return ring, wall, outlier, mass


def _phi(z: Floats) -> Floats:
    density: Floats = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    return density
