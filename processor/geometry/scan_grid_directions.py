"""Directions of the rays of a scanner's grid, including those without a return."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.geometry import rigid
from processor.model import Floats, Ints


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


def fitted(points: Floats, row: Ints, column: Ints) -> Rays | None:
    """Fit the rays of a scanner to points (n, 3) about it; None for too few points or rows.

    The axis of rotation is the direction to which the points of a row have a constant angle.
    """
    on = np.flatnonzero((row >= 0) & (column >= 0))
    if len(on) < 100:
        return None
    u = points[on] / np.maximum(np.linalg.norm(points[on], axis=1), 1e-9)[:, None]
    r, c = row[on], column[on]
    rows, columns = int(r.max()) + 1, int(c.max()) + 1
    number = np.bincount(r, minlength=rows)
    mean = np.stack([np.bincount(r, u[:, i], rows) for i in range(3)], axis=1) / np.maximum(number, 1)[:, None]
    deviation = u - mean[r]
    axis = np.linalg.eigh(deviation.T @ deviation)[1][:, 0]
    occupied = number > 0
    if occupied.sum() < 2:
        return None
    angles = np.arcsin(np.clip((mean @ axis)[occupied], -1.0, 1.0))  # scanners step by equal angles
    heights = np.sin(np.interp(np.arange(rows), np.flatnonzero(occupied), angles, left=np.nan, right=np.nan))
    e1, e2 = rigid.axes_across(axis)
    x, y = np.bincount(c, u @ e1, columns), np.bincount(c, u @ e2, columns)
    turn = np.where(np.bincount(c, minlength=columns) > 0, np.arctan2(y, x), np.nan)
    return Rays(np.stack([e1, e2, axis], axis=1), heights, turn)


def unanswered(rays: Rays, row: Ints, column: Ints) -> Floats:
    """Directions (m, 3) of the grid's places without a point: rays without a return."""
    on = (row >= 0) & (column >= 0)
    empty: npt.NDArray[np.bool_] = np.ones((len(rays.height), len(rays.turn)), np.bool_)
    empty[row[on], column[on]] = False
    empty[:, ~np.isfinite(rays.turn)] = False
    empty[~np.isfinite(rays.height)] = False
    return rays.of(*np.nonzero(empty))
