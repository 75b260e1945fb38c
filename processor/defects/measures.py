"""Size, depth, volume and curvature of a region."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from processor.defects.alignment import rays_to
from processor.defects.deviation_field import Field
from processor.defects.observations import Observed, cells_of, sorted_by_cell
from processor.defects.places.profiles import PlaceCells
from processor.defects.regions import Region, unrolled
from processor.defects.surface_charts import CYLINDER, DesignSurface, layout
from processor.large_arrays import Array, blocks, release
from processor.model import NORMAL_95, Bools, Floats, Ints

SMOOTH_SHARE = 0.35  # of a region's radius, over which deviations are averaged to find the deepest place
FIT_SHARE = 0.45  # of a region's radius, within which a paraboloid is fitted for its depth
CURVE_SHARE = 0.65  # of a region's radius, for its curvature
FEWEST_CELLS = 9  # three by three: fewer leave nothing over from a paraboloid
BORDER_CELLS = 1.6  # from the border of a face: a region's outermost cell, and half of one for rounding
FEWEST_PROFILE, PROFILE_MARGIN = 6, 0.5  # cells of a region with a profile, and margin about it by its size
VOLUME_BORDER = 0.25  # of a region's radius, that belongs to its volume
DEEPEST_MM = 500.0  # of the design behind a place

MARGIN_CELLS = 2  # about a region, of which points are used for a small bump
FEWEST_POINTS = 12  # twice the unknowns of a bump, and two
EXPONENTS = (2.0, 12.0)  # of a bump: from round to flat-bottomed
RIM_SHARE = 0.02  # of its depth, at which a bump ends: at the rim of a dent as round as a cosine
ROBUST_SDS = 2.0  # of a point, from which on its weight decreases


@dataclass(frozen=True)
class Measures:
    """Measures of a region, mm: columns of :class:`processor.defects.result.Defects`, and two that decide its class.

    ``borders`` is the number of sides of its face that the region reaches.
    """

    centre: Floats
    axes: Floats
    extent: Floats
    area_mm2: float
    depth_max: float
    depth_ci95: float
    depth_mean: float
    volume_mm3: float
    volume_ci95: float
    edge_distance: float
    curvature_per_m: float
    lod95: float
    diameter: float
    borders: int

    def columns(self) -> dict[str, Any]:
        """Return the columns of a defect's row."""
        return {name: value for name, value in vars(self).items() if name not in ("diameter", "borders")}


@dataclass(frozen=True)
class CellPoints:
    """The points of a scene sorted by cell of a field: ``order`` (n,) are their rows, ``cell`` (n,) their cells."""

    observed: Observed
    field: Field
    order: Ints
    cell: Ints

    def about(self, region: Region, shape_values: Floats) -> tuple[Floats, Floats]:
        """Return places u, v (n, 2) about a region and deviations (n,), corrected and less shapes (cells,), mm."""
        surface, charts, chart = self.field.surface, self.field.surface.charts, region.chart
        wide = charts.shape[chart, 1]
        i, j = np.divmod(region.cells - charts.first[chart], wide)
        rows = np.arange(max(0, i.min() - MARGIN_CELLS), min(charts.shape[chart, 0], i.max() + MARGIN_CELLS + 1))
        start = charts.first[chart] + rows * wide + max(0, j.min() - MARGIN_CELLS)
        stop = charts.first[chart] + rows * wide + min(wide, j.max() + MARGIN_CELLS + 1)
        first, last = np.searchsorted(self.cell, start), np.searchsorted(self.cell, stop)
        index = np.concatenate([[], *(np.arange(a, b) for a, b in zip(first, last, strict=True))]).astype(np.int64)
        points, cell = self.order[index], self.cell[index]
        centres, outward = surface.centres[cell], surface.outward[cell]
        station = self.observed.station[points].astype(np.int64)
        rays = rays_to(centres, self.observed.stations.positions[station])
        correction = self.field.alignment.corrections(centres, outward, rays, station)
        return self.observed.uv[points], self.observed.deviation[points] - correction - shape_values[cell]


