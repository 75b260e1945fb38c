"""Method ``default``: the defects of a scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor import scene_cloud
from processor.adjustment import scanner_class_errors
from processor.adjustment.body_motions import distance_derivative
from processor.defects import (
    alignment,
    component_deviations,
    design_pose,
    deviation_field,
    expected_points,
    measures,
    observations,
    regions,
    scan_statistic,
    surface_charts,
    to_result,
)
from processor.defects.absence import holes, missing_bodies
from processor.defects.alignment import Alignment
from processor.defects.component_deviations import ComponentShape
from processor.defects.deviation_field import Field
from processor.defects.movement import face_offsets, moved_bodies
from processor.defects.observations import Observed, Pairs
from processor.defects.params import Params
from processor.defects.regions import Region
from processor.defects.result import Result
from processor.defects.surface_charts import DesignSurface
from processor.geometry import mesh_distance, rigid
from processor.large_arrays import every
from processor.model import DesignBodies, Floats, Reason, Scene, Status, StructureDesign, reason

CELL_POINTS = 12.0  # in a cell, on the median
CELL_BOUNDS_MM = (5.0, 60.0)  # below, a beam covers more than one; above, a dent of 100 mm less than two
FIRST_CELL_MM = 50.0  # a first net, until the points' density is known
MOST_CELLS = 4_000_000  # work: 32 MB an array of a number a cell
AGAIN_MM = 2.0  # movement of the whole beyond which points are assigned to the design's faces again
ROUNDS = 3  # work: at most; the first that moves the whole by less than AGAIN_MM is the last
UNITE_CELLS, UNITE_MM = 3.0, 25.0  # distance within which places are one defect, the larger
SD_SAMPLES = 20_000  # cells by which alignments are compared


@dataclass(frozen=True)
class Registered:
    """Points on the cells of the design's surface, and the alignment of stations and whole by them."""

    T_design_project: Floats
    observed: Observed
    surface: DesignSurface
    pairs: Pairs
    alignment: Alignment


def defects(scene: Scene, params: Params, earlier: dict[str, Any]) -> Result:
    """Find the defects of a structure against its design. Raises InputError without points."""
    design = scene.structure
    assert design is not None
    vertices, origin = scene_cloud.local_design(design)
    scene = scene_cloud.stitched(scene, earlier.get("stitch"))
    pose = design_pose.pose(scene, earlier, params)
    if pose.T_design_project is None:
        return Result(status=Status.FAILED, method=params.method, reasons=pose.reasons)
    T = rigid.transform(np.eye(3), -origin) @ pose.T_design_project
    registered = _registered(scene, vertices, design, T, pose.error_mm, params)
    if registered is None:
        return Result(status=Status.FAILED, method=params.method, reasons=(reason("defects.no-point"),))
    search = _search(scene, registered, pose.error_mm, params)
    movements = moved_bodies.moved(search.shapes, search.significant)
    if movements:
        changed = moved_bodies.design(design.name, registered.surface, movements)
        T = registered.T_design_project
        again = _registered(scene, changed.vertices, changed, T, pose.error_mm, params, frozenset(movements))
        if again is not None:
            search = moved_bodies.together(movements, _search(scene, again, pose.error_mm, params))
            registered = again
    result = to_result.result_of(search, params, origin, pose.doubt)
    aligned = search.field.alignment
    T = alignment.corrected_pose(registered.T_design_project, aligned)
    return dataclasses.replace(
        result,
        covariance=rigid.about_origin(aligned.pose_covariance(), aligned.centre + origin),
        status=pose.status if result.status is Status.OK else result.status,
        reasons=(
            *pose.reasons,
            *_of_names(design.bodies),
            *scene_cloud.design_faults(design.faults),
            *_of_views(search),
            *result.reasons,
        ),
        T_design_project=rigid.transform(np.eye(3), origin) @ T,
        points=registered.observed.points,
        points_used=len(registered.observed.chart),
    )


