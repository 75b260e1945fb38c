"""Scenes of whole structures: roofs that moved, truss bridges to be stitched, plates and girders with defects."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from designgen import sequences
from designgen.asbuilt import defects as asbuilt_defects
from designgen.asbuilt import imperfections
from designgen.designs import plate_row, stadium_roof, structure, truss_bridge
from designgen.randomness import generator
from designgen.reading import filled
from designgen.scanning import clutter, picking, sampler, scanner, survey
from designgen.scanning.modes import ByRays, Scanning
from designgen.scanning.surfaces import Bools, Builder, Patch
from processor.model import (
    AsBuilt,
    DefectTruth,
    Floats,
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

TRUTH_STEP_MM = 250.0
Surface = Callable[[Floats, Floats], Floats]
Components = tuple[structure.Component, ...]
Built = tuple[list[tuple[int, Patch]], Callable[[Floats], Floats] | None, DefectTruth | None]


def design(recipe: Mapping[str, Any]) -> tuple[structure.Component, ...]:
    """Return the components of a structure's recipe as designed."""
    section = dict(recipe.get("structure", {}))
    builders: dict[Any, Callable[[], tuple[structure.Component, ...]]] = {
        "stadium-roof": lambda: stadium_roof.build(filled(stadium_roof.Params, {"structure": section}, "structure")),
        "truss-bridge": lambda: truss_bridge.build(filled(truss_bridge.Params, {"structure": section}, "structure")),
        "plate-row": lambda: plate_row.build(filled(plate_row.Params, {"structure": section}, "structure")),
    }
    kind = section.pop("type", None)
    if kind not in builders:
        raise UsageError(f"structure.type: expected one of {', '.join(builders)}, got {kind!r}")
    return builders[kind]()


def make(name: str, recipe: Mapping[str, Any], scanning: Scanning, seed: int) -> tuple[Scene, Truth]:
    """Make a structure's scene; ``structure.type`` says which: stadium-roof, truss-bridge or plate-row."""
    components = design(recipe)
    kind = recipe["structure"]["type"]
    patches, move, defects = BUILDERS[kind](components, recipe, seed)
    names = tuple(one.name for one in components)
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
        found = survey.survey(builder.done(), names, poses, scanning.device, params, seed)
        scans, labels, stations, station_truth = survey.in_project(found, origin, params.merged)
        picks = _picks(recipe, scans, station_truth, seed)
        if not params.registered:
            scans = tuple(dataclasses.replace(scan, T_project_scan=np.empty(0)) for scan in scans)
            stations = None
    else:
        if "picks" in recipe:
            raise UsageError('picks: points are picked in scans by rays; set scan.mode = "rays"')
        # Where bodies meet, one hides the other: told by the design, as the movement is smooth. Plates only touch.
        hidden = None if kind == "plate-row" else _hidden(components)
        cloud = sampler.scan_patches(patches, scanning, generator(seed, "scan"), hidden)
        scans = (Scan("scan", cloud.points, sigma_mm=scanning.sigma_mm),)
        labels = (PointLabels("scan", names, cloud.part, cloud.source),)
    vertices, faces = structure.mesh_of(components)
    scene = Scene(
        name,
        "structure",
        scans,
        stations=stations,
        units="mm",
        units_reason="made in millimetres",
        structure=StructureDesign(kind, vertices + origin, faces),
        picks=picks,
    )
    return scene, Truth(
        labels,
        structure=_truth(components, move, origin),
        defects=defects and dataclasses.replace(defects, centres=defects.centres + origin),
        stations=station_truth,
        as_built=_ledger(kind, recipe),
        spacing_mm=sampler.spacing_mm(scanning),
        sigma_mm=sampler.sigma_mm(scanning),
    )


def _picks(recipe: Mapping[str, Any], scans: Sequence[Scan], truth: StationTruth, seed: int) -> Picks | None:
    if "picks" not in recipe:
        return None
    T_project_scan = dict(zip(truth.ids, truth.T_project_station, strict=True))
    if any(scan.name not in T_project_scan for scan in scans):
        raise UsageError("picks: points are picked in scans of one station each; set scan.merged = false")
    params = filled(picking.Params, recipe, "picks")
    return picking.pick(scans, [T_project_scan[scan.name] for scan in scans], params, seed)[0]


def _stadium(components: Components, recipe: Mapping[str, Any], seed: int) -> Built:
    if "asbuilt" not in recipe:
        return _as_designed(components), None, None
    move = asbuilt_defects.movement(filled(asbuilt_defects.MovementParams, recipe, "asbuilt"), components)
    moved = [(part, dataclasses.replace(patch, at=_moved(patch.at, move))) for part, patch in _as_designed(components)]
    return moved, move, None


def _ledger(kind: str, recipe: Mapping[str, Any]) -> AsBuilt:
    """Return how a roof moved; what is wrong with plates and girders is in the truth of their defects."""
    ledger = imperfections.Ledger()
    if kind == "stadium-roof" and "asbuilt" in recipe:
        params = filled(asbuilt_defects.MovementParams, recipe, "asbuilt")
        ledger.note("sag at the middle", "roof", params.sag_mm, "mm")
        ledger.note("lean at the top", "roof", params.lean_mm, "mm")
        ledger.note("ripple at the middle", "roof", params.ripple_mm, "mm")
        ledger.note("ripples around", "roof", params.ripples, "count")
    return ledger.record()


