"""A face as a function of two parameters, with the net of triangles that rays meet first."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from processor.model import Bools, Floats, Ints

Surface = Callable[[Floats, Floats], Floats]  # p, q (n,) in 0..1 -> points (n, 3), mm
Displacement = Callable[[Floats], Floats]  # points (n, 3) -> their displacements (n, 3), mm


@dataclass(frozen=True)
class Patch:
    """A face: ``at(p, q)`` maps parameters (n,) each in 0..1 to points (n, 3), mm; ``p`` and ``q`` are the net's knots.

    ``present`` (len(p) - 1, len(q) - 1) marks the cells that exist; None: all of them. Patches of the same part and
    name are pieces of one smooth surface.
    """

    name: str
    at: Surface
    p: Floats
    q: Floats
    present: Bools | None = None

    def net(self) -> tuple[Floats, Ints]:
        """Return the parameters (v, 2) of the knots, and triangles (f, 3) of the cells that exist."""
        n = len(self.q)
        knots = np.stack(np.meshgrid(self.p, self.q, indexing="ij"), axis=-1).reshape(-1, 2)
        i, j = np.meshgrid(np.arange(len(self.p) - 1), np.arange(n - 1), indexing="ij")
        corner = (i * n + j)[np.ones(i.shape, bool) if self.present is None else self.present]
        quads = np.stack([corner, corner + n, corner + n + 1, corner + 1], axis=-1)
        return knots, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int64)

    def displaced(self, displacement: Displacement) -> Patch:
        """Return the face with every point displaced by a function of its position."""
        at = self.at

        def displaced_at(p: Floats, q: Floats) -> Floats:
            points = at(p, q)
            result: Floats = points + displacement(points)
            return result

        return dataclasses.replace(self, at=displaced_at)


@dataclass(frozen=True)
class Trimmed:
    """A face whose net is any set of triangles, with corners (f, 3, 3), mm, and their parameters pq (f, 3, 2).

    ``at`` maps parameters p, q (n,) to points (n, 3); None: the triangles are the face itself.
    """

    name: str
    corners: Floats
    pq: Floats
    at: Surface | None = None


def outside(a: Floats, b: Floats, rectangles: Floats) -> Bools:
    """Mark the points (a, b), (n,) each, that lie in none of the rectangles (k, 4): a0, a1, b0, b1."""
    result = np.ones(len(a), bool)
    for a0, a1, b0, b1 in rectangles:
        result &= ~((a > a0) & (a < a1) & (b > b0) & (b < b1))
    return result


def within_triangle(u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Fold parameters (n,) of the unit square onto the triangle u + v <= 1: what is uniform stays uniform."""
    beyond = u + v > 1.0
    return np.where(beyond, 1.0 - u, u), np.where(beyond, 1.0 - v, v)
