"""The shape of every component: what of its deviation is the component's as a whole."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri

from processor.defects import shape_models
from processor.defects.alignment import Alignment, chart_of_cells
from processor.defects.deviation_field import Field, component_of_cells
from processor.defects.scan_statistic import Levels
from processor.defects.surface_charts import DesignSurface
from processor.model import NORMAL_95, Floats, Ints

BLOCKS_ALONG, BLOCKS_ACROSS = 36, 16  # of a component's largest face, at the least
MOST_BLOCKS = 3000
FEWEST_BLOCKS = 24
FINER = 3  # times smaller blocks for the last fit
FLOOR_MM = 0.02
APART_GAIN = 100.0  # of chi-square
JUMP_CELLS = 1.5
LEAST_Z = 4.5  # of a shape: what stations share is known from few of them
FLUSH_COS, FLUSH_MM = 0.9998, 1.0  # faces in one plane


@dataclass(frozen=True)
class ComponentShape:
    """A component's frame, blocks and shapes."""

    component: int
    frame: shape_models.Frame
    blocks: shape_models.Blocks
    fitted: shape_models.Fitted


def frame_of(surface: DesignSurface, component: int) -> shape_models.Frame:
    """Return a component's own frame, by its largest face."""
    charts = surface.charts
    own = np.flatnonzero(charts.component == component)
    areas = [float(surface.share[charts.cells(int(k))].sum()) for k in own]
    main = own[int(np.argmax(areas))]
    axes = charts.axes[main]
    corners = surface.vertices[np.unique(surface.faces[surface.component_of == component])] @ axes.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = np.maximum(0.5 * (high - low), 1.0)
    front = surface.vertices[np.unique(surface.faces[surface.chart_of == main])] @ axes[1]
    return shape_models.Frame(0.5 * (low + high) @ axes, axes, half, max(0.5 * float(np.ptp(front)), 1.0))


