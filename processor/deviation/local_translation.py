"""Movement of a surface about a place: a small translation fitted to the distances of points from the surface.

On a plane this is the mean distance, as in M3C2. On a tube the normals at the points about a place differ from that at
the place, so that their mean distance would be too small. Distances s_i = n_i u of a common translation u are therefore
solved for u.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.linalg_small import assign, assign_rows, eigen
from processor.geometry.m3c2 import FEWEST_FOR_LOD, LEAST_RANGE
from processor.geometry.point_grid import HALF_DIAGONAL, SIDE, PointGrid, block_at, cells_within
from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats, Ints
from processor.robust_statistics import student_factor

DETERMINED = 0.05  # least eigenvalue of the mean of n n' for which the translation along its vector is estimated


@dataclass(frozen=True)
class Movement:
    """At each place (k,): movement along its normal, number of points used, and standard deviation of one point.

    ``vector`` (k, 3) is the translation itself, without the directions that the points do not determine, and ``rank``
    (k,) the number of the others. The standard error of ``along`` is sd / sqrt(count); ``sd`` includes the estimated
    unknowns and Student's factor for few points, so that 1.96 standard errors are 95 %. NaN below FEWEST_FOR_LOD
    points.
    """

    along: Floats
    count: Ints
    sd: Floats
    vector: Floats
    rank: Ints


class _Feet(NamedTuple):
    """Signed distance (n,) measured at each foot, unit normal (n, 3) of the surface there, and which feet to use."""

    distance: Floats
    normals: Floats
    radius: float
    least_cos: float


class _Places(NamedTuple):
    """Places (k, 3) on a surface with unit normals (k, 3), and the order (k,) to visit them in."""

    places: Floats
    directions: Floats
    order: Ints


class Sums(NamedTuple):
    """Over the feet about each place: their number (k,), and the sums of s s (k,), n n' (k, 3, 3) and n s (k, 3)."""

    number: Ints
    square: Floats
    nn: Floats
    ns: Floats


class PartSums(NamedTuple):
    """Sums over some feet, at the places (p,) about which there are any."""

    places: Ints
    sums: Sums


class _Moved(NamedTuple):
    """What the kernel fills; ``free`` (k,) are degrees of freedom, ``variance`` (k,) that of one point."""

    along: Floats
    variance: Floats
    vector: Floats
    number: Ints
    free: Ints


class Translations:
    """Movement of a surface at places (k, 3) on it, along unit normals ``directions`` (k, 3), from feet block by block.

    Feet are used within half ``diameter_mm`` of a place, where the cosine between the surface's normal and the place's
    is at least ``least_cos``.
    """

    def __init__(self, places: Floats, directions: Floats, diameter_mm: float, least_cos: float) -> None:
        self._places, self._directions = np.ascontiguousarray(places), np.ascontiguousarray(directions)
        self.diameter, self._least_cos = float(diameter_mm), float(least_cos)
        k = len(places)
        self._sums = Sums(np.zeros(k, np.int64), np.zeros(k), np.zeros((k, 3, 3)), np.zeros((k, 3)))

    def add(self, feet: PointGrid, distance: Floats, normals: Floats) -> None:
        """Add points on the surface with the signed ``distance`` (n,) of what was measured there.

        Distances and the unit ``normals`` (n, 3) of the surface are in the grid's order.
        """
        measured = _Feet(distance, normals, 0.5 * self.diameter, self._least_cos)
        wanted = _Places(self._places, self._directions, feet.beside(self._places))
        over_ranges(
            lambda a, b: _add(feet.cells, measured, wanted, a, b, self._sums), len(self._places), least=LEAST_RANGE
        )

    def part(self) -> PartSums:
        """Return the sums over the feet that were added."""
        sums = self._sums
        places = np.flatnonzero(sums.number)
        return PartSums(places, Sums(sums.number[places], sums.square[places], sums.nn[places], sums.ns[places]))

    def add_part(self, part: PartSums) -> None:
        """Add the sums over some feet, which another object has of the same places."""
        self._sums.number[part.places] += part.sums.number
        self._sums.square[part.places] += part.sums.square
        self._sums.nn[part.places] += part.sums.nn
        self._sums.ns[part.places] += part.sums.ns

    def movement(self) -> Movement:
        """Return the movement by all feet that were added."""
        k = len(self._places)
        moved = _Moved(
            along=np.full(k, np.nan), variance=np.full(k, np.nan), vector=np.full((k, 3), np.nan),
            number=self._sums.number.copy(), free=np.zeros(k, np.int64),
        )  # fmt: skip
        over_ranges(lambda a, b: _movement(self._sums, self._directions, a, b, moved), k, least=LEAST_RANGE)
        table = student_factor(np.arange(1.0, 401.0))
        factor = np.where(moved.free > 0, table[np.clip(moved.free, 1, 400) - 1], np.nan)
        return Movement(
            moved.along, moved.number, np.sqrt(moved.variance) * factor, moved.vector, moved.number - moved.free
        )


