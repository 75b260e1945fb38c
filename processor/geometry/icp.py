"""Iterative closest point, to points and to planes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.geometry.polyline import Polyline
from processor.model import Bools, Floats, Ints
from processor.robust_statistics import robust_sd

MOST_WEIGHT = 100.0  # of a point on a face that few points lie on
SURE_MM = 1e-6  # a sample counts as nearer than any other by more than errors of rounding


@dataclass(frozen=True)
class Alignment:
    """Pose reached, rms of the pairs' distances in mm, share of points paired, and number of iterations."""

    T_target_source: Floats
    rms: float
    paired_share: float
    iterations: int


def point_to_point(
    source: Floats,
    target: Floats,
    start: Floats,
    *,
    max_distance_mm: float = np.inf,
    max_iterations: int = 100,
    tolerance: float = 1e-6,
) -> Alignment:
    """Align source (n, 3) to target (m, 3) from a start (4, 4) (Besl and McKay; paper 000, eq. 5).

    Pairs farther apart than ``max_distance_mm`` are left out. Stops after ``max_iterations`` or when the rms changes
    by less than ``tolerance`` of itself.
    """
    tree = cKDTree(target)

    def pair(placed: Floats) -> tuple[Floats, Floats]:
        distance, index = tree.query(placed, distance_upper_bound=max_distance_mm, workers=-1)
        return distance, target[index[np.isfinite(distance)]]

    return _iterated(source, pair, start, max_iterations, tolerance)


def point_to_lines(
    source: Floats,
    lines: Sequence[Polyline],
    start: Floats,
    *,
    max_distance_mm: float = np.inf,
    max_iterations: int = 100,
    tolerance: float = 1e-6,
) -> Alignment:
    """Align source (n, 3) to polylines from a start (4, 4): the pair of a point is its nearest place on any of them.

    Paper 000, section 2.7, names it as another way to find pairs. Points of the target in place of lines hold a point
    back along the line, by as much as the target's spacing. Stops as :func:`point_to_point` does.
    """
    rows = np.arange(len(source))

    def pair(placed: Floats) -> tuple[Floats, Floats]:
        offsets = np.stack([line.nearest(placed)[1] for line in lines])
        distances = np.linalg.norm(offsets, axis=2)
        nearest = distances.argmin(axis=0)
        distance = distances[nearest, rows]
        paired = distance <= max_distance_mm
        return np.where(paired, distance, np.inf), (placed - offsets[nearest, rows])[paired]

    return _iterated(source, pair, start, max_iterations, tolerance)


def _iterated(
    source: Floats,
    pair: Callable[[Floats], tuple[Floats, Floats]],
    start: Floats,
    max_iterations: int,
    tolerance: float,
) -> Alignment:
    """Pair and fit in turns until the rms distance of the pairs changes by less than ``tolerance`` of itself.

    ``pair`` returns the distances (n,) of placed points to their partners, inf for none, and the partners (k, 3) that
    there are.
    """
    T, last, iteration = start, np.inf, 0
    rms, share = np.inf, 0.0
    for iteration in range(1, max_iterations + 1):
        distance, partner = pair(rigid.apply(T, source))
        paired = np.isfinite(distance)
        share = float(paired.mean())
        if paired.sum() < 3:
            return Alignment(T, np.inf, share, iteration)
        rms = float(np.sqrt(np.mean(distance[paired] ** 2)))
        if abs(last - rms) <= tolerance * max(rms, 1e-9):
            break
        last = rms
        T = rigid.fit(source[paired], partner)
    return Alignment(T, rms, share, iteration)


