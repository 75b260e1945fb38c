"""Shapes of components: the part of a component's deviation that extends over the whole component."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtrc, ndtr, ndtri

from processor.adjustment import scanner_class_errors
from processor.defects import shape_models
from processor.defects.deviation_field import Field
from processor.defects.scan_statistic import Levels
from processor.defects.surface_charts import DesignSurface
from processor.distinct_rows import distinct
from processor.model import NORMAL_95, Floats, Ints

BLOCKS_ALONG, BLOCKS_ACROSS = 36, 16  # of a component's largest face, at least
MOST_BLOCKS = 3000  # work: of larger components blocks are larger
FEWEST_BLOCKS = 24  # four for each unknown of a rigid motion
FINER = 3  # times smaller blocks for the last fit
FLOOR_MM = 0.02  # of a block's mean: the design's mesh, and roughness that points of one block share
DEFORMED_GAIN = 100.0  # of chi-square, above which a component is deformed
JUMP_CELLS = 1.5  # chosen: from a step's line, in which its height shows: its cell and the next
LEAST_Z = 4.5  # of a shape: what stations have in common is known from few of them
FEWEST_SEEN = 6  # cells of a face, whose mean movement is compared with that of others
FACE_GAIN = 1.1  # from which on another face than the front shows a movement
FLUSH_COS, FLUSH_MM = 0.9998, 1.0  # faces in one plane
LEAST_CHANCE = 1e-200  # below which the number of factors makes no difference
LARGE_SHARE = 0.9  # of the largest face's area, from which a face may be the front


@dataclass(frozen=True)
class ComponentShape:
    """A component's frame, blocks and shapes."""

    component: int
    frame: shape_models.Frame
    blocks: shape_models.Blocks
    fitted: shape_models.Fitted


@dataclass(frozen=True)
class SignificantShape:
    """A significant shape: its largest value (mm, outward positive), the half-width of its 95 % interval, its z.

    ``volume_ci95`` (mm3) is the half-width of that of the volume that the shape displaces.
    """

    shape: shape_models.Shape
    peak: float
    ci95: float
    volume_ci95: float
    z: float
    chance: float  # expected number of false alarms as strong on one mm2
    margin: float  # chi-square of the best fit of another kind less this one's


