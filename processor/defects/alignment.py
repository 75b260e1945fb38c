"""Alignment of stations to each other, and of the whole to the design; what remains is the structure's own deviation.

Stations that see one place must agree, whatever the structure's deviation there: this gives a small movement and a
range offset of each station. How large these are as a rule is estimated with them, as variance components: stations
that hardly share a surface are not moved by more than those that agree show. The whole is then fitted to the design
with redescending weights, as components that moved are few. What stations leave undetermined is carried into the
variance of every place.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from processor.adjustment import robust_least_squares, scanner_class_errors
from processor.adjustment.body_motions import distance_derivative, transform_about, variances
from processor.adjustment.elimination import eliminate
from processor.defects.observations import Pairs
from processor.defects.surface_charts import CYLINDER, DesignSurface
from processor.geometry import rigid
from processor.model import Bools, Columns, Floats, Ints
from processor.robust_statistics import CAUCHY, cauchy, robust_sd
from processor.views import Views

BLOCK_MM = 80.0  # chosen: less than a plate's waves, so that a block has one deviation; many points in each
BLOCK_RAD = 0.25  # of a block around a tube: within it, a movement of the tube is nearly one deviation
# Largest and least standard deviations of a station's error: rotation (rad), translation (mm), range offset (mm).
PRIOR = np.array([2e-4] * 3 + [3.0] * 3 + [2.0])
LEAST_PRIOR = np.array([1e-6] * 3 + [0.02] * 3 + [0.02])  # 0.01 mm at 10 m, and 0.02 mm: no block shows as much
# Of the class of scanners, whose error of a view is a translation and a range offset, with the degrees of freedom that
# an uncertainty by a factor of two amounts to: two or three stations hardly show their own standard deviations.
CLASS_SHARE = np.array([0.0] * 3 + [np.sqrt(0.5)] * 4)
CLASS_FREE = np.array([0.0] * 3 + [4.0] * 4)  # nothing is known of the class's rotation
GROUPS = (slice(0, 3), slice(3, 6), slice(6, 7))  # of parameters with one variance component each
WHOLE_PRIOR = np.array([5e-3] * 3 + [50.0] * 3)  # of the whole (rad, mm): as far as a coarse pose is off
FLOOR_MM = 0.15  # standard deviation of a block's mean: beams, encoders and the roughness of the steel
SHARED_MM = FLOOR_MM / 3.0  # error of a mean by another place: blocks of a face have it in common, noise not
FEWEST_COMPONENTS = 3  # to fit the whole by: of fewer, a component that moved cannot be identified
ROUNDS, STILL_MM = 12, 1e-4  # a step of the whole that moves all blocks by less is the last
MOST_ROUNDS, SETTLED = 40, 0.05  # of the stations' variance components, and the relative change of the last round
PAIRS_AT_ONCE = 1 << 18  # of cell and station, whose derivatives are in memory together
MOST_COUPLED = 3_000_000  # blocks times stations, beyond which stations are not fitted


@dataclass(frozen=True)
class Alignment:
    """Movements of stations and of the whole: rotations about ``centre`` (rad), translations and range offsets (mm).

    ``movements`` (k, 7) are of the stations, ``whole`` (6,) of everything; ``covariance`` (6, 6) is that of the whole
    if the stations' movements were known, ``station_covariance`` (7k, 7k) that of these. The whole moves by
    ``response`` (6, 7k) times an error of the stations' movements. Where it is not fitted, it would by
    ``free_response`` if it were fitted to all that was seen.
    """

    centre: Floats
    movements: Floats
    whole: Floats
    covariance: Floats
    fitted: bool
    station_covariance: Floats
    response: Floats
    free_response: Floats

    def corrections(self, points: Floats, outward: Floats, rays: Floats, station: Ints) -> Floats:
        """Return the corrections (n,) to subtract from deviations at points (n, 3) along unit rays (n, 3), mm."""
        J = distance_derivative(points - self.centre, outward, rays)
        correction: Floats = np.einsum("nk,nk->n", J, self.movements[station]) + J[:, :6] @ self.whole
        return correction

    def sd(self, points: Floats, outward: Floats) -> Floats:
        """Return the standard deviation (n,) of a deviation at points (n, 3) by the fit of the whole, mm."""
        sd: Floats = np.sqrt(variances(distance_derivative(points - self.centre, outward), self.covariance))
        return sd

    def pose_covariance(self) -> Floats:
        """Return the covariance (6, 6) of the whole about ``centre``, with what stations leave undetermined."""
        total: Floats = self.covariance + self.response @ self.station_covariance @ self.response.T
        return total


@dataclass(frozen=True)
class StationBlocks(Columns):
    """Observations of stations summed up by blocks of cells; ``variance`` is of the mean.

    ``cell`` is the cell nearest to the middle of the points of all stations: a place on the face, as the mean of places
    need not be. It is one for all, so that a movement which all stations have in common makes no difference.
    """

    block: Ints  # (n,)
    station: Ints
    mean: Floats
    variance: Floats
    cell: Ints


def none(surface: DesignSurface, stations: int, error_mm: float) -> Alignment:
    """Return the alignment that moves nothing; the whole has a standard deviation of ``error_mm`` along each axis."""
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.eye(3) * error_mm**2
    centre = surface.vertices.mean(axis=0)
    return Alignment(
        centre=centre,
        movements=np.zeros((stations, 7)),
        whole=np.zeros(6),
        covariance=covariance,
        fitted=False,
        station_covariance=np.zeros((7 * stations, 7 * stations)),
        response=np.zeros((6, 7 * stations)),
        free_response=np.zeros((6, 7 * stations)),
    )


def align(
    pairs: Pairs, surface: DesignSurface, stations: Views, error_mm: float, excluded: frozenset[int] = frozenset()
) -> Alignment:
    """Fit stations to each other, and the whole to the design if there are enough components.

    ``excluded`` are components that moved or are deformed: stations and whole are fitted by the others. What views that
    are not named have in common is added to the covariance by the class of scanners.
    """
    start = none(surface, len(stations.names), error_mm)
    blocks = _blocks(pairs, surface)
    if not len(blocks.block):
        return start
    points = surface.centres[blocks.cell]
    rays = rays_to(points, stations.positions[blocks.station])
    J = distance_derivative(points - start.centre, surface.outward[blocks.cell], rays)
    component = surface.component[blocks.cell]
    used = ~np.isin(component, sorted(excluded))
    enough = len(np.unique(component[used])) >= FEWEST_COMPONENTS
    compared = _of_one_place(blocks, J, points - start.centre, rays, component, surface)
    movements, station_covariance = station_movements(blocks.take(compared), J[compared], len(stations.names))
    start = replace(start, movements=movements, station_covariance=station_covariance)
    if not enough:
        # The gain (6, n) of a whole that all deviations would be fitted by
        of_whole = J[:, :6]
        weighted = of_whole.T / blocks.variance
        free: Floats = np.linalg.solve(weighted @ of_whole + np.diag(1.0 / WHOLE_PRIOR**2), weighted)
        return replace(start, free_response=_response(free, J, blocks.station, len(stations.names)))
    residual = blocks.mean - np.einsum("nk,nk->n", J, movements[blocks.station])
    whole, covariance, gain = _whole(residual[used], J[used, :6], component[used])
    if stations.unnamed:
        covariance = covariance + scanner_class_errors.pose_covariance(points[used] - start.centre)
    response = _response(gain, J[used], blocks.station[used], len(stations.names))
    return replace(start, whole=whole, covariance=covariance, fitted=True, response=response)


def _of_one_place(
    blocks: StationBlocks, J: Floats, arm: Floats, rays: Floats, component: Ints, surface: DesignSurface
) -> Bools:
    """Mark the blocks (n,) in which a station sees what others see there, to SHARED_MM; ``arm`` (n, 3) as for J.

    A point on a tube that lies elsewhere is given the place where its line of sight meets the tube as designed. That is
    off along the face by the deviation times the tangent of incidence, to either side for stations on either side, and
    the deviation changes along it as the tube moved. Each component is taken as a rigid body.
    """
    chart = surface.chart[blocks.cell]
    around = np.cross(surface.charts.axes[chart, 0], surface.outward[blocks.cell])
    out, along = np.zeros(len(blocks.mean)), np.zeros(len(blocks.mean))
    for number in np.unique(component):
        rows = component == number
        N, g = robust_least_squares.normal_equations(J[rows, :6], 1.0 / blocks.variance[rows], blocks.mean[rows])
        x = np.linalg.solve(N + np.diag(1.0 / WHOLE_PRIOR**2), g)
        out[rows], along[rows] = J[rows, :6] @ x, distance_derivative(arm[rows], around[rows]) @ x
    off = np.abs(blocks.mean * np.einsum("ni,ni->n", rays, around))
    with np.errstate(divide="ignore", invalid="ignore"):  # no station sees along its face; of planes nothing is asked
        turn = np.minimum(off / np.abs(J[:, 6]) / surface.charts.radius[chart], 0.5 * np.pi)
    error = np.abs(along) * np.sin(turn) + np.abs(out) * (1.0 - np.cos(turn))
    shared: Bools = (surface.charts.kind[chart] != CYLINDER) | (error <= SHARED_MM)
    return shared


def _response(gain: Floats, J: Floats, station: Ints, stations: int) -> Floats:
    """Return the movement (6, 7k) of a whole with a gain (6, n) by errors of the stations' movements."""
    response = np.zeros((6, 7 * stations))
    for k in range(stations):
        rows = np.flatnonzero(station == k)
        response[:, 7 * k : 7 * k + 7] = -gain[:, rows] @ J[rows]
    return response


