"""Stations fitted to each other and the whole to the design, so that what is left is the structure's own.

Where several stations see one place they must agree, whatever is wrong with the structure there: from that each
station's small movement and range offset follow. The whole is then fitted to the design with weights that leave out
what does not fit: components that moved are few.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.defects.observations import Pairs, Stations
from processor.defects.surface_charts import DesignSurface
from processor.geometry import rigid
from processor.model import Floats, Ints

BLOCK_MM = 80.0
# Standard deviations of what a station may be off where nothing says otherwise: turn (rad), place (mm), range (mm).
PRIOR = np.array([2e-4] * 3 + [3.0] * 3 + [2.0])
WHOLE_PRIOR = np.array([5e-3] * 3 + [50.0] * 3)
FLOOR_MM = 0.15  # of a block's mean: beams, encoders and the steel's own surface
FEWEST_COMPONENTS = 3  # by which a whole is fitted: of fewer none can be told to be off
ROUNDS = 12
CAUCHY = 2.385


@dataclass(frozen=True)
class Alignment:
    """What each station and the whole were moved by: turns about ``centre`` (rad), translations and ranges (mm).

    ``moves`` (k, 7) are of the stations, ``whole`` (6,) of everything; ``covariance`` (6, 6) is that of the whole.
    """

    centre: Floats
    moves: Floats
    whole: Floats
    covariance: Floats
    fitted: bool

    def corrections(self, points: Floats, outward: Floats, rays: Floats, station: Ints) -> Floats:
        """Return what to take off deviations (n,) at points (n, 3) seen along unit rays (n, 3), mm."""
        J = _derivative(points - self.centre, outward, rays)
        found: Floats = np.einsum("nk,nk->n", J, self.moves[station]) + J[:, :6] @ self.whole
        return found

    def sd(self, points: Floats, outward: Floats) -> Floats:
        """Return the standard deviation (n,) that the fit of the whole leaves in a deviation at points (n, 3), mm."""
        J = _derivative(points - self.centre, outward, np.zeros_like(points))[:, :6]
        found: Floats = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, self.covariance, J), 0.0))
        return found


def none(surface: DesignSurface, stations: int, error_mm: float) -> Alignment:
    """Leave all where it is; the whole is known to ``error_mm`` along each axis."""
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.eye(3) * error_mm**2
    centre = surface.vertices.mean(axis=0)
    return Alignment(centre, np.zeros((stations, 7)), np.zeros(6), covariance, False)


def align(
    pairs: Pairs, surface: DesignSurface, stations: Stations, error_mm: float, apart: frozenset[int] = frozenset()
) -> Alignment:
    """Fit stations to each other, and where there are components enough the whole to the design.

    Components ``apart`` are known to have moved or bent: the whole is fitted by the others.
    """
    start = none(surface, len(stations.names), error_mm)
    block, station, mean, variance, place = _blocks(pairs, surface)
    if not len(block):
        return start
    points, outward = surface.centres[place], surface.outward[place]
    J = _derivative(points - start.centre, outward, rays_to(points, stations.positions[station]))
    moves = _between(block, station, mean, variance, J, len(stations.names))
    left = mean - np.einsum("nk,nk->n", J, moves[station])
    component = surface.charts.component[chart_of_cells(surface)[place]]
    used = ~np.isin(component, sorted(apart))
    if len(np.unique(component[used])) < FEWEST_COMPONENTS:
        return Alignment(start.centre, moves, start.whole, start.covariance, False)
    whole, covariance = _whole(left[used], variance[used], J[used, :6], component[used])
    return Alignment(start.centre, moves, whole, covariance, True)


def chart_of_cells(surface: DesignSurface) -> Ints:
    """Return the chart (cells,) of each cell."""
    return np.repeat(np.arange(len(surface.charts.kind)), surface.charts.shape.prod(axis=1))


def rays_to(points: Floats, positions: Floats) -> Floats:
    """Return unit rays (n, 3) from scanners (n, 3) to points; zero where a scanner's place is unknown."""
    arm = points - positions
    found: Floats = np.nan_to_num(arm / np.linalg.norm(arm, axis=1)[:, None])
    return found


def _derivative(arm: Floats, outward: Floats, rays: Floats) -> Floats:
    """Return the derivative (n, 7) of deviations by a turn about the centre, a translation and a longer range."""
    return np.hstack([np.cross(arm, outward), outward, np.einsum("ni,ni->n", rays, outward)[:, None]])


