"""Faces near a place: every cell of a sparse grid lists the faces in and around it, so that one look is enough.

For thousands of poses tried, each with thousands of places: that is where the time of placing scans goes.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.model import Floats, Ints
from processor.stitching.planes.hashing import EMPTY, place
from processor.stitching.planes.samples import Elements

FIELD = 21  # bits of a cell's number along each axis
MASK = (1 << FIELD) - 1
KEPT = 4  # nearest faces that are asked


class Near(NamedTuple):
    """Faces (n, 3) with normals, and for each cell of an edge the rows of those within one cell of it."""

    points: Floats
    normals: Floats
    size: float
    shift: int  # of a mixed key, to its slot
    table: Ints  # (slots,) keys
    row: npt.NDArray[np.int32]  # (slots,) of ``starts``
    starts: Ints
    items: npt.NDArray[np.int32]


@njit(cache=True, nogil=True)
def _key(x, y, z):  # type: ignore[no-untyped-def]
    return ((x & MASK) << (2 * FIELD)) | ((y & MASK) << FIELD) | (z & MASK)


@njit(cache=True, nogil=True)
def listed(points, size, table, shift, row, starts, items, number):  # type: ignore[no-untyped-def]
    """List points (n, 3) with their own cell and the 26 around: first counts, then writes where there is room."""
    cells = number
    for i in range(len(points)):
        a = np.int64(np.floor(points[i, 0] / size))
        b = np.int64(np.floor(points[i, 1] / size))
        c = np.int64(np.floor(points[i, 2] / size))
        for u in range(-1, 2):
            for v in range(-1, 2):
                for w in range(-1, 2):
                    key = _key(a + u, b + v, c + w)
                    slot = place(table, key, shift)
                    if table[slot] == EMPTY:
                        table[slot] = key
                        row[slot] = cells
                        cells += 1
                    if len(items):
                        items[starts[row[slot]]] = i
                    starts[row[slot]] += 1
    return cells


@njit(cache=True, nogil=True)
def moved(table, row, keys, rows, shift):  # type: ignore[no-untyped-def]
    """Write a table into another one."""
    for i in range(len(table)):
        if table[i] != EMPTY:
            slot = place(keys, table[i], shift)
            keys[slot], rows[slot] = table[i], row[i]


def of_faces(faces: Elements, size_mm: float) -> Near:
    """List faces by cells of an edge, mm: what is nearer than that is found."""
    points = np.ascontiguousarray(faces.points)
    bits = max(1, int(2 * 27 * len(points)).bit_length())
    table, row = np.full(1 << bits, EMPTY, np.int64), np.zeros(1 << bits, np.int64)
    counts = np.zeros(27 * len(points), np.int64)
    cells = int(listed(points, size_mm, table, 64 - bits, row, counts, np.empty(0, np.int32), 0))
    starts = np.concatenate([[0], np.cumsum(counts[:cells])])
    items = np.empty(int(starts[-1]), np.int32)
    listed(points, size_mm, table, 64 - bits, row, starts[:-1].copy(), items, cells)
    # Cells lie over each other: a table for as many as there are is a tenth, and stays in the processor's cache.
    bits = max(1, int(2 * cells).bit_length())
    keys, rows = np.full(1 << bits, EMPTY, np.int64), np.zeros(1 << bits, np.int32)
    moved(table, row, keys, rows, 64 - bits)
    return Near(points, np.ascontiguousarray(faces.normals), size_mm, 64 - bits, keys, rows, starts, items)


@njit(cache=True, nogil=True)
def cell_of(near, x, y, z):  # type: ignore[no-untyped-def]
    """Row of ``starts`` of the cell around a place, -1 = nothing near."""
    size = near.size
    key = _key(np.int64(np.floor(x / size)), np.int64(np.floor(y / size)), np.int64(np.floor(z / size)))
    slot = place(near.table, key, near.shift)
    return near.row[slot] if near.table[slot] != EMPTY else -1


@njit(cache=True, nogil=True)
def nearest(near, x, y, z, bound2):  # type: ignore[no-untyped-def]
    """Row of the face nearest to a place, -1 = none within the root of ``bound2``."""
    found = -1
    at = cell_of(near, x, y, z)
    if at >= 0:
        for m in range(near.starts[at], near.starts[at + 1]):
            i = near.items[m]
            dx, dy, dz = near.points[i, 0] - x, near.points[i, 1] - y, near.points[i, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < bound2:
                bound2, found = d, i
    return found


@njit(cache=True, nogil=True)
def agreeing(near, T, points, normals, bound, off, like, out):  # type: ignore[no-untyped-def]
    """Mark (n,) faces that T brings onto one of the KEPT nearest: closer than ``off`` across it, looking its way."""
    rows, distance = np.empty(KEPT, np.int64), np.empty(KEPT)
    for k in range(len(points)):
        p, q, r = points[k, 0], points[k, 1], points[k, 2]
        x = T[0, 0] * p + T[0, 1] * q + T[0, 2] * r + T[0, 3]
        y = T[1, 0] * p + T[1, 1] * q + T[1, 2] * r + T[1, 3]
        z = T[2, 0] * p + T[2, 1] * q + T[2, 2] * r + T[2, 3]
        out[k] = False
        at = cell_of(near, x, y, z)
        if at < 0:
            continue
        distance[:] = bound * bound
        rows[:] = -1
        for m in range(near.starts[at], near.starts[at + 1]):
            i = near.items[m]
            dx, dy, dz = near.points[i, 0] - x, near.points[i, 1] - y, near.points[i, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < distance[KEPT - 1]:
                j = KEPT - 1
                while j > 0 and distance[j - 1] > d:
                    distance[j], rows[j] = distance[j - 1], rows[j - 1]
                    j -= 1
                distance[j], rows[j] = d, i
        p, q, r = normals[k, 0], normals[k, 1], normals[k, 2]
        a = T[0, 0] * p + T[0, 1] * q + T[0, 2] * r
        b = T[1, 0] * p + T[1, 1] * q + T[1, 2] * r
        c = T[2, 0] * p + T[2, 1] * q + T[2, 2] * r
        for j in range(KEPT):
            i = rows[j]
            if i < 0:
                break
            n = near.normals[i]
            dx, dy, dz = x - near.points[i, 0], y - near.points[i, 1], z - near.points[i, 2]
            across = abs(dx * n[0] + dy * n[1] + dz * n[2])
            if across < off and a * n[0] + b * n[1] + c * n[2] > like:
                out[k] = True
                break


@njit(cache=True, nogil=True)
def equations(small, large, T, points, normals, weight, bound, gate, like):  # type: ignore[no-untyped-def]
    """Point-to-plane normal equations of faces moved by T onto the nearest: H (6, 6), g (6,), centre, reach, how many.

    Turns about the centre, as movements at the reach: the root mean square distance from it. ``large`` is asked where
    ``small`` has nothing.
    """
    n = len(points)
    kept = np.empty((n, 8))
    count = 0
    centre = np.zeros(3)
    H, g = np.zeros((6, 6)), np.zeros(6)
    for k in range(n):
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
        turned = (
            m[0] * (T[0, 0] * p + T[0, 1] * q + T[0, 2] * r)
            + m[1] * (T[1, 0] * p + T[1, 1] * q + T[1, 2] * r)
            + m[2] * (T[2, 0] * p + T[2, 1] * q + T[2, 2] * r)
        )
        at = small.points[i]
        off = m[0] * (x - at[0]) + m[1] * (y - at[1]) + m[2] * (z - at[2])
        if turned <= like or abs(off) >= gate:
            continue
        kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
        kept[count, 3:6] = m
        kept[count, 6], kept[count, 7] = off, weight[k]
        centre += kept[count, :3]
        count += 1
    if count == 0:
        return H, g, centre, 1.0, 0
    centre /= count
    reach = 0.0
    for k in range(count):
        for i in range(3):
            reach += (kept[k, i] - centre[i]) ** 2
    reach = max(np.sqrt(reach / count), 1e-9)
    J = np.empty(6)
    for k in range(count):
        a, b, c = (kept[k, 0] - centre[0]) / reach, (kept[k, 1] - centre[1]) / reach, (kept[k, 2] - centre[2]) / reach
        u, v, w = kept[k, 3], kept[k, 4], kept[k, 5]
        J[0], J[1], J[2] = b * w - c * v, c * u - a * w, a * v - b * u
        J[3], J[4], J[5] = u, v, w
        for i in range(6):
            g[i] += kept[k, 7] * J[i] * kept[k, 6]
            for j in range(i + 1):
                H[i, j] += kept[k, 7] * J[i] * J[j]
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return H, g, centre, reach, count
