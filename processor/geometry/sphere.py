"""Spheres through points: the source paper's algebraic least squares and its four-point solve.

Source: paper 001 (Huang et al. 2019), equations 1-4 and 5-15. Every routine subtracts a local origin first: squares of
georeferenced coordinates leave no digits for a ball.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.model import Floats, Ints

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Sphere:
    """Centre (3,) and radius in mm, with the covariance (4, 4) of x, y, z and radius."""

    centre: Floats
    radius: float
    covariance: Floats

    @property
    def lowest_sd(self) -> float:
        """Standard deviation in mm of the lowest point's height, centre z - radius; their errors are correlated."""
        variance = self.covariance[2, 2] + self.covariance[3, 3] - 2.0 * self.covariance[2, 3]
        return float(np.sqrt(max(variance, 0.0)))

    def residuals(self, points: Floats) -> Floats:
        """Signed distances (n,) in mm of points (n, 3) from the surface, outside positive."""
        distance: Floats = np.linalg.norm(points - self.centre, axis=1) - self.radius
        return distance


def canonical_order(points: Floats) -> Ints:
    """Rows (n,) that sort points (n, 3) by x, then y, then z: random samples then ignore the order of the file."""
    return np.lexsort((points[:, 2], points[:, 1], points[:, 0])).astype(np.int64)


def algebraic(points: Floats) -> Sphere | None:
    """Sphere of least squared algebraic distance to points (n, 3), n >= 4 (paper 001, eq. 12-15).

    None where the points determine no sphere (fewer than four, or all in one plane). The covariance is formal: it takes
    the residuals for independent noise about an unbiased model, while this estimator makes partly seen balls too small
    and takes every outlier at its full weight. It is NaN for exactly four points, which have no redundancy.
    """
    if len(points) < 4:
        return None
    origin = points.mean(axis=0)
    local = points - origin
    # one length unit of the data's own size keeps the columns of eq. 14 comparable
    size = float(np.sqrt(np.mean(np.sum(local**2, axis=1))))
    if not size > 0.0:
        return None
    local = local / size
    A = np.column_stack([-2.0 * local, np.ones(len(local))])
    b = -np.sum(local**2, axis=1)
    U, singular, Vt = np.linalg.svd(A, full_matrices=False)
    if singular[3] <= 1e-9 * singular[0]:
        return None
    solution = Vt.T @ ((U.T @ b) / singular)
    centre = solution[:3]
    radius = float(np.sqrt(max(centre @ centre - solution[3], 0.0)))
    if not radius > 0.0:
        return None
    dof = len(points) - 4
    variance = float(np.sum((A @ solution - b) ** 2)) / dof if dof > 0 else float("nan")
    # r^2 = c.c - m, so dr = (c.dc - dm / 2) / r
    J = np.eye(4)
    J[3] = np.append(centre, -0.5) / radius
    half = J @ (Vt.T / singular)
    return Sphere(origin + size * centre, size * radius, variance * size**2 * (half @ half.T))


def through_four(quads: Floats) -> tuple[Floats, Floats]:
    """Centres (m, 3) and radii (m,) of the spheres through four points each, quads (m, 4, 3); NaN where coplanar.

    Paper 001, eq. 10-11 by cofactors; the last cofactor there is misprinted and is a e - b d.
    """
    first = quads[:, 0]
    rows = quads[:, 1:] - first[:, None]
    rhs = 0.5 * np.sum(rows**2, axis=2)
    (a, b, c), (d, e, f), (g, h, i) = (rows[:, k].T for k in range(3))
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    cofactors = np.stack(
        [
            np.stack([e * i - f * h, c * h - b * i, b * f - c * e], axis=1),
            np.stack([f * g - d * i, a * i - c * g, c * d - a * f], axis=1),
            np.stack([d * h - e * g, b * g - a * h, a * e - b * d], axis=1),
        ],
        axis=1,
    )
    size = np.linalg.norm(rows, axis=2).max(axis=1)
    flat = np.abs(det) <= 1e-9 * size**3
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.einsum("mij,mj->mi", cofactors, rhs) / det[:, None]
    offset[flat] = np.nan
    return first + offset, np.linalg.norm(offset, axis=1)


BANDS, SECTORS = 10, 20


def sphere_cells(points: Floats, centre: Floats) -> Ints:
    """Cell (n,) of 200 equal ones, 10 bands of equal height by 20 sectors, in which each point (n, 3) is seen."""
    direction = points - centre
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-300)[:, None]
    band = np.clip(np.floor((direction[:, 2] + 1.0) * (BANDS / 2.0)), 0, BANDS - 1)
    turn = np.arctan2(direction[:, 1], direction[:, 0]) / (2.0 * np.pi) + 0.5
    sector = np.clip(np.floor(turn * SECTORS), 0, SECTORS - 1)
    return np.asarray(band * SECTORS + sector).astype(np.int64)


def visible_fraction(points: Floats, centre: Floats) -> float:
    """Share of the 200 equal cells of the sphere that hold points (n, 3)."""
    return len(np.unique(sphere_cells(points, centre))) / (BANDS * SECTORS)