@njit(cache=True, nogil=True)
def _movement(sums, directions, first, last, moved):  # type: ignore[no-untyped-def]
    """Fit the movement at places first to last - 1."""
    A, g = np.empty((3, 3)), np.empty(3)
    for row in range(first, last):
        if sums.number[row] >= FEWEST_FOR_LOD:
            assign_rows(A, sums.nn[row])
            assign(g, sums.ns[row])
            _solve(A, g, sums.square[row], sums.number[row], directions[row], row, moved)


@njit(cache=True, nogil=True)
def _add(cells, feet, wanted, first, last, sums):  # type: ignore[no-untyped-def]
    """Add the feet about places order[first] to order[last - 1] to their sums."""
    places, directions, order = wanted.places, wanted.directions, wanted.order
    distance, normals, radius, least_cos = feet.distance, feet.normals, feet.radius, feet.least_cos
    size, (xl, yl, zl) = cells.size, (cells.lower[0], cells.lower[1], cells.lower[2])
    points, starts = cells.points, cells.starts
    rim, extent = radius * radius, radius * (1.0 + 1e-9)
    reach2 = (radius + HALF_DIAGONAL * size) ** 2
    A, g = np.empty((3, 3)), np.empty(3)
    for at in range(first, last):
        row = order[at]
        x, y, z = places[row, 0], places[row, 1], places[row, 2]
        a, b, c = directions[row, 0], directions[row, 1], directions[row, 2]
        if not np.isfinite(a + b + c + x + y + z) or len(points) == 0:
            continue
        i0, i1, j0, j1, k0, k1 = cells_within(cells, x, y, z, extent, extent, extent)
        n, square = 0, 0.0
        A[:, :], g[:] = 0.0, 0.0
        for bi in range(i0 // SIDE, i1 // SIDE + 1):
            for bj in range(j0 // SIDE, j1 // SIDE + 1):
                for bk in range(k0 // SIDE, k1 // SIDE + 1):
                    u = xl + SIDE * (bi + 0.5) * size - x
                    v = yl + SIDE * (bj + 0.5) * size - y
                    t = zl + SIDE * (bk + 0.5) * size - z
                    if u * u + v * v + t * t > reach2:
                        continue
                    block = block_at(cells, bi, bj, bk)
                    if block < 0:
                        continue
                    low, high = max(k0 - SIDE * bk, 0), min(k1 - SIDE * bk, SIDE - 1)
                    for i in range(max(i0, SIDE * bi), min(i1, SIDE * bi + SIDE - 1) + 1):
                        for j in range(max(j0, SIDE * bj), min(j1, SIDE * bj + SIDE - 1) + 1):
                            cell = ((i - SIDE * bi) * SIDE + (j - SIDE * bj)) * SIDE
                            for p in range(starts[block, cell + low], starts[block, cell + high + 1]):
                                u, v, t = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                                if u * u + v * v + t * t > rim:
                                    continue
                                e, m, o = normals[p, 0], normals[p, 1], normals[p, 2]
                                if e * a + m * b + o * c < least_cos:
                                    continue
                                s = distance[p]
                                n += 1
                                square += s * s
                                A[0, 0] += e * e
                                A[0, 1] += e * m
                                A[0, 2] += e * o
                                A[1, 1] += m * m
                                A[1, 2] += m * o
                                A[2, 2] += o * o
                                g[0] += e * s
                                g[1] += m * s
                                g[2] += o * s
        sums.number[row] += n
        sums.square[row] += square
        for i in range(3):
            sums.ns[row, i] += g[i]
            for j in range(i, 3):
                sums.nn[row, i, j] += A[i, j]


@njit(cache=True, nogil=True)
def _solve(A, g, square, n, direction, row, moved):  # type: ignore[no-untyped-def]
    """Solve for the translation by the sums A of n n', g of n s and ``square`` of s s over ``n`` points."""
    for i in range(3):
        g[i] /= n
        for j in range(i, 3):
            A[i, j] /= n
            A[j, i] = A[i, j]
    V, w = np.empty((3, 3)), np.empty(3)
    eigen(A, V)
    a, b, c = direction[0], direction[1], direction[2]
    # Sums of n u, and of its variance over that of one distance, over the directions determined, strongest first.
    total, cost, explained, number = 0.0, 0.0, 0.0, 0
    for k in range(3):
        w[k], moved.vector[row, k] = A[k, k], 0.0
    for _ in range(3):
        k = 0
        for i in range(1, 3):
            k = i if w[i] > w[k] else k
        if w[k] < DETERMINED or (number > 0 and n - number < FEWEST_FOR_LOD):
            break
        e = V[0, k] * a + V[1, k] * b + V[2, k] * c
        f = V[0, k] * g[0] + V[1, k] * g[1] + V[2, k] * g[2]
        total += e * f / w[k]
        for i in range(3):
            moved.vector[row, i] += V[i, k] * f / w[k]
        cost += e * e / w[k]
        explained += f * f / w[k]
        number += 1
        w[k] = -1.0
    moved.along[row] = total
    moved.free[row] = n - number
    moved.variance[row] = max(0.0, square / n - explained) * n / (n - number) * cost
