"""Gaussian field over the normals by which errors of unnamed views displace merged surfaces: covariance and size.

A view displaces the part of a surface that it sees by one vector: its shift, its rotation times the lever arm, and its
range offset along its rays. Its points on a ball have normals within a right angle of its direction and a density
that goes with the cosine of incidence. The merged surface has the mean of its views. For many views from all sides with
independent vectors, its displacement along the normal is a Gaussian field over the normals with the correlation

    cos a (sin a + (pi - a) cos a) / pi

at an angle a: the product of two normals for the vectors, times the arc-cosine kernel of first order for the densities
(Cho and Saul 2009, "Kernel methods for deep learning"). From ball to ball views change their directions and weights:
the correlation falls with the distance d as exp(-d / length).

Most of such a field is a shift and a change of radius, which no residual of one ball shows. The rest shows how large
the field is. Its variance has the prior of the scanner's class, and the likelihood of the residuals with the states of
all balls eliminated (restricted likelihood, Patterson and Thompson 1971). The posterior mean of the variance is used.
It includes the uncertainty of the variance, which is large with few views, as in Student's t.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from processor.adjustment.scanner_class_errors import VIEW_SD_MM
from processor.geometry.sphere import BANDS, SECTORS
from processor.model import Floats, Ints

# Spherical harmonics up to degree 3 hold all but a hundredth of the field's variance. A sphere's state takes up those
# of degrees 0 and 1.
MODES, TAKEN_UP = 16, 4
# Combinations of modes that only few points at the edge of the visible surface determine are left out.
LEAST_INFORMATION = 0.02
SD_MM = np.geomspace(0.01, 5.0, 40)  # a smaller field is negligible, a larger one occurs in no registered cloud
LENGTHS_MM = np.array([1e3, 2e3, 4e3, 8e3, 16e3, 32e3, np.inf])  # stations are metres to tens of metres away


class ViewField(NamedTuple):
    """Variance (mm^2) of the displacement along a normal, and the mixture of lengths that its correlation falls by."""

    variance: float
    lengths: Floats  # (e,) mm
    weights: Floats  # (e,), sum 1

    def correlation(self, distance: Floats) -> Floats:
        """Correlation of the fields of two balls at distances of any shape, mm."""
        total: Floats = np.sum(np.exp(-distance[..., None] / self.lengths) * self.weights, axis=-1)
        return total


class BallResiduals(NamedTuple):
    """Residuals of one ball: means over the cells of normals, and what a displacement of the cells leaves of them."""

    place: Floats  # (3,) mm
    cells: Ints  # (c,) rows of the cells
    means: Floats  # (c,) mm
    weights: Floats  # (c,) points in each
    left: Floats  # (c, c) residuals by a displacement of each cell's surface
    noise: float  # variance of a point, mm^2


def directions() -> Floats:
    """Middles (200, 3) of the cells of :func:`~processor.geometry.sphere.sphere_cells`."""
    z = np.repeat((np.arange(BANDS) + 0.5) * 2.0 / BANDS - 1.0, SECTORS)
    turn = np.tile(((np.arange(SECTORS) + 0.5) / SECTORS - 0.5) * 2.0 * np.pi, BANDS)
    level = np.sqrt(1.0 - z**2)
    return np.column_stack([level * np.cos(turn), level * np.sin(turn), z])


def correlation(cosine: Floats) -> Floats:
    """Correlation of the displacements at two normals, by the cosine (any shape) of their angle."""
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    product: Floats = np.cos(angle) * (np.sin(angle) + (np.pi - angle) * np.cos(angle)) / np.pi
    return product


@cache
def modes() -> Floats:
    """Factor (200, 16) of the correlation over the cells of normals, the smoothest modes first; not to be written."""
    normal = directions()
    values, vectors = np.linalg.eigh(correlation(normal @ normal.T))
    largest = np.argsort(-values, kind="stable")[:MODES]
    factor: Floats = vectors[:, largest] * np.sqrt(values[largest])
    factor.flags.writeable = False
    return factor


def estimate_field(balls: list[BallResiduals]) -> ViewField:
    """Estimate the field's variance and lengths, by the residuals of balls and the scanner's class."""
    # Equal probability for equal ratios, to the class's error of a view; beyond it less, as of a Cauchy distribution.
    prior = -np.log1p((SD_MM / VIEW_SD_MM) ** 2)
    log_probability = np.tile(prior, (len(LENGTHS_MM), 1))
    known = [(ball.place, score) for ball in balls if (score := _score(ball)) is not None]
    if known:
        y, H = np.concatenate([y for _, (y, _) in known]), np.concatenate([H for _, (_, H) in known])
        row = np.repeat(np.arange(len(known)), [len(y) for _, (y, _) in known])
        places = np.array([place for place, _ in known])
        distance = np.linalg.norm(places[:, None] - places[None], axis=2)[np.ix_(row, row)]
        product = H @ H.T
        for i, length in enumerate(LENGTHS_MM):
            values, vectors = np.linalg.eigh(product * np.exp(-distance / length))
            variances = 1.0 + SD_MM[:, None] ** 2 * np.maximum(values, 0.0)
            log_probability[i] -= 0.5 * np.sum(np.log(variances) + (vectors.T @ y) ** 2 / variances, axis=1)
    probability = np.exp(log_probability - log_probability.max())
    by_length = (probability / probability.sum()) @ SD_MM**2
    variance = float(by_length.sum())
    return ViewField(variance, LENGTHS_MM, by_length / variance)


def _score(ball: BallResiduals) -> tuple[Floats, Floats] | None:
    """Residuals in the modes that a state leaves, whitened (m,), and their derivatives (m, 16) by the field's modes."""
    factor = modes()[ball.cells]
    weighted = factor[:, TAKEN_UP:].T * ball.weights
    remaining = weighted @ ball.left
    noise = ball.noise * (remaining / ball.weights) @ remaining.T
    values, vectors = np.linalg.eigh(noise)
    good = values > LEAST_INFORMATION * values[-1]
    if not values[-1] > 0.0:
        return None
    whiten = (vectors[:, good] / np.sqrt(values[good])).T
    return whiten @ (weighted @ ball.means), whiten @ (remaining @ factor)