def point_to_plane(
    source: Floats,
    target: Floats,
    normals: Floats,
    start: Floats,
    *,
    gates_mm: tuple[float, ...],
    tree: cKDTree | None = None,
    axes: Floats | None = None,
    max_iterations: int = 15,
) -> Alignment:
    """Align source (n, 3) to a surface given by samples target (m, 3) with unit normals (m, 3).

    Gauss-Newton on the distances along the normals, Huber-weighted by their median. Pairs beyond the gate are left
    out; the gates are used in turn, from wide to narrow. The rms is that of the last gate's pairs. ``tree`` is of the
    target, if there is one already. With ``axes`` (3, 3, columns), faces along each axis have the same weight in sum:
    see :func:`balance`.
    """
    partners = _Partners(cKDTree(target) if tree is None else tree, len(source))
    T, rms, share, iterations = start, np.inf, 0.0, 0
    for gate in gates_mm:
        for _ in range(max_iterations):
            iterations += 1
            placed = rigid.apply(T, source)
            # The nearest sample may lie a sample spacing away along the surface; the gate limits the normal distance.
            index, near = partners.of(placed, 3.0 * gate)
            p, at = placed.compress(near, axis=0), index[near]
            n = normals.take(at, axis=0)  # with compress, in a quarter of the time of an index
            r = np.einsum("ni,ni->n", p - target.take(at, axis=0), n)
            keep = np.abs(r) <= gate
            p, n, r = p.compress(keep, axis=0), n.compress(keep, axis=0), r[keep]
            share = len(r) / len(source)
            if len(r) < 6:
                return Alignment(T, np.inf, share, iterations)
            rms = float(np.sqrt(np.mean(r**2)))
            # On a clean scan the median is close to zero. The few points of an end face, far off while the part still
            # slides along its length, would then lose all their weight: the gate sets a lower bound of the scale.
            scale = robust_sd(r, gate / 12.0)
            weight = np.minimum(1.0, 1.345 * scale / np.maximum(np.abs(r), 1e-12))
            if axes is not None:
                weight *= balance(facing(n, axes))
            centre = p.mean(axis=0)
            J = np.hstack([np.cross(p - centre, n), n])
            step = np.linalg.lstsq(J.T @ (weight[:, None] * J), -J.T @ (weight * r), rcond=None)[0]
            R = rigid.rotation_from_vector(step[:3])
            T = rigid.transform(R, centre + step[3:] - R @ centre) @ T
            reach = float(np.linalg.norm(p - centre, axis=1).max())
            if np.linalg.norm(step[:3]) * reach + np.linalg.norm(step[3:]) < 1e-3 * gate:
                break
    return Alignment(T, rms, share, iterations)


class _Partners:
    """The nearest samples of a tree to points that move a little at a time, searched for only where they may be others.

    A search also finds the second nearest sample. While a point has moved by less than half of what that one is
    farther away, the nearest one stays (triangle inequality).
    """

    def __init__(self, tree: cKDTree, count: int) -> None:
        self._tree, self._samples = tree, np.asarray(tree.data)
        self._index = np.full(count, tree.n)  # of the nearest sample; the tree's number of samples for none
        self._other = np.full(count, -np.inf)  # least distance of any other sample from where the point was
        self._searched = np.zeros((count, 3))  # where the point was

    def of(self, placed: Floats, reach: float) -> tuple[Ints, Bools]:
        """Return the nearest sample (n,) of each of the points (n, 3), and whether it lies within ``reach``."""
        known = self._index < self._tree.n
        nearest = self._samples.take(self._index, axis=0, mode="clip")
        distance = np.where(known, _lengths(placed - nearest), np.inf)
        other = self._other - _lengths(placed - self._searched) - SURE_MM
        again = np.flatnonzero((other <= distance) & (np.minimum(other, distance) < reach))
        if len(again):
            found, index = self._tree.query(placed[again], k=2, distance_upper_bound=reach)
            self._index[again], self._searched[again] = index[:, 0], placed[again]
            self._other[again] = np.minimum(found[:, 1], reach)
            distance[again] = found[:, 0]
        return self._index, distance < reach


def _lengths(vectors: Floats) -> Floats:
    length: Floats = np.sqrt(np.einsum("ni,ni->n", vectors, vectors))
    return length


def facing(normals: Floats, axes: Floats) -> Ints:
    """Return the index (n,) of the one of three axes (3, 3, columns) nearest to the line of each normal (n, 3)."""
    axis: Ints = np.argmax(np.abs(normals @ axes), axis=1)
    return axis


def balance(group: Ints) -> Floats:
    """Weights (n,) of points in groups (n,) 0 to 2 such that each group has the same weight in sum.

    The two ends of a long part are a few points in a thousand, yet they alone fix it along its length. The long faces
    are bent, and would otherwise dominate that direction by their form errors.
    """
    number = np.maximum(np.bincount(group, minlength=3), 1)
    weight: Floats = np.minimum(len(group) / (3.0 * number), MOST_WEIGHT)[group]
    return weight
