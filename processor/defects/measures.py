"""How large and how deep a region is."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from processor.defects.alignment import Alignment, rays_to
from processor.defects.deviation_field import Field
from processor.defects.observations import Observed, cells_of
from processor.defects.regions import Region, flat
from processor.defects.surface_charts import CYLINDER, DesignSurface
from processor.model import NORMAL_95, Floats, Ints

FIT_SHARE = 0.45  # of a region's radius, within which a paraboloid is fitted for its depth
CURVE_SHARE = 0.65  # of a region's radius, for its curvature
FEWEST_CELLS = 9
BORDER_CELLS = 1.6
VOLUME_BORDER = 0.25  # of a region's radius, that belongs to its volume


@dataclass(frozen=True)
class Measures:
    """Of a region: see :class:`processor.defects.result.Result`; ``borders`` are the sides of its face it reaches."""

    centre: Floats
    axes: Floats
    extent: Floats
    area: float
    depth: float
    depth_ci95: float
    mean: float
    volume: float
    volume_ci95: float
    edge: float
    curvature: float
    lod95: float
    diameter: float
    borders: int


def measure(
    region: Region, field: Field, surface: DesignSurface, alignment: Alignment, inflation: float, thickness: float
) -> Measures:
    """Measure a region on its face; what is missing is as deep as the plate is thick (mm)."""
    charts, cell = surface.charts, surface.charts.cell_mm
    uv = flat(surface, region)
    rows = region.cells
    area = surface.share[rows] * cell**2
    deviation, variance = field.deviation[rows], field.variance[rows]
    weight = area if region.sign == 0 else area * np.abs(deviation)
    middle = (uv * weight[:, None]).sum(axis=0) / max(weight.sum(), 1e-12)
    _, turn = np.linalg.eigh((uv - middle).T @ ((uv - middle) * area[:, None]) + 1e-9 * np.diag([1.0, 0.0]))
    along = (uv - middle) @ turn[:, ::-1]
    extent = np.ptp(along, axis=0) + cell
    # Width by area: a slim region that is not quite straight is not as wide as its box.
    extent[1] = min(extent[1], 4.0 / np.pi * area.sum() / extent[0] if len(rows) > FEWEST_CELLS else extent[1])
    nearest = int(rows[np.argmin(np.linalg.norm(uv - middle, axis=1))])
    axes = np.zeros((3, 3))
    out = surface.outward[nearest]
    frame = charts.axes[region.chart]
    side = np.cross(out, frame[0])
    axes[0] = turn[0, 1] * frame[0] + turn[1, 1] * side
    axes[1], axes[2] = np.cross(out, axes[0]), out
    registration = float(alignment.sd(surface.centres[nearest][None], out[None])[0])
    lod = NORMAL_95 * float(np.hypot(inflation / np.sqrt(np.sum(1.0 / np.maximum(variance, 1e-12))), registration))
    volume, volume_sd = _volume(region, field, surface)
    volume_sd *= inflation
    centre = surface.centres[nearest] + (middle - uv[np.argmin(np.linalg.norm(uv - middle, axis=1))]) @ np.stack(
        [frame[0], side]
    )
    edge, borders = _borders(region, surface, middle)
    diameter = float(2.0 * np.sqrt(area.sum() / np.pi))
    if region.sign == 0:
        lost = float(area.sum())
        ring = cell * np.sqrt(np.pi * lost)  # of cells that are missing in part
        return Measures(centre, axes, extent, lost, thickness, 0.0, thickness, lost * thickness,
                        NORMAL_95 * ring * thickness, edge, float("nan"), lod, diameter, borders)  # fmt: skip
    depth, depth_sd, curvature, mean_sd = _deepest(region, field, surface, inflation)
    lod = NORMAL_95 * float(np.hypot(mean_sd, registration))
    return Measures(
        centre, axes, extent, float(area.sum()), depth, NORMAL_95 * float(np.hypot(depth_sd, registration)),
        -float((deviation * area).sum() / area.sum()), volume,
        NORMAL_95 * float(np.hypot(volume_sd, registration * area.sum())), edge, curvature, lod, diameter, borders,
    )  # fmt: skip


def _curvature(at: Floats, value: Floats, w: Floats, inside: list[int], middle: Floats) -> float:
    """Return the larger curvature (1/m) of a paraboloid fitted to places (n, 2) ``inside``."""
    if len(inside) < 2 * FEWEST_CELLS:
        return float("nan")
    x, y = (at[inside] - middle).T
    columns = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)
    root = np.sqrt(w[inside])
    c = np.linalg.lstsq(root[:, None] * columns, root * value[inside], rcond=None)[0]
    H = np.array([[2.0 * c[3], c[4]], [c[4], 2.0 * c[5]]])
    return float(np.abs(np.linalg.eigvalsh(H)).max()) * 1000.0


def _volume(region: Region, field: Field, surface: DesignSurface) -> tuple[float, float]:
    """Volume inward and its standard deviation from noise, with a border about the region.

    What is too shallow there to be told from noise cell by cell still adds up.
    """
    charts, chart = surface.charts, region.chart
    mask = np.zeros(int(charts.shape[chart].prod()), bool)
    mask[region.cells - charts.first[chart]] = True
    wide = max(1, round(VOLUME_BORDER * float(np.sqrt(len(region.cells) / np.pi))))
    grown = ndimage.distance_transform_edt(~mask.reshape(tuple(charts.shape[chart]))) <= wide
    rows = charts.first[chart] + np.flatnonzero(grown.ravel())
    rows = rows[(field.seen[rows] > 0) | mask[rows - charts.first[chart]]]
    area = surface.share[rows] * charts.cell_mm**2
    return -float(field.deviation[rows] @ area), float(np.sqrt((field.variance[rows] * area**2).sum()))


def _deepest(
    region: Region, field: Field, surface: DesignSurface, inflation: float
) -> tuple[float, float, float, float]:
    """Depth at the deepest place, inward positive, its sd, the larger curvature (1/m), and the sd of a mean there.

    The vertex of a paraboloid fitted about it, with a term of the fourth order where there are cells enough.
    """
    uv, cell = flat(surface, region), surface.charts.cell_mm
    d, variance = field.deviation[region.cells], field.variance[region.cells]
    seen = field.seen[region.cells] > 0
    if seen.sum() < FEWEST_CELLS:
        use = seen if seen.any() else np.ones(len(d), bool)
        k = int(np.argmax(np.where(use, region.sign * d / np.sqrt(variance), -np.inf)))
        alone = float(np.sqrt(variance[k])) * inflation
        return -float(d[k]), alone, float("nan"), alone
    radius = max(np.sqrt(len(d) / np.pi), 1.0) * cell
    near = max(0.35 * radius, 1.01 * cell)
    tree = cKDTree(uv[seen])
    value, w, at = d[seen], 1.0 / variance[seen], uv[seen]
    near_by = tree.query_ball_point(at, near)
    smooth = np.array([np.sum(w[i] * value[i]) / np.sum(w[i]) for i in near_by])
    k = int(np.argmax(region.sign * smooth))
    plain, plain_sd = float(smooth[k]), float(1.0 / np.sqrt(w[near_by[k]].sum())) * inflation
    inside = tree.query_ball_point(at[k], max(FIT_SHARE * radius, 1.9 * cell))
    if len(inside) < FEWEST_CELLS:
        inside = tree.query(at[k], k=FEWEST_CELLS)[1].tolist()
    x, y = (at[inside] - at[k]).T / radius
    columns = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)
    if len(inside) >= 4 * FEWEST_CELLS:
        columns = np.hstack([columns, ((x * x + y * y) ** 2)[:, None]])
    A = columns.T @ (w[inside, None] * columns)
    inverse = np.linalg.pinv(A)
    c = inverse @ (columns.T @ (w[inside] * value[inside]))
    H = np.array([[2.0 * c[3], c[4]], [c[4], 2.0 * c[5]]])
    bend = _curvature(at, value, w, tree.query_ball_point(at[k], CURVE_SHARE * radius), at[k])
    if (region.sign * np.linalg.eigvalsh(H) >= 0.0).any():
        return -plain, plain_sd, bend, plain_sd  # no vertex
    move = -np.linalg.solve(H, c[1:3])
    move *= min(1.0, 0.5 * FIT_SHARE / max(float(np.linalg.norm(move)), 1e-12))
    row = np.array([1.0, *move, move[0] ** 2, move[0] * move[1], move[1] ** 2, (move @ move) ** 2])[: len(c)]
    top, sd = float(row @ c), float(np.sqrt(row @ inverse @ row)) * inflation
    if not abs(top - plain) < max(0.3 * abs(plain), 4.0 * sd) or sd > abs(plain):
        return -plain, plain_sd, bend, plain_sd
    return -top, sd, bend, plain_sd


def _borders(region: Region, surface: DesignSurface, middle: Floats) -> tuple[float, int]:
    """Distance of a place from its face's border, and how many sides of the face the region reaches."""
    charts, chart = surface.charts, region.chart
    cell = charts.cell_mm
    covered = charts.image(surface.share, chart) > 0.5
    round_ = charts.kind[chart] == CYLINDER
    pad = ((1, 1), (0, 0)) if round_ else ((1, 1), (1, 1))
    away = ndimage.distance_transform_edt(np.pad(covered, pad), sampling=cell)
    at = np.clip(((middle - charts.low[chart]) / cell).astype(np.int64), 0, charts.shape[chart] - 1)
    edge = float(away[at[0] + 1, at[1] + (0 if round_ else 1)])
    rows = region.cells - charts.first[chart]
    i, j = rows // charts.shape[chart, 1], rows % charts.shape[chart, 1]
    ij = np.argwhere(covered)
    low, high = ij.min(axis=0), ij.max(axis=0)
    reach = BORDER_CELLS
    sides = [i.min() < low[0] + reach, i.max() > high[0] - reach]
    if not round_:
        sides += [j.min() < low[1] + reach, j.max() > high[1] - reach]
    return edge, int(sum(sides))


