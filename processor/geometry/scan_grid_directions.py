"""Directions of the rays of a scanner's grid, including those without a return."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from processor import large_arrays
from processor.geometry import rigid
from processor.model import Bools, Floats, Ints, Labels

LEAST_POINTS = 100  # on the grid


@dataclass(frozen=True)
class Rays:
    """Rays by rows and columns: ``height`` (rows,) along the scanner's axis of rotation, ``turn`` (columns,) about it.

    ``axes`` (3, 3) has two directions across and the axis as columns. The turn of a column without points is NaN. The
    angle of a row without points is interpolated between its neighbours.
    """

    axes: Floats
    height: Floats
    turn: Floats

    def of(self, row: Ints, column: Ints) -> Floats:
        """Return unit vectors (n, 3) of places in the grid; NaN where the direction is unknown."""
        inside = (row >= 0) & (row < len(self.height))
        height = np.where(inside, self.height[np.where(inside, row, 0)], np.nan)
        turn = self.turn[column % len(self.turn)]
        flat = np.sqrt(np.maximum(1.0 - height**2, 0.0))
        local = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
        direction: Floats = local @ self.axes.T
        return direction


def fitted(points: Floats, row: Labels | Ints, column: Labels | Ints) -> Rays | None:
    """Fit the rays of a scanner to points (n, 3) about it; None for too few points or rows.

    The axis of rotation is the direction to which the points of a row have a constant angle.
    """
    rows, columns = np.zeros(0, np.int64), np.zeros(0, np.int64)  # points of each
    for _, r, c in _directions(points, row, column):
        rows, columns = _counted(rows, r), _counted(columns, c)
    occupied = rows > 0
    if rows.sum() < LEAST_POINTS or occupied.sum() < 2:
        return None
    mean = np.zeros((len(rows), 3))
    for u, r, _ in _directions(points, row, column):
        mean += np.stack([np.bincount(r, u[:, i], len(rows)) for i in range(3)], axis=1)
    mean /= np.maximum(rows, 1)[:, None]
    scatter = np.zeros((3, 3))
    for u, r, _ in _directions(points, row, column):
        u -= mean[r]
        scatter += u.T @ u
    axis = np.linalg.eigh(scatter)[1][:, 0]
    angles = np.arcsin(np.clip((mean @ axis)[occupied], -1.0, 1.0))  # scanners step by equal angles
    heights = np.sin(np.interp(np.arange(len(rows)), np.flatnonzero(occupied), angles, left=np.nan, right=np.nan))
    e1, e2 = rigid.axes_across(axis)
    x, y = np.zeros(len(columns)), np.zeros(len(columns))
    for u, _, c in _directions(points, row, column):
        x += np.bincount(c, u @ e1, len(columns))
        y += np.bincount(c, u @ e2, len(columns))
    turn = np.where(columns > 0, np.arctan2(y, x), np.nan)
    return Rays(np.stack([e1, e2, axis], axis=1), heights, turn)


def _directions(points: Floats, row: Labels | Ints, column: Labels | Ints) -> Iterator[tuple[Floats, Ints, Ints]]:
    """Pass over the unit vectors (m, 3) to the points on the grid, their rows and columns (m,)."""
    for part in large_arrays.blocks(len(points), large_arrays.AT_ONCE):
        on = np.flatnonzero((row[part] >= 0) & (column[part] >= 0))
        u = points[part][on]
        u /= np.maximum(np.linalg.norm(u, axis=1), 1e-9)[:, None]
        yield u, row[part][on].astype(np.int64), column[part][on].astype(np.int64)


def _counted(count: Ints, numbers: Ints) -> Ints:
    """Add how often each of some numbers occurs to the counts (m,) of those before."""
    more = np.bincount(numbers, minlength=len(count))
    more[: len(count)] += count
    return more.astype(np.int64, copy=False)


def unanswered(rays: Rays, empty: Bools, first: int = 0) -> Floats:
    """Directions (m, 3) of the ``empty`` places of rows of the grid from row ``first`` on: rays without a return."""
    known = np.isfinite(rays.height[first : first + len(empty)])[:, None] & np.isfinite(rays.turn)
    row, column = np.nonzero(empty[: known.shape[0], : known.shape[1]] & known[:, : empty.shape[1]])
    return rays.of(first + row, column)
