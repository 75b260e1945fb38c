"""The sphere that fills most of a crop: the points of one target, with what it stands on and touches.

Spheres through four points drawn from the crop are scored within bands about their surface, from narrow to wide; the
best of each band are fitted robustly. The first that passes every test of a sphere is taken: in a narrow band what
touches the sphere does not count. It is then fitted to more of the points, until these no longer agree with it. A
sphere that is a small share of the points is searched for as in a whole cloud, see
:mod:`processor.space_frame.spheres.sphere_detection`. Where nearly all points are within the narrowest band of the
sphere of least squares, that one comes before those drawn.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numba import njit

from processor.geometry.sphere import MINIMAL, Sphere, canonical_order, through_four, visible_fraction
from processor.geometry.sphere_evidence import (
    LEAST_VISIBLE,
    RADIUS_BAND,
    ROUGHEST,
    Grade,
    Limits,
    grade,
    inlier_share,
    rows_of_cells,
)
from processor.geometry.sphere_fit import WORST_CONDITION, RobustFit, robust_fit
from processor.model import Floats, Ints
from processor.robust_statistics import TUKEY, robust_sd
from processor.space_frame.spheres.sphere_detection import Ball

BANDS = (0.02, 0.04, 0.08)  # half-widths about the surface, in radii
SETS = (1000, 10_000)  # of four points, at first and where these give no certain sphere
CELLS, MOST_SCORED = 40, 300  # along the diagonal of a crop, of which one point each is scored; such points
SMALLEST, LARGEST = 0.15, 0.7  # radius of a sphere, in diagonals of the crop
EACH_BAND, MOST_LOOKED = 2, 300  # spheres tried, of those with the best scores
ALONE = 0.98  # least share of the points on the sphere of a crop that holds nothing else: rays at the limb are split
APART = 0.2  # of their centres, in radii
# No shape is as large as the noise: what a crop holds beside its sphere is little.
LIMITS = Limits(facing=0.94, likely_facing=0.9, thinned=False, white=0.7, shape=0.005, small=0.002)
MOST_FITTED = 20_000  # points that proposals are fitted to; the one taken is fitted to all
WIDER, LEAST_WIDER = 2.0, 1.05  # times the scale of a fit: allowed to the next one, and reached by it
CHI2_95 = {3: 7.815, 4: 9.488}  # 95 % of chi-square, by its degrees of freedom


@dataclass(frozen=True)
class Found:
    """The sphere of a crop, and whether it passes every test."""

    ball: Ball
    certain: bool


def find(points: Floats, least_points: int, radius_mm: float | None, scanner: Floats | None) -> Found | None:
    """Fit the sphere of a crop (n, 3), mm; None where nothing is like a sphere.

    ``radius_mm`` fixes the radius; ``scanner`` (n, 3) is the position each point was seen from. The result does not
    depend on the order of the points.
    """
    if len(points) < least_points:
        return None
    order = canonical_order(points)
    origin = points.mean(axis=0)
    crop = _Crop(points[order] - origin, None if scanner is None else scanner[order] - origin, radius_mm, least_points)
    few = crop.every(len(points) // MOST_FITTED + 1)
    rng = np.random.default_rng(0)  # fixed: the result must not depend on a seed
    likely = None
    drawn = (_starts(few.points, rng, sets, radius_mm) for sets in SETS)
    for start, scale in chain(_alone(few.points, radius_mm), chain.from_iterable(drawn)):
        fit = few.fit(start, scale)
        outcome = Grade.NONE if fit is None else few.grade(fit)
        if fit is not None and few is not crop and outcome is not Grade.NONE:
            fit = crop.fit(fit.sphere, fit.scale)
            outcome = Grade.NONE if fit is None else crop.grade(fit)
        if fit is None or outcome is Grade.NONE:
            continue
        if outcome is Grade.CERTAIN:
            fit, outcome = _widest(crop, fit)
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

    def every(self, step: int) -> _Crop:
        """Return the crop with every ``step``-th of its points."""
        if step == 1:
            return self
        scanner = None if self.scanner is None else self.scanner[::step]
        return replace(self, points=self.points[::step], scanner=scanner)

    def fit(self, start: Sphere, scale: float) -> RobustFit | None:
        """Fit a sphere to the points."""
        return robust_fit(self.points, start, scale, self.radius_mm, self.scanner)

    def grade(self, fit: RobustFit) -> Grade:
        """Return what the fit is by the tests of a sphere."""
        return grade(self.points, fit, self.least_points, self.radius_mm is not None, LIMITS)


def _widest(crop: _Crop, first: RobustFit) -> tuple[RobustFit, Grade]:
    """Fit a sphere again with more of the points, as long as that changes it by chance alone.

    The scale of a fit in a band narrower than the noise is that of the band, and its sphere scatters more than it must.
    Where other things touch the sphere a wider fit is moved by them: by more than chance allows. This is the test of
    Hausman (1978), but with the covariance of the narrower fit, which is above that of the difference. The covariance
    of the fit returned holds what it moved by. The grade is only likely if more points agree, but are too rough.
    """
    fit, outcome, free = first, Grade.CERTAIN, 4 if crop.radius_mm is None else 3
    while True:
        wider = crop.fit(fit.sphere, WIDER * fit.scale)
        if wider is None or wider.scale < LEAST_WIDER * fit.scale:
            break
        moved = fit.sphere.moved_to(wider.sphere)[:free]
        if moved @ np.linalg.pinv(fit.sphere.covariance[:free, :free]) @ moved > CHI2_95[free]:
            break
        if crop.grade(wider) is not Grade.CERTAIN:
            outcome = Grade.LIKELY if wider.scale > ROUGHEST * fit.sphere.radius else outcome
            break
        fit = wider
    moved = first.sphere.moved_to(fit.sphere)
    return replace(fit, sphere=fit.sphere.widened_by(moved, first.sphere.covariance)), outcome


def _in_place(crop: _Crop, fit: RobustFit, order: Ints, origin: Floats, *, certain: bool) -> Found:
    share = inlier_share(crop.points, fit)
    return Found(Ball(fit.in_place(len(order), order, origin), share), certain)


def _alone(crop: Floats, radius_mm: float | None) -> Iterator[tuple[Sphere, float]]:
    """Yield the sphere of least squares, with the scale of the narrowest band, if nearly all points are within it."""
    A = np.column_stack([2.0 * crop, np.ones(len(crop))])
    normal = A.T @ A
    if np.linalg.cond(normal) > WORST_CONDITION:
        return
    solution = np.linalg.solve(normal, A.T @ np.sum(crop**2, axis=1))
    radius = float(np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 0.0)))
    low, high = _radii(crop, radius_mm)
    off, scale = np.linalg.norm(crop - solution[:3], axis=1) - radius, 0.5 * BANDS[0] * radius
    if low <= radius <= high and robust_sd(off) < scale and np.mean(np.abs(off) < TUKEY * robust_sd(off)) >= ALONE:
        yield Sphere(solution[:3], radius, np.zeros((4, 4))), scale


def _radii(crop: Floats, radius_mm: float | None) -> tuple[float, float]:
    """Return the least and the greatest radius of what may be the sphere of a crop."""
    if radius_mm is not None:
        return (1.0 - RADIUS_BAND) * radius_mm, (1.0 + RADIUS_BAND) * radius_mm
    diagonal = float(np.linalg.norm(np.ptp(crop, axis=0)))
    return SMALLEST * diagonal, LARGEST * diagonal


def _starts(
    crop: Floats, rng: np.random.Generator, sets: int, radius_mm: float | None
) -> Iterator[tuple[Sphere, float]]:
    """Yield spheres of the best scores, each with the first scale of its residuals; the narrowest band comes first.

    Points are scored one per cell, so that places with many weigh no more than others.
    """
    diagonal = float(np.linalg.norm(np.ptp(crop, axis=0)))
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
    """Fill the sums of 1 - u^2 over points (n, 3), u their distances from each sphere's surface in half-widths."""
    for s in range(len(radii)):
        width = band * radii[s]
        nearest, farthest = (radii[s] - width) ** 2, (radii[s] + width) ** 2
        for i in range(len(points)):
            x, y, z = points[i, 0] - centres[s, 0], points[i, 1] - centres[s, 1], points[i, 2] - centres[s, 2]
            square = x * x + y * y + z * z
            if nearest < square < farthest:  # of few points alone the root is taken
                u = (np.sqrt(square) - radii[s]) / width
                scores[s] += max(1.0 - u * u, 0.0)