def station_variance(
    pairs: Pairs, surface: DesignSurface, stations: Views, alignment: Alignment, free: bool = False
) -> Floats:
    """Return the variance (cells,) of the cells' deviations by errors of the stations' movements, mm2.

    If ``free``, the deviations are those from the best fit of the whole.
    """
    total = np.maximum(np.bincount(pairs.cell, pairs.count, len(surface.share)), 1.0)
    C, R = alignment.station_covariance, alignment.free_response if free else alignment.response
    CR, RCR, variance = C @ R.T, R @ C @ R.T, np.zeros(len(surface.share))
    for rows in _whole_cells(pairs.cell):
        cell, station = pairs.cell[rows], pairs.station[rows]
        points, outward = surface.centres[cell], surface.outward[cell]
        J = distance_derivative(points - alignment.centre, outward, rays_to(points, stations.positions[station]))
        quadratic_forms(cell, station, pairs.count[rows] / total[cell], J, C, CR, RCR, variance)
    return variance


def _whole_cells(cell: Ints) -> Iterator[slice]:
    """Yield slices of about PAIRS_AT_ONCE pairs sorted by cell (n,), all of a cell in one."""
    start = 0
    while start < len(cell):
        end = int(np.searchsorted(cell, cell[min(start + PAIRS_AT_ONCE, len(cell)) - 1], side="right"))
        yield slice(start, end)
        start = end


