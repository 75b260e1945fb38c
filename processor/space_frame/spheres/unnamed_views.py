"""Errors that the points of one view have in common, where a merged cloud does not name its views.

A view sees normals within a right angle of its direction. Its range offset and the errors of its registration displace
all of them alike, so that the displacement of a merged surface along its normal is a smooth field over the normals. The
field is modelled as a Gaussian process with a correlation of exp(cos angle - 1). Its variance is estimated by moments
from what the fits of all spheres leave (Henderson 1953, "Estimation of variance and covariance components", Biometrics
9, 226-252): means of residuals over cells of the normals against the scatter within them. The products of different
spheres give the part that is common to all of them.

A shift of all views together, and an offset of all their ranges, look like places and radii: they are not estimated but
stated, by the scanner's class.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from processor.adjustment.scanner_class import OFFSET_MM, SHIFT_MM
from processor.geometry.sphere import BANDS, SECTORS, sphere_cells
from processor.model import Floats, Ints
from processor.space_frame.spheres.records import CropsWithRays, Fits, Priors, ViewErrors

MEAN_COSINE = 2.0 / 3.0  # of incidence on a sphere: a range moves the surface by less along its normal
LEAST_POINTS = 30
LEAST_CELLS = 8
ACROSS = 0.3  # largest cosine between an axis and the normals of its tube: cells are as wide
MOST_SPHERES = 400  # that the variances are estimated from


class _Fit(NamedTuple):
    """The fit of one sphere over the cells (c,) of normals that have points."""

    cells: Ints
    counts: Floats  # (c,) points
    means: Floats  # (c,) of residuals, mm
    scatter: Floats  # (c,) variance of residuals within cells, mm^2
    J: Floats  # (c, 4) derivatives by centre and radius
    covariance: Floats  # (4, 4) by noise and priors
    gain: Floats  # (4, c) change of the state by a displacement of each cell's surface


def view_errors(crops: CropsWithRays, weights: Floats, fits: Fits, priors: Priors) -> ViewErrors:
    """Estimate the errors of unnamed views from the fits of k spheres; ``weights`` (n,) > 0 mark the points used."""
    directions = _directions()
    correlation = np.exp(directions @ directions.T - 1.0)
    found, seen = {}, np.zeros(len(directions))
    for k in np.flatnonzero(fits.fitted).tolist():
        fit = _fit_of(k, crops, weights, fits, priors)
        if fit is not None:
            found[k] = fit
            seen[fit.cells] += fit.counts
    rows = [k for k, fit in found.items() if len(fit.cells) >= LEAST_CELLS and fit.counts.sum() >= LEAST_POINTS]
    sampled = (
        [found[rows[i]] for i in np.unique(np.linspace(0, len(rows) - 1, MOST_SPHERES).astype(int))] if rows else []
    )
    variance, shared = _variances(sampled, correlation)
    whole, common = np.zeros((len(fits.states), 4, 4)), np.zeros((len(fits.states), 4, 4))
    for k, fit in found.items():
        by_field = fit.gain @ correlation[np.ix_(fit.cells, fit.cells)] @ fit.gain.T
        by_offset = MEAN_COSINE * OFFSET_MM * fit.gain.sum(axis=1)
        by_class = np.diag([SHIFT_MM**2] * 3 + [0.0]) + np.outer(by_offset, by_offset)
        whole[k] = variance * by_field + by_class
        common[k] = shared * by_field + by_class
    return ViewErrors(whole, common, float(np.sqrt(variance)), float(np.sqrt(shared)), seen)


def of_tubes(views: ViewErrors, axes: Floats, side: Floats) -> Floats:
    """Covariances (m, 3, 3) of tubes by errors of views: of places along ``side`` and axis x side, and of radii; mm^2.

    ``axes`` and ``side`` (m, 3) are unit vectors. Tubes are seen from where the spheres are: their points have the
    normals of the spheres' points that are across the axis.
    """
    directions = _directions()
    covariance = np.zeros((len(axes), 3, 3))
    for m, (axis, first) in enumerate(zip(axes, side, strict=True)):
        on = (np.abs(directions @ axis) < ACROSS) & (views.seen > 0.0)
        normal = directions[on] - np.outer(directions[on] @ axis, axis)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        J = np.column_stack([normal @ first, normal @ np.cross(axis, first), np.ones(len(normal))])
        weighted = (J * views.seen[on][:, None]).T
        gain = np.linalg.pinv(weighted @ J, rcond=1e-6) @ weighted
        by_offset = MEAN_COSINE * OFFSET_MM * gain.sum(axis=1)
        covariance[m] = views.sd**2 * gain @ np.exp(normal @ normal.T - 1.0) @ gain.T
        covariance[m] += np.diag([SHIFT_MM**2, SHIFT_MM**2, 0.0]) + np.outer(by_offset, by_offset)
    return covariance


def _directions() -> Floats:
    """Middles (200, 3) of the cells of :func:`~processor.geometry.sphere.sphere_cells`."""
    z = np.repeat((np.arange(BANDS) + 0.5) * 2.0 / BANDS - 1.0, SECTORS)
    turn = np.tile(((np.arange(SECTORS) + 0.5) / SECTORS - 0.5) * 2.0 * np.pi, BANDS)
    level = np.sqrt(1.0 - z**2)
    return np.column_stack([level * np.cos(turn), level * np.sin(turn), z])


def _fit_of(k: int, crops: CropsWithRays, weights: Floats, fits: Fits, priors: Priors) -> _Fit | None:
    rows = slice(crops.start[k], crops.start[k + 1])
    on = weights[rows] > 0.0
    if not on.any():
        return None
    points, state = crops.points[rows][on], fits.states[k]
    away = points - state[:3]
    distance = np.linalg.norm(away, axis=1)
    cells, cell = np.unique(sphere_cells(points, state[:3]), return_inverse=True)
    counts = np.bincount(cell).astype(np.float64)
    residual = distance - state[3]
    means = np.bincount(cell, residual) / counts
    free = max(len(points) - len(cells), 1)
    within = max(float(np.sum((residual - means[cell]) ** 2)) / free, 1e-6)
    apart = np.bincount(cell, (residual - means[cell]) ** 2)
    # Noise differs by incidence: each cell has its own, except where one point shows none.
    scatter = np.where(counts > 1, apart / np.maximum(counts - 1.0, 1.0), within)
    normal = np.stack([np.bincount(cell, away[:, i] / distance) / counts for i in range(3)], axis=1)
    J = np.column_stack([normal, np.ones(len(cells))])
    by_points = (J * (counts / within)[:, None]).T
    prior = np.zeros((4, 4))
    prior[:3, :3] = priors.centre_weight[k]
    prior[3, 3] = priors.size_weights[k]
    H = by_points @ J + prior
    if np.linalg.cond(H) > 1e12:
        return None
    covariance = np.linalg.inv(H)
    # A bias was taken off the state: one step back to where the residuals are least.
    size = priors.sizes[k] if priors.size_weights[k] > 0.0 else state[3]
    means = means - J @ covariance @ (by_points @ means - prior @ (state - np.array([0.0, 0.0, 0.0, size])))
    # The axes that the centre's prior comes from were seen by the same views: they move as a sphere of this size does.
    held = by_points[:3] @ J[:, :3]
    moved = np.linalg.pinv(held, rcond=1e-3) @ by_points[:3]
    gain = covariance @ (by_points + prior @ np.vstack([moved, np.zeros(len(cells))]))
    return _Fit(cells, counts, means, scatter, J, covariance, gain)


def _variances(fits: list[_Fit], correlation: Floats) -> tuple[float, float]:
    """Variance of the field and its part common to all spheres, mm^2, by moments."""
    count = len(correlation)
    squares, expected = 0.0, 0.0
    total, own = np.zeros(count), 0.0
    spread, own_spread = np.zeros((count, count)), 0.0
    for fit in fits:
        weight = fit.counts  # not over the sphere's own noise: a ratio of estimates is biased
        left = np.eye(len(fit.cells)) - fit.J @ fit.gain
        K = correlation[np.ix_(fit.cells, fit.cells)]
        absorbed = float(np.einsum("c,ci,ij,cj->", weight, fit.J, fit.covariance, fit.J))
        noise = float(np.sum(fit.scatter)) - absorbed
        squares += float(weight @ fit.means**2) - noise
        expected += float(np.einsum("c,ci,ij,cj->", weight, left, K, left, optimize=True))
        S = np.zeros((count, count))
        S[np.ix_(fit.cells, fit.cells)] = weight[:, None] * left
        score = np.zeros(count)
        score[fit.cells] = weight * fit.means
        total, own = total + score, own + float(score @ score)
        spread, own_spread = spread + S, own_spread + float(np.sum((S @ correlation) * S))
    if not expected > 0.0:
        return 0.0, 0.0
    between = float(np.sum((spread @ correlation) * spread)) - own_spread
    shared = (float(total @ total) - own) / between if len(fits) > 1 and between > 0.0 else 0.0
    return max(squares / expected, shared, 0.0), max(shared, 0.0)