def points_by_cell(observed: Observed, field: Field) -> CellPoints:
    """Sort the points of a scene by their cells."""
    surface, count = field.surface, np.zeros(len(field.deviation), np.int64)

    def of_rows(rows: slice) -> tuple[Array, ...]:
        pure = np.flatnonzero(~observed.mixed[rows])
        return cells_of(observed, surface, rows)[pure], rows.start + pure

    for rows in blocks(len(observed.chart)):
        count += np.bincount(of_rows(rows)[0], minlength=len(count))
    (cell, order), parts = sorted_by_cell(observed, surface, count, of_rows)
    for part in parts:
        by_cell = np.argsort(cell[part], kind="stable")
        order[part], cell[part] = order[part][by_cell], cell[part][by_cell]
        release()
    return CellPoints(observed, field, order, cell)


def measure(region: Region, field: Field, inflation: float, thickness: float) -> Measures:
    """Measure a region on its face; the depth of a missing region is the ``thickness`` of the plate in mm."""
    surface, cell = field.surface, field.surface.charts.cell_mm
    uv, rows = unrolled(surface, region), region.cells
    area = surface.share[rows] * cell**2
    total = float(area.sum())
    deviation, variance = field.deviation[rows], field.variance[rows]
    weight = area if region.sign == 0 else area * np.abs(deviation)
    middle = (uv * weight[:, None]).sum(axis=0) / max(weight.sum(), 1e-12)
    _, turn = np.linalg.eigh((uv - middle).T @ ((uv - middle) * area[:, None]) + 1e-9 * np.diag([1.0, 0.0]))
    extent = np.ptp((uv - middle) @ turn[:, ::-1], axis=0) + cell
    # Width by area: a slim region that is not quite straight is narrower than its bounding box.
    extent[1] = min(extent[1], 4.0 / np.pi * total / extent[0] if len(rows) > FEWEST_CELLS else extent[1])
    closest = int(np.argmin(np.linalg.norm(uv - middle, axis=1)))
    place, outward = surface.centres[rows[closest]], surface.outward[rows[closest]]
    along = surface.charts.axes[region.chart, 0]
    across = np.cross(outward, along)
    longest = turn[0, 1] * along + turn[1, 1] * across
    registration = registration_sd(field, place, outward, rows)
    edge, borders = _borders(region, surface, middle)
    volume, volume_sd, summed = _volume(region, field)
    if region.sign == 0:
        # Missing: the uncertainty of the volume is that of the border's cells, which are missing in part.
        mean_sd = inflation / np.sqrt(np.sum(1.0 / np.maximum(variance, 1e-12)))
        border = cell * np.sqrt(np.pi * total)
        depth, curvature, depth_ci95, mean = thickness, float("nan"), 0.0, thickness
        volume, volume_ci95 = total * thickness, NORMAL_95 * border * thickness
    else:
        depth, sd, curvature, mean_sd = _deepest(region, field, inflation)
        depth_ci95 = NORMAL_95 * float(np.hypot(sd, registration))
        mean = -float((deviation * area).sum() / total)
        volume_ci95 = NORMAL_95 * float(np.hypot(volume_sd * inflation, registration * summed))
    return Measures(
        centre=place + (middle - uv[closest]) @ np.stack([along, across]),
        axes=np.stack([longest, np.cross(outward, longest), outward]),
        extent=extent,
        area_mm2=total,
        depth_max=depth,
        depth_ci95=depth_ci95,
        depth_mean=mean,
        volume_mm3=volume,
        volume_ci95=volume_ci95,
        edge_distance=edge,
        curvature_per_m=curvature,
        lod95=NORMAL_95 * float(np.hypot(mean_sd, registration)),
        diameter=float(2.0 * np.sqrt(total / np.pi)),
        borders=borders,
    )


def registration_sd(field: Field, place: Floats, outward: Floats, cells: Ints) -> float:
    """Return the standard deviation that all ``cells`` about a place (3,) have in common, mm: of poses and of views."""
    return float(np.hypot(field.alignment.sd(place[None], outward[None])[0], field.stations_sd(cells)))