@njit(cache=True, nogil=True)
def quadratic_forms(
    cell: Ints, station: Ints, weight: Floats, J: Floats, C: Floats, CR: Floats, RCR: Floats, variance: Floats
) -> None:
    """Fill the form g C g' of each cell into (cells,), g = sum over its pairs of weight J + the cell's J[:6] R.

    ``J`` (n, 7) of pairs sorted by cell; C (7k, 7k) covariance, CR (7k, 6) and RCR (6, 6) its products with R (6, 7k).
    """
    start, n = 0, len(cell)
    while start < n:
        end = start
        while end < n and cell[end] == cell[start]:
            end += 1
        total = 0.0
        for i in range(start, end):
            a = 7 * station[i]
            for p in range(7):
                row = 0.0
                for j in range(start, end):
                    b = 7 * station[j]
                    for q in range(7):
                        row += weight[j] * J[j, q] * C[a + p, b + q]
                for q in range(6):
                    row += 2.0 * J[i, q] * CR[a + p, q]
                total += weight[i] * J[i, p] * row
        for p in range(6):
            for q in range(6):
                total += J[start, p] * J[start, q] * RCR[p, q]
        variance[cell[start]] = max(total, 0.0)
        start = end


def corrected_pose(T_design_project: Floats, alignment: Alignment) -> Floats:
    """Return the pose less the movement of the whole."""
    moved = transform_about(alignment.whole, alignment.centre)
    T: Floats = rigid.invert(moved) @ T_design_project
    return T


