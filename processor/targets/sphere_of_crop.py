"""The sphere that fills most of a crop: the points of one target, with what it stands on and touches.

Spheres through four points drawn from the crop are scored within bands about their surface, from narrow to wide; the
best of each band are fitted robustly; points inside a sphere count against it. The first that passes every test of a
sphere is taken: in a narrow band what touches the sphere does not count. It is then fitted to all of its points, but
for the directions in which something stands on it. One that passes the tests in the other directions alone is likely. A
sphere that is a small share of the points is searched for as in a whole cloud, see
:mod:`processor.space_frame.spheres.sphere_detection`. Where nearly all points are on the sphere of least squares,
that one comes before those drawn.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from processor import large_arrays
from processor.geometry.sphere import (
    MINIMAL,
    Sphere,
    algebraic,
    canonical_order,
    lengths,
    through_four,
    visible_fraction,
)
from processor.geometry.sphere_evidence import (
    ABOUT,
    BAND,
    LEAST_VISIBLE,
    RADIUS_BAND,
    ROUGHEST,
    Grade,
    Limits,
    grade,
    inlier_share,
    rows_of_cells,
)
from processor.geometry.sphere_fit import LEAST_SCALE, RobustFit, robust_fit
from processor.model import Floats, Ints
from processor.robust_statistics import TUKEY, robust_sd
from processor.space_frame.spheres.sphere_detection import Ball

BANDS = (0.02, 0.04, 0.08)  # half-widths about the surface, in radii
SETS = (1000, 10_000)  # of four points, at first and where these give no certain sphere
CELLS, MOST_SCORED = 40, 300  # along the diagonal of a crop, of which one point each is scored; such points
SMALLEST, LARGEST = 0.15, 0.7  # radius of a sphere, in diagonals of the crop
EACH_BAND, MOST_LOOKED = 2, 300  # spheres tried, of those with the best scores
ALONE = 0.98  # least share of the points on the sphere of a crop that holds nothing else: rays at the limb are split
# What stands on a sphere hides it up to some rad about its own directions: without 0.1, 0.15, 0.2, 0.3 rad about tubes,
# mean errors of the centres of 183 crops of balls were 0.34, 0.34, 0.36 and 0.45 mm, and 0.49 with all points. Fewer
# points than a share of those that the sphere has there are strays.
CLEAR, STRAY = 0.125, 0.5
BESIDE = 3.0  # sd: points farther outside stand on the sphere; one in 700 of its own does
REFITS = 2  # work: the second uses the directions by the first, whose sphere is moved by nothing
APART = 0.2  # of their centres, in radii
# No shape is as large as the noise: what a crop holds beside its sphere is little.
LIMITS = Limits(facing=0.94, likely_facing=0.9, thinned=False, white=0.7, shape=0.005, small=0.002)
CLEAR_LIMITS = LIMITS._replace(facing=0.9, likely_facing=None)  # what stood beside is left out: by all other tests
MOST_FITTED = 20_000  # points that proposals are fitted to; the one taken is fitted to all
WIDER = 2.0  # times the noise of points inside: the largest scale of a fit to them


def find(points: Floats, least_points: int, radius_mm: float | None, scanner: Floats | None) -> Ball | None:
    """Fit the sphere of a crop (n, 3), mm; None where nothing is like a sphere.

    ``radius_mm`` fixes the radius; ``scanner`` (n, 3) is the position each point was seen from. The result does not
    depend on the order of the points.
    """
    if len(points) < least_points:
        return None
    order = canonical_order(points)
    origin = points.mean(axis=0)
    crop = _Crop(points[order] - origin, None if scanner is None else scanner[order] - origin, radius_mm, least_points)
    few = crop.of(slice(None, None, len(points) // MOST_FITTED + 1))
    rng = np.random.default_rng(0)  # fixed: the result must not depend on a seed
    likely = None
    drawn = (_starts(few.points, rng, sets, radius_mm) for sets in SETS)
    for start, scale in chain(_alone(few.points, radius_mm), chain.from_iterable(drawn)):
        fit = few.fit(start, scale)
        outcome = Grade.NONE if fit is None else few.grade(fit)
        if fit is not None and len(few.points) < len(crop.points) and outcome is not Grade.NONE:
            fit = crop.fit(fit.sphere, fit.scale)
            outcome = Grade.NONE if fit is None else crop.grade(fit)
        if fit is None:
            continue
        if outcome is Grade.NONE:
            rows, noise = crop.clear(fit)
            fit, outcome = crop.fit_at(rows, fit, noise)
            if fit is None or outcome is Grade.NONE:
                continue
            outcome = Grade.LIKELY
        if outcome is Grade.CERTAIN:
            fit, outcome = _whole(crop, fit, at_noise=fit.scale < scale)
            return _in_place(crop, fit, order, origin, certain=outcome is Grade.CERTAIN)
        likely = likely or fit
    return None if likely is None else _in_place(crop, likely, order, origin, certain=False)


@dataclass(frozen=True)
class _Crop:
    """Points (n, 3) in canonical order, where each was seen from (n, 3), a radius that is held, and the fewest points.

    Without positions and without a known radius these are None.
    """

    points: Floats
    scanner: Floats | None
    radius_mm: float | None
    least_points: int

    def of(self, rows: Ints | slice) -> _Crop:
        """Return the crop with some of its points."""
        scanner = None if self.scanner is None else self.scanner[rows]
        return replace(self, points=self.points[rows], scanner=scanner)

    def clear(self, fit: RobustFit) -> tuple[Ints, float]:
        """Return the rows of the points in whose directions nothing stands on a ball, and the noise of its points.

        What touches a ball lies outside it: points inside show the noise, where the fit is one in a narrower band. A
        stray point hides no direction.
        """
        ball = fit.sphere
        off = ball.residuals(self.points)
        noise = robust_sd(off[(off < 0.0) & (off > -BAND * ball.radius)], fit.scale)
        about = off < ABOUT * ball.radius
        near, beyond, rows = np.abs(off) < BESIDE * noise, about & (off > BESIDE * noise), np.flatnonzero(about)
        visible = max(visible_fraction(self.points[near], ball.centre), 1e-9)
        fewest = max(1, round(STRAY * np.count_nonzero(near) * 0.25 * CLEAR**2 / visible))
        if np.count_nonzero(beyond) < fewest:
            return rows, noise
        away = self.points - ball.centre
        directions = away / lengths(away)[:, None]
        nearest = cKDTree(directions[beyond]).query(directions[rows], k=[fewest])[0][:, 0]
        return rows[nearest > CLEAR], noise

    def fit(self, start: Sphere, scale: float) -> RobustFit | None:
        """Fit a sphere to the points."""
        return robust_fit(self.points, start, scale, self.radius_mm, self.scanner)

    def grade(self, fit: RobustFit, limits: Limits = LIMITS) -> Grade:
        """Return what the fit is by the tests of a sphere."""
        return grade(self.points, fit, self.least_points, self.radius_mm is not None, limits)

    def fit_at(self, rows: Ints, start: RobustFit, noise: float) -> tuple[RobustFit | None, Grade]:
        """Fit a sphere to some of the points, at their noise; also its grade by these alone."""
        part = self.of(rows)
        fit = part.fit(start.sphere, WIDER * noise)
        if fit is None:
            return None, Grade.NONE
        return fit.in_place(len(self.points), rows, np.zeros(3)), part.grade(fit, CLEAR_LIMITS)


def _whole(crop: _Crop, first: RobustFit, *, at_noise: bool) -> tuple[RobustFit, Grade]:
    """Fit a sphere again to all points on it where nothing stands on it, at their noise.

    The scale of a fit in a band narrower than the noise is that of the band, and its sphere scatters more than it must.
    The covariance of the fit returned holds what it moved by beyond chance, by that of the narrower fit. The grade is
    only likely if the points are too rough. Where the first fit is ``at_noise`` and nothing is beside, it is the one.
    """
    fit = first
    for _ in range(REFITS):
        rows, noise = crop.clear(fit)
        if at_noise and fit is first and np.count_nonzero(fit.inliers[rows]) == np.count_nonzero(fit.inliers):
            return first, Grade.CERTAIN
        again, outcome = crop.fit_at(rows, fit, noise)
        if again is None or outcome is not Grade.CERTAIN:
            rough = again is not None and again.scale > ROUGHEST * fit.sphere.radius
            return first, Grade.LIKELY if rough else Grade.CERTAIN
        fit = again
    moved = first.sphere.moved_to(fit.sphere)
    return replace(fit, sphere=fit.sphere.widened_by(moved, first.sphere.covariance)), Grade.CERTAIN


def _in_place(crop: _Crop, fit: RobustFit, order: Ints, origin: Floats, *, certain: bool) -> Ball:
    on = np.abs(fit.sphere.residuals(crop.points)) < TUKEY * fit.scale
    share = inlier_share(crop.points, replace(fit, inliers=on))
    return Ball(fit.in_place(len(order), order, origin), share, certain)


def _alone(crop: Floats, radius_mm: float | None) -> Iterator[tuple[Sphere, float]]:
    """Yield the sphere of least squares, with twice their scale, if nearly all points are on it."""
    sphere = algebraic(crop)
    if sphere is None:
        return
    low, high = _radii(crop, radius_mm)
    off, radius = sphere.residuals(crop), sphere.radius
    sd = robust_sd(off)
    if low <= radius <= high and sd < 0.5 * BANDS[-1] * radius and np.mean(np.abs(off) < TUKEY * sd) >= ALONE:
        yield sphere, max(WIDER * sd, LEAST_SCALE * radius)


def _radii(crop: Floats, radius_mm: float | None) -> tuple[float, float]:
    """Return the least and the greatest radius of what may be the sphere of a crop."""
    if radius_mm is not None:
        return (1.0 - RADIUS_BAND) * radius_mm, (1.0 + RADIUS_BAND) * radius_mm
    diagonal = float(np.linalg.norm(large_arrays.span(crop)))
    return SMALLEST * diagonal, LARGEST * diagonal


def _starts(
    crop: Floats, rng: np.random.Generator, sets: int, radius_mm: float | None
) -> Iterator[tuple[Sphere, float]]:
    """Yield spheres of the best scores, each with the first scale of its residuals; the narrowest band comes first.

    Points are scored one per cell, so that places with many weigh no more than others.
    """
    diagonal = float(np.linalg.norm(large_arrays.span(crop)))
    scored = crop[rows_of_cells(crop, diagonal / CELLS)]
    scored = np.ascontiguousarray(scored[:: len(scored) // MOST_SCORED + 1])
    if len(scored) < MINIMAL:
        return
    draws = rng.random((sets, MINIMAL))
    centres, radii = through_four(scored[(draws * len(scored)).astype(np.int64)])
    low, high = _radii(crop, radius_mm)
    likely = (radii >= low) & (radii <= high)
    centres, radii = centres[likely], radii[likely]
    for band in BANDS:
        scores = np.zeros(len(radii))
        _score(scored, centres, radii, band, scores)
        looked: list[int] = []
        tried = 0
        for row in np.argsort(-scores, kind="stable")[:MOST_LOOKED].tolist():
            if any(np.linalg.norm(centres[row] - centres[other]) < APART * radii[row] for other in looked):
                continue
            looked.append(row)
            near = np.abs(np.linalg.norm(scored - centres[row], axis=1) - radii[row]) < band * radii[row]
            if visible_fraction(scored[near], centres[row]) < LEAST_VISIBLE:
                continue
            yield Sphere(centres[row], float(radii[row]), np.zeros((4, 4))), 0.5 * band * float(radii[row])
            tried += 1
            if tried == EACH_BAND:
                break


@njit(cache=True, nogil=True, error_model="numpy")
def _score(points, centres, radii, band, scores):  # type: ignore[no-untyped-def]
    """Fill the sums of 1 - u^2 over points (n, 3), u their distances from each sphere's surface in half-widths.

    A sphere holds no points, other bodies that it cuts do: each farther inside counts -1.
    """
    for s in range(len(radii)):
        width = band * radii[s]
        nearest, farthest = (radii[s] - width) ** 2, (radii[s] + width) ** 2
        for i in range(len(points)):
            x, y, z = points[i, 0] - centres[s, 0], points[i, 1] - centres[s, 1], points[i, 2] - centres[s, 2]
            square = x * x + y * y + z * z
            if square <= nearest:
                scores[s] -= 1.0
            elif square < farthest:  # of few points alone the root is taken
                u = (np.sqrt(square) - radii[s]) / width
                scores[s] += max(1.0 - u * u, 0.0)