def cells_about(region: Region, field: Field, claimed: Bools) -> PlaceCells | None:
    """Return the cells about a region that are seen and of no other place; None where it is small or on a cylinder.

    ``claimed`` (cells,) marks the cells of all places.
    """
    surface, charts, chart = field.surface, field.surface.charts, region.chart
    if charts.kind[chart] == CYLINDER or len(region.cells) < FEWEST_PROFILE:
        return None
    shape, first = charts.shape[chart], int(charts.first[chart])
    ij = np.stack(np.divmod(region.cells - first, shape[1]), axis=1)
    low, high = ij.min(axis=0), ij.max(axis=0)
    wide = np.maximum(np.ceil(PROFILE_MARGIN * (high - low + 1)), 2).astype(np.int64)
    start, stop = np.maximum(low - wide, 0), np.minimum(high + wide + 1, shape)
    u, v = (part.ravel() for part in np.meshgrid(*(np.arange(a, b) for a, b in zip(start, stop, strict=True))))
    rows = first + u * shape[1] + v
    used = (field.seen[rows] > 0) & (~claimed[rows] | np.isin(rows, region.cells))
    rows, grid = rows[used], np.stack([u, v], axis=1)[used]
    corners = layout(charts, np.full(1, chart), surface.vertices[np.unique(surface.faces[surface.chart_of == chart])])
    return PlaceCells(
        uv=charts.low[chart] + (grid + 0.5) * charts.cell_mm,
        value=field.deviation[rows],
        noise=np.sqrt(field.variance[rows]),
        low=corners.min(axis=0),
        high=corners.max(axis=0),
        centre=charts.low[chart] + (0.5 * (low + high) + 0.5) * charts.cell_mm,
        half=0.5 * (high - low + 1) * charts.cell_mm,
        cell_mm=charts.cell_mm,
    )


def _volume(region: Region, field: Field) -> tuple[float, float, float]:
    """Return the volume inward, its standard deviation from noise, and the area, with a border about the region.

    Cells of the border are too shallow to be significant one by one, but add up.
    """
    charts, chart = field.surface.charts, region.chart
    mask = np.zeros(int(charts.shape[chart].prod()), bool)
    mask[region.cells - charts.first[chart]] = True
    wide = max(1, round(VOLUME_BORDER * float(np.sqrt(len(region.cells) / np.pi))))
    grown = ndimage.distance_transform_edt(~mask.reshape(tuple(charts.shape[chart]))) <= wide
    rows = charts.first[chart] + np.flatnonzero(grown.ravel())
    rows = rows[(field.seen[rows] > 0) | mask[rows - charts.first[chart]]]
    area = field.surface.share[rows] * charts.cell_mm**2
    sd = float(np.sqrt((field.variance[rows] * area**2).sum()))
    return -float(field.deviation[rows] @ area), sd, float(area.sum())


def _deepest(region: Region, field: Field, inflation: float) -> tuple[float, float, float, float]:
    """Return the depth at the deepest place (inward positive, mm), its sd, curvature (1/m), and the sd of a mean there.

    The depth is that of the vertex of a paraboloid fitted about the place, or else the mean there.
    """
    uv, cell = unrolled(field.surface, region), field.surface.charts.cell_mm
    deviation, variance = field.deviation[region.cells], field.variance[region.cells]
    seen = field.seen[region.cells] > 0
    if seen.sum() < FEWEST_CELLS:
        used = seen if seen.any() else np.ones(len(deviation), bool)
        k = int(np.argmax(np.where(used, region.sign * deviation / np.sqrt(variance), -np.inf)))
        sd = float(np.sqrt(variance[k])) * inflation
        return -float(deviation[k]), sd, float("nan"), sd
    radius = max(np.sqrt(len(deviation) / np.pi), 1.0) * cell
    tree = cKDTree(uv[seen])
    value, weight, at = deviation[seen], 1.0 / variance[seen], uv[seen]
    near = tree.query_ball_point(at, max(SMOOTH_SHARE * radius, 1.01 * cell))
    smooth = np.array([np.sum(weight[i] * value[i]) / np.sum(weight[i]) for i in near])
    k = int(np.argmax(region.sign * smooth))
    mean, mean_sd = float(smooth[k]), float(1.0 / np.sqrt(weight[near[k]].sum())) * inflation
    inside = tree.query_ball_point(at[k], max(FIT_SHARE * radius, 1.9 * cell))
    if len(inside) < FEWEST_CELLS:
        inside = tree.query(at[k], k=FEWEST_CELLS)[1].tolist()
    top, sd = _vertex((at[inside] - at[k]) / radius, value[inside], weight[inside], region.sign, cell / radius)
    sd *= inflation
    curvature = _curvature(at, value, weight, tree.query_ball_point(at[k], CURVE_SHARE * radius), at[k])
    if not abs(top - mean) < max(0.3 * abs(mean), 4.0 * sd) or sd > abs(mean):
        top, sd = mean, mean_sd
    return -top, sd, curvature, mean_sd


