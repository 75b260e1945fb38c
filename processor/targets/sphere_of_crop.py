"""The sphere that fills most of a crop: the points of one target, with what it stands on and touches.

Spheres through four points drawn from the crop are scored within bands about their surface, from narrow to wide; the
best of each band are fitted robustly. The first that passes every test of a sphere is taken: in a narrow band what
touches the sphere does not count. It is then fitted to more of the points, until these no longer agree with it. A
sphere that is a small share of the points is searched for as in a whole cloud, see
:mod:`processor.space_frame.spheres.sphere_detection`.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from itertools import chain

import numpy as np
from numba import njit

from processor.geometry import sphere_evidence
from processor.geometry.sphere import MINIMAL, Sphere, canonical_order, through_four, visible_fraction
from processor.geometry.sphere_evidence import EVIDENCE_CELLS, thinned
from processor.geometry.sphere_robust_fit import RobustFit, robust_fit
from processor.model import Floats, Ints

BANDS = (0.02, 0.04, 0.08)  # half-widths about the surface, in radii
SETS = (1000, 10_000)  # of four points, at first and where these give no certain sphere
CELLS, MOST_SCORED = 40, 300  # along the diagonal of a crop, of which one point each is scored; such points
SMALLEST, LARGEST = 0.15, 0.7  # radius of a sphere, in diagonals of the crop
EACH_BAND, MOST_LOOKED = 2, 300  # spheres tried, of those with the best scores
APART = 0.2  # of their centres, in radii
RADIUS_BAND = 0.15  # of a known radius, about it
LEAST_VISIBLE = 0.08  # share of the sphere
LARGEST_SD = 0.05  # of the radius or, where it is fixed, of the centre, in radii
LIKELY_FACING, LEAST_FACING = 0.9, 0.94  # median cosine between the crop's own normals and the sphere's
AROUND = 0.4  # of the radius: points up to there outside are about it
ROUGHEST = 0.05  # noise over radius, above which other round bodies cannot be told from a sphere
WHITE, SMALL = 0.7, 0.002  # of residuals: no shape is as large as their noise; in radii, rounder than targets are
WIDER, LEAST_WIDER = 2.0, 1.05  # times the scale of a fit: allowed to the next one, and reached by it
CHI2_95 = {3: 7.815, 4: 9.488}  # 95 % of chi-square, by its degrees of freedom
STANDS_OUT = 3.5  # times as dense at the surface as beside it


class Grade(Enum):
    """What the tests of a sphere state of a fit."""

    NONE = 0
    LIKELY = 1
    CERTAIN = 2


@dataclass(frozen=True)
class Found:
    """A fit to a crop (n, 3), the share of the points about it that lie on it, and whether it passes every test."""

    fit: RobustFit
    inlier_share: float
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
    crop = points[order] - origin
    seen_from = None if scanner is None else scanner[order] - origin
    likely = None
    for start, scale in chain.from_iterable(_starts(crop, sets, radius_mm) for sets in SETS):
        fit = robust_fit(crop, start, scale, radius_mm, seen_from)
        grade = Grade.NONE if fit is None else _assessed(crop, fit, least_points)
        if fit is None or grade is Grade.NONE:
            continue
        if grade is Grade.CERTAIN:
            fit, grade = _widest(crop, fit, least_points, radius_mm, seen_from)
            return _in_place(crop, fit, order, origin, certain=grade is Grade.CERTAIN)
        likely = likely or fit
    return None if likely is None else _in_place(crop, likely, order, origin, certain=False)


def _widest(
    crop: Floats, fit: RobustFit, least_points: int, radius_mm: float | None, seen_from: Floats | None
) -> tuple[RobustFit, Grade]:
    """Fit a sphere again with more of the points, as long as that changes it by chance alone.

    The scale of a fit in a band narrower than the noise is that of the band, and its sphere scatters more than it must.
    Where other things touch the sphere a wider fit is moved by them: by more than chance allows (Hausman 1978). The
    grade is only likely if more points agree, but are too rough.
    """
    free = 4 if radius_mm is None else 3
    while True:
        wider = robust_fit(crop, fit.sphere, WIDER * fit.scale, radius_mm, seen_from)
        if wider is None or wider.scale < LEAST_WIDER * fit.scale:
            return fit, Grade.CERTAIN
        moved = np.append(wider.sphere.centre - fit.sphere.centre, wider.sphere.radius - fit.sphere.radius)[:free]
        if moved @ np.linalg.solve(fit.sphere.covariance[:free, :free], moved) > CHI2_95[free]:
            return fit, Grade.CERTAIN
        if _assessed(crop, wider, least_points) is not Grade.CERTAIN:
            return fit, Grade.LIKELY if wider.scale > ROUGHEST * fit.sphere.radius else Grade.CERTAIN
        fit = wider


def _in_place(crop: Floats, fit: RobustFit, order: Ints, origin: Floats, *, certain: bool) -> Found:
    around = np.count_nonzero(fit.sphere.residuals(crop) <= AROUND * fit.sphere.radius)
    share = min(1.0, float(fit.inliers.sum() / max(around, 1)))
    return Found(fit.in_place(len(order), order, origin), share, certain)


def _starts(crop: Floats, sets: int, radius_mm: float | None) -> Iterator[tuple[Sphere, float]]:
    """Yield spheres of the best scores, each with the first scale of its residuals, those of the narrowest band first.

    Points are scored one per cell, so that places with many weigh no more than others.
    """
    diagonal = float(np.linalg.norm(np.ptp(crop, axis=0)))
    scored = crop[thinned(crop, diagonal / CELLS)]
    scored = np.ascontiguousarray(scored[:: len(scored) // MOST_SCORED + 1])
    if len(scored) < MINIMAL:
        return
    draws = np.random.default_rng(0).random((sets, MINIMAL))  # fixed: the result must not depend on a seed
    centres, radii = through_four(scored[(draws * len(scored)).astype(np.int64)])
    low, high = (SMALLEST * diagonal, LARGEST * diagonal)
    if radius_mm is not None:
        low, high = (1.0 - RADIUS_BAND) * radius_mm, (1.0 + RADIUS_BAND) * radius_mm
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
        for i in range(len(points)):
            x, y, z = points[i, 0] - centres[s, 0], points[i, 1] - centres[s, 1], points[i, 2] - centres[s, 2]
            u = (np.sqrt(x * x + y * y + z * z) - radii[s]) / width
            scores[s] += max(1.0 - u * u, 0.0)


def _assessed(crop: Floats, fit: RobustFit, least_points: int) -> Grade:
    """Whether a fit is determined and the crop's own normals are about those of the sphere, and passes all tests.

    These are that it stands out of the crop, that its residuals are noise, and closer normals.
    """
    ball, on = fit.sphere, crop[fit.inliers]
    if not fit.converged or len(on) < least_points or visible_fraction(on, ball.centre) < LEAST_VISIBLE:
        return Grade.NONE
    if not np.sqrt(np.diag(ball.covariance).max()) <= LARGEST_SD * ball.radius:
        return Grade.NONE
    rows = thinned(crop, ball.radius / EVIDENCE_CELLS)
    facing = sphere_evidence.facing(crop[rows], fit.inliers[rows], ball)
    if facing < LIKELY_FACING or not sphere_evidence.redundant(on, fit):
        return Grade.NONE
    residual = fit.residuals[fit.inliers]
    certain = (
        facing >= LEAST_FACING
        and fit.scale <= ROUGHEST * ball.radius
        and sphere_evidence.denser(crop, ball, STANDS_OUT, fit.scale)
        and sphere_evidence.misfit(on, residual, ball, fit.scale) <= sphere_evidence.largest_misfit(fit)
        and sphere_evidence.is_noise(on, residual, ball, WHITE, SMALL)
    )
    return Grade.CERTAIN if certain else Grade.LIKELY