def _blocks(pairs: Pairs, surface: DesignSurface) -> tuple[Ints, Ints, Floats, Floats, Ints]:
    """Sum up pairs by blocks of cells: block, station, mean, its variance and the cell in the middle of the block."""
    charts = surface.charts
    chart = chart_of_cells(surface)[pairs.cell]
    used = pairs.count > 0
    at = pairs.cell - charts.first[chart]
    side = max(1, round(BLOCK_MM / charts.cell_mm))
    row, column = at // charts.shape[chart, 1] // side, at % charts.shape[chart, 1] // side
    across = -(-charts.shape // side)
    first = np.concatenate([[0], np.cumsum(across.prod(axis=1))])[:-1]
    block = first[chart] + row * across[chart, 1] + column
    stations = int(pairs.station.max(initial=0)) + 1
    key, index = np.unique((block * stations + pairs.station)[used], return_inverse=True)
    index = index.reshape(-1)
    weight = pairs.count[used].astype(float)
    count = np.bincount(index, weight)
    mean = np.bincount(index, weight * pairs.mean[used]) / count
    freedom = np.maximum(np.bincount(index, np.maximum(weight - 1.0, 0.0)), 1.0)
    square = np.bincount(index, pairs.square[used]) / freedom
    # The cell nearest to the middle of what was seen: a place on the face, where the mean of cells need not be one.
    own = np.flatnonzero(used)
    where = np.stack([np.bincount(index, weight * x[used]) / count for x in (at // charts.shape[chart, 1],
                                                                             at % charts.shape[chart, 1])])  # fmt: skip
    some = np.empty(len(key), np.int64)
    some[index] = own
    c = chart[some]
    place = (
        charts.first[c] + np.round(where[0]).astype(np.int64) * charts.shape[c, 1] + np.round(where[1]).astype(np.int64)
    )
    return key // stations, key % stations, mean, square / count + FLOOR_MM**2, place


def _between(block: Ints, station: Ints, mean: Floats, variance: Floats, J: Floats, stations: int) -> Floats:
    """Movements (k, 7) by which stations agree, with Cauchy's weights; the place of each block is free."""
    _, block = np.unique(block, return_inverse=True)
    block = block.reshape(-1)
    blocks = int(block.max()) + 1
    x = np.zeros((stations, 7))
    weight = 1.0 / variance
    for _ in range(ROUNDS):
        left = mean - np.einsum("nk,nk->n", J, x[station])
        total = np.bincount(block, weight, blocks)
        middle = np.bincount(block, weight * left, blocks) / total
        off = (left - middle[block]) / np.sqrt(variance)
        weight = 1.0 / variance / (1.0 + (off / CAUCHY) ** 2)
        # What a block says of stations is what is left when its own place is taken out.
        total = np.bincount(block, weight, blocks)
        A = np.diag(np.tile(1.0 / PRIOR**2, stations))
        right = np.zeros(7 * stations)
        mixed = np.zeros((blocks, 7 * stations)) if blocks * stations < 3_000_000 else None
        for k in range(stations):
            rows = station == k
            wJ = weight[rows, None] * J[rows]
            here = slice(7 * k, 7 * k + 7)
            A[here, here] += wJ.T @ J[rows]
            right[here] += wJ.T @ mean[rows]
            if mixed is not None:
                np.add.at(mixed[:, here], block[rows], wJ)
        if mixed is None:
            return x
        A -= mixed.T @ (mixed / total[:, None])
        right -= mixed.T @ (np.bincount(block, weight * mean, blocks) / total)
        x = np.asarray(np.linalg.solve(A, right), np.float64).reshape(stations, 7)
    return x


def _whole(left: Floats, variance: Floats, J: Floats, component: Ints) -> tuple[Floats, Floats]:
    """Movement (6,) of the whole and its covariance from how components differ; redescending weights."""
    x = np.zeros(6)
    prior = np.diag(1.0 / WHOLE_PRIOR**2)
    scale = max(1.4826 * float(np.median(np.abs(left))), FLOOR_MM)
    weight = np.ones(len(left))
    for _ in range(4 * ROUNDS):
        off = left - J @ x
        weight = 1.0 / (1.0 + (off / (CAUCHY * scale)) ** 2) ** 2
        A = J.T @ (weight[:, None] * J) / scale**2 + prior
        step = np.linalg.solve(A, J.T @ (weight * left) / scale**2) - x
        x = x + step
        off = left - J @ x
        scale = max(1.4826 * float(np.median(np.abs(off))), FLOOR_MM)
        if np.abs(J @ step).max() < 1e-4:
            break
    off = left - J @ x
    A = J.T @ (weight[:, None] * J) / scale**2 + prior
    pull = weight[:, None] * J * off[:, None] / scale**2
    groups = np.stack([np.bincount(component, pull[:, i], component.max() + 1) for i in range(6)], axis=1)
    inverse = np.linalg.inv(A)
    count = len(np.unique(component))
    covariance = inverse @ (groups.T @ groups) @ inverse * count / max(count - 6.0, 1.0) + inverse
    return x, covariance


def corrected_pose(T_design_project: Floats, alignment: Alignment) -> Floats:
    """Return the pose with the whole's movement taken off."""
    R = rigid.rotation_from_vector(-alignment.whole[:3])
    shift = alignment.centre - R @ alignment.centre - R @ alignment.whole[3:]
    found: Floats = rigid.transform(R, shift) @ T_design_project
    return found
