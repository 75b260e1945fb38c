"""Spatial index of patches: every cell of a sparse grid lists the patches in and around it, for a single look-up.

The coarse registration scores thousands of poses with thousands of patches each: most of its time is spent here.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry.point_grid import hash_table, slot_of
from processor.inner_kernels import inner
from processor.model import Floats, Ints
from processor.stitching.planes.grouped_sums import numbered
from processor.stitching.planes.sampled_patches import Patches

FIELD = 21  # bits of a cell's index along each axis
MASK = (1 << FIELD) - 1
NEAREST = 4  # patches that are compared with a transformed one


class FaceIndex(NamedTuple):
    """Patches (n, 3) with normals, and for each grid cell the rows of the patches within one cell of it."""

    points: Floats
    normals: Floats
    size: float  # edge of a cell, mm
    table: Ints  # (slots,) keys
    row: npt.NDArray[np.int32]  # (slots,) of ``starts``
    starts: Ints
    items: npt.NDArray[np.int32]


def build(patches: Patches, size_mm: float) -> FaceIndex:
    """Index patches by cells of edge ``size_mm``, which is also the largest distance that look-ups cover."""
    points = np.ascontiguousarray(patches.points)
    cell = np.floor(points / size_mm).astype(np.int64)[:, None] + np.array(list(np.ndindex(3, 3, 3))) - 1
    keys = (((cell[..., 0] & MASK) << FIELD | cell[..., 1] & MASK) << FIELD | cell[..., 2] & MASK).ravel()
    first, number = numbered(keys)
    table, row = hash_table(keys[first])
    return FaceIndex(
        points=points, normals=np.ascontiguousarray(patches.normals), size=size_mm, table=table,
        row=row.astype(np.int32), starts=np.concatenate([[0], np.cumsum(np.bincount(number))]),
        items=(np.argsort(number, kind="stable") // 27).astype(np.int32),
    )  # fmt: skip


@inner
def cell_of(index, x, y, z):  # type: ignore[no-untyped-def]
    """Return the row of ``starts`` of the cell around a point, -1 = no patch near."""
    size = index.size
    i, j, k = np.int64(np.floor(x / size)), np.int64(np.floor(y / size)), np.int64(np.floor(z / size))
    return index.row[slot_of(index.table, ((i & MASK) << FIELD | j & MASK) << FIELD | k & MASK)]


@njit(cache=True, nogil=True)
def nearest(index, x, y, z, bound2):  # type: ignore[no-untyped-def]
    """Return the row of the patch nearest to a point, -1 = none within the square root of ``bound2``."""
    row = -1
    at = cell_of(index, x, y, z)
    if at >= 0:
        for m in range(index.starts[at], index.starts[at + 1]):
            i = index.items[m]
            dx, dy, dz = index.points[i, 0] - x, index.points[i, 1] - y, index.points[i, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < bound2:
                bound2, row = d, i
    return row


@njit(cache=True, nogil=True)
def mark_matches(index, T, patches, bound, off, like, out):  # type: ignore[no-untyped-def]
    """Mark (n,) the patches that T brings onto an indexed one.

    Compared are the NEAREST within ``bound``: distance across below ``off``, cosine of normals above ``like``.
    """
    points, normals = patches.points, patches.normals
    rows, distance = np.empty(NEAREST, np.int64), np.empty(NEAREST)
    for k in range(len(points)):
        p, q, r = points[k, 0], points[k, 1], points[k, 2]
        x = T[0, 0] * p + T[0, 1] * q + T[0, 2] * r + T[0, 3]
        y = T[1, 0] * p + T[1, 1] * q + T[1, 2] * r + T[1, 3]
        z = T[2, 0] * p + T[2, 1] * q + T[2, 2] * r + T[2, 3]
        out[k] = False
        at = cell_of(index, x, y, z)
        if at < 0:
            continue
        distance[:] = bound * bound
        rows[:] = -1
        for m in range(index.starts[at], index.starts[at + 1]):
            i = index.items[m]
            dx, dy, dz = index.points[i, 0] - x, index.points[i, 1] - y, index.points[i, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < distance[NEAREST - 1]:
                j = NEAREST - 1
                while j > 0 and distance[j - 1] > d:
                    distance[j], rows[j] = distance[j - 1], rows[j - 1]
                    j -= 1
                distance[j], rows[j] = d, i
        p, q, r = normals[k, 0], normals[k, 1], normals[k, 2]
        a = T[0, 0] * p + T[0, 1] * q + T[0, 2] * r
        b = T[1, 0] * p + T[1, 1] * q + T[1, 2] * r
        c = T[2, 0] * p + T[2, 1] * q + T[2, 2] * r
        for j in range(NEAREST):
            i = rows[j]
            if i < 0:
                break
            n = index.normals[i]
            dx, dy, dz = x - index.points[i, 0], y - index.points[i, 1], z - index.points[i, 2]
            across = abs(dx * n[0] + dy * n[1] + dz * n[2])
            if across < off and a * n[0] + b * n[1] + c * n[2] > like:
                out[k] = True
                break


@inner
def _matches(small, large, T, patches, weight, bound, gate, like):  # type: ignore[no-untyped-def]
    """Find for each patch, transformed by T, the nearest indexed one: place, its normal, distance and weight (m, 8)."""
    points, normals = patches.points, patches.normals
    matched = np.empty((len(points), 8))
    count = 0
    for k in range(len(points)):
        p, q, r = points[k, 0], points[k, 1], points[k, 2]
        x = T[0, 0] * p + T[0, 1] * q + T[0, 2] * r + T[0, 3]
        y = T[1, 0] * p + T[1, 1] * q + T[1, 2] * r + T[1, 3]
        z = T[2, 0] * p + T[2, 1] * q + T[2, 2] * r + T[2, 3]
        i = nearest(small, x, y, z, min(bound, small.size) ** 2)
        if i < 0 and bound > small.size:
            i = nearest(large, x, y, z, bound * bound)
        if i < 0:
            continue
        m = small.normals[i]
        p, q, r = normals[k, 0], normals[k, 1], normals[k, 2]
        cosine = (
            m[0] * (T[0, 0] * p + T[0, 1] * q + T[0, 2] * r)
            + m[1] * (T[1, 0] * p + T[1, 1] * q + T[1, 2] * r)
            + m[2] * (T[2, 0] * p + T[2, 1] * q + T[2, 2] * r)
        )
        at = small.points[i]
        off = m[0] * (x - at[0]) + m[1] * (y - at[1]) + m[2] * (z - at[2])
        if cosine <= like or abs(off) >= gate:
            continue
        matched[count, 0], matched[count, 1], matched[count, 2] = x, y, z
        matched[count, 3], matched[count, 4], matched[count, 5] = m[0], m[1], m[2]
        matched[count, 6], matched[count, 7] = off, weight[k]
        count += 1
    return matched[:count]


@njit(cache=True, nogil=True)
def normal_equations(small, large, T, patches, weight, bound, gate, like):  # type: ignore[no-untyped-def]
    """Return point-to-plane normal equations of patches transformed by T onto the nearest indexed ones.

    H (6, 6), g (6,), centre (3,), reach and the number of matches. Rotations are about the centre of the matches, in mm
    at the reach, their root mean square distance from it. ``large`` is searched where ``small`` has no patch in reach.
    """
    matched = _matches(small, large, T, patches, weight, bound, gate, like)
    count = len(matched)
    centre = np.zeros(3)
    H, g = np.zeros((6, 6)), np.zeros(6)
    if count == 0:
        return H, g, centre, 1.0, 0
    for k in range(count):
        centre += matched[k, :3]
    centre /= count
    reach = 0.0
    for k in range(count):
        for i in range(3):
            reach += (matched[k, i] - centre[i]) ** 2
    reach = max(np.sqrt(reach / count), 1e-9)
    J = np.empty(6)
    for k in range(count):
        a = (matched[k, 0] - centre[0]) / reach
        b = (matched[k, 1] - centre[1]) / reach
        c = (matched[k, 2] - centre[2]) / reach
        u, v, w = matched[k, 3], matched[k, 4], matched[k, 5]
        J[0], J[1], J[2] = b * w - c * v, c * u - a * w, a * v - b * u
        J[3], J[4], J[5] = u, v, w
        for i in range(6):
            g[i] += matched[k, 7] * J[i] * matched[k, 6]
            for j in range(i + 1):
                H[i, j] += matched[k, 7] * J[i] * J[j]
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return H, g, centre, reach, count
