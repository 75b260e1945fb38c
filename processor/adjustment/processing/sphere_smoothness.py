"""Whether the residuals of a sphere are smooth, as those of a filter or of samples of a mesh are.

Half the mean square of the differences to neighbours is the variance of white noise (von Neumann 1941), and less where
neighbours share errors. The variance is that about a surface of second order in each of some parts of the sphere, as
what a scanner has by incidence is no trace of software. Parts hold several times what filters take, 8 to 30 points:
a surface through fewer takes most of what is shared with it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import coincident_points
from processor.model import Floats, Ints

PART_POINTS = 180  # about; from 90 on means of 8, and from 150 on those of 20 and moving least squares are told apart
NEAREST = 5  # the point itself, two along a line of the scanner and two across
LOOKED_AT = 500  # points whose neighbours are looked at: the ratio of white noise is known to 0.7 / root of it
TERMS, RIDGE = 6, 1e-9  # of a surface of second order, and what keeps it determined where points lie in lines
# White noise has 1. Errors correlated by 0.3 to 0.5 along the lines of a scanner, two of four neighbours, leave 0.85 to
# 0.75; three real scans of a sphere of 50 mm 0.65 to 0.96; means of 8 and 20 and moving least squares of 450 points or
# more 0.33 to 0.55, of points nearer than their noise up to 0.66. Some 100 smoothed points have up to
# 0.86: neither of these are told from those of real scanners.
SMOOTH = 0.62


def smooth(directions: Floats, errors: Floats) -> bool:
    """Whether errors (n,) at unit vectors (n, 3) from a sphere's centre are smoother than noise."""
    return ratio(directions, errors) < SMOOTH


def ratio(directions: Floats, errors: Floats) -> float:
    """Return the variance by differences of neighbours over that of errors (n,), the median of the sphere's parts."""
    parts = _parts(directions)
    own = directions[parts] - directions[parts].mean(axis=1, keepdims=True)
    v, w = np.moveaxis(own @ np.linalg.eigh(np.swapaxes(own, 1, 2) @ own)[1], 2, 0)[1:]
    left, part = np.zeros(len(errors)), np.full(len(errors), -1)
    left[parts], part[parts] = off_second_order(errors[parts], v, w), np.arange(len(parts))[:, None]
    variance = np.sum(left[parts] ** 2, axis=1) / (parts.shape[1] - TERMS)
    rows = parts[:, :: max(1, parts.size // LOOKED_AT)].ravel()
    near = cKDTree(directions, **coincident_points.FEW).query(directions[rows], k=NEAREST)[1][:, 1:]
    within = part[near] == part[rows, None]
    squares = np.where(within, (left[near] - left[rows, None]) ** 2, 0.0)
    sums, pairs = (np.bincount(part[rows], one.sum(axis=1), len(parts)) for one in (squares, within))
    return float(np.median(0.5 * sums / np.maximum(pairs * variance, np.finfo(float).tiny)))


def off_second_order(height: Floats, v: Floats, w: Floats) -> Floats:
    """Return what surfaces of second order over places v, w (p, m) leave of heights (p, m) of points of patches."""
    A = np.stack([np.ones_like(v), v, w, v * v, v * w, w * w], axis=2)
    normal = np.swapaxes(A, 1, 2)
    fitted = A @ np.linalg.solve(normal @ A + RIDGE * np.eye(TERMS), normal @ height[..., None])
    left: Floats = height - fitted[..., 0]
    return left


def _parts(directions: Floats) -> Ints:
    """Return the rows (p, m) of directions (n, 3) in parts of as many points each; fewer than p are left out.

    Rings about the mean direction are parted along their turn.
    """
    n = len(directions)
    rings = max(1, round(np.sqrt(n / PART_POINTS)))
    sectors = max(1, round(n / PART_POINTS / rings))
    side = directions.mean(axis=0)
    across = np.cross(side, np.eye(3)[np.argmin(np.abs(side))])
    turn = np.arctan2(directions @ np.cross(side, across), directions @ across * np.linalg.norm(side))
    ring = np.empty(n, np.int64)
    ring[np.argsort(directions @ side, kind="stable")] = np.arange(n) * rings // n
    parts: Ints = np.lexsort((turn, ring))[: n // (rings * sectors) * rings * sectors].reshape(rings * sectors, -1)
    return parts