def blocks_of(field: Field, surface: DesignSurface, rows: Ints, side: int) -> shape_models.Blocks:
    """Sum up the cells ``rows`` of one component by squares of ``side`` cells."""
    charts = surface.charts
    chart = chart_of_cells(surface)[rows]
    at = rows - charts.first[chart]
    block = np.stack([chart, at // charts.shape[chart, 1] // side, at % charts.shape[chart, 1] // side], axis=1)
    _, index = np.unique(block, axis=0, return_inverse=True)
    index = index.reshape(-1)
    w = 1.0 / field.variance[rows]
    total = np.bincount(index, w)
    mean = np.bincount(index, w * field.deviation[rows]) / total
    points, outward = (
        np.stack([np.bincount(index, w * x[rows, k]) / total for k in range(3)], axis=1)
        for x in (surface.centres, surface.outward)
    )
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    return shape_models.Blocks(points, outward, mean, 1.0 / (1.0 / total + FLOOR_MM**2), side * charts.cell_mm)


def fit_all(field: Field, surface: DesignSurface, alignment: Alignment) -> list[ComponentShape]:
    """Fit the shapes of all components that enough is seen of."""
    component = component_of_cells(surface)
    rows = np.flatnonzero(field.seen > 0)
    order = np.argsort(component[rows], kind="stable")
    found = []
    for own in np.split(rows[order], np.flatnonzero(np.diff(component[rows][order])) + 1):
        if not len(own):
            continue
        number = int(component[own[0]])
        frame = frame_of(surface, number)
        wanted = min(2.0 * frame.half[0] / BLOCKS_ALONG, 2.0 * frame.half[1] / BLOCKS_ACROSS)
        most = np.sqrt(len(own) / MOST_BLOCKS)
        side = max(1, round(max(wanted / surface.charts.cell_mm, most)))
        blocks = blocks_of(field, surface, own, side)
        if len(blocks.mean) >= FEWEST_BLOCKS:
            fitted = shape_models.fit(blocks, frame)
            if fitted.shapes and side > 1:
                fitted = shape_models.refitted(fitted, _unmasked(fitted, blocks, field, surface, own, side), frame)
            found.append(ComponentShape(number, frame, blocks, fitted))
    return found


def deformed(shaped: list[ComponentShape]) -> frozenset[int]:
    """Return the components that have a shape of their own beyond doubt, as far as the whole's place is known."""
    return frozenset(one.component for one in shaped if any(gain > APART_GAIN for gain in one.fitted.gain))


def _unmasked(
    fitted: shape_models.Fitted, blocks: shape_models.Blocks, field: Field, surface: DesignSurface, own: Ints, side: int
) -> shape_models.Blocks:
    """Return finer blocks, those that lie in blocks left out left out too."""
    fine = blocks_of(field, surface, own, max(1, side // FINER))
    if (fitted.weight < blocks.weight).any():
        masked = cKDTree(blocks.points).query(fine.points)[1]
        fine = dataclasses.replace(fine, weight=fine.weight * (fitted.weight / blocks.weight)[masked])
    return fine


def values(surface: DesignSurface, shaped: list[ComponentShape], kept: dict[int, list[shape_models.Shape]]) -> Floats:
    """Return what kept shapes, by component, add to the deviation of every cell (cells,)."""
    found = np.zeros(len(surface.share))
    component = component_of_cells(surface)
    for one in shaped:
        if kept.get(one.component):
            rows = np.flatnonzero(component == one.component)
            for shape in kept[one.component]:
                found[rows] += shape.values(one.frame, surface.centres[rows], surface.outward[rows])
    return found


def jumps(surface: DesignSurface, shaped: list[ComponentShape], kept: dict[int, list[shape_models.Shape]]) -> Ints:
    """Return the cells that a step runs through: their means are of both of its sides."""
    found = [np.empty(0, np.int64)]
    component = component_of_cells(surface)
    for one in shaped:
        for shape in kept.get(one.component, ()):
            if shape.kind == "step":
                axis = int(shape.at[0])
                rows = np.flatnonzero(component == one.component)
                along = one.frame.local(surface.centres[rows])[:, axis] - shape.at[1] * one.frame.half[axis]
                found.append(rows[np.abs(along) <= JUMP_CELLS * surface.charts.cell_mm])
    return np.concatenate(found)


@dataclass(frozen=True)
class SignificantShape:
    """A shape that is more than chance: its largest value (mm, signed, outward) and the 95 % interval."""

    shape: shape_models.Shape
    peak: float
    ci95: float
    z: float
    chance: float  # how many as strong chance brings on one mm2
    margin: float  # how much more the best of other kinds leaves, in standard deviations squared


def seen_front(surface: DesignSurface, component: int, field: Field) -> Ints:
    """Return the cells of the largest face, seen from where most of it was seen: a plate has two of them."""
    charts = surface.charts
    own = np.flatnonzero(charts.component == component)
    areas = np.array([float(surface.share[charts.cells(int(k))].sum()) for k in own])
    seen = np.array([float(field.seen[charts.cells(int(k))].sum()) for k in own])
    large = areas > 0.9 * areas.max()
    main = own[int(np.argmax(np.where(large, seen, -1.0)))]
    out, at = charts.axes[main, 2], charts.origin[main]
    flush = [
        int(k)
        for k in own
        if charts.kind[k] == charts.kind[main]
        and charts.axes[k, 2] @ out > FLUSH_COS
        and abs((charts.origin[k] - at) @ out) < FLUSH_MM
    ]
    found: Ints = np.concatenate([np.arange(charts.cells(k).start, charts.cells(k).stop) for k in flush])
    return found


def with_corners(surface: DesignSurface, rows: Ints) -> tuple[Floats, Floats]:
    """Places (n, 3) and normals (n, 3) of a face's cells and of its corners, where many shapes are largest."""
    chart = np.unique(chart_of_cells(surface)[rows])
    own = np.isin(surface.chart_of, chart)
    corners = surface.vertices[surface.faces[own]].reshape(-1, 3)
    normals = np.repeat(surface.normals[own], 3, axis=0)
    return np.concatenate([surface.centres[rows], corners]), np.concatenate([surface.outward[rows], normals])


def significant(
    shaped: list[ComponentShape],
    surface: DesignSurface,
    field: Field,
    alignment: Alignment,
    levels: Levels,
    alarms_per_mm2: float,
) -> dict[int, list[SignificantShape]]:
    """Keep the shapes that chance brings no more often than asked for, by component.

    Of the largest deviation of a shape three things are uncertain: noise, what means of large places share, and where
    the whole is in the design's frame.
    """
    found: dict[int, list[SignificantShape]] = {}
    for one in shaped:
        real = [(k, s) for k, s in enumerate(one.fitted.shapes) if s.kind != "bump"]
        if not real:
            continue
        rows = seen_front(surface, one.component, field)
        rows = rows[surface.share[rows] > 0.5]
        area = float(surface.share[rows].sum()) * surface.charts.cell_mm**2
        threshold = max(LEAST_Z, float(-ndtri(min(0.25, 0.5 * alarms_per_mm2 * area / len(shape_models.BASES)))))
        # Of blocks: what larger places share beyond that stands beside it.
        size = int(np.searchsorted(levels.sides, one.blocks.side_mm / surface.charts.cell_mm))
        inflation = float(levels.inflation[min(size, len(levels.sides) - 1)])
        points, outward = with_corners(surface, rows)
        registration = alignment.sd(points, outward)
        for k, shape in real:
            value = shape.values(one.frame, points, outward)
            top = int(np.argmax(np.abs(value)))
            formal = abs(value[top]) / max(np.sqrt(max(one.fitted.gain[k], 1e-9)), 1e-9) * inflation
            sd = float(np.sqrt(formal**2 + levels.common_mm**2 + levels.systematic_mm**2 + registration[top] ** 2))
            z = abs(float(value[top])) / sd
            if z > threshold:
                chance = 2.0 * float(ndtr(-z)) * len(shape_models.BASES) / area
                found.setdefault(one.component, []).append(
                    SignificantShape(
                        shape=shape,
                        peak=float(value[top]),
                        ci95=NORMAL_95 * sd,
                        z=z,
                        chance=chance,
                        margin=one.fitted.margin / inflation**2,
                    )
                )
    return found
