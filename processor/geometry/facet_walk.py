"""Compiled: from a facet near each point over smooth edges to the facet that the point's foot is on."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def feet(points, start, vertices, faces, normals, neighbours, steps, face, distance, beyond, first, last):  # type: ignore[no-untyped-def]
    """Walk from facets ``start`` (n,), -1 = none, at most ``steps`` facets far; for points first..last.

    Writes the facet, the signed distance from it, and how far the foot lies beyond its face's edge, mm.
    """
    share = np.empty(3)
    for i in range(first, last):
        at = start[i]
        if at < 0:
            continue
        side = barycentric(points[i], vertices, faces[at], share)
        for _ in range(steps):
            over = neighbours[at, side]
            if not (share[side] < -1e-9 and over >= 0):
                break
            at = over
            side = barycentric(points[i], vertices, faces[at], share)
        a = vertices[faces[at, 0]]
        off = 0.0
        for k in range(3):
            off += (points[i, k] - a[k]) * normals[at, k]
        face[i], distance[i] = at, off
        beyond[i] = -min(share[side], 0.0) * height(vertices, faces[at], side)


@njit(cache=True, nogil=True, inline="always")
def barycentric(point, vertices, corners, share):  # type: ignore[no-untyped-def]
    """Write the barycentric coordinates (3,) of a point's foot on a facet; returns the vertex with the least."""
    a, b, c = vertices[corners[0]], vertices[corners[1]], vertices[corners[2]]
    b0, b1, b2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    c0, c1, c2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    p0, p1, p2 = point[0] - a[0], point[1] - a[1], point[2] - a[2]
    n0, n1, n2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    square = n0 * n0 + n1 * n1 + n2 * n2
    share[1] = ((p1 * c2 - p2 * c1) * n0 + (p2 * c0 - p0 * c2) * n1 + (p0 * c1 - p1 * c0) * n2) / square
    share[2] = ((b1 * p2 - b2 * p1) * n0 + (b2 * p0 - b0 * p2) * n1 + (b0 * p1 - b1 * p0) * n2) / square
    share[0] = 1.0 - share[1] - share[2]
    least = 0
    for k in range(1, 3):
        if share[k] < share[least]:
            least = k
    return least


@njit(cache=True, nogil=True, inline="always")
def height(vertices, corners, side):  # type: ignore[no-untyped-def]
    """Height of a facet over the side opposite to a vertex."""
    a, b, c = vertices[corners[side]], vertices[corners[(side + 1) % 3]], vertices[corners[(side + 2) % 3]]
    b0, b1, b2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    c0, c1, c2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    n0, n1, n2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    base = np.sqrt((c0 - b0) ** 2 + (c1 - b1) ** 2 + (c2 - b2) ** 2)
    return np.sqrt(n0 * n0 + n1 * n1 + n2 * n2) / max(base, 1e-12)
