"""Straight stretches: sets of linear voxels that continue each other, and the line through each set."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from processor.inner_kernels import inner
from processor.model import Floats, Ints
from processor.space_frame.members.voxel_linearity import HALO, SMALL2, WIDE, Linearity, ball, fill, principal
from processor.space_frame.points.voxels import SIDE, Voxels

MOST_TURN = np.cos(np.deg2rad(12.0))  # between the axes of two windows of one tube
MOST_OFF = 0.45  # voxels: largest distance of the mean of one window from the axis of another on the same tube


@dataclass(frozen=True)
class Segments:
    """Lines (s,): ``points`` in the middle of the stretch seen, unit ``directions``, ``halves`` of its length, mm."""

    points: Floats
    directions: Floats
    halves: Floats

    @property
    def count(self) -> int:
        """Number of segments."""
        return len(self.points)


@inner
def root_of(parent, i):  # type: ignore[no-untyped-def]
    """Root of a set, halving the path to it."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def join(voxels, offsets, linear, least, most_off, parent):  # type: ignore[no-untyped-def]
    """Join linear voxels near each other whose windows lie on one line; a set's root is its first voxel."""
    local = np.empty((WIDE, WIDE, WIDE), np.int32)
    values, axes, centres = linear
    cells, blocks = voxels.cells, voxels.blocks
    for block in range(len(blocks)):
        fill(local, block, voxels)
        for i in range(voxels.starts[block], voxels.starts[block + 1]):
            if values[i] < least:
                continue
            x = cells[i, 0] - blocks[block, 0] * SIDE + HALO
            y = cells[i, 1] - blocks[block, 1] * SIDE + HALO
            z = cells[i, 2] - blocks[block, 2] * SIDE + HALO
            for k in range(len(offsets)):
                j = local[x + offsets[k, 0], y + offsets[k, 1], z + offsets[k, 2]]
                if j <= i or values[j] < least:
                    continue
                cos = axes[i, 0] * axes[j, 0] + axes[i, 1] * axes[j, 1] + axes[i, 2] * axes[j, 2]
                if abs(cos) < MOST_TURN:
                    continue
                sign = 1.0 if cos > 0.0 else -1.0
                ux, uy, uz = (
                    axes[i, 0] + sign * axes[j, 0],
                    axes[i, 1] + sign * axes[j, 1],
                    axes[i, 2] + sign * axes[j, 2],
                )
                dx, dy, dz = centres[j, 0] - centres[i, 0], centres[j, 1] - centres[i, 1], centres[j, 2] - centres[i, 2]
                along = dx * ux + dy * uy + dz * uz
                off2 = dx * dx + dy * dy + dz * dz - along * along / (ux * ux + uy * uy + uz * uz)
                if off2 > most_off * most_off:
                    continue
                a, b = root_of(parent, i), root_of(parent, j)
                if a < b:
                    parent[b] = a
                elif b < a:
                    parent[a] = b
    for i in range(len(parent)):
        parent[i] = root_of(parent, i)


def segments(voxels: Voxels, linear: Linearity, least: float, least_length_mm: float) -> Segments:
    """Join the voxels whose linearity is at least ``least``; lines shorter than ``least_length_mm`` are left out."""
    parent = np.arange(len(voxels.cells))
    join(voxels, ball(SMALL2)[1:], linear, least, MOST_OFF * voxels.size_mm, parent)
    rows = np.flatnonzero(linear.values >= least)
    order = rows[np.argsort(parent[rows], kind="stable")]
    _, first = np.unique(parent[order], return_index=True)
    return _lines(voxels.means[order], np.append(first, len(order)), least_length_mm)


@njit(cache=True, nogil=True)
def lines_of(means, starts, points, directions, halves):  # type: ignore[no-untyped-def]
    """Fill in the line through each set of means, rows starts[k] to starts[k + 1]."""
    for k in range(len(starts) - 1):
        cells = means[starts[k] : starts[k + 1]]
        n = len(cells)
        middle = np.zeros(3)
        for i in range(n):
            for j in range(3):
                middle[j] += cells[i, j] / n
        m = np.zeros(6)
        for i in range(n):
            x, y, z = cells[i, 0] - middle[0], cells[i, 1] - middle[1], cells[i, 2] - middle[2]
            m[0] += x * x / n
            m[1] += y * y / n
            m[2] += z * z / n
            m[3] += x * y / n
            m[4] += x * z / n
            m[5] += y * z / n
        _, _, dx, dy, dz = principal(m[0], m[1], m[2], m[3], m[4], m[5])
        low, high = np.inf, -np.inf
        for i in range(n):
            t = (cells[i, 0] - middle[0]) * dx + (cells[i, 1] - middle[1]) * dy + (cells[i, 2] - middle[2]) * dz
            low, high = min(low, t), max(high, t)
        # Of both directions the one whose largest component is positive.
        largest = dx if abs(dx) >= abs(dy) and abs(dx) >= abs(dz) else dy if abs(dy) >= abs(dz) else dz
        sign = 1.0 if largest > 0.0 else -1.0
        for j, d in enumerate((dx, dy, dz)):
            points[k, j] = middle[j] + 0.5 * (low + high) * d
            directions[k, j] = sign * d
        halves[k] = 0.5 * (high - low)


def _lines(means: Floats, starts: Ints, least_length_mm: float) -> Segments:
    count = len(starts) - 1
    points, directions, halves = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    lines_of(means, starts, points, directions, halves)
    keep = 2.0 * halves >= least_length_mm
    return Segments(points[keep], directions[keep], halves[keep])
