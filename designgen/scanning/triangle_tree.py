"""A tree of boxes over many triangles, for rays in any direction and for the scanner's grid.

Small or long and thin triangles, as of meshes of CAD bodies, cover few rays of their windows on the grid, so that a
tree is faster than windows. Hits are the same: the same test of a triangle in float64, and the nearest one counts.
"""
# Numba infers the types of the arguments: the kernels have no annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from processor.model import Bools, Floats, Ints

LEAF = 4  # triangles at which a node is not divided any more
BINS = 16  # work: places tried for a cut along an axis; more hardly improve a tree (Wald 2007)
MOST_DEPTH = 48  # of nodes divided by the surface area heuristic; deeper ones are halved
STACK = 160  # entries, two a level: MOST_DEPTH and the 32 of halving 4e9 triangles
SLACK = 1e-9  # of the largest coordinate: boxes are larger by it, as the test of a triangle has a slack, too
MORE, LEAST_MORE = 1, 300_000  # pieces of long triangles in addition: by the number of triangles, and at least
MOST_PIECES = 64  # of a triangle
TOP = 512  # number of nodes whose windows are drawn onto the grid


class Tree(NamedTuple):
    """The nodes of a tree. Node k has the triangles ``order[first[k]:last[k]]``; long ones are in several nodes.

    ``box`` (k, 6) are the lowest and highest coordinates; ``child[k]`` is the first of its two children, -1 for a leaf.
    """

    order: Ints  # (r,) rows of the triangles
    box: Floats  # (k, 6)
    child: Ints
    first: Ints
    last: Ints

    def top(self) -> Ints:
        """Return about TOP nodes that hold all triangles together."""
        nodes = np.zeros(1, np.int64)
        while len(nodes) < TOP and (self.child[nodes] >= 0).any():
            inner = nodes[self.child[nodes] >= 0]
            nodes = np.concatenate([nodes[self.child[nodes] < 0], self.child[inner], self.child[inner] + 1])
        return nodes


def build(corners: Floats) -> Tree:
    """Return the tree of triangles (f, 3, 3)."""
    rows, low, high = _cut(corners)
    order, child, first, last = _divided(low, high, 0.5 * (low + high))
    slack = SLACK * float(np.abs(corners).max(initial=1.0))
    return Tree(rows[order], _boxes(low, high, order, child, first, last, slack), child, first, last)


