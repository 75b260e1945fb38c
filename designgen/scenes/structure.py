"""Scenes of whole structures: displaced roofs, truss bridges in separate scans, plates and girders with defects."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from designgen.asbuilt import defects as asbuilt_defects
from designgen.asbuilt import imperfections
from designgen.designs import boxes_and_tubes, defect_specimens, structure_registry
from designgen.designs.parametric_face import Displacement, Patch
from designgen.low_discrepancy import van_der_corput
from designgen.models import as_built
from designgen.models.body_deviations import Defect
from designgen.randomness import generator
from designgen.recipe_params import filled
from designgen.scanning import clutter, picking, sampler, scanner, surroundings, survey
from designgen.scanning.scan_settings import ByRays, Scanning
from designgen.scanning.surfaces import Builder
from processor.model import (
    AsBuilt,
    Bools,
    DefectTruth,
    Floats,
    Labels,
    Picks,
    PointLabels,
    Scan,
    Scene,
    StationTruth,
    StructureDesign,
    StructureTruth,
    Truth,
    UsageError,
)

NEXT_WINDOW_MM = 9_000.0  # from one scan of a station to the next, of a scanner that does not turn
TRUTH_STEP_MM = 250.0  # between places where the truth states a movement, which is smooth over metres
Components = tuple[boxes_and_tubes.Component, ...]
PartPatches = list[tuple[int, Patch]]  # the row of the component of each face
OfDefects = Callable[[Floats, PointLabels], Labels]  # points in the design's frame -> defect of each


PlacedDefect = tuple[defect_specimens.Place, asbuilt_defects.Defect]


class Built(NamedTuple):
    """Faces as built, the displacement of a whole structure, and the truth of plates' defects."""

    patches: PartPatches
    displacement: Displacement | None = None
    defects: DefectTruth | None = None
    of_defects: OfDefects | None = None


def make(name: str, recipe: Mapping[str, Any], scanning: Scanning, seed: int) -> tuple[Scene, Truth]:
    """Make the scene of a structure of type ``structure.type``: stadium-roof, truss-bridge or plate-row."""
    components = structure_registry.design(recipe)
    kind = recipe["structure"]["type"]
    patches, displacement, defects, of_defects = built_faces(kind, components, recipe, seed)
    names = tuple(component.name for component in components)
    stations, station_truth, picks = None, None, None
    origin = np.zeros(3)
    if isinstance(scanning, ByRays):
        params = scanning.params
        origin = np.array(params.origin_mm)
        builder = Builder()
        for part, patch in patches:
            builder.patch(part, patch)
        poses = _places(kind, patches, params, seed)
        _add_poles(builder, poses, patches, params.clutter, seed)
        corners = np.vstack([boxes_and_tubes.mesh_of((one,))[0] for one in components if one.name != "ground"])
        box = surroundings.Box.about(corners)
        surroundings.add(builder, scanning.surroundings, box, poses, seed, on_ground="ground" in names)
        surveyed = survey.survey(builder.to_surfaces(), names, poses, scanning.device, params, seed)
        if of_defects is not None:
            surveyed = _labelled(surveyed, of_defects)
        scans, labels, stations, station_truth = survey.in_project(surveyed, params, registered=params.registered)
        picks = _picks(recipe, scans, station_truth, params, corners + origin, seed)
    else:
        if "picks" in recipe:
            raise UsageError('picks: points are picked in scans by rays; set scan.mode = "rays"')
        # Overlapping bodies cover each other, as built where they do as designed: displacements are smooth. Plates of a
        # row only touch.
        hidden = None if kind == "plate-row" else _hidden(components)
        cloud = sampler.scan_patches(patches, scanning, generator(seed, "scan"), hidden)
        scans = (Scan("scan", cloud.points, sigma_mm=scanning.sigma_mm),)
        label = PointLabels("scan", names, cloud.part, cloud.source)
        if of_defects is not None:
            label = dataclasses.replace(label, defect=of_defects(cloud.points, label))
        labels = (label,)
    vertices, faces = boxes_and_tubes.mesh_of(components)
    scene = Scene(
        name,
        "structure",
        scans,
        stations=stations,
        structure=StructureDesign(kind, vertices + origin, faces),
        picks=picks,
    )
    return scene, Truth(
        labels,
        structure=_truth(components, displacement, origin),
        defects=defects and dataclasses.replace(defects, centres=defects.centres + origin),
        stations=station_truth,
        as_built=_ledger(kind, recipe),
    )