def thickness_at(surface: DesignSurface, point: Floats, outward: Floats, component: int, most: float = 500.0) -> float:
    """Return how thick the design is behind a place (3,), mm; NaN where nothing lies behind within ``most``."""
    rows: Ints = np.flatnonzero(surface.component_of == component)
    corners = surface.vertices[surface.faces[rows]]
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    way = -outward
    cross = np.cross(np.broadcast_to(way, e2.shape), e2)
    turn = np.einsum("ni,ni->n", e1, cross)
    with np.errstate(divide="ignore", invalid="ignore"):
        arm = point - a
        u = np.einsum("ni,ni->n", arm, cross) / turn
        q = np.cross(arm, e1)
        v = (q @ way) / turn
        t = np.einsum("ni,ni->n", e2, q) / turn
        hit = (np.abs(turn) > 1e-9) & (u >= -1e-6) & (v >= -1e-6) & (u + v <= 1.0 + 1e-6) & (t > 0.5) & (t < most)
    return float(t[hit].min()) if hit.any() else float("nan")


# --- Small dents and pits: a bump fitted to the points themselves, for cells are too coarse to tell their depth.


MARGIN_CELLS = 2
FEWEST_POINTS = 12
ROBUST = 2.0  # standard deviations of a point, from which on it counts less


