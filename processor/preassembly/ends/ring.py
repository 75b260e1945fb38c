"""The end face of an open part, a ring as thin as its plates, by the likelihood of the points about it.

Noise smears the ring's points over its edges, and those of the walls into it: a margin wide enough to keep them apart
would leave little of a plate of 25 mm. So each point is weighed by where it may come from. In the plane across the
ring, x outward along the part and e inward from the wall's outer face, the density of points is that of a mixture:

    ring    rho_r phi(x - x0) (Phi(e) - Phi(e - t))
    walls   (rho_o phi(e) + rho_i phi(e - t)) Phi(x0 - x)

with phi and Phi of the noise's standard deviation, t the thickness, and the densities rho counted on the walls and the
ring themselves; a small even share is left to outliers. x0, linear in 1, u, v and their products, is found by scoring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from processor.model import Floats, Ints
from processor.preassembly.ends import plate_sides

REACH = 4.0  # standard deviations about ring and walls
LEAST_REACH_MM = 3.0
AROUND = 24  # sectors of the ring
STRAY_SHARE = 0.005  # of points, even over the window
LEAST_POINTS = 40
FLOOR_MM = 0.01  # of the noise


@dataclass(frozen=True)
class Ring:
    """Coefficients (k,) of the basis, their covariance (k, k), and the noise across the ring; empty without points."""

    coefficients: Floats
    covariance: Floats
    sigma_mm: float


NOTHING = Ring(np.empty(0), np.empty((0, 0)), float("nan"))


def fit(x: Floats, e: Floats, thickness: Floats, basis: Floats, sigma_mm: float) -> Ring:
    """Fit the ring to points near it: x, e, the plate's thickness (n,) each, and the basis (n, k).

    Points near the corners, where walls meet, are to be left out before.
    """
    sigma = max(sigma_mm, FLOOR_MM)
    start = _start(x, e, thickness, basis, sigma)
    if start is None:
        return NOTHING
    coefficients, on_ring = start
    reach = max(REACH * sigma, LEAST_REACH_MM)
    off = x - basis @ coefficients
    near = (np.abs(off) < reach) & (e > -reach) & (e < thickness + reach)
    densities = _densities(off, e, thickness, on_ring, reach)
    x, e, t, basis = x[near], e[near], thickness[near], basis[near]
    window = basis @ coefficients  # the window stays where the start put it
    covariance = np.full((len(coefficients),) * 2, np.nan)
    for _ in range(40):
        x0 = basis @ coefficients
        ring, wall, stray, mass = _mixture(x - x0, e, t, sigma, densities, reach, x0 - window)
        z, total, edge = (x - x0) / sigma, ring + wall + stray, (densities[1] + densities[2]) / mass
        of_ring, of_wall, hazard = ring / total, wall / total, _hazard(-z)
        slope = (of_ring * z + of_wall * hazard) / sigma
        # Minus the second derivative of log(density / mass), point by point (Louis 1982).
        bend = (of_ring * (1.0 - z**2) - of_wall * hazard * z) / sigma**2 + slope**2 - edge**2
        information = basis.T @ (basis * bend[:, None])
        if np.linalg.eigvalsh(information).min() <= 0.0:  # far from the answer: as if it were known what is of the ring
            information = basis.T @ (basis * (of_ring / sigma**2)[:, None])
        if np.linalg.cond(information) > 1e12:
            return NOTHING
        covariance = np.linalg.inv(information)
        step = covariance @ (basis.T @ (slope - edge))
        coefficients = coefficients + step
        sigma = max(float(np.sqrt((of_ring * z**2).sum() / of_ring.sum())) * sigma, FLOOR_MM)
        if np.abs(step).max() < 1e-3 * np.sqrt(np.diag(covariance)).min():
            break
    if np.abs(basis @ coefficients - window).max() > reach:
        return NOTHING  # not where the points that are surely of the ring have it: this is no such ring
    return Ring(coefficients, covariance, sigma)


def sectors(basis: Floats) -> Ints:
    """Return in which of AROUND sectors of the ring points (n,) lie, by their basis (n, k)."""
    turn = np.arctan2(basis[:, 2], basis[:, 1]) / (2.0 * np.pi) + 0.5
    found: Ints = np.minimum(np.floor(AROUND * turn), AROUND - 1).astype(np.int64)
    return found


def _start(x: Floats, e: Floats, thickness: Floats, basis: Floats, sigma: float) -> tuple[Floats, np.ndarray] | None:
    """Least squares on points that are surely of the ring by their place across it, and which they are."""
    margin = np.minimum(3.0 * sigma + 1.0, 0.35 * thickness)
    inside = (e > margin) & (e < thickness - margin)
    used = inside.copy()
    # Around the ring, so that its slope does not smear what lies beside it: an end may be centimetres off.
    used[inside] = plate_sides.outer_surface(x[inside], basis[inside, :3], sectors(basis[inside]))
    coefficients = np.zeros(basis.shape[1])
    for _ in range(8):
        if used.sum() < LEAST_POINTS:
            return None
        # The median first: walls' points pull inward only.
        coefficients = np.asarray(np.linalg.lstsq(basis[used], x[used], rcond=None)[0], np.float64)
        rest = x - basis @ coefficients
        spread = max(1.4826 * float(np.median(np.abs(rest[used] - np.median(rest[used])))), FLOOR_MM)
        now = inside & (np.abs(rest) < 3.5 * spread + 0.01)
        if (now == used).all():
            break
        used = now
    return coefficients, used


def _densities(
    off: Floats, e: Floats, thickness: Floats, on_ring: np.ndarray, reach: float
) -> tuple[float, float, float]:
    """Points a mm across, per unit of the ring's length, of the ring, the outer and the inner wall; up to a factor."""
    margin = np.minimum(reach, 0.35 * thickness)
    inside = (e > margin) & (e < thickness - margin)
    width = float((thickness - 2.0 * margin).mean())
    ring = float((on_ring & inside).sum()) / width
    deep = (off < -reach) & (off > -reach - 30.0)
    outer, inner = (float((deep & (np.abs(at) < reach)).sum()) / 30.0 for at in (e, e - thickness))
    return max(ring, 1e-9), outer, inner


def _mixture(
    off: Floats, e: Floats, t: Floats, sigma: float, densities: tuple[float, float, float], reach: float, moved: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Densities (n,) of ring, walls and strays, and the whole of them in the window."""
    ring_rho, outer_rho, inner_rho = densities
    across = ndtr(e / sigma) - ndtr((e - t) / sigma)
    ring = ring_rho * _phi(off / sigma) / sigma * across
    wall = (outer_rho * _phi(e / sigma) + inner_rho * _phi((e - t) / sigma)) / sigma * ndtr(-off / sigma)
    mass = ring_rho * t + (outer_rho + inner_rho) * (reach + moved)
    stray = STRAY_SHARE * mass / (2.0 * reach * (t + 2.0 * reach))
    return ring, wall, stray, mass


def _phi(z: Floats) -> Floats:
    found: Floats = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    return found


def _hazard(z: Floats) -> Floats:
    """Return phi(z) / Phi(z)."""
    found: Floats = _phi(z) / np.maximum(ndtr(z), 1e-300)
    return found