def _labelled(surveyed: survey.Survey, of_defects: OfDefects) -> survey.Survey:
    """Label the points of a survey with the defects that displaced them."""
    labels = [
        dataclasses.replace(label, defect=of_defects(scan.points @ T[:3, :3].T + T[:3, 3], label))
        for scan, label, T in zip(surveyed.scans, surveyed.labels, surveyed.truth.T_project_station, strict=True)
    ]
    return dataclasses.replace(surveyed, labels=tuple(labels))


def _picks(
    recipe: Mapping[str, Any],
    scans: Sequence[Scan],
    truth: StationTruth,
    scanning: scanner.Params,
    corners: Floats,
    seed: int,
) -> Picks | None:
    if "picks" not in recipe:
        return None
    T_project_scan = dict(zip(truth.ids, truth.T_project_station, strict=True))
    if any(scan.name not in T_project_scan for scan in scans):
        raise UsageError("picks: points are picked in scans of one station each; set scan.merged = false")
    params = filled(picking.Params, recipe, "picks")
    poses = [T_project_scan[scan.name] for scan in scans]
    return picking.pick(scans, poses, params, seed, corners, scanning.sees)[0]


def built_faces(kind: str, components: Components, recipe: Mapping[str, Any], seed: int) -> Built:
    """Return a structure as built."""
    if kind == "plate-row":
        return _plates(components, recipe, seed)
    designed = _as_designed(components)
    if "asbuilt" not in recipe:
        return Built(designed)
    if kind == "truss-bridge":
        raise UsageError("asbuilt: a truss-bridge is built as designed; leave the section asbuilt out")
    displacement = asbuilt_defects.movement(filled(asbuilt_defects.MovementParams, recipe, "asbuilt"), components)
    return Built([(part, patch.displaced(displacement)) for part, patch in designed], displacement)


def _ledger(kind: str, recipe: Mapping[str, Any]) -> AsBuilt:
    """Return the displacement of a roof; defects of plates and girders are in the truth of defects instead."""
    ledger = imperfections.Ledger()
    if kind == "stadium-roof" and "asbuilt" in recipe:
        params = filled(asbuilt_defects.MovementParams, recipe, "asbuilt")
        ledger.note("sag at the middle", "roof", params.sag_mm, "mm")
        ledger.note("lean at the top", "roof", params.lean_mm, "mm")
        ledger.note("ripple at the middle", "roof", params.ripple_mm, "mm")
        ledger.note("ripples around", "roof", params.ripples, "count")
    return ledger.record()


def _plates(components: Components, recipe: Mapping[str, Any], seed: int) -> Built:
    form = structure_registry.params(recipe)
    sizes = filled(asbuilt_defects.Params, recipe, "asbuilt")
    patches: PartPatches = []
    placed: list[PlacedDefect] = []
    for part, place in enumerate(defect_specimens.places(form)):
        if place.defect == "none":
            patches += [(part, patch) for patch in components[part].patches]
            continue
        defect = asbuilt_defects.draw(place.defect, sizes, form, generator(seed, f"defect {place.name}"), place.name)
        patches += [
            (part, patch) for patch in asbuilt_defects.damaged(place, defect_specimens.bodies(form, place), defect)
        ]
        placed.append((place, defect))
    of_bodies = []
    for place, defect in placed:
        centre, size = place.origin + np.array([*defect.place, 0.0]) @ defect_specimens.AXES, defect.area_mm2
        of_bodies.append(Defect(defect.kind, place.name, centre, size, defect.depth_max_mm, volume=defect.volume_mm3))
    return Built(patches, defects=as_built.defect_truth(of_bodies), of_defects=partial(_defects_of, placed))


def _defects_of(placed: Sequence[PlacedDefect], at: Floats, label: PointLabels) -> Labels:
    """Return the row in ``placed`` of the defect that displaced the surface at each of the points ``at``, -1 = none."""
    rows = np.full(len(at), -1, np.int32)
    for number, (place, defect) in enumerate(placed):
        of_component = np.flatnonzero(label.part == label.part_names.index(place.name))
        if defect.front_only and len(label.surface):
            fronts = [row for row, name in enumerate(label.surface_names) if name == "0 +n"]
            of_component = of_component[np.isin(label.surface[of_component], fronts)]
        rows[of_component[defect.displaces(place.local(at[of_component]))]] = number
    return rows