@dataclass(frozen=True)
class CellPoints:
    """The points of a scene in the order of their cells, to be had by place."""

    seen: Observed
    surface: DesignSurface
    alignment: Alignment
    order: Ints
    cell: Ints  # (n,) sorted

    def of(self, region: Region, shape_values: Floats) -> tuple[Floats, Floats]:
        """Places u, v (n, 2) about a region and deviations (n,), less what stations are off and shapes, mm."""
        charts, chart = self.surface.charts, region.chart
        wide = charts.shape[chart, 1]
        at = region.cells - charts.first[chart]
        i, j = at // wide, at % wide
        rows = np.arange(max(0, i.min() - MARGIN_CELLS), min(charts.shape[chart, 0], i.max() + MARGIN_CELLS + 1))
        start = charts.first[chart] + rows * wide + max(0, j.min() - MARGIN_CELLS)
        stop = charts.first[chart] + rows * wide + min(wide, j.max() + MARGIN_CELLS + 1)
        first, last = np.searchsorted(self.cell, start), np.searchsorted(self.cell, stop)
        own = np.concatenate([[], *(np.arange(a, b) for a, b in zip(first, last, strict=True))]).astype(np.int64)
        points, cell = self.order[own], self.cell[own]
        centres, outward = self.surface.centres[cell], self.surface.outward[cell]
        station = self.seen.station[points]
        rays = rays_to(centres, self.seen.stations.positions[station])
        off = self.alignment.corrections(centres, outward, rays, station)
        return self.seen.uv[points], self.seen.deviation[points] - off - shape_values[cell]


def points_by_cell(seen: Observed, surface: DesignSurface, alignment: Alignment) -> CellPoints:
    """Sort the points of a scene by their cells."""
    cell = cells_of(seen, surface)
    order = np.argsort(cell, kind="stable")
    return CellPoints(seen, surface, alignment, order, cell[order])


def refined(got: Measures, region: Region, near: CellPoints, field: Field, shape_values: Floats) -> Measures:
    """Return measures with the depth of a bump d (1 - r^2 / R^2)^2 fitted to points; as they were where none fits."""
    uv, deviation = near.of(region, shape_values)
    middle = flat(near.surface, region).mean(axis=0)
    radius = max(0.5 * got.diameter, near.surface.charts.cell_mm)
    noise = float(np.median(field.noise[region.cells]))
    use = np.abs(deviation) < 3.0 * abs(got.depth) + 6.0 * noise
    uv, deviation = (uv[use] - middle) / radius, deviation[use]
    if len(deviation) < FEWEST_POINTS:
        return got

    def bump(x: Floats) -> Floats:
        away = ((uv[:, 0] - x[0]) ** 2 + (uv[:, 1] - x[1]) ** 2) / x[2] ** 2
        found: Floats = -x[3] * np.maximum(1.0 - away, 0.0) ** 2
        return found

    low, high = [-1.5, -1.5, 0.3, -np.inf], [1.5, 1.5, 3.0, np.inf]
    fit = least_squares(
        lambda x: (deviation - bump(x)) / noise, [0.0, 0.0, 1.3, got.depth], bounds=(low, high), loss="soft_l1",
        f_scale=ROBUST,
    )  # fmt: skip
    try:
        sd = float(np.sqrt(np.linalg.inv(fit.jac.T @ fit.jac)[3, 3]))
    except np.linalg.LinAlgError:
        return got
    depth = float(fit.x[3])
    if not fit.success or depth * got.depth <= 0.0 or not sd < 0.5 * abs(depth) or abs(depth) > 4.0 * abs(got.depth):
        return got
    curvature = 4.0 * abs(depth) / (fit.x[2] * radius) ** 2 * 1000.0
    return dataclasses.replace(got, depth=depth, depth_ci95=NORMAL_95 * sd, curvature=curvature)