def _vertex(at: Floats, value: Floats, weight: Floats, sign: int, side: float) -> tuple[float, float]:
    """Return the value at the vertex of a paraboloid fitted to places (n, 2), and its sd from noise; NaN without one.

    With enough places a term of the fourth order is added. Values are means of cells of a ``side``, which exceed those
    at their middles by side^2 / 24 times the sum of the second derivatives.
    """
    x, y = at.T
    columns = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)
    if len(at) >= 4 * FEWEST_CELLS:
        columns = np.hstack([columns, ((x * x + y * y) ** 2)[:, None]])
    inverse = np.linalg.pinv(columns.T @ (weight[:, None] * columns))
    c = inverse @ (columns.T @ (weight * value))
    H = np.array([[2.0 * c[3], c[4]], [c[4], 2.0 * c[5]]])
    if (sign * np.linalg.eigvalsh(H) >= 0.0).any():
        return float("nan"), float("nan")
    step = -np.linalg.solve(H, c[1:3])
    step *= min(1.0, 0.5 * FIT_SHARE / max(float(np.linalg.norm(step)), 1e-12))
    row = np.array([1.0, *step, step[0] ** 2, step[0] * step[1], step[1] ** 2, (step @ step) ** 2])[: len(c)]
    return float(row @ c - side**2 / 24.0 * np.trace(H)), float(np.sqrt(row @ inverse @ row))


def _curvature(at: Floats, value: Floats, weight: Floats, inside: list[int], middle: Floats) -> float:
    """Return the larger curvature (1/m) of a paraboloid fitted to places (n, 2) ``inside``."""
    if len(inside) < 2 * FEWEST_CELLS:
        return float("nan")
    x, y = (at[inside] - middle).T
    columns = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)
    root = np.sqrt(weight[inside])
    c = np.linalg.lstsq(root[:, None] * columns, root * value[inside], rcond=None)[0]
    H = np.array([[2.0 * c[3], c[4]], [c[4], 2.0 * c[5]]])
    return float(np.abs(np.linalg.eigvalsh(H)).max()) * 1000.0


def _borders(region: Region, surface: DesignSurface, middle: Floats) -> tuple[float, int]:
    """Return the distance of a place (2,) from its face's border, and the number of sides that the region reaches."""
    charts, chart = surface.charts, region.chart
    cell = charts.cell_mm
    covered = charts.image(surface.share, chart) > 0.5
    is_cylinder = charts.kind[chart] == CYLINDER
    pad = ((1, 1), (0, 0)) if is_cylinder else ((1, 1), (1, 1))
    distance = ndimage.distance_transform_edt(np.pad(covered, pad), sampling=cell)
    at = np.clip(((middle - charts.low[chart]) / cell).astype(np.int64), 0, charts.shape[chart] - 1)
    edge = float(distance[at[0] + 1, at[1] + (0 if is_cylinder else 1)])
    i, j = np.divmod(region.cells - charts.first[chart], charts.shape[chart, 1])
    ij = np.argwhere(covered)
    low, high = ij.min(axis=0), ij.max(axis=0)
    sides = [i.min() < low[0] + BORDER_CELLS, i.max() > high[0] - BORDER_CELLS]
    if not is_cylinder:
        sides += [j.min() < low[1] + BORDER_CELLS, j.max() > high[1] - BORDER_CELLS]
    return edge, int(sum(sides))