def _moved(at: Surface, move: asbuilt_defects.Displacement) -> Surface:
    def where(p: Floats, q: Floats) -> Floats:
        points = at(p, q)
        found: Floats = points + move(points)
        return found

    return where


def _truss(components: Components, recipe: Mapping[str, Any], seed: int) -> Built:
    if "asbuilt" in recipe:
        raise UsageError("asbuilt: a truss-bridge is built as designed; leave the section asbuilt out")
    return _as_designed(components), None, None


def _plates(components: Components, recipe: Mapping[str, Any], seed: int) -> Built:
    section = {key: value for key, value in recipe["structure"].items() if key != "type"}
    form = filled(plate_row.Params, {"structure": section}, "structure")
    sizes = filled(asbuilt_defects.Params, recipe, "asbuilt")
    patches: list[tuple[int, Patch]] = []
    found: list[tuple[plate_row.Place, asbuilt_defects.Defect]] = []
    for part, place in enumerate(plate_row.places(form)):
        if place.defect == "none":
            patches += [(part, patch) for patch in components[part].patches]
            continue
        defect = asbuilt_defects.draw(place.defect, sizes, form, generator(seed, f"defect {place.name}"), place.name)
        patches += [(part, patch) for patch in asbuilt_defects.damaged(place, plate_row.bodies(form, place), defect)]
        found.append((place, defect))
    centres = [place.origin + np.array([*defect.place, 0.0]) @ plate_row.AXES for place, defect in found]
    truth = DefectTruth(
        np.arange(len(found)),
        tuple(defect.kind for _, defect in found),
        tuple(place.name for place, _ in found),
        np.array(centres).reshape(-1, 3),
        np.array([defect.area_mm2 for _, defect in found]),
        np.array([defect.depth_max_mm for _, defect in found]),
        np.array([defect.volume_mm3 for _, defect in found]),
    )
    return patches, None, truth


BUILDERS = {"stadium-roof": _stadium, "truss-bridge": _truss, "plate-row": _plates}


def _as_designed(components: tuple[structure.Component, ...]) -> list[tuple[int, Patch]]:
    return [(part, patch) for part, one in enumerate(components) for patch in one.patches]


def _hidden(components: Components) -> Callable[[int, Floats, Floats], Bools]:
    """Return a function that says which places on the design's faces lie inside of a body."""
    faces = [patch for _, patch in _as_designed(components)]
    inside = structure.covered(components)
    return lambda row, p, q: inside(faces[row].at(p, q))


def _places(kind: str, patches: list[tuple[int, Patch]], params: scanner.Params, seed: int) -> dict[str, Floats]:
    """Return where the stations stand: before a row of plates, beside a truss, within a stadium, on the ground.

    A station more leaves the others where they are.
    """
    corners = np.vstack([patch.at(patch.p[[0, -1, -1, 0]], patch.q[[0, 0, -1, -1]]) for _, patch in patches])
    low, high = corners.min(axis=0), corners.max(axis=0)
    poses = {}
    for i in range(int(np.prod(params.stations))):
        station = f"S{i + 1}"
        rng = generator(seed, f"place {station}")
        share = sequences.van_der_corput(i + 1)  # whatever the count
        if kind == "plate-row":
            at = np.array([low[0] + share * (high[0] - low[0]), low[1] - params.distance_mm, params.height_mm])
        elif kind == "truss-bridge":
            # Along both sides, and turn and turn about: neighbours on one side overlap.
            side = 1.0 if i % 2 else -1.0
            at = np.array([12_000.0 * (i // 2) + 3_000.0, side * params.distance_mm, params.height_mm])
        else:
            turn = 2.0 * np.pi * share
            reach = 0.5 * (high - low)[:2] * 0.45
            at = np.array([*(0.5 * (low + high)[:2] + reach * [np.cos(turn), np.sin(turn)]), params.height_mm])
        at[:2] += rng.uniform(-300.0, 300.0, 2)
        again = params.scans_at_first if i < params.repeated else 1
        for k in range(again):
            heading = generator(seed, f"heading {station} {k}").uniform(0.0, 2.0 * np.pi)
            poses[station if again == 1 else f"{station}-{k + 1}"] = survey.levelled(at, heading)
    return poses


def _add_poles(
    builder: Builder, poses: dict[str, Floats], patches: list[tuple[int, Patch]], count: int, seed: int
) -> None:
    """Add poles on the ground, each between a station, in turn, and a face drawn above the ground."""
    places = list(dict.fromkeys(tuple(T[:3, 3]) for T in poses.values()))  # some stations scan more than once
    half = np.array([0.5])
    middles = np.vstack([patch.at(half, half) for _, patch in patches])
    middles = middles[middles[:, 2] > 0.0]
    for i in range(count):
        rng = generator(seed, f"clutter {i}")
        target = middles[rng.integers(len(middles))]
        station = np.array(places[i % len(places)])
        clutter.add_pole(builder, station, target, np.array([0.0, 0.0, 1.0]), (0.2, 0.4), rng, on_ground=True)


def _truth(
    components: tuple[structure.Component, ...], move: Callable[[Floats], Floats] | None, origin: Floats
) -> StructureTruth | None:
    """Return points of the design a step apart along every face but inside of other bodies, and how each has moved."""
    if move is None:
        return None
    points, normals = [], []
    for one in components:
        for patch in one.patches:
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
    seen = ~structure.covered(components)(x)
    x = x[seen]
    return StructureTruth(x + origin, np.vstack(normals)[seen], move(x))