def _cut(corners: Floats) -> tuple[Ints, Floats, Floats]:
    """Return rows (r,) of triangles and boxes, low and high (r, 3), of pieces across the longest edges of long ones.

    The box of a long triangle that runs askew is mostly empty; those of its pieces are not.
    """
    lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    turn = (np.argmax(lengths, axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, turn[:, :, None], axis=1), 1, 0)
    box = np.ptp(corners, axis=1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    empty = box[:, 0] * box[:, 1] + box[:, 1] * box[:, 2] + box[:, 2] * box[:, 0] - area
    longest, budget = np.where(empty > area, lengths.max(axis=1), 0.0), MORE * len(corners) + LEAST_MORE
    piece = float(longest.max(initial=0.0)) / MOST_PIECES + 1e-300
    while (count := np.clip(np.ceil(longest / piece), 1, MOST_PIECES)).sum() - len(corners) > budget:
        piece *= 1.3
    number = count.astype(np.int64)
    rows = np.repeat(np.arange(len(corners)), number)
    start = (np.arange(len(rows)) - np.repeat(np.cumsum(number) - number, number)) / number[rows]
    end = start + 1.0 / number[rows]
    along = b - a
    foot = np.einsum("ni,ni->n", c - a, along) / np.maximum(np.einsum("ni,ni->n", along, along), 1e-300)
    foot = np.clip(foot, 0.0, 1.0)[rows]
    a, c, along = a[rows], c[rows], along[rows]
    low, high = np.full((len(rows), 3), np.inf), np.full((len(rows), 3), -np.inf)
    for share in (start, end, np.clip(foot, start, end)):
        on_edge = a + share[:, None] * along
        # Of the line across the longest edge, at the other two edges.
        before = share / np.maximum(foot, 1e-300)
        after = (1.0 - share) / np.maximum(1.0 - foot, 1e-300)
        weight = np.minimum(np.minimum(before, after), 1.0)[:, None]
        across = on_edge + weight * (c - a - foot[:, None] * along)
        for points in (on_edge, across):
            low, high = np.minimum(low, points), np.maximum(high, points)
    whole = (number == 1)[rows]
    low[whole], high[whole] = corners[rows[whole]].min(axis=1), corners[rows[whole]].max(axis=1)
    return rows, low, high


def free(tree: Tree, corners: Floats, start: Floats, end: Floats, margin_mm: float) -> Bools:
    """Return whether nothing lies between points (n, 3) and (n, 3), but nearer than ``margin_mm`` to either end.

    ``corners`` (f, 3, 3) are the triangles in the order of the tree.
    """
    result: Bools = _free(tree, corners.reshape(-1, 9), start, end, margin_mm)
    return result


@njit(cache=True, nogil=True)
def _divided(low, high, middle):  # type: ignore[no-untyped-def]
    """Return the order of the triangles, and child, first and last of each node; children come after their parents."""
    count = len(low)
    most = 2 * count + 2
    order, depth = np.arange(count), np.zeros(most, np.int32)
    first, last, child = np.zeros(most, np.int64), np.zeros(most, np.int64), np.full(most, -1, np.int64)
    last[0], nodes, node = count, 1, 0
    counts, boxes, areas = np.zeros(BINS, np.int64), np.empty((BINS, 6)), np.empty(BINS)
    while node < nodes:
        a, z = first[node], last[node]
        if z - a > LEAF:
            least, most_ = np.full(3, np.inf), np.full(3, -np.inf)
            for i in range(a, z):
                for k in range(3):
                    m = middle[order[i], k]
                    least[k], most_[k] = min(least[k], m), max(most_[k], m)
            axis = np.argmax(most_ - least)
            span, cut = most_[axis] - least[axis], a
            if span > 0.0 and depth[node] < MOST_DEPTH:
                counts[:] = 0
                boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
                scale = BINS * (1.0 - 1e-9) / span
                for i in range(a, z):
                    row = order[i]
                    b = int((middle[row, axis] - least[axis]) * scale)
                    counts[b] += 1
                    for k in range(3):
                        boxes[b, k] = min(boxes[b, k], low[row, k])
                        boxes[b, 3 + k] = max(boxes[b, 3 + k], high[row, k])
                best, edge = np.inf, 0
                _sweep(boxes, counts, areas)  # cost of all bins from each on
                box, number = np.array([np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf]), 0
                for b in range(BINS - 1):
                    for k in range(3):
                        box[k], box[3 + k] = min(box[k], boxes[b, k]), max(box[3 + k], boxes[b, 3 + k])
                    number += counts[b]
                    if 0 < number < z - a:
                        cost = _area(box) * number + areas[b + 1]
                        if cost < best:
                            best, edge = cost, b + 1
                i, j = a, z - 1
                while i <= j:
                    if int((middle[order[i], axis] - least[axis]) * scale) < edge:
                        i += 1
                    else:
                        order[i], order[j] = order[j], order[i]
                        j -= 1
                cut = i
            if cut <= a or cut >= z:
                cut = a + (z - a) // 2
                rows = order[a:z].copy()
                order[a:z] = rows[np.argsort(middle[rows, axis], kind="mergesort")]
            child[node] = nodes
            first[nodes], last[nodes], depth[nodes] = a, cut, depth[node] + 1
            first[nodes + 1], last[nodes + 1], depth[nodes + 1] = cut, z, depth[node] + 1
            nodes += 2
        node += 1
    return order, child[:nodes].copy(), first[:nodes].copy(), last[:nodes].copy()


@njit(cache=True, nogil=True)
def _area(box):  # type: ignore[no-untyped-def]
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x


@njit(cache=True, nogil=True)
def _sweep(boxes, counts, costs):  # type: ignore[no-untyped-def]
    box, number = np.array([np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf]), 0
    for b in range(BINS - 1, -1, -1):
        for k in range(3):
            box[k], box[3 + k] = min(box[k], boxes[b, k]), max(box[3 + k], boxes[b, 3 + k])
        number += counts[b]
        costs[b] = _area(box) * number if number else 0.0


@njit(cache=True, nogil=True)
def _boxes(low, high, order, child, first, last, slack):  # type: ignore[no-untyped-def]
    box = np.empty((len(child), 6))
    for node in range(len(child) - 1, -1, -1):
        c = child[node]
        for k in range(3):
            if c >= 0:
                box[node, k] = min(box[c, k], box[c + 1, k])
                box[node, 3 + k] = max(box[c, 3 + k], box[c + 1, 3 + k])
            else:
                box[node, k], box[node, 3 + k] = np.inf, -np.inf
                for i in range(first[node], last[node]):
                    box[node, k] = min(box[node, k], low[order[i], k] - slack)
                    box[node, 3 + k] = max(box[node, 3 + k], high[order[i], k] + slack)
    return box


@njit(cache=True, nogil=True)
def enters(box, node, ox, oy, oz, ix, iy, iz, far):  # type: ignore[no-untyped-def]
    """Return the range at which a ray enters a node's box; infinite if beyond ``far`` or never.

    ``ix``, ``iy`` and ``iz`` are the inverses of the direction; a NaN, of a ray in the plane of a side, bounds nothing.
    """
    a, b = (box[node, 0] - ox) * ix, (box[node, 3] - ox) * ix
    near, end = min(a, b), max(a, b)
    near = near if near > 0.0 else 0.0
    end = end if end < far else far
    a, b = (box[node, 1] - oy) * iy, (box[node, 4] - oy) * iy
    low, high = min(a, b), max(a, b)
    near, end = (low if low > near else near), (high if high < end else end)
    a, b = (box[node, 2] - oz) * iz, (box[node, 5] - oz) * iz
    low, high = min(a, b), max(a, b)
    near, end = (low if low > near else near), (high if high < end else end)
    return near if near <= end * (1.0 + 1e-12) else np.inf


@njit(cache=True, nogil=True)
def _range(n, px, py, pz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the range at which a ray meets a triangle n (9,), and the determinant, which is negative on entry."""
    e1x, e1y, e1z = n[3] - n[0], n[4] - n[1], n[5] - n[2]
    e2x, e2y, e2z = n[6] - n[0], n[7] - n[1], n[8] - n[2]
    qx, qy, qz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
    det = e1x * qx + e1y * qy + e1z * qz
    if det == 0.0:
        return np.inf, det
    sx, sy, sz = px - n[0], py - n[1], pz - n[2]
    u = (sx * qx + sy * qy + sz * qz) / det
    if u < 0.0 or u > 1.0:
        return np.inf, det
    rx, ry, rz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
    v = (dx * rx + dy * ry + dz * rz) / det
    if v < 0.0 or u + v > 1.0:
        return np.inf, det
    return (e2x * rx + e2y * ry + e2z * rz) / det, det


@njit(cache=True, nogil=True)
def _free(tree, corners, start, end, margin):  # type: ignore[no-untyped-def]
    _, box, child, first, last = tree
    result = np.ones(len(start), np.bool_)
    stack = np.empty(STACK, np.int64)
    for r in range(len(start)):
        ox, oy, oz = start[r, 0], start[r, 1], start[r, 2]
        dx, dy, dz = end[r, 0] - ox, end[r, 1] - oy, end[r, 2] - oz
        share = margin / max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-300)
        ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
        stack[0], top = 0, 1
        while top and result[r]:
            top -= 1
            node = stack[top]
            if enters(box, node, ox, oy, oz, ix, iy, iz, 1.0) == np.inf:
                continue
            if child[node] >= 0:
                stack[top], stack[top + 1] = child[node], child[node] + 1
                top += 2
                continue
            for i in range(first[node], last[node]):
                t, _ = _range(corners[i], ox, oy, oz, dx, dy, dz)
                if share < t < 1.0 - share:
                    result[r] = False
                    break
    return result


@njit(cache=True, nogil=True)
def _inverse(x):  # type: ignore[no-untyped-def]
    return 1.0 / x if x != 0.0 else np.inf