def fit_all(field: Field) -> list[ComponentShape]:
    """Fit the shapes of all components with enough observed blocks."""
    surface, component = field.surface, field.surface.component
    seen = np.flatnonzero(field.seen > 0)
    order = np.argsort(component[seen], kind="stable")
    shapes = []
    for cells in np.split(seen[order], np.flatnonzero(np.diff(component[seen][order])) + 1):
        if not len(cells):
            continue
        number = int(component[cells[0]])
        frame = _frame_of(surface, number)
        block_mm = min(2.0 * frame.half[0] / BLOCKS_ALONG, 2.0 * frame.half[1] / BLOCKS_ACROSS)
        side = max(1, round(max(block_mm / surface.charts.cell_mm, np.sqrt(len(cells) / MOST_BLOCKS))))
        blocks = _blocks_of(field, cells, side)
        if len(blocks.mean) >= FEWEST_BLOCKS:
            fitted = shape_models.fit(blocks, frame)
            if fitted.shapes and side > 1:
                fine = _blocks_of(field, cells, max(1, side // FINER))
                # Finer blocks have the weights by which the fit left out blocks.
                if (fitted.weight < blocks.weight).any():
                    nearest = cKDTree(blocks.points).query(fine.points)[1]
                    weight = fine.weight * (fitted.weight / blocks.weight)[nearest]
                    fine = dataclasses.replace(fine, weight=weight)
                fitted = shape_models.refitted(fitted, fine, frame)
            shapes.append(ComponentShape(number, frame, blocks, fitted))
    return shapes


def deformed(shapes: list[ComponentShape]) -> frozenset[int]:
    """Return the components that certainly have a shape of their own."""
    return frozenset(fit.component for fit in shapes if any(gain > DEFORMED_GAIN for gain in fit.fitted.gain))


def values(surface: DesignSurface, shapes: list[ComponentShape], chosen: dict[int, list[shape_models.Shape]]) -> Floats:
    """Return the deviation (cells,) by the chosen shapes of each component, mm."""
    total = np.zeros(len(surface.share))
    component = surface.component
    for fit in shapes:
        if chosen.get(fit.component):
            rows = np.flatnonzero(component == fit.component)
            for shape in chosen[fit.component]:
                total[rows] += shape.values(fit.frame, surface.centres[rows], surface.outward[rows])
    return total


def jumps(surface: DesignSurface, shapes: list[ComponentShape], chosen: dict[int, list[shape_models.Shape]]) -> Ints:
    """Return the cells that the edge of a step runs through: their means mix both sides."""
    cells = [np.empty(0, np.int64)]
    component = surface.component
    for fit in shapes:
        for shape in chosen.get(fit.component, ()):
            if shape.kind == "step":
                axis = int(shape.at[0])
                rows = np.flatnonzero(component == fit.component)
                along = fit.frame.local(surface.centres[rows])[:, axis] - shape.at[1] * fit.frame.half[axis]
                cells.append(rows[np.abs(along) <= JUMP_CELLS * surface.charts.cell_mm])
    return np.concatenate(cells)


def significant(
    shapes: list[ComponentShape], field: Field, levels: Levels, alarms_per_mm2: float
) -> dict[int, list[SignificantShape]]:
    """Return the shapes, by component, that are significant at the given rate of false alarms.

    The value of a shape at a place has three errors: noise, the common error of means of large places, and the pose of
    the whole in the design's frame. Its significance is that of the place where it is most significant, of all places
    that the shape's factors may bring out (Scheffe 1953); its interval is that where it is largest, which may be a
    corner that was not seen.
    """
    chosen, surface = dict[int, list[SignificantShape]](), field.surface
    for fit in shapes:
        candidates = [shape for shape in fit.fitted.shapes if shape.kind != "bump"]
        if not candidates:
            continue
        front = front_of(field, fit.component)
        area = float(surface.share[front[surface.share[front] > 0.5]].sum()) * surface.charts.cell_mm**2
        threshold = max(LEAST_Z, float(-ndtri(min(0.25, 0.5 * alarms_per_mm2 * area / len(shape_models.BASES)))))
        of_all = [judged(fit, shape, field, levels) for shape in candidates]
        found = [
            dataclasses.replace(one, chance=2.0 * float(ndtr(-one.z)) * len(shape_models.BASES) / area)
            for one in of_all
            if one.z > threshold
        ]
        if found:
            chosen[fit.component] = found
    return chosen


def judged(fit: ComponentShape, shape: shape_models.Shape, field: Field, levels: Levels) -> SignificantShape:
    """Return a shape with its interval, whether or not it is significant; ``chance`` is left to the search."""
    surface = field.surface
    # Noise of blocks; the common error of larger places is added below.
    size = int(np.searchsorted(levels.sides, fit.blocks.side_mm / surface.charts.cell_mm))
    inflation = float(levels.inflation[min(size, len(levels.sides) - 1)])
    value, own, noise, shared = _errors(fit, shape, field, levels)
    sd = np.hypot(inflation * noise, shared)
    top = int(np.argmax(np.abs(value)))
    # The noise of places averages out in the volume, what they have in common does not.
    cells = swept_cells(field, fit, shape)
    points, outward = surface.centres[cells], surface.outward[cells]
    # 0 where the shape does not reach
    swept = np.sign(shape.values(fit.frame, points, outward)) * surface.cell_areas[cells]
    of_noise = inflation * shape.total_sd(fit.frame, points, outward, swept)
    in_common = np.abs(swept).sum() * np.sqrt(np.mean(shared**2))
    return SignificantShape(
        shape=shape,
        peak=float(value[top]),
        ci95=NORMAL_95 * float(sd[top]),
        volume_ci95=NORMAL_95 * float(np.hypot(of_noise, in_common)),
        z=deviate_of_one(float((np.abs(own) / sd).max()), len(shape.factors)),
        chance=0.0,
        margin=fit.fitted.margin / inflation**2,
    )


def _errors(
    fit: ComponentShape, shape: shape_models.Shape, field: Field, levels: Levels
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return a shape's values (n,) at cells and corners, those that its significance is of, and their errors.

    These are one sd: by the noise of blocks, and what places have in common.
    """
    rows = cells_of_shape(field, fit, shape)
    points, outward = with_corners(field.surface, rows)
    value = own = shape.values(fit.frame, points, outward)

    def moved(mean: Floats) -> Floats:
        """Return what the rigid motion nearest to deviations of the blocks moves the points by."""
        motion = shape_models.rigid_motion(dataclasses.replace(fit.blocks, mean=mean), fit.frame)
        return motion.values(fit.frame, points, outward)

    registration = np.hypot(field.alignment.sd(points, outward), field.stations_sd(rows))
    if shape.kind != shape_models.RIGID and not field.alignment.fitted:
        # The error of a pose that was not fitted to the design may be large: it moves, it does not deform.
        own = value - moved(shape.values(fit.frame, fit.blocks.points, fit.blocks.outward))
        registration = np.full_like(value, field.stations_sd(rows, free=True))
    # A surface that lies off as a whole, or from some place on, may be of another paint. Seen from all sides, a body
    # does not move by it.
    bias = np.full_like(value, scanner_class_errors.known().incidence_mm if shape.kind == "step" else 0.0)
    if shape.kind == shape_models.RIGID:
        bias = moved(np.full(len(fit.blocks.mean), scanner_class_errors.known().incidence_mm))
    of_scanner = np.sqrt(levels.common[-1] ** 2 + levels.systematic_mm**2 + field.drift**2)
    shared = np.sqrt(of_scanner**2 + bias**2 + registration**2)
    return value, own, shape.sd(fit.frame, points, outward), shared


def unproven_motions(
    shapes: list[ComponentShape], significant: dict[int, list[SignificantShape]]
) -> dict[int, list[shape_models.Shape]]:
    """Return the rigid motion, by component, of those that fit one which is not significant.

    It may be an error of the registration. A search that does not leave it out finds the whole component in place of
    what deviates from the rest of it.
    """
    motions: dict[int, list[shape_models.Shape]] = {}
    for fit in shapes:
        proven = [judged.shape for judged in significant.get(fit.component, ())]
        kinds = [shape.kind for shape in proven]
        if shape_models.RIGID not in kinds and any(shape.kind == shape_models.RIGID for shape in fit.fitted.shapes):
            rest = fit.blocks.mean.copy()
            for shape in proven:
                rest -= shape.values(fit.frame, fit.blocks.points, fit.blocks.outward)
            blocks = dataclasses.replace(fit.blocks, mean=rest, weight=fit.fitted.weight)
            motions[fit.component] = [shape_models.rigid_motion(blocks, fit.frame)]
    return motions


def deviate_of_one(z: float, factors: int) -> float:
    """Return the deviate of one factor that is as improbable as the largest, ``z``, of all sums of several factors."""
    chance = float(chdtrc(factors, z**2))
    return float(-ndtri(0.5 * chance)) if chance > LEAST_CHANCE else z


def cells_of_shape(field: Field, fit: ComponentShape, shape: shape_models.Shape | None = None) -> Ints:
    """Return the cells on which a shape is measured: the front, or the seen face on which a movement is largest.

    A component that moved along its front shows it on other faces alone.
    """
    surface, front = field.surface, front_of(field, fit.component)
    front = front[surface.share[front] > 0.5]
    if shape is None or shape.kind != shape_models.RIGID:
        return front
    seen = np.flatnonzero((surface.component == fit.component) & (field.seen > 0.0))
    charts, index, count = np.unique(surface.chart[seen], return_inverse=True, return_counts=True)
    value = np.abs(shape.values(fit.frame, surface.centres[seen], surface.outward[seen]))
    mean = np.where(count >= FEWEST_SEEN, np.bincount(index.reshape(-1), value) / np.maximum(count, 1), 0.0)
    on_front = np.isin(charts, surface.chart[front])
    if not len(charts) or mean.max() <= max(FACE_GAIN * mean[on_front].max(initial=0.0), 1e-9):
        return front
    of_face = surface.charts.cells(int(charts[int(np.argmax(mean))]))
    cells = np.arange(of_face.start, of_face.stop)
    shown: Ints = cells[surface.share[cells] > 0.5]
    return shown if len(shown) else front


def swept_cells(field: Field, fit: ComponentShape, shape: shape_models.Shape) -> Ints:
    """Return the cells that sweep the volume of a shape.

    Of a movement these are cells of all faces that were seen, where they go inward or where they come out, whichever
    sweeps more: the opposite faces sweep the same volume.
    """
    if shape.kind != shape_models.RIGID:
        return cells_of_shape(field, fit, shape)
    surface, chart = field.surface, field.surface.chart
    count = np.bincount(chart[field.seen > 0.0], minlength=len(surface.charts.kind))
    of_component = surface.charts.component[chart] == fit.component
    cells = np.flatnonzero(of_component & (count[chart] >= FEWEST_SEEN) & (surface.share > 0.5))
    value = shape.values(fit.frame, surface.centres[cells], surface.outward[cells])
    inward, outward = ((way * value > 0.0) for way in (-1.0, 1.0))
    larger: Ints = cells[max(inward, outward, key=lambda side: np.abs(value[side]) @ surface.share[cells[side]])]
    return larger


def front_of(field: Field, component: int) -> Ints:
    """Return the cells of the largest face and of those in its plane; of equal faces that with most cells observed."""
    charts, share = field.surface.charts, field.surface.share
    candidates = np.flatnonzero(charts.component == component)
    areas = np.array([float(share[charts.cells(int(k))].sum()) for k in candidates])
    seen = np.array([float(field.seen[charts.cells(int(k))].sum()) for k in candidates])
    large = areas > LARGE_SHARE * areas.max()
    main = candidates[int(np.argmax(np.where(large, seen, -1.0)))]
    out, at = charts.axes[main, 2], charts.origin[main]
    flush = [
        int(k)
        for k in candidates
        if charts.kind[k] == charts.kind[main]
        and charts.way[k] == charts.way[main]
        and charts.axes[k, 2] @ out > FLUSH_COS
        and abs((charts.origin[k] - at) @ out) < FLUSH_MM
    ]
    cells: Ints = np.concatenate([np.arange(charts.cells(k).start, charts.cells(k).stop) for k in flush])
    return cells


def _frame_of(surface: DesignSurface, component: int) -> shape_models.Frame:
    """Return a component's frame, by its largest face."""
    charts = surface.charts
    faces = np.flatnonzero(charts.component == component)
    areas = [float(surface.share[charts.cells(int(k))].sum()) for k in faces]
    main = faces[int(np.argmax(areas))]
    axes = charts.axes[main]
    corners = surface.vertices[np.unique(surface.faces[surface.component_of == component])] @ axes.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = np.maximum(0.5 * (high - low), 1.0)
    front = surface.vertices[np.unique(surface.faces[surface.chart_of == main])] @ axes[1]
    return shape_models.Frame(0.5 * (low + high) @ axes, axes, half, max(0.5 * float(np.ptp(front)), 1.0))


def _blocks_of(field: Field, cells: Ints, side: int) -> shape_models.Blocks:
    """Sum up the cells of one component by squares of ``side`` cells."""
    surface, charts = field.surface, field.surface.charts
    chart = surface.chart[cells]
    u, v = np.divmod(cells - charts.first[chart], charts.shape[chart, 1])
    index = distinct(np.stack([chart, u // side, v // side], axis=1)).number
    w = 1.0 / field.variance[cells]
    total = np.bincount(index, w)
    mean = np.bincount(index, w * field.deviation[cells]) / total
    points, outward = (
        np.stack([np.bincount(index, w * x[cells, k]) / total for k in range(3)], axis=1)
        for x in (surface.centres, surface.outward)
    )
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    return shape_models.Blocks(points, outward, mean, 1.0 / (1.0 / total + FLOOR_MM**2), side * charts.cell_mm)


def with_corners(surface: DesignSurface, cells: Ints) -> tuple[Floats, Floats]:
    """Return places (n, 3) and normals (n, 3) of cells and of the corners of their faces, where shapes are largest."""
    on_faces = np.isin(surface.chart_of, np.unique(surface.chart[cells]))
    corners = surface.vertices[surface.faces[on_faces]].reshape(-1, 3)
    normals = np.repeat(surface.normals[on_faces], 3, axis=0)
    return np.concatenate([surface.centres[cells], corners]), np.concatenate([surface.outward[cells], normals])
