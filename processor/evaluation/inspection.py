"""Characteristics of parts compared with those of the parts as built.

Those of a bridge's part follow from its true key points and bottom edges, those of a body from the true displacements
of its faces, those of a member from the true centres of its nodes and the bows that were built.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from processor import scene_cloud
from processor.adjustment import thermal
from processor.evaluation.error_statistics import covered
from processor.geometry import mesh_distance
from processor.geometry.lines_and_polylines import Polyline
from processor.inspection import flat_faces, members, part_geometry, structure_bodies
from processor.inspection.arch_parts import design_ends
from processor.inspection.result import InspectedComponent, Quantity, Result
from processor.model import (
    ArchDesign,
    ArchTruth,
    DesignPart,
    Floats,
    FrameDesign,
    Metric,
    Scene,
    Statistic,
    StructureDesign,
    StructureTruth,
    Truth,
)

NAMES = {
    Quantity.LENGTH: "lengths",
    Quantity.THICKNESS: "thicknesses",
    Quantity.WIDTH: "widths and heights",
    Quantity.HEIGHT: "widths and heights",
    Quantity.DIAGONAL: "diagonals",
    Quantity.DIAGONAL_DIFFERENCE: "diagonals",
    Quantity.TWIST: "twists",
    Quantity.SWEEP: "sweeps and cambers",
    Quantity.CAMBER: "sweeps and cambers",
    Quantity.SQUARENESS: "squareness of end faces",
    Quantity.DIAMETER: "diameters",
    Quantity.BOW: "bows",
    Quantity.ANGLE: "angles of sides",
}
OF_SIZE = (Quantity.SWEEP, Quantity.CAMBER, Quantity.BOW)
REACH_MM, ALIKE = 50.0, 0.99  # of a true point to its facet, and cosine between their normals
PIECE_MM, LEAST_FACE_MM = 100.0, 1.0  # as pieces of a measurement are; faces down to 1 mm, as the truth has no noise


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Compare the characteristics of parts and bodies with the truth; all figures are for information."""
    if truth.arch is not None and scene.arch is not None:
        parts = [component for component in result.components if component.name in truth.arch.names]
        true = {component.name: _of_part(scene.arch, component, truth.arch) for component in parts}
    elif truth.frame is not None and scene.frame is not None:
        true = _of_members(scene, scene.frame, truth)
    elif truth.structure is not None and scene.structure is not None and len(truth.structure.points):
        true = _of_bodies(scene.structure, truth.structure)
    else:
        return []
    errors: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for component in result.components:
        found, true_values = component.characteristics, true.get(component.name, {})
        for id_, quantity, unit, deviation, ci95 in zip(
            found.id, found.quantity, found.unit, found.deviation, found.ci95, strict=True
        ):
            if id_ in true_values:
                value = true_values[id_]
                error = abs(deviation) - abs(value) if quantity in OF_SIZE else deviation - value
                errors[NAMES[quantity], unit].append((float(error), float(ci95)))
    metrics = []
    for (name, unit), found_errors in sorted(errors.items()):
        error, half = np.array(found_errors).T
        known = np.isfinite(error)
        if known.any():
            rms = float(np.sqrt(np.mean(error[known] ** 2)))
            metrics += [Metric(name, rms, Statistic.RMS, unit=unit), *covered(name, error, half)]
    return metrics


def _of_part(design: ArchDesign, component: InspectedComponent, truth: ArchTruth) -> dict[str, float]:
    """Return the true deviations of a part of a bridge by id."""
    row = truth.names.index(component.name)
    ends, edges = truth.key_points_bridge[row], truth.edges_bridge[row]
    index = [part.name for part in design.parts].index(component.name)
    as_designed = design_ends(design, index)
    true = part_geometry.deviations(as_designed, ends)
    joined = [bool(np.isfinite(end).all()) for end in as_designed]
    if sum(joined) == 1 and len(design.parts[index].bottom_edge_left):
        end, outermost = (1, 0) if joined[1] else (0, -1)
        designed = [design.parts[index].bottom_edge_left, design.parts[index].bottom_edge_right]
        outer = [np.mean([edge[outermost] for edge in pair], axis=0) for pair in (edges, designed)]
        lengths = [float(np.linalg.norm(at[end, 4] - o)) for at, o in zip((ends, as_designed), outer, strict=True)]
        true["length-bottom"] = lengths[0] - lengths[1]
    if len(component.axis):
        departures = _departures(design.parts[index], edges, component.axis.chainage)
        designed = [design.parts[index].bottom_edge_left, design.parts[index].bottom_edge_right]
        points = [Polyline.through(edge).at(component.axis.chainage) for edge in designed]
        axis = part_geometry.axis_of_shape(*points) @ np.moveaxis(departures, 2, 0).ravel()
        for a, quantity in enumerate((Quantity.SWEEP, Quantity.CAMBER)):
            true[str(quantity)] = float(np.abs(axis[a]).max())
        at = int(np.argmin(np.abs(component.axis.chainage - component.axis.chainage.mean())))
        true["middle-width-bottom"] = float(departures[0, at, 0] - departures[1, at, 0])
    return true


def _of_members(scene: Scene, design: FrameDesign, truth: Truth) -> dict[str, dict[str, float]]:
    """Return the true deviations of members by name and id; tubes have the diameters of the design."""
    assert truth.frame is not None
    built = truth.as_built
    bows = {} if built is None else dict(zip(zip(built.what, built.where, strict=True), built.value, strict=True))
    as_built = dict(zip(truth.frame.ids.tolist(), truth.frame.centres, strict=True))
    as_designed = dict(zip(design.ids.tolist(), design.centres, strict=True))
    factor = thermal.expansion(scene.temperature_C)
    true: dict[str, dict[str, float]] = {}
    for m, (a, b) in enumerate(zip(design.member_a.tolist(), design.member_b.tolist(), strict=True)):
        of_member = {"diameter": 0.0, "bow": float(bows.get(("bow", f"member {m}"), 0.0))}
        if a in as_built and b in as_built:
            actual, nominal = (np.linalg.norm(centres[b] - centres[a]) for centres in (as_built, as_designed))
            of_member["length"] = float(actual / factor - nominal)
        true[members.name_of(design, m)] = of_member
    return true


def _of_bodies(design: StructureDesign, truth: StructureTruth) -> dict[str, dict[str, float]]:
    """Return the true deviations of bodies by name and id: the step's own functions of the true displacements.

    Of flatness there is none, as points of the truth are not dense enough.
    """
    vertices, origin = scene_cloud.local_design(design)
    surface = mesh_distance.of_design(vertices, design.faces)
    facet, _, beyond = surface.distances(truth.points - origin, REACH_MM)
    on = mesh_distance.on_face(facet, beyond) & (np.einsum("ni,ni->n", surface.normals[facet], truth.normals) > ALIKE)
    points, normals, facet = truth.points[on] - origin, truth.normals[on], facet[on]
    moved = np.einsum("ni,ni->n", truth.displacement[on], normals)
    none = np.zeros(len(points))
    seen = flat_faces.Observed(places=points, facet=facet, deviation=moved, noise=none, shared=none, side=PIECE_MM)
    return {
        body.name: {
            one.of: one.value for one in structure_bodies.measured(body, seen)[0] if one.what is not Quantity.FLATNESS
        }
        for body in flat_faces.bodies(design, seen, LEAST_FACE_MM)
    }


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
