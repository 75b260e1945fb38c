"""Linearity and direction of the voxels about each voxel."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats, Ints
from processor.space_frame.points.voxels import SIDE, Voxels

SMALL2, LARGE2 = 6, 17  # squared radii of the two windows, voxels
HALO = 4  # voxels: the radius of the larger window
WIDE = SIDE + 2 * HALO  # of a block with what lies about it
LEAST_VOXELS = 4  # three axes of a scatter and a mean take four


class Linearity(NamedTuple):
    """Of each voxel's window: 1 - sqrt(second / first eigenvalue) (v,), the first axis (v, 3) and the mean (v, 3)."""

    values: Floats
    directions: Floats
    means: Floats


@njit(cache=True, nogil=True)
def principal(a, b, c, d, e, f):  # type: ignore[no-untyped-def]
    """First two eigenvalues and first axis of [[a, d, e], [d, b, f], [e, f, c]], in closed form."""
    q = (a + b + c) / 3.0
    p2 = (a - q) ** 2 + (b - q) ** 2 + (c - q) ** 2 + 2.0 * (d * d + e * e + f * f)
    p = np.sqrt(p2 / 6.0)
    if p == 0.0:
        return q, q, 1.0, 0.0, 0.0
    A, B, C, D, E, F = (a - q) / p, (b - q) / p, (c - q) / p, d / p, e / p, f / p
    half = 0.5 * (A * (B * C - F * F) - D * (D * C - F * E) + E * (D * F - B * E))
    angle = np.arccos(min(1.0, max(-1.0, half))) / 3.0
    first = q + 2.0 * p * np.cos(angle)
    third = q + 2.0 * p * np.cos(angle + 2.0 * np.pi / 3.0)
    second = 3.0 * q - first - third
    # The longest cross product of two rows of (M - first I) is along the axis.
    r0x, r1y, r2z = a - first, b - first, c - first
    x0, y0, z0 = d * f - e * r1y, e * d - r0x * f, r0x * r1y - d * d
    x1, y1, z1 = d * r2z - e * f, e * e - r0x * r2z, r0x * f - d * e
    x2, y2, z2 = r1y * r2z - f * f, f * e - d * r2z, d * f - r1y * e
    n0, n1, n2 = x0 * x0 + y0 * y0 + z0 * z0, x1 * x1 + y1 * y1 + z1 * z1, x2 * x2 + y2 * y2 + z2 * z2
    if n0 >= n1 and n0 >= n2:
        x, y, z, n = x0, y0, z0, n0
    elif n1 >= n2:
        x, y, z, n = x1, y1, z1, n1
    else:
        x, y, z, n = x2, y2, z2, n2
    if n <= 0.0:
        return first, second, 1.0, 0.0, 0.0
    n = np.sqrt(n)
    return first, second, x / n, y / n, z / n


@njit(cache=True, nogil=True)
def fill(local, block, voxels):  # type: ignore[no-untyped-def]
    """Write the rows of the voxels in a block and its halo to ``local`` (WIDE, WIDE, WIDE); -1 = empty."""
    local[:] = -1
    cells, corner = voxels.cells, voxels.blocks[block]
    x0, y0, z0 = corner[0] * SIDE - HALO, corner[1] * SIDE - HALO, corner[2] * SIDE - HALO
    for k in range(27):
        other = voxels.beside[block, k]
        if other < 0:
            continue
        for i in range(voxels.starts[other], voxels.starts[other + 1]):
            x, y, z = cells[i, 0] - x0, cells[i, 1] - y0, cells[i, 2] - z0
            if 0 <= x < WIDE and 0 <= y < WIDE and 0 <= z < WIDE:
                local[x, y, z] = i


@njit(cache=True, nogil=True)
def window(local, means, x, y, z, ball, stop, out):  # type: ignore[no-untyped-def]
    """Moments of the voxel means in the first ``stop`` places of a ball about a voxel of ``local``."""
    i0 = local[x, y, z]
    ox, oy, oz = means[i0, 0], means[i0, 1], means[i0, 2]
    n = 0
    sx = sy = sz = xx = yy = zz = xy = xz = yz = 0.0
    for k in range(stop):
        i = local[x + ball[k, 0], y + ball[k, 1], z + ball[k, 2]]
        if i < 0:
            continue
        dx, dy, dz = means[i, 0] - ox, means[i, 1] - oy, means[i, 2] - oz
        n += 1
        sx += dx
        sy += dy
        sz += dz
        xx += dx * dx
        yy += dy * dy
        zz += dz * dz
        xy += dx * dy
        xz += dx * dz
        yz += dy * dz
    sx, sy, sz = sx / n, sy / n, sz / n
    out[0], out[1], out[2] = xx / n - sx * sx, yy / n - sy * sy, zz / n - sz * sz
    out[3], out[4], out[5] = xy / n - sx * sy, xz / n - sx * sz, yz / n - sy * sz
    out[6], out[7], out[8] = ox + sx, oy + sy, oz + sz
    return n


@njit(cache=True, nogil=True)
def measure(voxels, ball, small, least, linear, first, last):  # type: ignore[no-untyped-def]
    """Fill in linearity, axis and mean of the voxels of blocks first..last; the large window where the small fails."""
    local = np.empty((WIDE, WIDE, WIDE), np.int32)
    values, axes, centres = linear
    cells, blocks = voxels.cells, voxels.blocks
    m = np.empty(9)
    for block in range(first, last):
        fill(local, block, voxels)
        for i in range(voxels.starts[block], voxels.starts[block + 1]):
            x = cells[i, 0] - blocks[block, 0] * SIDE + HALO
            y = cells[i, 1] - blocks[block, 1] * SIDE + HALO
            z = cells[i, 2] - blocks[block, 2] * SIDE + HALO
            for scale in range(2):
                n = window(local, voxels.means, x, y, z, ball, small if scale == 0 else len(ball), m)
                if n < LEAST_VOXELS:
                    continue
                l1, l2, dx, dy, dz = principal(m[0], m[1], m[2], m[3], m[4], m[5])
                value = 1.0 - np.sqrt(max(l2, 0.0) / l1) if l1 > 0.0 else 0.0
                if value > values[i]:
                    values[i] = value
                    axes[i, 0], axes[i, 1], axes[i, 2] = dx, dy, dz
                    centres[i, 0], centres[i, 1], centres[i, 2] = m[6], m[7], m[8]
                if values[i] >= least:
                    break


def ball(radius2: int) -> Ints:
    """Offsets (k, 3) in voxels within a squared radius, nearest first."""
    reach = int(np.sqrt(radius2))
    every = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    square = (every**2).sum(axis=1)
    order = np.argsort(square, kind="stable")
    offsets: Ints = every[order[square[order] <= radius2]]
    return offsets


def linearity(voxels: Voxels, least: float, threads: int = 0) -> Linearity:
    """Return the linearity of each voxel's window: the small one, and the large one where that is below ``least``."""
    offsets = ball(LARGE2)
    small = len(ball(SMALL2))
    linear = Linearity(np.zeros(len(voxels.cells)), np.zeros((len(voxels.cells), 3)), voxels.means.copy())
    over_ranges(partial(measure, voxels, offsets, small, least, linear), len(voxels.blocks), threads)
    return linear
