"""Straight lines and polylines in space."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from processor import diagnostics
from processor.model import Floats


@dataclass(frozen=True)
class Line:
    """A line through ``point`` (3,) along the unit vector ``direction`` (3,)."""

    point: Floats
    direction: Floats

    def distances(self, points: Floats) -> Floats:
        """Distances of points (n, 3), mm (paper 000, eq. 2)."""
        distances: Floats = np.linalg.norm(np.cross(points - self.point, self.direction), axis=1)
        return distances


def fit_line(points: Floats) -> Line:
    """Least-squares line through points (n, 3), n >= 2: their mean and first principal direction."""
    centre = points.mean(axis=0)
    _, _, Vt = np.linalg.svd(points - centre, full_matrices=False)
    return Line(centre, Vt[0])


def ransac_line(
    points: Floats, threshold_mm: float, probability: float, max_iterations: int, rng: np.random.Generator
) -> Line | None:
    """Line with the most points within the threshold, fitted to them by least squares.

    The number of two-point samples adapts to the largest share of inliers so far. None if all points coincide.
    """
    best: np.ndarray | None = None
    needed, tried = float(max_iterations), 0
    while tried < min(needed, max_iterations):
        tried += 1
        a, b = points[rng.choice(len(points), 2, replace=False)]
        length = float(np.linalg.norm(b - a))
        if length == 0.0:
            continue
        inliers = Line(a, (b - a) / length).distances(points) <= threshold_mm
        if best is None or inliers.sum() > best.sum():
            best = inliers
            share = min(float(inliers.mean()), 1.0 - 1e-12)
            needed = math.log(1.0 - probability) / math.log(1.0 - share**2)
    diagnostics.note("line consensus", trials=tried, inliers=0 if best is None else int(best.sum()))
    return None if best is None else fit_line(points[best])


def crossing(a: Line, b: Line) -> Floats:
    """Midpoint (3,) of the shortest segment between two lines; NaN for parallel lines."""
    normal = np.cross(a.direction, b.direction)
    square = float(normal @ normal)
    if square < 1e-12:
        return np.full(3, np.nan)
    offset = b.point - a.point
    on_a = a.point + (np.cross(offset, b.direction) @ normal / square) * a.direction
    on_b = b.point + (np.cross(offset, a.direction) @ normal / square) * b.direction
    return 0.5 * (on_a + on_b)


@dataclass(frozen=True)
class Polyline:
    """A polyline through vertices (m, 3), m >= 2, with the arc length (m,) at each."""

    vertices: Floats
    arc: Floats

    @classmethod
    def through(cls, vertices: Floats) -> Polyline:
        """Make a polyline; its arc length starts at 0."""
        steps = np.linalg.norm(np.diff(vertices, axis=0), axis=1)
        return cls(vertices, np.concatenate([[0.0], np.cumsum(steps)]))

    @property
    def length(self) -> float:
        """Length in mm."""
        return float(self.arc[-1])

    def at(self, s: Floats) -> Floats:
        """Points (k, 3) at arc lengths s (k,)."""
        return np.stack([np.interp(s, self.arc, self.vertices[:, i]) for i in range(3)], axis=1)

    def nearest(self, points: Floats) -> tuple[Floats, Floats]:
        """Arc length (n,) of the nearest point of the polyline to each of points (n, 3), and vector (n, 3) from it."""
        start, along = self.vertices[:-1], np.diff(self.vertices, axis=0)
        squared = np.einsum("mi,mi->m", along, along)
        regular = squared > 0.0
        start, along, squared, arc = start[regular], along[regular], squared[regular], self.arc[:-1][regular]
        segment, t = np.zeros(len(points), np.int64), np.zeros(len(points))
        _nearest_segments(np.ascontiguousarray(points), start, along, squared, segment, t)
        offset = points - (start[segment] + t[:, None] * along[segment])
        return arc[segment] + t * np.sqrt(squared[segment]), offset


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest_segments(points, start, along, squared, segment, t):  # type: ignore[no-untyped-def]
    """Fill the nearest segment (n,) of points (n, 3), the first of several, and the place (n,) on it from 0 to 1.

    They stay for points that are not finite. Segments go from ``start`` (m, 3) by ``along`` (m, 3), whose squared
    lengths (m,) are above 0.
    """
    for i in range(len(points)):
        least = np.inf
        for k in range(len(start)):
            x, y, z = points[i, 0] - start[k, 0], points[i, 1] - start[k, 1], points[i, 2] - start[k, 2]
            u, v, w = along[k, 0], along[k, 1], along[k, 2]
            at = min(max((x * u + y * v + z * w) / squared[k], 0.0), 1.0)
            x, y, z = x - at * u, y - at * v, z - at * w
            distance = x * x + y * y + z * z
            if distance < least:
                least, segment[i], t[i] = distance, k, at
