"""Characteristics of parts held against those of the parts as built.

Those of the ends follow from the true key points; sweep, camber and the width half way from the true bottom edges.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from processor.evaluation.error_statistics import covered
from processor.geometry.polyline import Polyline
from processor.inspection import part_geometry
from processor.inspection.arch_parts import design_ends
from processor.inspection.result import InspectedComponent, Quantity, Result
from processor.model import ArchDesign, DesignPart, Floats, Metric, Scene, Statistic, Truth

NAMES = {
    Quantity.LENGTH: "lengths",
    Quantity.WIDTH: "widths and heights",
    Quantity.HEIGHT: "widths and heights",
    Quantity.DIAGONAL: "diagonals",
    Quantity.DIAGONAL_DIFFERENCE: "diagonals",
    Quantity.TWIST: "twists",
    Quantity.SWEEP: "sweeps and cambers",
    Quantity.CAMBER: "sweeps and cambers",
    Quantity.SQUARENESS: "squareness of end faces",
}


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Compare the characteristics of the parts of a bridge with the truth; all figures are for information."""
    if truth.arch is None or scene.arch is None:
        return []
    errors: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for component in result.components:
        row = truth.arch.names.index(component.name)
        true = _true(scene.arch, component, truth.arch.key_points_bridge[row], truth.arch.edges_bridge[row])
        found = component.characteristics
        for id_, quantity, deviation, ci95 in zip(found.id, found.quantity, found.deviation, found.ci95, strict=True):
            if id_ in true:
                of_size = quantity in (Quantity.SWEEP, Quantity.CAMBER)
                error = abs(deviation) - abs(true[id_]) if of_size else deviation - true[id_]
                errors[NAMES[quantity]].append((float(error), float(ci95)))
    metrics = []
    for name, found_errors in sorted(errors.items()):
        error, half = np.array(found_errors).T
        known = np.isfinite(error)
        if known.any():
            rms = float(np.sqrt(np.mean(error[known] ** 2)))
            metrics += [Metric("inspect", name, rms, Statistic.RMS, unit="mm"), *covered("inspect", name, error, half)]
    return metrics


def _true(design: ArchDesign, component: InspectedComponent, ends: Floats, edges: Floats) -> dict[str, float]:
    """Return the true deviations of a component by id; edges (2, e, 3) left and right."""
    index = [part.name for part in design.parts].index(component.name)
    joints = [None, *design.joint_points, None]
    as_designed = design_ends(joints[index], joints[index + 1])
    true = part_geometry.deviations(as_designed, ends)
    if index in (0, len(design.parts) - 1):
        end, outermost = (1, 0) if index == 0 else (0, -1)
        designed = [design.parts[index].bottom_edge_left, design.parts[index].bottom_edge_right]
        outer = [np.mean([edge[outermost] for edge in pair], axis=0) for pair in (edges, designed)]
        lengths = [float(np.linalg.norm(at[end, 4] - o)) for at, o in zip((ends, as_designed), outer, strict=True)]
        true["length-bottom"] = lengths[0] - lengths[1]
    if len(component.axis):
        departures = _departures(design.parts[index], edges, component.axis.chainage)
        off = part_geometry.off_the_chord(component.axis.chainage)
        axis = off @ departures.mean(axis=0)
        for a, quantity in enumerate((Quantity.SWEEP, Quantity.CAMBER)):
            true[str(quantity)] = float(np.abs(axis[:, a]).max())
        at = int(np.argmin(np.abs(component.axis.chainage - component.axis.chainage.mean())))
        true["middle-width-bottom"] = float(departures[0, at, 0] - departures[1, at, 0])
    return true


def _departures(part: DesignPart, edges: Floats, chainage: Floats) -> Floats:
    """Return the departures (2, k, 2) of the true edges from the design's at chainages (k,), to the left and up."""
    lines = [Polyline.through(edge) for edge in (part.bottom_edge_left, part.bottom_edge_right)]
    points = [line.at(chainage) for line in lines]
    left = points[0] - points[1]
    left = left / np.linalg.norm(left, axis=1)[:, None]
    found = []
    for line, at, edge in zip(lines, points, edges, strict=True):
        along = line.at(chainage + 5.0) - line.at(chainage - 5.0)
        up = np.cross(along / np.linalg.norm(along, axis=1)[:, None], left)
        off = -Polyline.through(edge).nearest(at)[1]
        found.append(np.stack([np.einsum("ki,ki->k", off, left), np.einsum("ki,ki->k", off, up)], axis=1))
    return np.array(found)
