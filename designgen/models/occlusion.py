"""A tree of boxes over triangles, and which lines of sight between pairs of points are free.

The scanner's own caster sweeps an angular grid from one place. Here few rays leave each of many places, for which a
tree is faster. Compiled kernels in float64.
"""
# Numba infers the types of the arguments: the kernels have no annotations.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from designgen.designs.patch import Bools
from processor.model import Floats, Ints

LEAF = 4  # most triangles of a leaf
DEPTH = 64  # of the stack: halves of 2^60 triangles


@dataclass(frozen=True, kw_only=True)
class Tree:
    """Triangles in the order of the tree, and its nodes.

    Node k has the box ``low``, ``high`` and the triangles ``first[k]`` to ``last[k]``; ``child[k]`` is the number of
    the first of its two halves, -1 for a leaf.
    """

    corners: Floats  # (f, 3, 3)
    order: Ints  # (f,) rows of the triangles as given
    low: Floats  # (k, 3)
    high: Floats  # (k, 3)
    first: Ints
    last: Ints
    child: Ints

    def free(self, start: Floats, end: Floats, margin_mm: float) -> Bools:
        """Return whether nothing lies between points (n, 3) and (n, 3), but nearer than ``margin_mm`` to either end."""
        result: Bools = _free(
            start, end, margin_mm, self.corners, self.low, self.high, self.first, self.last, self.child
        )
        return result

    def crossings(self, points: Floats, direction: Floats) -> Ints:
        """Return the number of triangles (n,) that rays from points (n, 3) along one direction (3,) cross."""
        result: Ints = _crossings(
            points, direction, self.corners, self.low, self.high, self.first, self.last, self.child
        )
        return result


def tree(corners: Floats) -> Tree:
    """Return the tree of triangles (f, 3, 3): boxes halved at the median of the middles along their longest side."""
    middles = corners.mean(axis=1)
    order, first, last, child = _halved(middles)
    ordered = np.ascontiguousarray(corners[order])
    low, high = _boxes(ordered, first, last, child)
    return Tree(corners=ordered, order=order, low=low, high=high, first=first, last=last, child=child)


@njit(cache=True, nogil=True)
def _halved(middles):  # type: ignore[no-untyped-def]
    """Return the order of the triangles, and first, last and first child of each node."""
    count = len(middles)
    most = 4 * (count // LEAF + 1) + 8
    order = np.arange(count)
    first, last = np.zeros(most, np.int64), np.zeros(most, np.int64)
    child = np.full(most, -1, np.int64)
    last[0], nodes, node = count, 1, 0
    while node < nodes:  # children come after their parents
        a, z = first[node], last[node]
        if z - a > LEAF:
            rows = order[a:z]
            best, axis = -1.0, 0
            for k in range(3):
                least, largest = np.inf, -np.inf
                for i in rows:
                    least, largest = min(least, middles[i, k]), max(largest, middles[i, k])
                if largest - least > best:
                    best, axis = largest - least, k
            values = np.empty(z - a)
            for i in range(z - a):
                values[i] = middles[rows[i], axis]
            order[a:z] = rows[np.argsort(values, kind="mergesort")]
            half = a + (z - a) // 2
            child[node] = nodes
            first[nodes], last[nodes] = a, half
            first[nodes + 1], last[nodes + 1] = half, z
            nodes += 2
        node += 1
    return order, first[:nodes].copy(), last[:nodes].copy(), child[:nodes].copy()


@njit(cache=True, nogil=True)
def _boxes(corners, first, last, child):  # type: ignore[no-untyped-def]
    nodes = len(first)
    low, high = np.full((nodes, 3), np.inf), np.full((nodes, 3), -np.inf)
    for node in range(nodes - 1, -1, -1):
        for k in range(3):
            if child[node] < 0:
                for i in range(first[node], last[node]):
                    for c in range(3):
                        low[node, k] = min(low[node, k], corners[i, c, k])
                        high[node, k] = max(high[node, k], corners[i, c, k])
            else:
                a, b = child[node], child[node] + 1
                low[node, k], high[node, k] = min(low[a, k], low[b, k]), max(high[a, k], high[b, k])
    return low, high


@njit(cache=True, nogil=True)
def _meets_box(o, inverse, low, high, near, far):  # type: ignore[no-untyped-def]
    for k in range(3):
        a, b = (low[k] - o[k]) * inverse[k], (high[k] - o[k]) * inverse[k]
        # A NaN, of a ray in the plane of a side, leaves the bounds as they are.
        if a > b:
            a, b = b, a
        near = a if a > near else near
        far = b if b < far else far
    return near <= far


@njit(cache=True, nogil=True)
def _range(o, d, c):  # type: ignore[no-untyped-def]
    """Return the range in units of d at which a ray meets a triangle (3, 3); infinite if none."""
    e1x, e1y, e1z = c[1, 0] - c[0, 0], c[1, 1] - c[0, 1], c[1, 2] - c[0, 2]
    e2x, e2y, e2z = c[2, 0] - c[0, 0], c[2, 1] - c[0, 1], c[2, 2] - c[0, 2]
    px, py, pz = d[1] * e2z - d[2] * e2y, d[2] * e2x - d[0] * e2z, d[0] * e2y - d[1] * e2x
    det = e1x * px + e1y * py + e1z * pz
    if det == 0.0:
        return np.inf
    sx, sy, sz = o[0] - c[0, 0], o[1] - c[0, 1], o[2] - c[0, 2]
    u = (sx * px + sy * py + sz * pz) / det
    if u < 0.0 or u > 1.0:
        return np.inf
    qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
    v = (d[0] * qx + d[1] * qy + d[2] * qz) / det
    if v < 0.0 or u + v > 1.0:
        return np.inf
    return (e2x * qx + e2y * qy + e2z * qz) / det


@njit(cache=True, nogil=True)
def _free(start, end, margin, corners, low, high, first, last, child):  # type: ignore[no-untyped-def]
    result = np.ones(len(start), np.bool_)
    stack = np.empty(DEPTH, np.int64)
    for r in range(len(start)):
        o, d = start[r], end[r] - start[r]
        length = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        near, far = margin / max(length, 1e-300), 1.0 - margin / max(length, 1e-300)
        inverse = 1.0 / d
        stack[0], top = 0, 1
        while top and result[r]:
            top -= 1
            node = stack[top]
            if not _meets_box(o, inverse, low[node], high[node], near, far):
                continue
            if child[node] >= 0:
                stack[top], stack[top + 1] = child[node], child[node] + 1
                top += 2
                continue
            for i in range(first[node], last[node]):
                t = _range(o, d, corners[i])
                if near < t < far:
                    result[r] = False
                    break
    return result


@njit(cache=True, nogil=True)
def _crossings(points, d, corners, low, high, first, last, child):  # type: ignore[no-untyped-def]
    result = np.zeros(len(points), np.int64)
    stack = np.empty(DEPTH, np.int64)
    inverse = 1.0 / d
    for r in range(len(points)):
        stack[0], top = 0, 1
        while top:
            top -= 1
            node = stack[top]
            if not _meets_box(points[r], inverse, low[node], high[node], 0.0, np.inf):
                continue
            if child[node] >= 0:
                stack[top], stack[top + 1] = child[node], child[node] + 1
                top += 2
                continue
            for i in range(first[node], last[node]):
                t = _range(points[r], d, corners[i])
                if 0.0 < t < np.inf:
                    result[r] += 1
    return result
