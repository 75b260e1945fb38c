"""Uncertainty of spheres by errors that the points of one view share, where a merged cloud does not name its views.

They displace surfaces by a smooth field, whose size the residuals of all balls show. A shift of all views together,
and an offset of all their ranges, look like places and radii: they are stated by the scanner's class. If radii are off
their sizes on the mean, this may be an offset of ranges, which moves surfaces that are seen from below, or a wide beam,
which does not; both are taken to be equally likely.

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

A ball may also have errors of its own: it was fitted with a wrong size, or something touches it. Such balls are found
as those of a mixture, have their own variance, and do not show the field.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.distance import cdist

from processor.adjustment import scanner_class_errors
from processor.geometry.sphere import BANDS, SECTORS, sphere_cells
from processor.model import NORMAL_95, Floats, Ints
from processor.space_frame.members.records import Members
from processor.space_frame.points.sphere_crops import CropsWithRays
from processor.space_frame.spheres.records import OF_ALL, Fits, Priors, ViewErrors

LEAST_POINTS = 30  # of a fit whose residuals are looked at: seven an unknown
LEAST_CELLS = 8  # of it: twice the unknowns
LEAST_COSINE = 0.1  # of incidence: no view shows a surface at less
MOST_PAIRS = 20  # of neighbouring balls that the field is estimated from
KNOTS = 12  # places whose fields stand for those of all balls
BEAM = np.array([0.0, 0.0, 1.0, 1.0])  # what a wide beam does to the state of a ball that is seen from below
# Spherical harmonics up to degree 3 hold all but a hundredth of the field's variance. A sphere's state takes up those
# of degrees 0 and 1.
MODES, TAKEN_UP = 16, 4
# Combinations of modes that only few points at the edge of the visible surface determine are left out.
LEAST_INFORMATION = 0.02
SD_MM = np.geomspace(0.01, 5.0, 40)  # a smaller field is negligible, a larger one occurs in no registered cloud
ODD = 0.01  # chosen: share of balls with errors of their own; gross ones are found at five times more or less
LENGTHS_MM = np.array([1e3, 2e3, 4e3, 8e3, 16e3, 32e3, np.inf])  # stations are metres to tens of metres away


class _Fit(NamedTuple):
    """The fit of one sphere over the cells (c,) of normals that have points."""

    cells: Ints
    counts: Floats  # (c,) points
    means: Floats  # (c,) of residuals, mm
    noise: float  # variance of residuals within cells, mm^2
    J: Floats  # (c, 4) derivatives by centre and radius
    gain: Floats  # (4, c) change of the state by a displacement of each cell's surface


def view_errors(
    crops: CropsWithRays, weights: Floats, fits: Fits, priors: Priors, places: Floats, radius_offset: float = 0.0
) -> ViewErrors:
    """Estimate the errors of unnamed views from the fits of k spheres.

    Parameters
    ----------
    weights : (n,) of points, > 0 where they are used
    places : (k, 3) of the nodes, mm
    radius_offset : mean deviation of the radii from their sizes, mm
    """
    found, seen = {}, np.zeros(len(directions()))
    for k in np.flatnonzero(fits.fitted).tolist():
        fit = _fit_of(k, crops, weights, fits, priors)
        if fit is not None:
            found[k] = fit
            seen[fit.cells] += fit.counts
    rows = [k for k, fit in found.items() if len(fit.cells) >= LEAST_CELLS and fit.counts.sum() >= LEAST_POINTS]
    residuals = {k: _residuals(found[k], places[k]) for k in rows}
    own_variance = np.zeros(len(places))
    own_variance[rows] = odd_variances(list(residuals.values()))
    sampled = _neighbours([k for k in rows if not own_variance[k]], places)
    field = estimate_field([residuals[k] for k in sampled])
    cosines = _mean_cosines(seen)
    offset_sd, beam_sd = _offset_or_beam(list(found.values()), cosines, radius_offset, field.variance)
    shared, own = _of_spheres(found, field, cosines, places, offset_sd, beam_sd)
    for k in np.flatnonzero(own_variance).tolist():
        change = found[k].gain @ modes()[found[k].cells]
        own[k] += own_variance[k] * change @ change.T
    between = field.correlation(cdist(places[sampled], places[sampled])).mean() if sampled else 0.0
    return ViewErrors(
        covariance=own + shared @ np.swapaxes(shared, 1, 2),
        shared=shared,
        sd=float(np.sqrt(field.variance)),
        common_sd=float(np.sqrt(field.variance * between)),
        offset_sd=offset_sd,
        seen=seen,
    )


def of_tubes(views: ViewErrors, members: Members) -> Floats:
    """Covariances (m, 3, 3) of tubes by errors of views: of places along side and other, and of radii; mm^2."""
    count, sectors = members.around.shape
    turn = 2.0 * np.pi * (np.arange(sectors) + 0.5) / sectors
    across = np.column_stack([np.cos(turn), np.sin(turn)])
    J = np.column_stack([across, np.ones(sectors)])
    factor = correlation(across @ across.T)
    normals, cosines = directions(), _mean_cosines(views.seen)
    covariance = np.tile(
        np.diag([scanner_class_errors.SHIFT_SD_MM**2, scanner_class_errors.SHIFT_SD_MM**2, 0.0]), (count, 1, 1)
    )
    for m, points in enumerate(members.around):
        weighted = (J * points[:, None]).T
        gain = np.linalg.pinv(weighted @ J, rcond=1e-6, hermitian=True) @ weighted
        normal = across @ np.stack([members.side[m], members.other[m]])
        by_offset = views.offset_sd * gain @ cosines[np.argmax(normal @ normals.T, axis=1)]
        covariance[m] += views.sd**2 * gain @ factor @ gain.T + np.outer(by_offset, by_offset)
    return covariance


def _mean_cosines(seen: Floats) -> Floats:
    """Mean cosines of incidence (200,) over the cells of normals, by the points ``seen`` (200,) in them.

    The views are those directions whose densities, by the cosine of incidence, add up to the points best.
    """
    normals = directions()
    cosine = normals @ normals.T
    density = np.where(cosine > LEAST_COSINE, cosine, 0.0)
    if not seen.any():
        return np.full(len(seen), 2.0 / 3.0)  # of a sphere that is seen from all sides
    views, _ = nnls(density, seen / seen.max())
    points, total = density @ views, (density**2) @ views
    mean: Floats = np.where(points > 0.0, total / np.where(points > 0.0, points, 1.0), LEAST_COSINE)
    return mean


def _offset_or_beam(fits: list[_Fit], cosines: Floats, radius_offset: float, variance: float) -> tuple[float, float]:
    """Return standard deviations (mm) of an offset of ranges and of a change of radii by a wide beam.

    Half of the variance of the radii's offset is attributed to an offset of ranges, which is limited to its 95 % bound
    by the scanner's class and the variance of the mean of the views. The rest is attributed to the width of the beam.
    """
    change = float(np.mean([fit.gain[3] @ cosines[fit.cells] for fit in fits])) if fits else 0.0
    of_class = scanner_class_errors.known().offset_mm
    limit = NORMAL_95 * float(np.hypot(of_class, np.sqrt(variance)))
    offset = radius_offset / change if abs(radius_offset) < limit * abs(change) else limit
    explained = 0.5 * (offset * change) ** 2
    return float(np.hypot(of_class, np.sqrt(0.5) * offset)), float(np.sqrt(max(radius_offset**2 - explained, 0.0)))


# --- spheres ---------------------------------------------------------------------------------------------------------


def _fit_of(k: int, crops: CropsWithRays, weights: Floats, fits: Fits, priors: Priors) -> _Fit | None:
    """Means of residuals over cells and the gain of the fit of sphere ``k``; None where it is not determined."""
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
    noise = max(float(np.sum((residual - means[cell]) ** 2)) / free, 1e-6)
    normal = np.stack([np.bincount(cell, away[:, i] / distance) / counts for i in range(3)], axis=1)
    J = np.column_stack([normal, np.ones(len(cells))])
    by_points = (J * (counts / noise)[:, None]).T
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
    return _Fit(cells=cells.astype(np.int64), counts=counts, means=means, noise=noise, J=J, gain=gain)


def _residuals(fit: _Fit, place: Floats) -> BallResiduals:
    left = np.eye(len(fit.cells)) - fit.J @ fit.gain
    return BallResiduals(place, fit.cells, fit.means, weights=fit.counts, left=left, noise=fit.noise)


def _neighbours(rows: list[int], places: Floats) -> list[int]:
    """At most 40 of some rows of places (k, 3): evenly spaced ones, each with its nearest neighbour."""
    if len(rows) <= 2 * MOST_PAIRS:
        return rows
    every = np.array(rows)
    first = every[np.linspace(0, len(every) - 1, MOST_PAIRS).astype(int)]
    others = np.setdiff1d(every, first)
    distance = cdist(places[first], places[others])
    return [int(row) for row in np.union1d(first, others[distance.argmin(axis=1)])]


def _of_spheres(
    found: dict[int, _Fit],
    field: ViewField,
    cosines: Floats,
    places: Floats,
    offset_sd: float,
    beam_sd: float,
) -> tuple[Floats, Floats]:
    """Return changes (k, 4, q) of states by variates common to all, and the covariance (k, 4, 4) of each by itself."""
    factor, at_knots = modes(), _knots(field, places)
    count, knots = at_knots.shape
    shared, own = np.zeros((count, 4, OF_ALL + factor.shape[1] * knots)), np.zeros((count, 4, 4))
    shared[:, :3, :3] = scanner_class_errors.SHIFT_SD_MM * np.eye(3)
    own_share = np.maximum(1.0 - np.sum(at_knots**2, axis=1), 0.0)
    for k, fit in found.items():
        change = np.sqrt(field.variance) * fit.gain @ factor[fit.cells]
        shared[k, :, 3] = -offset_sd * fit.gain @ cosines[fit.cells]
        shared[k, :, 4] = beam_sd * BEAM
        shared[k, :, OF_ALL:] = (change[:, :, None] * at_knots[k]).reshape(4, -1)
        own[k] = own_share[k] * change @ change.T
    # A node that is known from its axes alone was seen by the same views.
    seen = sorted(found)
    typical = own[seen] + shared[seen, :, 3:] @ np.swapaxes(shared[seen, :, 3:], 1, 2)
    for k in np.setdiff1d(np.arange(count), seen).tolist():
        own[k, :3, :3] = typical[:, :3, :3].mean(axis=0) if seen else field.variance * np.eye(3)
    return shared, own


def _knots(field: ViewField, places: Floats) -> Floats:
    """Return changes (k, u) of the fields at places (k, 3) by independent variates: those of places far apart.

    What these do not explain of a field is independent of the others'.
    """
    rows = [0] if len(places) else []
    away = np.linalg.norm(places - places[:1], axis=1)
    while len(rows) < min(KNOTS, len(places)) and away.max() > 0.0:
        rows.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(places - places[rows[-1]], axis=1))
    if not rows:
        return np.zeros((len(places), 0))
    values, vectors = np.linalg.eigh(field.correlation(cdist(places[rows], places[rows])))
    good = values > 1e-9 * values[-1]
    root = vectors[:, good] / np.sqrt(values[good])
    changes: Floats = field.correlation(cdist(places, places[rows])) @ root
    return changes


# --- Gaussian field over the normals: covariance and size ------------------------------------------------------------


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
    log_probability = np.tile(_log_prior(), (len(LENGTHS_MM), 1))
    known = [(ball.place, score) for ball in balls if (score := _score(ball)) is not None]
    if known:
        y, H = np.concatenate([y for _, (y, _) in known]), np.concatenate([H for _, (_, H) in known])
        row = np.repeat(np.arange(len(known)), [len(y) for _, (y, _) in known])
        places = np.array([place for place, _ in known])
        distance = np.linalg.norm(places[:, None] - places[None], axis=2)[np.ix_(row, row)]
        product = H @ H.T
        for i, length in enumerate(LENGTHS_MM):
            log_probability[i] += _log_likelihood(y, product * np.exp(-distance / length))
    probability = np.exp(log_probability - log_probability.max())
    by_length = (probability / probability.sum()) @ SD_MM**2
    variance = float(by_length.sum())
    return ViewField(variance, LENGTHS_MM, by_length / variance)


def odd_variances(balls: list[BallResiduals]) -> Floats:
    """Variances (b,), mm^2, of the errors of each ball that has errors of its own; 0 of balls that show the field.

    The likelihood of each ball is that of the field's variance, the same for all, or the mean over all variances.
    """
    scores = [_score(ball) for ball in balls]
    each = np.array([
        np.zeros(len(SD_MM)) if score is None else _log_likelihood(score[0], score[1] @ score[1].T) for score in scores
    ]).reshape(-1, len(SD_MM))  # fmt: skip
    own = np.log(ODD / len(SD_MM)) + np.logaddexp.reduce(each, axis=1)
    alike = np.log1p(-ODD) + each
    best = int(np.argmax(_log_prior() + np.logaddexp(alike, own[:, None]).sum(axis=0)))
    probability = np.exp(each + _log_prior() - (each + _log_prior()).max(axis=1, keepdims=True))
    variances: Floats = (probability / probability.sum(axis=1, keepdims=True)) @ SD_MM**2
    return np.where((own > alike[:, best]) & (variances > SD_MM[best] ** 2), variances, 0.0)


def _log_prior() -> Floats:
    """Equal probability for equal ratios, to the class's error of a view; beyond less, as of a Cauchy distribution."""
    prior: Floats = -np.log1p((SD_MM / scanner_class_errors.known().view_mm) ** 2)
    return prior


def _log_likelihood(y: Floats, covariance: Floats) -> Floats:
    """Log likelihood by ``SD_MM`` of whitened residuals y (m,), which a field of unit variance gives a covariance."""
    values, vectors = np.linalg.eigh(covariance)
    variances = 1.0 + SD_MM[:, None] ** 2 * np.maximum(values, 0.0)
    log: Floats = -0.5 * np.sum(np.log(variances) + (vectors.T @ y) ** 2 / variances, axis=1)
    return log


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
