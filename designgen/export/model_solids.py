"""The solids of a model's bodies, by their names, and where they are as built."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from designgen.cad import files
from designgen.models import body_deviations, cadquery_objects, loading
from designgen.models.model import Model, ModelBody
from designgen.recipe_params import filled
from designgen.scenes.model import Params, part_solid
from processor.model import UsageError

if TYPE_CHECKING:
    import cadquery as cq


def of_recipe(recipe: Mapping[str, Any]) -> tuple[dict[str, cq.Shape], Model]:
    """Return the solids of the bodies of a recipe's model, by name, mm, and the model.

    Raises UsageError for a model of surfaces or meshes, which has no solids; InputError for a file that is gone.
    """
    section = filled(Params, recipe, "model")
    path = Path(section.file)
    if section.part:
        assembly = part_solid(section.part, recipe)
        solids, model = cadquery_objects.solids(section.part, assembly), loading.load(assembly, name=section.part)
    elif path.suffix.lower() == loading.PYTHON:
        made = cadquery_objects.run(path)
        solids, model = cadquery_objects.solids(str(path), made), loading.load(made, name=path.stem)
    elif path.suffix.lower() in files.STEP_SUFFIXES and not section.units:
        import cadquery as cq

        model = loading.load(path)
        solids = list(cq.importers.importStep(str(path)).solids().vals())
    else:
        solids, model = [], Model(path.stem, ())
    if not solids or len(solids) != len(model.bodies):
        raise UsageError(f"--step: {section.file or section.part} has bodies without a solid; leave --step out")
    return dict(zip((body.name for body in model.bodies), solids, strict=True)), model


def movement(body: ModelBody, params: body_deviations.Params | None) -> cq.Location:
    """Return the movement of a body as built: turned about the middle of its box, and moved."""
    import cadquery as cq

    if params is None:
        return cq.Location()
    middle = cq.Vector(*(0.5 * (body.vertices.min(axis=0) + body.vertices.max(axis=0))))
    turn = np.array(params.turn_deg)
    angle = float(np.linalg.norm(turn))
    axis = cq.Vector(*(turn / angle)) if angle else cq.Vector(0.0, 0.0, 1.0)
    there = cq.Location(middle + cq.Vector(*params.move_mm))
    return there * cq.Location(cq.Vector(), axis, angle) * cq.Location(middle * -1.0)
