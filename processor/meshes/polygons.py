"""Polygons in space cut into triangles: as a fan where that is right, else by ear clipping."""

from __future__ import annotations

import numpy as np

from processor.model import Floats, Ints

# Of a polygon's area: a smaller triangle counts as none. Corners in double precision are right to 1e-16 of their
# coordinates, so that a triangle of corners in one line comes out a million times smaller than this.
NO_AREA = 1e-12
# Of the square of a polygon's size: where its fan has less area, its corners lie in one line but for the last digits.
SLIVER = 1e-6


class CrossingError(ValueError):
    """A polygon whose sides cross, so that no triangles make up its area; ``row`` is its number, from 0."""

    def __init__(self, row: int) -> None:
        super().__init__(f"the sides of polygon {row} cross")
        self.row = row


def triangulated(vertices: Floats, corners: Ints, counts: Ints) -> Ints:
    """Return the triangles (f, 3), in rows of ``vertices`` (v, 3), of polygons in space, those of each one in a row.

    ``corners`` (c,) are the rows of the polygons' corners one after the other, ``counts`` (p,) how many each has. All
    corners in one line with two others stay corners of triangles, so that a mesh remains closed. A polygon may touch
    itself, as one with a hole does that is cut open towards its outline. Polygons of less than three corners are left
    out. A polygon need not be plane: it is cut as its projection along its mean normal (Newell).

    Raises CrossingError for a polygon whose sides cross.
    """
    if (counts == 3).all():
        return np.asarray(corners.reshape(-1, 3), np.int64)
    first = np.cumsum(counts) - counts
    of_triangle = np.repeat(np.arange(len(counts)), np.maximum(counts - 2, 0))
    step = np.arange(len(of_triangle)) - np.searchsorted(of_triangle, of_triangle)
    start = first[of_triangle]
    triangles = corners[np.stack([start, start + step + 1, start + step + 2], axis=1)].astype(np.int64)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)  # twice that of a triangle, along its normal
    normal = np.zeros((len(counts), 3))
    for k in range(3):
        normal[:, k] = np.bincount(of_triangle, area[:, k], len(counts))
    along = np.einsum("ni,ni->n", area, normal[of_triangle])
    square = np.einsum("ni,ni->n", normal, normal)
    bad = np.unique(of_triangle[~(along > NO_AREA * square[of_triangle])])
    bad = bad[counts[bad] > 3]
    begins = np.searchsorted(of_triangle, bad)
    parts, done = list[Ints](), 0
    for row, begin in zip(bad.tolist(), begins.tolist(), strict=True):
        ring = corners[first[row] : first[row] + counts[row]]
        cut = _clipped(vertices[ring] - vertices[ring[0]], normal[row])
        end = begin + int(counts[row]) - 2
        if cut is None:
            points = vertices[ring]
            from_first = points[1:] - points[0]
            size = float(np.linalg.norm(np.ptp(points, axis=0)))
            in_one_line = (
                float(np.linalg.norm(np.cross(from_first[:-1], from_first[1:]), axis=1).sum()) <= SLIVER * size * size
            )
            if not in_one_line:
                raise CrossingError(row)
            continue  # the fan stays: whichever way it is cut, its area is that of the digits
        parts += [triangles[done:begin], ring[cut].astype(np.int64)]
        done = end
    return np.concatenate([*parts, triangles[done:]])


def _clipped(points: Floats, normal: Floats) -> Ints | None:
    """Return the triangles (f, 3) of a polygon's corners (n, 3) by ear clipping; None where its sides cross.

    An ear is a convex corner that can be cut off: no other corner lies in its triangle or on its rim. Only corners
    that are not convex can lie there.
    """
    drop = int(np.argmax(np.abs(normal)))
    x, y = (points[:, k] for k in range(3) if k != drop)
    if (normal[drop] < 0.0) != (drop == 1):
        y = -y
    clipping = _Clipping(x, y, NO_AREA * float(np.abs(normal[drop])))
    triangles = list[tuple[int, int, int]]()
    at, passed, left = 0, 0, len(points)
    while left > 2:
        before, after = clipping.before[at], clipping.after[at]
        strict = passed < left  # a second round lets other corners lie on the rim, as rounding may put them there
        if passed >= 2 * left:
            return None
        if clipping.is_repeated(at) or (not strict and clipping.is_spike(at)):
            clipping.remove(at)
        elif clipping.is_ear(at, strict):
            triangles.append((before, at, after))
            clipping.remove(at)
            after = clipping.after[after] if left > 4 else after  # passing one over gives less pointed triangles
        else:
            at, passed = after, passed + 1
            continue
        at, passed, left = after, 0, left - 1
    return np.array(triangles, np.int64).reshape(-1, 3)


class _Clipping:
    """A polygon in a plane, counterclockwise, while ears are cut off: neighbours and turn of each corner left."""

    def __init__(self, x: Floats, y: Floats, no_area: float) -> None:
        count = len(x)
        self.x, self.y, self.no_area = x, y, no_area
        self.before, self.after = [(i - 1) % count for i in range(count)], [(i + 1) % count for i in range(count)]
        self.turn = np.array([self._turn(i) for i in range(count)])
        self.blunt = self.turn <= no_area  # corners that are left and not convex

    def _area(self, i: int, j: int, k: int) -> float:
        x, y = self.x, self.y
        return float((x[j] - x[i]) * (y[k] - y[i]) - (x[k] - x[i]) * (y[j] - y[i]))

    def _turn(self, i: int) -> float:
        return self._area(self.before[i], i, self.after[i])

    def _same(self, i: int, j: int) -> bool:
        return bool(self.x[i] == self.x[j] and self.y[i] == self.y[j])

    def is_repeated(self, i: int) -> bool:
        """Whether the next corner has the same place."""
        return self._same(i, self.after[i])

    def is_spike(self, i: int) -> bool:
        """Whether the polygon turns back at a corner, or the corner is in line with its neighbours."""
        return abs(float(self.turn[i])) <= self.no_area

    def is_ear(self, i: int, strict: bool) -> bool:
        """Whether a corner can be cut off; not ``strict``, others may lie on the rim of its triangle."""
        if not self.turn[i] > self.no_area:
            return False
        corners = (self.before[i], i, self.after[i])
        others = np.flatnonzero(self.blunt)
        px, py = self.x[others], self.y[others]
        outside, at_corner = np.zeros(len(others), bool), np.zeros(len(others), bool)
        for j, k in zip(corners, (*corners[1:], corners[0]), strict=True):
            ax, ay, bx, by = self.x[j], self.y[j], self.x[k], self.y[k]
            side = (bx - ax) * (py - ay) - (px - ax) * (by - ay)
            outside |= (side < 0.0) if strict else (side <= self.no_area)
            at_corner |= (px == ax) & (py == ay)
        return bool((outside | at_corner).all())

    def remove(self, i: int) -> None:
        """Cut a corner off."""
        before, after = self.before[i], self.after[i]
        self.after[before], self.before[after] = after, before
        self.blunt[i] = False
        for k in (before, after):
            self.turn[k] = self._turn(k)
            self.blunt[k] = self.turn[k] <= self.no_area
