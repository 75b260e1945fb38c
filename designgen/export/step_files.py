"""The CAD solids of a recipe's design as STEP files (AP214, mm)."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from designgen.asbuilt import imperfections
from designgen.asbuilt.imperfections import Ledger
from designgen.cad.process import escape
from designgen.designs import (
    arch_bridge,
    arch_part,
    bolt_holes,
    boxes_and_tubes,
    closed_ring,
    girder_assemblies,
    prismatic_solids,
    space_frame,
    structure_registry,
)
from designgen.export import model_solids
from designgen.models import body_deviations
from designgen.randomness import generator
from designgen.recipe_params import filled
from designgen.scenes import assembly
from processor.model import UsageError
from processor.store.whole_output import replacing

if TYPE_CHECKING:
    import cadquery as cq

WRITTEN = "1970-01-01T00:00:00"  # date in every file, so that the same design gives the same bytes


def write_as_built(recipe: Mapping[str, Any], seed: int, folder: Path) -> list[Path]:
    """Write the solids of what a recipe built otherwise than designed; return the files, none where all is as designed.

    Parts of an arch or ring have their ends, twist, bow, section, corners and plates at the design's temperature, but
    no waves, dents and missing pieces; parts of assemblies and frames have all their errors; bodies of a model are
    moved and turned or missing, but not bent or dented.
    """
    if "asbuilt" not in recipe:
        return []
    kind, written = recipe.get("kind"), []
    if kind in ("arch-bridge", "ring"):
        parts = _parts_of_arch(recipe)
        errors = filled(imperfections.ArchParams, recipe, "asbuilt")
        rngs = [generator(seed, f"built {part.name}") for part in parts]
        folder.mkdir(exist_ok=True)
        for part in imperfections.arch(parts, errors, rngs, Ledger()):
            written.append(folder / f"{part.name}.step")
            write_step(written[-1], {part.name: arch_part.solid(part)})
    elif kind == "assembly":
        solids = {part.name: prismatic_solids.as_built(part) for part in assembly.built(recipe, seed, Ledger())[1]}
        written.append(folder / "assembly.step")
        folder.mkdir(exist_ok=True)
        write_step(written[-1], solids)
    elif kind == "space-frame":
        errors_of_frame = filled(imperfections.FrameParams, recipe, "asbuilt")
        nominal = space_frame.build(filled(space_frame.Params, recipe, "frame"))
        frame = imperfections.frame(nominal, errors_of_frame, generator(seed, "built"), Ledger())
        written.append(folder / "frame.step")
        folder.mkdir(exist_ok=True)
        write_step(written[-1], {"frame": space_frame.solid(frame)}, _origin(recipe))
    elif "model" in recipe:
        shapes, model = model_solids.of_recipe(recipe)
        params = body_deviations.params_of(recipe, tuple(shapes))
        built = {
            body.name: shapes[body.name].moved(model_solids.movement(body, params.get(body.name)))
            for body in model.bodies
            if not (body.name in params and params[body.name].missing)
        }
        folder.mkdir(exist_ok=True)
        written.append(folder / "structure.step")
        write_step(written[-1], built, _origin(recipe))
    return written


def write_design(recipe: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write the solids of a recipe's design in the scene's frame, a file for each arch part; return the files.

    Raises UsageError where the recipe has no design, or its model no solids.
    """
    folder.mkdir(exist_ok=True)
    kind = recipe.get("kind")
    shapes: dict[str, cq.Shape]
    if kind in ("arch-bridge", "ring"):
        parts = _parts_of_arch(recipe)
        written = [folder / f"{part.name}.step" for part in parts]
        for path, part in zip(written, parts, strict=True):
            write_step(path, {part.name: arch_part.solid(part)})
        return written
    if kind == "space-frame":
        path = folder / "frame.step"
        shapes = {"frame": space_frame.solid(space_frame.build(filled(space_frame.Params, recipe, "frame")))}
    elif kind == "structure" and "model" in recipe:
        path, (shapes, _) = folder / "structure.step", model_solids.of_recipe(recipe)
    elif kind == "structure":
        path = folder / "structure.step"
        components = structure_registry.design(recipe)
        shapes = {component.name: boxes_and_tubes.solid([component]) for component in components}
    elif kind == "assembly":
        # The solids of the girders and nodes of an assembly
        bolts = filled(bolt_holes.Params, recipe, "bolts") if "bolts" in recipe else None
        built = girder_assemblies.build(filled(girder_assemblies.Params, recipe, "assembly"), bolts).parts
        path, shapes = folder / "assembly.step", {part.name: prismatic_solids.solid(part.made_of) for part in built}
    else:
        raise UsageError("--step: the scene does not name the recipe it was made from, so its solids are not known")
    write_step(path, shapes, _origin(recipe))
    return [path]


def _origin(recipe: Mapping[str, Any]) -> Sequence[float]:
    """Return the position (3,) of a design's own origin in the scene's frame, mm."""
    origin: Sequence[float] = recipe.get("scan", {}).get("origin_mm", (0.0, 0.0, 0.0))
    return origin


def _parts_of_arch(recipe: Mapping[str, Any]) -> tuple[arch_part.ArchPart, ...]:
    """Return the parts of an arch bridge or of a closed ring."""
    if recipe["kind"] == "ring":
        return closed_ring.build(filled(closed_ring.Params, recipe, "ring"))
    return arch_bridge.build(filled(arch_bridge.Params, recipe, "bridge"))


def write_step(path: Path, shapes: Mapping[str, cq.Shape], origin_mm: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
    """Write shapes with their names as one STEP file; the same shapes give the same bytes.

    ``origin_mm`` (3,) is the position of the shapes' own origin. Raises InputError where the file cannot be written.
    """
    import cadquery as cq

    assembly = cq.Assembly(name="assembly")
    location = cq.Location(cq.Vector(*map(float, origin_mm)))
    # The kernel takes the bytes of a name for letters, so names are inserted into the text afterwards.
    placeholders = {f"name-{number:06d}-of-shape": name for number, name in enumerate(shapes)}
    for placeholder, shape in zip(placeholders, shapes.values(), strict=True):
        assembly.add(shape, name=placeholder, loc=location)
    with replacing(path) as temporary:
        assembly.export(str(temporary), exportType="STEP")
        text = temporary.read_text("ascii")
        # The kernel writes the date and the temporary file's name.
        header = f"FILE_NAME('{_quoted(path.stem)}','{WRITTEN}',(''),(''),'','','');\n"
        text = re.sub(r"FILE_NAME\(.*?\);\s*(?=FILE_SCHEMA)", lambda _: header, text, count=1, flags=re.S)
        # It numbers the parts of assemblies through all files of a process, and breaks lines by the number's length.
        numbers = itertools.count(1)
        text = re.sub(
            r"(NEXT_ASSEMBLY_USAGE_OCCURRENCE\(')\d+([^;]*;)",
            lambda m: m[1] + str(next(numbers)) + re.sub(r"\s*\n\s*", "", m[2]),
            text,
        )
        text = re.sub(r"'(name-\d{6}-of-shape)'", lambda m: f"'{_quoted(placeholders[m[1]])}'", text)
        temporary.write_text(text, "ascii")


def _quoted(name: str) -> str:
    """Return a name as it is written between the quotes of a STEP file."""
    plain = "".join(c if c.isprintable() else " " for c in name)
    return escape(plain.replace("\\", "\\\\").replace("'", "''"))