def rays_to(points: Floats, positions: Floats) -> Floats:
    """Return unit rays (n, 3) from scanners (n, 3) to points; zero where a scanner's position is unknown."""
    arm = points - positions
    rays: Floats = np.nan_to_num(arm / np.linalg.norm(arm, axis=1)[:, None])
    return rays


def _blocks(pairs: Pairs, surface: DesignSurface) -> StationBlocks:
    """Sum up pairs of cell and station by blocks of cells."""
    charts = surface.charts
    chart = surface.chart[pairs.cell]
    used = pairs.count > 0
    u, v = np.divmod(pairs.cell - charts.first[chart], charts.shape[chart, 1])
    wide = np.where(charts.kind == CYLINDER, np.minimum(BLOCK_MM, BLOCK_RAD * charts.radius), BLOCK_MM)
    side = np.maximum(1, np.round(np.stack([np.full_like(wide, BLOCK_MM), wide], axis=1) / charts.cell_mm))
    side = side.astype(np.int64)
    across = -(-charts.shape // side)
    first = np.concatenate([[0], np.cumsum(across.prod(axis=1))])[:-1]
    block = first[chart] + u // side[chart, 0] * across[chart, 1] + v // side[chart, 1]
    stations = int(pairs.station.max(initial=0)) + 1
    key, index = np.unique((block * stations + pairs.station)[used], return_inverse=True)
    index = index.reshape(-1)
    weight = pairs.count[used].astype(float)
    count = np.bincount(index, weight)
    mean = np.bincount(index, weight * pairs.mean[used]) / count
    dof = np.maximum(np.bincount(index, np.maximum(weight - 1.0, 0.0)), 1.0)
    square = np.bincount(index, pairs.square[used]) / dof
    _, of_block = np.unique(block[used], return_inverse=True)
    of_block = of_block.reshape(-1)
    total = np.bincount(of_block, weight)
    last, group = np.empty(len(key), np.int64), np.empty(len(key), np.int64)
    last[index], group[index] = np.flatnonzero(used), of_block
    middle_u, middle_v = (
        np.round(np.bincount(of_block, weight * x[used]) / total).astype(np.int64)[group] for x in (u, v)
    )
    c = chart[last]
    cell = charts.first[c] + middle_u * charts.shape[c, 1] + middle_v
    return StationBlocks(
        block=key // stations,
        station=key % stations,
        mean=mean,
        variance=square / count + FLOOR_MM**2,
        cell=cell,
    )


def station_movements(blocks: StationBlocks, J: Floats, stations: int) -> tuple[Floats, Floats]:
    """Return the movements (k, 7) by which stations agree, with Cauchy's weights, and their covariance (7k, 7k).

    The deviation of a block is free. The movements' standard deviations are variance components of maximum likelihood
    (expectation maximisation, Dempster et al. 1977), from PRIOR down, moderated by the class. Where stations do not
    show one at all, as a single station does not, nothing is moved: an error that stations share is stated by the
    parameters.
    """
    _, block = np.unique(blocks.block, return_inverse=True)
    block = block.reshape(-1)
    count = int(block.max()) + 1
    x: Floats = np.zeros((stations, 7))
    covariance: Floats = np.zeros((7 * stations, 7 * stations))
    if count * stations >= MOST_COUPLED:
        return x, covariance
    seen = np.bincount(blocks.station, minlength=stations) > 0
    prior = PRIOR.copy()
    weight = 1.0 / blocks.variance
    for iteration in range(MOST_ROUNDS):
        residual = blocks.mean - np.einsum("nk,nk->n", J, x[blocks.station])
        middle = np.bincount(block, weight * residual) / np.bincount(block, weight)
        weight = cauchy((residual - middle[block]) / np.sqrt(blocks.variance) / CAUCHY) / blocks.variance
        N, g = _normal_equations(blocks, J, block, weight, stations)
        covariance = np.asarray(np.linalg.inv(N + np.diag(np.tile(1.0 / prior**2, stations))), np.float64)
        x = (covariance @ g).reshape(stations, 7)
        remaining = np.diag(covariance).reshape(stations, 7)
        before = prior.copy()
        for group in GROUPS:
            known = 1.0 - remaining[:, group] / prior[group] ** 2
            undetermined = iteration == 0 and known.sum() < 1.0
            expected = (x**2 + remaining)[seen, group]
            free = CLASS_FREE[group][0]
            square = free * (CLASS_SHARE[group][0] * scanner_class_errors.known().view_mm) ** 2 + float(expected.sum())
            size = 0.0 if undetermined else float(np.sqrt(square / (free + expected.size)))
            prior[group] = max(size, LEAST_PRIOR[group][0])
        if iteration >= ROUNDS - 1 and np.abs(prior / before - 1.0).max() < SETTLED:
            break
    return x, covariance


def _normal_equations(
    blocks: StationBlocks, J: Floats, block: Ints, weight: Floats, stations: int
) -> tuple[Floats, Floats]:
    """Return the normal equations (7k, 7k), (7k,) of the stations, reduced by the deviation of each block."""
    N, g = np.zeros((7 * stations, 7 * stations)), np.zeros(7 * stations)
    columns = 7 * blocks.station[:, None] + np.arange(7)
    for k in range(stations):
        own, rows = slice(7 * k, 7 * k + 7), blocks.station == k
        N[own, own], g[own] = robust_least_squares.normal_equations(J[rows], weight[rows], blocks.mean[rows])
    inverse = 1.0 / np.bincount(block, weight)
    right = np.bincount(block, weight * blocks.mean)
    eliminate(block, columns, (weight[:, None] * J)[:, :, None], inverse[:, None, None], right[:, None], N, g)
    return N, g


def _whole(deviation: Floats, J: Floats, component: Ints) -> tuple[Floats, Floats, Floats]:
    """Return the movement (6,) of the whole, with redescending weights, its covariance, and its gain (6, n).

    The movement is the gain times the deviations. A component has a weight as well as each of its blocks: of one that
    moved, faces along the movement do not deviate, and its other faces may be the largest of their direction.

    The covariance follows from the scatter between components (sandwich estimator), plus that of the fit itself.
    """
    prior = np.diag(1.0 / WHOLE_PRIOR**2)
    number = np.unique(component, return_inverse=True)[1].reshape(-1)

    def weights(x: Floats) -> Floats:
        residual = deviation - J @ x
        rms = np.sqrt(np.bincount(number, residual**2) / np.bincount(number))
        of_component = cauchy(rms / (CAUCHY * max(float(np.median(rms)), FLOOR_MM)))
        relative: Floats = (of_component[number] * cauchy(residual / (CAUCHY * robust_sd(residual, FLOOR_MM)))) ** 2
        return relative

    def scaled(x: Floats, relative: Floats) -> tuple[Floats, Floats, Floats]:
        """Return weights (n,) by the scale of the residuals at x, and the normal equations."""
        weight = relative / robust_sd(deviation - J @ x, FLOOR_MM) ** 2
        N, g = robust_least_squares.normal_equations(J, weight, deviation)
        return weight, N + prior, g

    def solved(x: Floats, relative: Floats) -> Floats:
        _, N, g = scaled(x, relative)
        return np.asarray(np.linalg.solve(N, g))

    def is_still(step: Floats) -> bool:
        return bool(np.abs(J @ step).max() < STILL_MM)

    x, relative = robust_least_squares.reweighted(np.zeros(6), weights, solved, 4 * ROUNDS, is_still)
    weight, N, _ = scaled(x, relative)
    inverse, gradient = np.asarray(np.linalg.inv(N)), J * (weight * (deviation - J @ x))[:, None]
    covariance = robust_least_squares.sandwich(inverse, gradient, component) + inverse
    return x, covariance, inverse @ (weight[:, None] * J).T
