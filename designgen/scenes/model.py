"""Scenes of models: any CAD file, mesh or CadQuery object, scanned from stations around it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from designgen.designs import arch_bridge, arch_part
from designgen.models import as_built, body_deviations, loading, station_placement
from designgen.models.model import Model
from designgen.recipe_files import Recipe, overridden
from designgen.recipe_params import filled
from designgen.scanning import scanner as scanner_module
from designgen.scanning import surroundings, survey
from designgen.scanning.scan_settings import ByRays, Scanning
from designgen.scanning.surfaces import Builder
from processor.model import Scene, StructureDesign, Truth, UsageError

if TYPE_CHECKING:
    import cadquery as cq


@dataclass(frozen=True)
class Params:
    """The model's file, the unit of its numbers ("": as the file states), and a file of stations ("": placed).

    In place of a file, ``part`` is a part of an arch bridge (foot1, rib1, ...) whose sizes are in [bridge].
    """

    file: str = ""
    part: str = ""
    units: str = ""
    stations: str = ""


def recipe_of(
    file: str,
    stations: int | str | PathLike[str],
    scanner: str,
    units: str,
    settings: Sequence[str] | Mapping[str, Any],
) -> Recipe:
    """Return the recipe of a scan of a model: ``stations`` is a number or a JSON file of places."""
    if isinstance(stations, bool) or not isinstance(stations, Integral | str | PathLike):
        raise UsageError(f"stations: expected a number from 1 or a .json file, got {stations!r}")
    places = str(stations)
    recipe: Recipe = {
        "kind": "structure",
        "model": {"file": file, "units": units},
        "scan": {"mode": scanner_module.MODE, "scanner": scanner},
    }
    if isinstance(stations, Integral) or places.isdigit():
        recipe["scan"]["stations"] = [int(places)]
    elif places.lower().endswith(".json"):
        recipe["model"]["stations"] = places
    else:
        raise UsageError(f"--stations {stations}: expected a number from 1 or a .json file")
    return overridden(recipe, settings)


def make(
    name: str, recipe: Mapping[str, Any], scanning: Scanning, seed: int, model: Model | None = None
) -> tuple[Scene, Truth]:
    """Make the scene of a model and its truth; without a model, that of the file which the recipe names."""
    section = filled(Params, recipe, "model")
    if bool(section.file) == bool(section.part) and model is None:
        raise UsageError(f'model.file: expected a file, or a part in its place, got "{section.file}"')
    if not isinstance(scanning, ByRays):
        raise UsageError('scan.mode: a model is scanned from stations; set scan.mode = "rays"')
    if model is None:
        part = part_solid(section.part, recipe) if section.part else None
        file = Path(section.file)
        model = loading.load(file, section.units) if part is None else loading.load(part, name=section.part)
    loading.log_notes(model)
    params, origin = scanning.params, np.array(scanning.params.origin_mm)
    names = tuple(body.name for body in model.bodies)
    built = as_built.build(model, body_deviations.params_of(recipe, names), seed)
    if section.stations:
        poses = station_placement.read_stations(Path(section.stations), seed)
    else:
        distance = params.distance_mm if "distance_mm" in recipe.get("scan", {}) else None
        poses = station_placement.place_stations(model, math.prod(params.stations), distance, scanning.device, seed)
    builder = Builder()
    for number, body in enumerate(built.bodies):
        for patch, smooth in body.patches() if body is not None else ():  # None: left out
            builder.patch(number, patch, smooth)
    surroundings.add(builder, scanning.surroundings, surroundings.Box.about(model.mesh()[0]), poses, seed)
    surveyed = survey.survey(builder.to_surfaces(), names, poses, scanning.device, params, seed)
    scans, labels, stations, station_truth = survey.in_project(surveyed, params, registered=params.registered)
    vertices, faces = model.mesh()
    scene = Scene(
        name,
        "structure",
        scans,
        stations=stations,
        structure=StructureDesign(model.name, vertices + origin, faces, model.design_bodies()),
    )
    return scene, Truth(
        labels,
        structure=dataclasses.replace(built.movement, points=built.movement.points + origin),
        defects=dataclasses.replace(built.defects, centres=built.defects.centres + origin),
        stations=station_truth,
        as_built=built.ledger,
    )


def part_solid(name: str, recipe: Mapping[str, Any]) -> cq.Assembly:
    """Return the solid of a part of an arch bridge, in the bridge's frame; UsageError for a part that it has not."""
    import cadquery as cq

    parts = {part.name: part for part in arch_bridge.build(filled(arch_bridge.Params, recipe, "bridge"))}
    if name not in parts:
        raise UsageError(f'model.part: expected one of {", ".join(parts)}, got "{name}"')
    return cq.Assembly(name="bridge").add(arch_part.solid(parts[name]), name=name)
