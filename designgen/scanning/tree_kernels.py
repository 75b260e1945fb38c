"""Compiled kernels of the ray caster: rays of the scanner's grid against triangles in a tree, in float64.

As in :mod:`designgen.scanning.ray_kernels`, a kernel works on one strip on its own.
"""
# Numba infers the types of the arguments: the kernels have no annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from designgen.scanning.ray_kernels import direction, elevations, hit
from designgen.scanning.surfaces import TRIANGLE
from designgen.scanning.triangle_tree import STACK, Tree, enters
from processor.model import Floats, Ints

NO_CUTS = np.empty((0, 4))  # a triangle has no caps cut off


class TreeView(NamedTuple):
    """A tree from a scanner's place: its boxes are in the scene's frame, its triangles in the scanner's."""

    tree: Tree
    corners: Floats  # (f, 9) in the order of the tree, scanner's frame
    shape: Ints  # (f,) rows of Surfaces
    R_scene_scanner: Floats  # (3, 3)
    place: Floats  # (3,) of the scanner in the scene


@njit(cache=True, nogil=True)
def nearest(view, dx, dy, dz, far, shape, guess, stack, ranges):  # type: ignore[no-untyped-def]
    """Return range, shape and place in the tree of the nearest hit nearer than ``far``, else the values given.

    ``dx, dy, dz`` is the direction in the scanner's frame. ``guess`` is a place in the tree that is tested first, as
    that of the ray before; -1 = none.
    """
    tree, corners, owner, R, o = view
    box, child, first, last = tree.box, tree.child, tree.first, tree.last
    found = -1
    if guess >= 0:
        t = hit(TRIANGLE, corners[guess], NO_CUTS, 0, 0, dx, dy, dz)
        if t < far or (t == far and owner[guess] < shape):
            far, shape, found = t, owner[guess], guess
    x = R[0, 0] * dx + R[0, 1] * dy + R[0, 2] * dz
    y = R[1, 0] * dx + R[1, 1] * dy + R[1, 2] * dz
    z = R[2, 0] * dx + R[2, 1] * dy + R[2, 2] * dz
    ix = 1.0 / x if x != 0.0 else np.inf
    iy = 1.0 / y if y != 0.0 else np.inf
    iz = 1.0 / z if z != 0.0 else np.inf
    stack[0], ranges[0], top = 0, enters(box, 0, o[0], o[1], o[2], ix, iy, iz, far), 1
    while top:
        top -= 1
        node = stack[top]
        if ranges[top] > far * (1.0 + 1e-9) or ranges[top] == np.inf:
            continue
        c = child[node]
        if c >= 0:
            a = enters(box, c, o[0], o[1], o[2], ix, iy, iz, far)
            b = enters(box, c + 1, o[0], o[1], o[2], ix, iy, iz, far)
            # The nearer one is visited first.
            if a <= b:
                c, a, b, other = c + 1, b, a, c
            else:
                other = c + 1
            if a < np.inf:
                stack[top], ranges[top] = c, a
                top += 1
            if b < np.inf:
                stack[top], ranges[top] = other, b
                top += 1
            continue
        for i in range(first[node], last[node]):
            t = hit(TRIANGLE, corners[i], NO_CUTS, 0, 0, dx, dy, dz)
            if t < far or (t == far and owner[i] < shape):
                far, shape, found = t, owner[i], i
    return far, shape, found


@njit(cache=True, nogil=True)
def covered(windows, first, width, side, rows):  # type: ignore[no-untyped-def]
    """Mark the rays (width + 2 side, rows) of a strip that lie in windows (b, 5)."""
    mask = np.zeros((width + 2 * side, rows), np.bool_)
    for b in range(len(windows)):
        for column in range(max(windows[b, 1], first - side), min(windows[b, 2], first + width - 1 + side) + 1):
            mask[column - first + side, windows[b, 3] : windows[b, 4] + 1] = True
    return mask


@njit(cache=True, nogil=True)
def cast(view, windows, strip, grid, rays, beside, shape, best):  # type: ignore[no-untyped-def]
    """Replace shape and range (width + 2 side, rows) of each ray of a strip where the tree has a nearer hit.

    ``windows`` (b, 5) are those of nodes that hold all triangles; the other arguments are those of
    :func:`designgen.scanning.ray_kernels.cast`.
    """
    _, first, width, side = strip
    jitter, _, _, max_range = rays
    rows = jitter.shape[1]
    mask = covered(windows, first, width, side, rows)
    used = min(width, grid.columns - first)
    level, rise = elevations(grid, rows)
    stack, ranges = np.empty(STACK, np.int64), np.empty(STACK)
    for column in range(first - side, first + used + side):
        j, guess = column - first + side, -1
        outside = max(first - column, column - first - used + 1)
        azimuth = 2.0 * np.pi * column / grid.columns
        ca, sa = np.cos(azimuth), np.sin(azimuth)
        for row in range(rows):
            if not mask[j, row] or outside > beside[row]:
                continue
            dx, dy, dz = direction(ca, sa, level[row], rise[row], jitter[j, row, 0], jitter[j, row, 1])
            far = min(best[j, row], max_range * (1.0 + 1e-15))
            t, i, found = nearest(view, dx, dy, dz, far, shape[j, row], guess, stack, ranges)
            if found >= 0:
                best[j, row], shape[j, row] = t, i
            guess = found


@njit(cache=True, nogil=True)
def cast_around(view, strip, grid, rays, number, angle, offsets, shape, best):  # type: ignore[no-untyped-def]
    """Replace shape and range (m, k) of sub-rays where the tree has a nearer hit.

    The arguments are those of :func:`designgen.scanning.ray_kernels.cast_around`.
    """
    _, first, width, side = strip
    jitter, _, _, max_range = rays
    rows = number.shape[1]
    level, rise = elevations(grid, rows)
    stack, ranges = np.empty(STACK, np.int64), np.empty(STACK)
    for column in range(first, first + width):
        j, guess = column - first + side, -1
        azimuth = 2.0 * np.pi * column / grid.columns
        ca, sa = np.cos(azimuth), np.sin(azimuth)
        for row in range(rows):
            ray = number[j, row]
            if ray < 0:
                continue
            for o in range(len(offsets)):
                da = jitter[j, row, 0] + angle[ray] * offsets[o, 0]
                de = jitter[j, row, 1] + angle[ray] * offsets[o, 1]
                dx, dy, dz = direction(ca, sa, level[row], rise[row], da, de)
                far = min(best[ray, o], max_range * (1.0 + 1e-15))
                t, i, found = nearest(view, dx, dy, dz, far, shape[ray, o], guess, stack, ranges)
                if found >= 0:
                    best[ray, o], shape[ray, o] = t, i
                guess = found