def thickness_at(surface: DesignSurface, point: Floats, outward: Floats, component: int) -> float:
    """Return the thickness of the design behind a place (3,), mm; NaN if there is no face within DEEPEST_MM.

    Intersection of a ray with triangles after Moeller and Trumbore (1997).
    """
    rows: Ints = np.flatnonzero(surface.component_of == component)
    corners = surface.vertices[surface.faces[rows]]
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    ray = -outward
    cross = np.cross(np.broadcast_to(ray, e2.shape), e2)
    determinant = np.einsum("ni,ni->n", e1, cross)
    with np.errstate(divide="ignore", invalid="ignore"):
        arm = point - a
        u = np.einsum("ni,ni->n", arm, cross) / determinant
        q = np.cross(arm, e1)
        v = (q @ ray) / determinant
        t = np.einsum("ni,ni->n", e2, q) / determinant
        inside = (u >= -1e-6) & (v >= -1e-6) & (u + v <= 1.0 + 1e-6)
        hit = (np.abs(determinant) > 1e-9) & inside & (t > 0.5) & (t < DEEPEST_MM)
    return float(t[hit].min()) if hit.any() else float("nan")


def refined(measured: Measures, region: Region, points: CellPoints, shape_values: Floats, inflation: float) -> Measures:
    """Return measures with depth and diameter of a bump d exp(-(r / R)^q) fitted to points; unchanged without a fit.

    For small dents and pits: cells average their depth, and those at the rim are not significant one by one. The
    exponent q covers round and flat bottoms.
    """
    field, (uv, deviation) = points.field, points.about(region, shape_values)
    middle = unrolled(field.surface, region).mean(axis=0)
    radius = max(0.5 * measured.diameter, field.surface.charts.cell_mm)
    noise = float(np.median(field.noise[region.cells]))
    used = np.abs(deviation) < 3.0 * abs(measured.depth_max) + 6.0 * noise
    uv, deviation = (uv[used] - middle) / radius, deviation[used]
    if len(deviation) < FEWEST_POINTS:
        return measured

    def bump(x: Floats) -> Floats:
        height: Floats = -x[3] * np.exp(-((np.hypot(uv[:, 0] - x[0], uv[:, 1] - x[1] + 1e-12) / x[2]) ** x[4]))
        return height

    fit = least_squares(
        lambda x: (deviation - bump(x)) / noise,
        [0.0, 0.0, 0.8, measured.depth_max, 3.0],
        bounds=([-1.5, -1.5, 0.2, -np.inf, EXPONENTS[0]], [1.5, 1.5, 3.0, np.inf, EXPONENTS[1]]),
        loss="soft_l1",
        f_scale=ROBUST_SDS,
    )
    try:
        variance = float(np.linalg.inv(fit.jac.T @ fit.jac)[3, 3])
    except np.linalg.LinAlgError:
        return measured
    sd = float(np.sqrt(variance)) if variance > 0.0 else np.inf  # by rounding, of a matrix that is nearly singular
    depth = float(fit.x[3])
    plausible = depth * measured.depth_max > 0.0 and abs(depth) <= 4.0 * abs(measured.depth_max)
    if not (fit.success and plausible and sd < 0.5 * abs(depth)):
        return measured
    curvature = 2.0 * abs(depth) / (fit.x[2] * radius) ** 2 * 1000.0
    registration = registration_sd(field, measured.centre, measured.axes[2], region.cells)
    ci95 = NORMAL_95 * float(np.hypot(sd * inflation, registration))
    diameter = float(2.0 * fit.x[2] * radius * np.log(1.0 / RIM_SHARE) ** (1.0 / fit.x[4]))
    return dataclasses.replace(measured, depth_max=depth, depth_ci95=ci95, curvature_per_m=curvature, diameter=diameter)
