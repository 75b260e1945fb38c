"""Method ``default``: from a scene to its defects."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from processor.defects import (
    alignment,
    component_shapes,
    design_pose,
    deviation_field,
    measures,
    missing_material,
    observations,
    regions,
    scan_statistic,
    surface_charts,
    to_result,
)
from processor.defects.params import Params
from processor.defects.result import Result
from processor.geometry import merging, rigid
from processor.model import Floats, InputError, Scene

CELL_POINTS = 12.0  # in a cell, on the median
CELL_BOUNDS_MM = (5.0, 60.0)
FIRST_CELL_MM = 50.0
MOST_CELLS = 4_000_000
AGAIN_MM = 2.0  # a movement of the whole beyond which points are put to the design once more
ROUNDS = 3


def defects(scene: Scene, params: Params, earlier: dict[str, Any]) -> Result:
    """Find the defects of a structure against its design. Raises InputError without a design or without points."""
    design = scene.structure
    if design is None or not len(design.faces):
        raise InputError(f"{scene.name}: defects need the structure's design (a mesh or STEP in project.toml)")
    vertices, origin = merging.local_design(design)
    scene = merging.stitched(scene, earlier.get("stitch"))
    placed = design_pose.pose(scene, earlier, params)
    if placed.T_design_project is None:
        return Result("failed", params.method, placed.said)
    T = rigid.transform(np.eye(3), -origin) @ placed.T_design_project
    base = surface_charts.of_mesh(vertices, design.faces, _coarse(vertices, design.faces))
    for _ in range(ROUNDS):
        seen = observations.observe(scene, T, base, params.reach_mm)
        if not len(seen.chart):
            return Result("failed", params.method, "no point of the scans is near the design; " + design_pose.ADVICE)
        cell = params.cell_mm or observations.fitting_cell(seen, base, CELL_POINTS, CELL_BOUNDS_MM)
        cell = max(cell, float(np.sqrt(base.area_mm2 / MOST_CELLS)))
        whole = surface_charts.gridded(base, cell)
        pairs = observations.paired(seen, whole)
        if not params.align:
            fitted = alignment.none(whole, len(seen.stations.names), placed.error_mm)
            break
        fitted = alignment.align(pairs, whole, seen.stations, placed.error_mm)
        if _largest(fitted, whole) < AGAIN_MM:
            break
        T = alignment.moved(T, fitted)
    offered, near = seen.offered, len(seen.chart)
    stations = seen.stations
    field = deviation_field.of_pairs(pairs, whole, stations, fitted, params.edge_mm)
    alarms = params.false_alarms / (1e6 * params.per_m2)
    shaped = component_shapes.fit_all(field, whole, fitted)
    apart = component_shapes.shaped_ones(shaped)
    if fitted.fitted and apart:
        again = alignment.align(pairs, whole, stations, placed.error_mm, apart)
        # Components that are few, or all to one side, may tell less than many of which some moved.
        if again.fitted and _typical_sd(again, whole) < _typical_sd(fitted, whole):
            fitted = again
            field = deviation_field.of_pairs(pairs, whole, stations, fitted, params.edge_mm)
            shaped = component_shapes.fit_all(field, whole, fitted)
    kept = {one.component: [s for s in one.fitted.shapes if s.kind != "bump"] for one in shaped}
    left = field.less(component_shapes.values(whole, shaped, kept))
    levels = scan_statistic.levels_of(left, whole, alarms, params.systematic_mm)
    judged = component_shapes.significant(shaped, whole, field, fitted, levels, alarms)
    kept = {number: [one.shape for one in own] for number, own in judged.items()}
    shape_values = component_shapes.values(whole, shaped, kept)
    left = field.less(shape_values).without(component_shapes.jumps(whole, shaped, kept))
    finding = scan_statistic.search(left, whole, levels)
    hoped = missing_material.expected(scene, T, pairs, whole, stations)
    places = regions.united(
        regions.missing(field, hoped, whole, alarms) + regions.of_finding(finding, whole), whole, max(3.0 * cell, 25.0)
    )
    found = to_result.Found(whole, field, left, fitted, levels, shaped, judged, places, hoped, shape_values,
                         measures.near_of(seen, whole, fitted))  # fmt: skip
    result = to_result.result_of(found, params, scene.name)
    moved = rigid.transform(np.eye(3), origin) @ alignment.moved(T, fitted)
    said = f"{placed.said}; {result.message}" if placed.said else result.message
    return dataclasses.replace(
        result,
        status=placed.status if result.status == "ok" else result.status,
        T_design_project=moved,
        centres=result.centres + origin,
        surface_at=result.surface_at + origin,
        points=offered,
        used=near,
        message=said,
    )


def _coarse(vertices: Floats, faces: Any) -> float:
    """Return a first size of cells that makes no more of them than memory likes."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return max(FIRST_CELL_MM, float(np.sqrt(area / (0.25 * MOST_CELLS))))


def _typical_sd(fitted: alignment.Alignment, whole: surface_charts.DesignSurface) -> float:
    """Return the median over the surface of what the fit of the whole leaves uncertain, mm."""
    rows = slice(None, None, max(1, len(whole.centres) // 20_000))
    return float(np.median(fitted.sd(whole.centres[rows], whole.outward[rows])))


def _largest(fitted: alignment.Alignment, whole: surface_charts.DesignSurface) -> float:
    """Return how far the whole was moved at most, mm, along the normals of cells."""
    rows = slice(None, None, max(1, len(whole.centres) // 20_000))
    points, outward = whole.centres[rows], whole.outward[rows]
    J = np.hstack([np.cross(points - fitted.centre, outward), outward])
    return float(np.abs(J @ fitted.whole).max())
