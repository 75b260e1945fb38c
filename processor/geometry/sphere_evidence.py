"""Whether points on a fitted sphere are those of a ball: density, normals, systematic residuals, redundancy."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from processor import large_arrays
from processor.geometry import coincident_points
from processor.geometry.linalg_small import eigen
from processor.geometry.selection import least_first
from processor.geometry.sphere import Sphere, canonical_order, lengths, sphere_cells, visible_fraction
from processor.geometry.sphere_fit import LEAST_SCALE, RobustFit
from processor.model import Bools, Floats, Ints
from processor.robust_statistics import robust_sd

BAND = 0.1  # half-width of a proposal's surface, in radii
NEIGHBOURHOODS = (0.1, 0.2, 0.4)  # of the ball's points, the least that is no line
MOST_NORMALS = 60  # points of a ball that have normals: each neighbourhood is a tenth of the ball or more
OF_A_LINE = 0.05  # ratio of the variances along and across the neighbourhood of a line
QUADRIC_TERMS, LEAST_F = 9, 4.0  # of the shape of an ellipsoid; chance exceeds 4 less than once in 10,000
RIDGE = 1e-14  # of the trace: terms that a flat cap does not determine explain nothing
MOST_NEAREST = 500  # points whose nearest neighbours are compared: the ratio of white noise is known to 0.04
EXPLAINED = 0.3  # share of the residuals' squares that an ellipsoid may explain
LARGEST_HALF_SD = 0.15  # of the radius or, where it is fixed, of the centre, in radii, by half of the points
MISFIT = 0.5  # of the scale: cell means of residuals on a ball are noise alone
ROUND = 0.02  # of the radius: nothing but a ball departs from a sphere by less
ROUGHEST = 0.05  # noise over radius, above which a ball is not distinguishable from a cluster of points
LEAST_VISIBLE = 0.08  # share of the sphere
LARGEST_SD = 0.05  # of the radius or, where it is fixed, of the centre, in radii
FLATTEST = 2.2  # rms of residuals of what is likely a sphere, in scales; 2.7 where a volume fills the window evenly
STANDS_OUT = 3.5  # times as dense at the surface as beside it; a tube reaches 2.4
ABOUT = 0.4  # of the radius: points up to there outside are about a ball
RADIUS_BAND = 0.15  # proposals within this share of a fixed radius
EVIDENCE_CELLS = 12.0  # of a cloud thinned to one point a cell, in a ball's radius


class Grade(Enum):
    """What the tests of a sphere state of a fit."""

    NONE = 0
    LIKELY = 1
    CERTAIN = 2


class Limits(NamedTuple):
    """Limits of the tests of a sphere.

    ``facing`` is the least median cosine between the cloud's own normals and the ball's, ``likely_facing`` that of what
    is likely a sphere, None where this is no answer. Density is that of a ``thinned`` cloud, or of all its points.
    ``white`` is the least sd by the differences of neighbours, over that of all residuals: 0.7 where a shape is as
    large as the noise. ``shape`` is the largest rms of an ellipsoid's part of the residuals, in radii. Residuals below
    ``small``, in radii, are accepted even if they are systematic.
    """

    facing: float
    likely_facing: float | None
    thinned: bool
    white: float
    shape: float
    small: float


def rows_of_cells(points: Floats, cell: float) -> Ints:
    """Rows of the first point in every cell of a grid of this edge."""
    lower, upper = large_arrays.corners(points)
    size = max(cell, float((upper - lower).max()) / (1 << 20))  # 21 bits per axis
    i, j, k = np.floor((points - lower) / size).astype(np.int64).T
    return np.sort(np.unique(i << 42 | j << 21 | k, return_index=True)[1])


def grade(points: Floats, fit: RobustFit, least_points: int, radius_held: bool, limits: Limits) -> Grade:
    """Return what a fit to points (n, 3) is: NONE, LIKELY (determined, about the cloud's own normals, no volume).

    CERTAIN passes every test: converged, enough of it visible, smooth, round, and far denser than its surroundings.
    """
    ball, on, residual = fit.sphere, points[fit.inliers], fit.residuals[fit.inliers]
    if not determined(points, fit, least_points) or not redundant(on, fit, radius_held):
        return Grade.NONE
    most_misfit = max(MISFIT * fit.scale, ROUND * ball.radius)  # systematic part of the residuals, mm
    smooth = fit.scale <= ROUGHEST * ball.radius and misfit(on, residual, ball, fit.scale) <= most_misfit
    if not smooth and limits.likely_facing is None:
        return Grade.NONE
    rows = rows_of_cells(points, ball.radius / EVIDENCE_CELLS)
    cosine = facing(points[rows], fit.inliers[rows], ball)
    cloud = points[rows] if limits.thinned else points
    stands_out = smooth and cosine >= limits.facing and denser(cloud, ball, STANDS_OUT, fit.scale)
    if stands_out and is_noise(on, residual, ball, limits):
        return Grade.CERTAIN
    if limits.likely_facing is None or not cosine >= limits.likely_facing:
        return Grade.NONE
    return Grade.LIKELY if np.sqrt(np.mean(residual**2)) <= FLATTEST * fit.scale else Grade.NONE


def determined(points: Floats, fit: RobustFit, least_points: int) -> bool:
    """Whether a fit to points (n, 3) converged, with enough of them, of the sphere and of certainty."""
    ball = fit.sphere
    if not fit.converged or np.count_nonzero(fit.inliers) < least_points:
        return False
    if visible_fraction(points[fit.inliers], ball.centre) < LEAST_VISIBLE:
        return False
    return bool(np.sqrt(np.diag(ball.covariance).max()) <= LARGEST_SD * ball.radius)


def inlier_share(points: Floats, fit: RobustFit) -> float:
    """Share of the points (n, 3) about a sphere that lie on it."""
    around = np.count_nonzero(fit.sphere.residuals(points) <= ABOUT * fit.sphere.radius)
    return min(1.0, float(fit.inliers.sum() / max(around, 1)))


def denser(points: Floats, ball: Sphere, times: float, scale: float | None = None) -> bool:
    """Whether a shell at the surface has some times the points of those of equal width outside and inside it."""
    off = ball.residuals(points)
    if scale is None:
        close = np.abs(off[np.abs(off) < BAND * ball.radius])
        scale = max(robust_sd(close), LEAST_SCALE * ball.radius)
    width = 3.0 * scale
    at = np.count_nonzero(np.abs(off) <= width)
    outside = np.count_nonzero((off > width) & (off <= 3.0 * width))
    inside = np.count_nonzero((off < -width) & (off >= -3.0 * width))
    return bool(at >= max(times * max(outside, inside), 1))


def redundant(points: Floats, fit: RobustFit, radius_held: bool) -> bool:
    """Whether either half of the points (n, 3) determines the sphere, whichever way they are parted.

    Two lines of a scanner on any round body lie on a sphere: one line predicts nothing about the other.
    """
    ball = fit.sphere
    radial = _radial(points, ball)
    J = np.column_stack([radial, np.ones(len(radial))])[:, : 3 if radius_held else 4]
    least = (fit.scale / (LARGEST_HALF_SD * ball.radius)) ** 2
    off = radial - radial.mean(axis=0)
    for axis in np.linalg.eigh(off.T @ off)[1].T:
        along = radial @ axis
        middle = float(np.median(along))
        for half in (J[along <= middle], J[along >= middle]):
            if np.linalg.eigvalsh(half.T @ half)[0] < least:
                return False
    return True


def is_noise(points: Floats, residual: Floats, ball: Sphere, limits: Limits) -> bool:
    """Whether residuals (n,) of points (n, 3) are noise and not the shape of another body, or are small.

    Those of neighbours differ (von Neumann 1941), and an ellipsoid explains little of them.
    """
    sd = float(np.sqrt(np.mean(residual**2)))
    if sd <= limits.small * ball.radius:
        return True
    # Of equal points the nearest is no neighbour.
    order = canonical_order(points)
    rows = order[np.append(True, (points[order[1:]] != points[order[:-1]]).any(axis=1))]  # of equal points the first
    radial, off = _radial(points[rows], ball), residual[rows]
    some = np.arange(0, len(rows), max(1, len(rows) // MOST_NEAREST))
    if (
        np.sqrt(
            np.mean((off[some] - off[cKDTree(radial, **coincident_points.FEW).query(radial[some], k=2)[1][:, 1]]) ** 2)
            / 2.0
        )
        < limits.white * sd
    ):
        return False
    # The part of the sum of squares of residuals (n,) that the shape of an ellipsoid explains
    x, y, z = _radial(points, ball).T
    A = np.column_stack([np.ones_like(x), x, y, z, x * x, y * y, x * y, y * z, z * x])
    normal = A.T @ A
    left = residual - A @ np.linalg.solve(normal + RIDGE * np.trace(normal) * np.eye(QUADRIC_TERMS), A.T @ residual)
    explained, of_all = float(np.sum(residual**2) - np.sum(left**2)), float(np.sum(residual**2))
    if explained > EXPLAINED * of_all:
        return False
    noise = max(of_all - explained, 0.0) / max(len(residual) - QUADRIC_TERMS, 1)
    by_chance = explained <= LEAST_F * QUADRIC_TERMS * noise
    return by_chance or explained - QUADRIC_TERMS * noise <= len(residual) * (limits.shape * ball.radius) ** 2


def _radial(points: Floats, ball: Sphere) -> Floats:
    """Return the unit vectors (n, 3) from a sphere's centre to points (n, 3)."""
    out = points - ball.centre
    radial: Floats = out / lengths(out)[:, None]
    return radial


def facing(points: Floats, on: Bools, ball: Sphere) -> float:
    """Median cosine between the normals of neighbourhoods of points (n, 3), on the ball or not, and its radii.

    Tubes, edges and volumes that only cross the surface have other normals. A neighbourhood is about a tenth of the
    ball's points, so that it is wide compared with the noise at any density. Where the ball was scanned in few lines
    one line has as many, which has no normal: neighbourhoods are then wider.
    """
    count = int(np.count_nonzero(on))
    query = np.ascontiguousarray(points[on][:: max(1, count // MOST_NORMALS)])
    if not len(query):
        return 0.0
    sizes = np.minimum(np.maximum((np.array(NEIGHBOURHOODS) * count).astype(np.int64), 8), len(points))
    cosine = np.zeros(len(query))
    _cosines(np.ascontiguousarray(points.T), query, sizes, np.ascontiguousarray(ball.centre), cosine)
    return float(np.median(cosine))


@njit(cache=True, nogil=True, error_model="numpy")
def _cosines(points, places, sizes, centre, cosine):  # type: ignore[no-untyped-def]
    """Fill the cosines at places (m, 3) between the radius and the normal of the points (3, n) about them.

    A normal is the direction of least variance of the nearest points, of the first of ``sizes`` that is not a line.
    """
    x, y, z, n = points[0], points[1], points[2], points.shape[1]
    squares, near, found = np.empty(n), np.empty(n), np.empty(n, np.int64)
    C, V, mean, off, order = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3, np.int64)
    reach = np.inf  # of the search: the next place has its neighbours about as far away
    for q in range(len(places)):
        px, py, pz = places[q, 0], places[q, 1], places[q, 2]
        for i in range(n):
            squares[i] = (x[i] - px) ** 2 + (y[i] - py) ** 2 + (z[i] - pz) ** 2
        for k in sizes:
            count = 0
            for i in range(n):
                found[count], near[count] = i, squares[i]
                count += squares[i] <= reach
            if count < k:
                for i in range(n):
                    found[i], near[i] = i, squares[i]
                count = n
            least_first(near, count, k - 1)
            limit, used = near[k - 1], 0
            reach = 2.0 * limit
            mean[:] = 0.0
            C[:] = 0.0
            for m in range(count):
                i = found[m]
                if squares[i] <= limit:
                    off[0], off[1], off[2] = x[i] - px, y[i] - py, z[i] - pz
                    used += 1
                    for a in range(3):
                        mean[a] += off[a]
                        for b in range(a + 1):
                            C[a, b] += off[a] * off[b]
            for a in range(3):
                for b in range(a + 1):
                    C[a, b] -= mean[a] * mean[b] / used
                    C[b, a] = C[a, b]
            eigen(C, V)
            for a in range(3):
                order[a] = a
            for a in range(1, 3):  # by insertion
                for b in range(a, 0, -1):
                    if C[order[b], order[b]] < C[order[b - 1], order[b - 1]]:
                        order[b], order[b - 1] = order[b - 1], order[b]
            if C[order[1], order[1]] >= OF_A_LINE * C[order[2], order[2]]:
                break
        inner_product, length = 0.0, 0.0
        for a in range(3):
            out = places[q, a] - centre[a]
            inner_product += V[a, order[0]] * out
            length += out * out
        cosine[q] = abs(inner_product) / np.sqrt(length)


def misfit(points: Floats, residual: Floats, ball: Sphere, scale: float) -> float:
    """Systematic part in mm of the residuals (n,): means of cells beyond noise, median over the points.

    The median is used because a real scan of a good ball departs from the sphere at the limb.
    """
    cell = sphere_cells(points, ball.centre)
    count = np.maximum(np.bincount(cell), 1)
    mean = np.bincount(cell, residual) / count
    return float(np.median(np.sqrt(np.maximum(mean**2 - scale**2 / count, 0.0))[cell]))