def _of_names(bodies: DesignBodies | None) -> Iterator[Reason]:
    """Yield how components are named where the design does not give each body a name of its own."""
    if bodies is not None and bodies.shared:
        yield reason("defects.names-shared", bodies=bodies.shared)
    if bodies is not None and bodies.unnamed:
        yield reason("defects.names-missing", bodies=bodies.unnamed)


def _of_views(search: to_result.Search) -> Iterator[Reason]:
    """Yield what is taken of the errors of views that are not named, and of those that all views share."""
    if search.points.observed.stations.unnamed and search.field.alignment.fitted:
        yield reason(
            "defects.views-by-class",
            shift=scanner_class_errors.SHIFT_SD_MM,
            offset=scanner_class_errors.known().offset_mm,
        )
    if search.field.views > 0.0:
        yield reason("defects.views-differ", sd=search.field.views)
    if search.field.drift > 0.0:
        yield reason("defects.sides-differ", sd=search.field.drift)
    if search.field.bias:
        yield reason("defects.common-bias", bias=search.field.bias)


def _registered(
    scene: Scene,
    vertices: Floats,
    design: StructureDesign,
    T: Floats,
    error_mm: float,
    params: Params,
    excluded: frozenset[int] = frozenset(),
) -> Registered | None:
    """Assign points to cells and align them, again after a large movement; None without points near the design.

    ``excluded`` are components that stations and whole are not fitted by.
    """
    # A first size of cells that keeps their number within MOST_CELLS
    cell_mm = max(FIRST_CELL_MM, float(np.sqrt(mesh_distance.area(vertices, design.faces) / (0.25 * MOST_CELLS))))
    base = surface_charts.of_mesh(vertices, design.faces, cell_mm, design.bodies)
    for left in reversed(range(ROUNDS)):
        observed = observations.observe(scene, T, base, params.reach_mm)
        if not len(observed.chart):
            return None
        cell = params.cell_mm or observations.fitting_cell(observed, base, CELL_POINTS, CELL_BOUNDS_MM)
        cell = max(cell, float(np.sqrt(base.area_mm2 / MOST_CELLS)))
        surface = surface_charts.gridded(base, cell)
        observed = observations.without_beside(observed, surface)
        pairs = observations.paired(observed, surface)
        if not params.align:
            aligned = alignment.none(surface, len(observed.stations.names), error_mm)
            break
        aligned = alignment.align(pairs, surface, observed.stations, error_mm, excluded)
        # The largest movement of the whole along the normals of cells
        rows = slice(None, None, max(1, len(surface.centres) // SD_SAMPLES))
        points, outward = surface.centres[rows], surface.outward[rows]
        movement_mm = float(np.abs(distance_derivative(points - aligned.centre, outward) @ aligned.whole).max())
        if not left or movement_mm < AGAIN_MM:
            break
        T = alignment.corrected_pose(T, aligned)
    return Registered(T_design_project=T, observed=observed, surface=surface, pairs=pairs, alignment=aligned)


def _search(scene: Scene, registered: Registered, error_mm: float, params: Params) -> to_result.Search:
    """Search for shapes of components, places that deviate and places that are missing."""
    surface, observed, pairs = registered.surface, registered.observed, registered.pairs
    alarms_per_mm2 = params.false_alarms / (1e6 * params.per_m2)
    field, shapes = _fitted_shapes(registered, error_mm, params)
    candidates = {fit.component: [s for s in fit.fitted.shapes if s.kind != "bump"] for fit in shapes}
    residuals = field.minus(component_deviations.values(surface, shapes, candidates))
    levels = scan_statistic.levels_of(residuals, alarms_per_mm2, params.systematic_mm)
    significant = component_deviations.significant(shapes, field, levels, alarms_per_mm2)
    chosen = {number: [judged.shape for judged in of_one] for number, of_one in significant.items()}
    shape_values = component_deviations.values(surface, shapes, chosen)
    shape_values += component_deviations.values(
        surface, shapes, component_deviations.unproven_motions(shapes, significant)
    )
    if not field.alignment.fitted:
        shape_values += face_offsets.unproven(field.minus(shape_values))
    residuals = field.minus(shape_values).without(component_deviations.jumps(surface, shapes, chosen))
    searched = scan_statistic.widened(residuals, levels)
    finding = scan_statistic.search(searched, levels)
    expected = expected_points.expected(pairs, surface, observed.stations)
    missing = shaded = regions.missing(field, expected.points, alarms_per_mm2)
    if missing:
        expected = expected_points.without_shade(expected, [one.cells for one in missing], surface, observed.stations)
        missing = regions.missing(field, expected.points, alarms_per_mm2)
    hidden = regions.hidden(expected.hidden | (observed.beside > 0), shaded, missing, field)
    missing += _inferred(scene, registered, field, missing, alarms_per_mm2)
    deviating = regions.of_finding(finding, surface)
    near_mm = max(UNITE_CELLS * surface.charts.cell_mm, UNITE_MM)
    united = regions.united(missing + deviating, surface, near_mm)
    return to_result.Search(
        field=field,
        residuals=residuals,
        levels=levels,
        shapes=shapes,
        significant=significant,
        places=[group for group in united if regions.is_significant(group[0], searched, levels)],
        expected=expected.points,
        hidden=hidden,
        shape_values=shape_values,
        points=measures.points_by_cell(observed, field),
    )


def _inferred(
    scene: Scene, registered: Registered, field: Field, missing: list[Region], alarms_per_mm2: float
) -> list[Region]:
    """Return what is missing where no ray shows it: holes in plates, and of clouds without rays bodies that are gone.

    Rays show nothing where stations are not named, or see a face obliquely alone. ``missing`` is what they show.
    """
    gone: list[Region] = []
    if registered.observed.stations.unnamed:
        gone = missing_bodies.of_bodies(registered.observed, field, alarms_per_mm2)
    known = {cell for region in missing + gone for cell in region.cells.tolist()}
    step = max(1, sum(len(scan.points) for scan in scene.scans) // SD_SAMPLES)
    T = registered.T_design_project
    few = [rigid.apply(T @ scan.pose, every(scan.points, step) + scan.origin) for scan in scene.scans]
    cut = holes.holes(field, np.concatenate(few), alarms_per_mm2)
    return gone + [region for region in cut if known.isdisjoint(region.cells.tolist())]


def _fitted_shapes(registered: Registered, error_mm: float, params: Params) -> tuple[Field, list[ComponentShape]]:
    """Fit shapes of components; align the whole again without the components that have one, if that is more precise."""
    surface, pairs, stations = registered.surface, registered.pairs, registered.observed.stations
    inner = deviation_field.inner_cells(surface, params.edge_mm)

    def fitted(aligned: Alignment) -> tuple[Field, list[ComponentShape]]:
        field = deviation_field.of_pairs(pairs, surface, stations, aligned, inner)
        if aligned.fitted:
            bias = deviation_field.common_bias(field)
            field = dataclasses.replace(field, deviation=field.deviation - bias, bias=bias)
        return field, component_deviations.fit_all(field)

    def median_sd(aligned: Alignment) -> float:
        """Return the median over the surface of the standard deviation that the fit of the whole leaves, mm."""
        rows = slice(None, None, max(1, len(surface.centres) // SD_SAMPLES))
        return float(np.median(aligned.sd(surface.centres[rows], surface.outward[rows])))

    field, shapes = fitted(registered.alignment)
    deformed = component_deviations.deformed(shapes)
    if not (field.alignment.fitted and deformed):
        return field, shapes
    again = alignment.align(pairs, surface, stations, error_mm, deformed)
    # The components left may be few, or all on one side: then the whole is known better by all.
    better = again.fitted and median_sd(again) < median_sd(field.alignment)
    return fitted(again) if better else (field, shapes)