def _as_designed(components: Components) -> PartPatches:
    return [(part, patch) for part, component in enumerate(components) for patch in component.patches]


def _hidden(components: Components) -> Callable[[int, Floats, Floats], Bools]:
    """Return a function that marks the places on the design's faces inside of a body."""
    faces = [patch for _, patch in _as_designed(components)]
    inside = boxes_and_tubes.covered(components)
    return lambda row, p, q: inside(faces[row].at(p, q))


def _places(kind: str, patches: PartPatches, params: scanner.Params, seed: int) -> dict[str, Floats]:
    """Return the stations' poses: on the ground before a row of plates, beside a truss, or inside of a stadium.

    More stations leave the first unchanged.
    """
    corners = np.vstack([patch.at(patch.p[[0, -1, -1, 0]], patch.q[[0, 0, -1, -1]]) for _, patch in patches])
    low, high = corners.min(axis=0), corners.max(axis=0)
    poses = {}
    for i in range(int(np.prod(params.stations))):
        station = f"S{i + 1}"
        rng = generator(seed, f"place {station}")
        fraction = van_der_corput(i + 1)  # independent of the number of stations
        if kind == "plate-row":
            at = np.array([low[0] + fraction * (high[0] - low[0]), low[1] - params.distance_mm, params.height_mm])
        elif kind == "truss-bridge":
            # Along both sides, alternately; neighbours on one side overlap.
            side = 1.0 if i % 2 else -1.0
            at = np.array([12_000.0 * (i // 2) + 3_000.0, side * params.distance_mm, params.height_mm])
        else:
            angle = 2.0 * np.pi * fraction
            reach = 0.5 * (high - low)[:2] * 0.45
            at = np.array([*(0.5 * (low + high)[:2] + reach * [np.cos(angle), np.sin(angle)]), params.height_mm])
        at[:2] += rng.uniform(-300.0, 300.0, 2)
        scans = params.scans_at_first if i < params.repeated else 1
        for k in range(scans):
            heading = generator(seed, f"heading {station} {k}").uniform(0.0, 2.0 * np.pi)
            if not params.turns:  # its window is on the bridge, and moves along it from scan to scan
                aim = np.array([12_000.0 * (i // 2) + 3_000.0 + NEXT_WINDOW_MM * k, 0.0]) - at[:2]
                heading = float(np.arctan2(aim[1], aim[0])) + 0.02 * (heading / np.pi - 1.0)
            poses[station if scans == 1 else f"{station}-{k + 1}"] = survey.levelled_pose(at, heading)
    return poses


def _add_poles(builder: Builder, poses: dict[str, Floats], patches: PartPatches, count: int, seed: int) -> None:
    """Add poles on the ground, each between a station, in rotation, and a random face above the ground."""
    places = list(dict.fromkeys(tuple(T[:3, 3]) for T in poses.values()))  # some stations scan more than once
    half = np.array([0.5])
    middles = np.vstack([patch.at(half, half) for _, patch in patches])
    middles = middles[middles[:, 2] > 0.0]
    for i in range(count):
        rng = generator(seed, f"clutter {i}")
        target = middles[rng.integers(len(middles))]
        station = np.array(places[i % len(places)])
        clutter.add_pole(builder, station, target, clutter.UP, (0.2, 0.4), rng, on_ground=True)


def _truth(components: Components, displacement: Displacement | None, origin: Floats) -> StructureTruth | None:
    """Return points of the design along every face, but not inside of other bodies, with normals and displacements."""
    if displacement is None:
        return None
    points, normals = [], []
    for component in components:
        for patch in component.patches:
            corners = patch.at(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
            count = max(2, int(np.linalg.norm(corners[1] - corners[0]) / TRUTH_STEP_MM))
            p, q = (x.ravel() for x in np.meshgrid((np.arange(count) + 0.5) / count, np.arange(8) / 8.0, indexing="ij"))
            h = 1e-4
            du = patch.at(p + h, q) - patch.at(p - h, q)
            dv = patch.at(p, q + h) - patch.at(p, q - h)
            normal = np.cross(du, dv)
            points.append(patch.at(p, q))
            normals.append(normal / np.linalg.norm(normal, axis=1)[:, None])
    x = np.vstack(points)
    visible = ~boxes_and_tubes.covered(components)(x)
    x = x[visible]
    return StructureTruth(x + origin, np.vstack(normals)[visible], displacement(x))
