"""Iterative closest point, to points and to planes."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.geometry.linalg_small import assign_rows, product
from processor.geometry.lines_and_polylines import Polyline
from processor.geometry.selection import median
from processor.inner_kernels import inner
from processor.model import Floats, Ints
from processor.robust_statistics import MAD_TO_SD

MOST_WEIGHT = 100.0  # of a point on a face that few points lie on
LEAF = 8  # samples in a box that holds no other boxes
NEAR = 3  # samples that a search finds: with fewer there are more searches, with more each takes longer
STACK = 64  # more than twice the levels of boxes about 2^31 samples
SURE_MM = 1e-6  # a sample counts as nearer than any other by more than errors of rounding
HUBER = 1.345  # standard deviations from which a point's weight falls: 95 % efficient for normal errors
RANK = 6.0 * float(np.finfo(np.float64).eps)  # least singular value over the greatest of a motion that pairs determine


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
    boxes: SampleBoxes,
    start: Floats,
    *,
    gates_mm: tuple[float, ...],
    axes: Floats | None = None,
    max_iterations: int = 15,
    known: Known | None = None,
) -> Alignment:
    """Align source (n, 3) to a surface given by ``boxes`` about its samples.

    Gauss-Newton on the distances along the normals, Huber-weighted by their median. Pairs beyond the gate are left
    out; the gates are used in turn, from wide to narrow. The rms is that of the last gate's pairs. With ``axes``
    (3, 3, columns), faces along each axis have the same weight in sum: see :func:`balance`. What is ``known`` of the
    source's nearest samples is brought up to date.
    """
    known = nothing_known(len(source)) if known is None else known
    source, axes = np.ascontiguousarray(source), np.ascontiguousarray(np.empty((3, 0)) if axes is None else axes)
    T, rms, share, iterations = start.copy(), np.inf, 0.0, 0
    for gate in gates_mm:
        rms, share, more = _aligned(boxes, source, T, float(gate), axes, max_iterations, known)
        iterations += more
        if rms == np.inf:
            break
    return Alignment(T, rms, share, iterations)


@njit(cache=True, nogil=True)
def _aligned(boxes, source, T, gate, axes, most, known):  # type: ignore[no-untyped-def]
    """Align with one gate by at most ``most`` iterations from T (4, 4), which becomes the pose reached.

    Return the rms of the pairs before the last step, infinite where too few are left, their share, and iterations.
    """
    count = len(source)
    placed, near = np.empty((count, 3)), np.empty(count, np.bool_)
    p, n, r, sizes = np.empty((count, 3)), np.empty((count, 3)), np.empty(count), np.empty(count)
    rms = np.inf
    for iteration in range(1, most + 1):
        for row in range(count):
            for i in range(3):
                x, y, z = source[row, 0], source[row, 1], source[row, 2]
                placed[row, i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3]
        # The nearest sample may lie a sample spacing away along the surface; the gate limits the normal distance.
        find_partners(boxes, placed, 3.0 * gate, known, near)
        pairs = _pairs(boxes, placed, known.first, near, gate, p, n, r)
        if pairs < 6:
            return np.inf, pairs / count, iteration
        squares = 0.0
        for k in range(pairs):
            squares += r[k] * r[k]
            sizes[k] = abs(r[k])
        rms = np.sqrt(squares / pairs)
        # On a clean scan the median is close to zero. The few points of an end face, far off while the part still
        # slides along its length, would then lose all their weight: the gate sets a lower bound of the scale.
        scale = max(MAD_TO_SD * median(sizes, pairs), gate / 12.0)
        moved = _step(p, n, r, pairs, HUBER * scale, axes, T)
        if moved < 1e-3 * gate:
            break
    return rms, pairs / count, iteration


@inner
def _pairs(boxes, placed, nearest, near, gate, p, n, r):  # type: ignore[no-untyped-def]
    """Write the points, normals and distances of pairs within the gate to the start of p, n and r; return how many."""
    pairs = 0
    for row in range(len(placed)):
        if near[row]:
            at = nearest[row]
            off = 0.0
            for i in range(3):
                off += (placed[row, i] - boxes.samples[at, i]) * boxes.normals[at, i]
            if abs(off) <= gate:
                for i in range(3):
                    p[pairs, i], n[pairs, i] = placed[row, i], boxes.normals[at, i]
                r[pairs] = off
                pairs += 1
    return pairs


@inner
def _step(p, n, r, pairs, huber, axes, T):  # type: ignore[no-untyped-def]
    """Move T (4, 4) by one weighted least-squares step of pairs, the first of the arrays (k, ...).

    Return by how much it moves the points, mm.
    """
    share, group = _balance(n, pairs, axes)
    centre = np.zeros(3)
    for k in range(pairs):
        for i in range(3):
            centre[i] += p[k, i]
    for i in range(3):
        centre[i] /= pairs
    normal, right, row = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    reach = 0.0
    for k in range(pairs):
        weight = min(1.0, huber / max(abs(r[k]), 1e-12)) * share[group[k]]
        x, y, z = p[k, 0] - centre[0], p[k, 1] - centre[1], p[k, 2] - centre[2]
        reach = max(reach, x * x + y * y + z * z)
        row[0] = y * n[k, 2] - z * n[k, 1]
        row[1] = z * n[k, 0] - x * n[k, 2]
        row[2] = x * n[k, 1] - y * n[k, 0]
        row[3], row[4], row[5] = n[k, 0], n[k, 1], n[k, 2]
        for i in range(6):
            right[i] -= weight * r[k] * row[i]
            for j in range(i + 1):
                normal[i, j] += weight * row[i] * row[j]
    for i in range(6):
        for j in range(i):
            normal[j, i] = normal[i, j]
    step = _solution(normal, right)
    motion = _turn(step[0], step[1], step[2])
    for i in range(3):
        motion[i, 3] = centre[i] + step[3 + i]
        for j in range(3):
            motion[i, 3] -= motion[i, j] * centre[j]
    assign_rows(T, product(motion, T))
    turn, shift = 0.0, 0.0
    for i in range(3):
        turn += step[i] * step[i]
        shift += step[3 + i] * step[3 + i]
    return np.sqrt(turn) * np.sqrt(reach) + np.sqrt(shift)


@inner
def _balance(n, count, axes):  # type: ignore[no-untyped-def]
    """Return weights (3,) of groups and the group (k,) of the first normals (k, 3), see :func:`balance`.

    Without axes all are in one group of weight 1.
    """
    group, number, share = np.zeros(count, np.int64), np.zeros(3), np.ones(3)
    if axes.shape[1] == 0:
        return share, group
    for k in range(count):
        most = -1.0
        for i in range(3):
            along = abs(n[k, 0] * axes[0, i] + n[k, 1] * axes[1, i] + n[k, 2] * axes[2, i])
            if along > most:
                most, group[k] = along, i
        number[group[k]] += 1.0
    for i in range(3):
        share[i] = min(count / (3.0 * max(number[i], 1.0)), MOST_WEIGHT)
    return share, group


@inner
def _solution(normal, right):  # type: ignore[no-untyped-def]
    """Return the shortest solution (6,) of normal equations: motions that the pairs do not determine are not made."""
    values, vectors = np.linalg.eigh(normal)
    solution, most = np.zeros(6), 0.0
    for k in range(6):
        most = max(most, abs(values[k]))
    for k in range(6):
        if abs(values[k]) > RANK * most:
            along = 0.0
            for i in range(6):
                along += vectors[i, k] * right[i]
            for i in range(6):
                solution[i] += along / values[k] * vectors[i, k]
    return solution


@inner
def _turn(a, b, c):  # type: ignore[no-untyped-def]
    """Return the motion (4, 4) that turns about the origin by a vector, rad (Rodrigues)."""
    T, K = np.zeros((4, 4)), np.zeros((3, 3))
    for i in range(4):
        T[i, i] = 1.0
    angle = np.sqrt(a * a + b * b + c * c)
    if angle == 0.0:
        return T
    K[1, 0], K[0, 2], K[2, 1] = c / angle, b / angle, a / angle
    K[0, 1], K[2, 0], K[1, 2] = -c / angle, -b / angle, -a / angle
    K2 = product(K, K)
    for i in range(3):
        for j in range(3):
            T[i, j] += np.sin(angle) * K[i, j] + (1.0 - np.cos(angle)) * K2[i, j]
    return T


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


# --- Nearest samples of a surface to points that move a little at a time
#
# A tree's search starts without a bound, and far from a surface, where many samples are about as near, it visits many
# of them. Here the samples found before, which stay near, are the bound from the start, and one of them mostly is the
# nearest one again.


class SampleBoxes(NamedTuple):
    """Samples (n, 3) with unit normals (n, 3), neighbours near each other in their order, and the boxes about them.

    Box i holds the boxes 2i and 2i + 1, box 1 all; the last half of the boxes ``low`` and ``high`` (2k, 3) holds LEAF
    samples each, in their order. A box without samples has infinite limits.
    """

    samples: Floats
    normals: Floats
    low: Floats
    high: Floats


class Known(NamedTuple):
    """What is known of the nearest samples of points (n,), numbers in the boxes' order, -1 where none was found.

    ``first`` (n,) is the nearest one, ``near`` (n, NEAR) those nearest to where the point was ``searched`` (n, 3), and
    ``other`` (n,) the least distance of any other sample from there.
    """

    first: Ints
    near: Ints
    other: Floats
    searched: Floats


def boxes_of(points: Floats, normals: Floats) -> SampleBoxes:
    """Put boxes about samples (n, 3) with unit normals (n, 3)."""
    row = np.asarray(cKDTree(points, leafsize=LEAF // 2, balanced_tree=False).indices, np.int64)
    samples = points[row]
    leaves = 1 << max(int(np.ceil(np.log2(max(len(row) / LEAF, 1.0)))), 0)
    low, high = np.full((2 * leaves, 3), np.inf), np.full((2 * leaves, 3), -np.inf)
    starts = np.arange(0, len(row), LEAF)
    low[leaves : leaves + len(starts)] = np.minimum.reduceat(samples, starts)
    high[leaves : leaves + len(starts)] = np.maximum.reduceat(samples, starts)
    while leaves > 1:
        half = leaves // 2
        low[half:leaves] = low[leaves : 2 * leaves].reshape(half, 2, 3).min(axis=1)
        high[half:leaves] = high[leaves : 2 * leaves].reshape(half, 2, 3).max(axis=1)
        leaves = half
    return SampleBoxes(samples, normals[row], low, high)


def nothing_known(count: int) -> Known:
    """Return what is known of ``count`` points before any search."""
    return Known(
        first=np.full(count, -1, np.int64),
        near=np.full((count, NEAR), -1, np.int64),
        other=np.full(count, -np.inf),
        searched=np.zeros((count, 3)),
    )


@njit(cache=True, nogil=True)
def find_partners(boxes, placed, reach, known, within):  # type: ignore[no-untyped-def]
    """Bring the nearest samples of points (n, 3) up to date in ``known``; ``within`` (n,) marks those in ``reach``.

    A search finds some of the nearest samples. While a point has moved by less than any other one is farther away than
    the nearest of these, that one is the nearest of all (triangle inequality).
    """
    stack, away, squares = np.empty(STACK, np.int64), np.empty(STACK), np.empty(NEAR + 1)
    samples, (first, near, other, searched) = boxes.samples, known
    last = -1  # neighbours among the points often have the same partner
    for row in range(len(placed)):
        x, y, z = placed[row, 0], placed[row, 1], placed[row, 2]
        best, first[row] = np.inf, -1
        for m in range(NEAR):
            at = near[row, m]
            if at >= 0:
                square = _square(samples, at, x, y, z)
                if square < best:
                    best, first[row] = square, at
        left = other[row] - np.sqrt(_square(searched, row, x, y, z)) - SURE_MM
        if left <= np.sqrt(best) and min(left, np.sqrt(best)) < reach:
            if near[row, 0] < 0:
                near[row, 0] = last
            other[row] = _search(boxes, x, y, z, reach, near[row], squares, stack, away)
            searched[row, 0], searched[row, 1], searched[row, 2] = x, y, z
            first[row], best = near[row, 0], squares[0] if near[row, 0] >= 0 else np.inf
        within[row] = np.sqrt(best) < reach
        last = first[row]


@inner
def _search(boxes, x, y, z, reach, near, squares, stack, away):  # type: ignore[no-untyped-def]
    """Write the samples (NEAR,) nearest to (x, y, z) within ``reach``, -1 for none, and the squares of distances.

    Those given are the bounds to begin with. Return the least distance of any other sample, at most ``reach``.
    """
    samples, low, high = boxes.samples, boxes.low, boxes.high
    for m in range(NEAR + 1):
        squares[m] = reach * reach
    for m in range(NEAR):  # each is put among those before it
        at, near[m] = near[m], -1
        if at >= 0:
            _insert(near, squares, at, _square(samples, at, x, y, z))
    leaves, count = len(low) // 2, len(samples)
    stack[0], away[0], depth = 1, 0.0, 1
    while depth:
        depth -= 1
        box = stack[depth]
        if away[depth] >= squares[NEAR]:
            continue
        while box < leaves:
            left, right = _from_box(low, high, 2 * box, x, y, z), _from_box(low, high, 2 * box + 1, x, y, z)
            box *= 2
            if right < left:
                box += 1
                left, right = right, left
            if right < squares[NEAR]:
                stack[depth], away[depth] = box ^ 1, right
                depth += 1
            if left >= squares[NEAR]:
                break
        if box < leaves or _from_box(low, high, box, x, y, z) >= squares[NEAR]:
            continue
        for at in range((box - leaves) * LEAF, min((box - leaves + 1) * LEAF, count)):
            square = _square(samples, at, x, y, z)
            if square < squares[NEAR]:
                _insert(near, squares, at, square)
    return np.sqrt(squares[NEAR])


@njit(cache=True, nogil=True, inline="always")
def _insert(near, squares, at, square):  # type: ignore[no-untyped-def]
    """Put a sample among the nearest (NEAR,) by the square of its distance, if it is not one of them."""
    for m in range(NEAR):
        if near[m] == at:
            return
    if square >= squares[NEAR]:
        return
    m = NEAR
    while m > 0 and squares[m - 1] > square:
        squares[m] = squares[m - 1]
        if m < NEAR:
            near[m] = near[m - 1]
        m -= 1
    squares[m] = square
    if m < NEAR:
        near[m] = at


@njit(cache=True, nogil=True, inline="always")
def _square(points, row, x, y, z):  # type: ignore[no-untyped-def]
    a, b, c = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
    return a * a + b * b + c * c


@njit(cache=True, nogil=True, inline="always")
def _from_box(low, high, box, x, y, z):  # type: ignore[no-untyped-def]
    """Return the square of the distance of (x, y, z) from a box, infinite for one without samples."""
    a = max(low[box, 0] - x, x - high[box, 0], 0.0)
    b = max(low[box, 1] - y, y - high[box, 1], 0.0)
    c = max(low[box, 2] - z, z - high[box, 2], 0.0)
    return a * a + b * b + c * c
