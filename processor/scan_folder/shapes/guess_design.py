"""A design.json from the surfaces in a folder: of an arch bridge in parts, or of a space frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import KEY_POINTS, ArchDesign, Floats, FrameDesign, Ints
from processor.scan_folder import component_names
from processor.scan_folder.shapes import arch, files, frame, unit
from processor.scan_folder.shapes.body import Body, stacked, welded
from processor.scan_folder.units import MM_PER_UNIT

PARTS = ("foot", "rib", "crown")  # words in the names of an arch bridge's parts


@dataclass(frozen=True)
class GuessedDesign:
    """A design as guessed from surfaces.

    ``design`` is None where there is none, and ``doubts`` say why. ``units`` are those of design.json, ``meshes`` the
    files (path below the folder, vertices (v, 3) in mm, triangles) to be written beside it, by part.
    """

    design: ArchDesign | FrameDesign | None = None
    doubts: tuple[str, ...] = ()
    units: str = "mm"
    reason: str = ""
    kind_doubt: str = ""
    root_gap_mm: float = 0.0
    files: tuple[str, ...] = ()
    mesh_of: dict[str, str] = field(default_factory=dict)
    meshes: tuple[tuple[str, Floats, Ints], ...] = ()


def guess(
    folder: Path, group: Sequence[Path], scans: Sequence[tuple[float, str]], given_unit: str = ""
) -> GuessedDesign:
    """Guess the design that the files of one folder hold.

    ``scans`` are the radius of each scan and the unit that its format states. Raises InputError for a file that cannot
    be read.
    """
    chosen, doubts = files.one_a_stem(group)
    surfaces = [files.read(folder, path, given_unit or "mm") for path in chosen]
    without = [surface for surface in surfaces if not surface.unit]
    units = unit.DesignUnit(given_unit or "mm", "given" if given_unit else "the CAD files state their units", True)
    if without and not given_unit:
        units = unit.guess([surface.vertices for surface in surfaces], scans, len(surfaces) == 1)
        if not units.sure:
            doubts.append(
                f"units of the design: {'taken as ' + units.unit if units.unit else 'not clear'}: {units.reason}; "
                "state it by --design-units"
            )
        if not units.unit:
            return GuessedDesign(doubts=tuple(doubts), files=_names(folder, chosen))
    names, json_units = _names(folder, chosen), units.unit if without else "mm"
    bodies, mesh_of, meshes, named = _bodies(folder, surfaces, units.unit)
    if not bodies:
        return GuessedDesign(doubts=(*doubts, "no surface has an area"), files=names)
    balls = frame.find(stacked("all", bodies))
    if balls.design is not None:
        return GuessedDesign(
            design=balls.design,
            doubts=(*doubts, *balls.doubts),
            units=json_units,
            reason=f"balls and the tubes between them, in {_some(names)}",
            files=names,
        )
    found = arch.find(bodies)
    whole = len(surfaces) == 1
    if found.design is None or (whole and not found.arched and not _named_as_parts(bodies)):
        told = not whole or _named_as_parts(bodies)
        return GuessedDesign(
            doubts=(*doubts, *(f"as an arch bridge: {text}" for text in found.doubts if told)), files=names
        )
    kept = {mesh_of[part.name] for part in found.design.parts}
    return GuessedDesign(
        design=found.design,
        doubts=(*doubts, *named, *found.doubts),
        units="mm" if meshes else json_units,
        reason=f"{len(kept)} parts that meet end to end, in {_some(names)}",
        kind_doubt="" if found.arched else "the parts follow each other in a straight line, which is no arch",
        root_gap_mm=found.root_gap_mm,
        files=names,
        mesh_of={part.name: mesh_of[part.name] for part in found.design.parts},
        meshes=tuple(mesh for mesh in meshes if mesh[0] in kept),
    )


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (" and more" if len(names) > 3 else "")


def _names(folder: Path, paths: Sequence[Path]) -> tuple[str, ...]:
    return tuple(str(path.relative_to(folder)) for path in paths)


def _named_as_parts(bodies: Sequence[Body]) -> bool:
    return any(word in component_names.plain(body.name).split() for body in bodies for word in PARTS)


def _bodies(
    folder: Path, surfaces: Sequence[files.Surface], units: str
) -> tuple[list[Body], dict[str, str], list[tuple[str, Floats, Ints]], list[str]]:
    """Return the parts in mm, the file of each part's mesh, the meshes to be written, and doubts about names."""
    found, doubts = list[Body](), list[str]()
    mesh_of: dict[str, str] = {}
    meshes = list[tuple[str, Floats, Ints]]()
    if len(surfaces) > 1:
        for surface in surfaces:
            scale = 1.0 if surface.unit or surface.bodies is not None else MM_PER_UNIT[units]
            body = welded(surface.path.stem, surface.vertices * scale, surface.faces)
            if body is not None:
                found.append(body)
                mesh_of[body.name] = str(surface.path.relative_to(folder))
        return found, mesh_of, meshes, doubts
    (surface,) = surfaces
    scale = 1.0 if surface.unit or surface.bodies is not None else MM_PER_UNIT[units]
    for name, vertices, faces in files.bodies(surface):
        body = welded(name, vertices * scale, faces)
        if body is not None:
            found.append(body)
            mesh_of[name] = f"{files.MADE}/{_stem(name, mesh_of)}.ply"
            meshes.append((mesh_of[name], body.vertices, body.faces))
    if surface.bodies is None:
        doubts.append(f"names: the parts are pieces of {surface.path.name}, numbered in its order")
    elif surface.bodies.unnamed or surface.bodies.shared:
        doubts.append(
            f"names: of the bodies of {surface.path.name} {surface.bodies.unnamed} have none and "
            f"{surface.bodies.shared} share theirs; they were numbered"
        )
    return found, mesh_of, meshes, doubts


def _stem(name: str, taken: dict[str, str]) -> str:
    """Return a part's name as that of a new file."""
    plain = "".join(c if c.isalnum() or c in "-_" else "_" for c in name) or "part"
    stems = {Path(path).stem.casefold() for path in taken.values()}
    stem, number = plain, 2
    while stem.casefold() in stems:
        stem, number = f"{plain}-{number}", number + 1
    return stem


def content(guessed: GuessedDesign, questions: Sequence[str]) -> dict[str, Any]:
    """Return the object of design.json; ``questions`` say what is not sure in it."""
    head: dict[str, Any] = {"units": guessed.units}
    if questions:
        head["unsure"] = [f"? {text}" for text in questions]
    scale = 1.0 / MM_PER_UNIT[guessed.units]
    if isinstance(guessed.design, ArchDesign):
        return {**head, "kind": "arch-bridge", **_arch(guessed.design, guessed.mesh_of, scale)}
    assert guessed.design is not None
    return {**head, "kind": "space-frame", **_frame(guessed.design, scale)}


def _arch(design: ArchDesign, mesh_of: Mapping[str, str], scale: float) -> dict[str, Any]:
    components = {
        part.name: {
            "mesh": mesh_of[part.name],
            "bottom_edge_left": _rounded(part.bottom_edge_left, scale),
            "bottom_edge_right": _rounded(part.bottom_edge_right, scale),
        }
        for part in design.parts
    }
    joints = [
        {"name": name, "left": left, "right": right, "points": dict(zip(KEY_POINTS, _rounded(p, scale), strict=True))}
        for name, left, right, p in zip(
            design.joint_names, design.joint_left, design.joint_right, design.joint_points, strict=True
        )
    ]
    return {"order": [part.name for part in design.parts], "components": components, "joints": joints}


def _frame(design: FrameDesign, scale: float) -> dict[str, Any]:
    centres, radii, diameters = (
        _rounded(x, scale) for x in (design.centres, design.radii[:, None], design.tube_diameters[:, None])
    )
    nodes = [
        {"id": int(i), "centre": centre, "radius": radius}
        for i, centre, (radius,) in zip(design.ids, centres, radii, strict=True)
    ]
    members = [
        {"a": int(a), "b": int(b), "tube_diameter": diameter}
        for a, b, (diameter,) in zip(design.member_a, design.member_b, diameters, strict=True)
    ]
    return {"nodes": nodes, "members": members}


def _rounded(values_mm: Floats, scale: float) -> list[list[float]]:
    """Return values (n, k) to a millionth of a millimetre, times ``scale``."""
    return [[float(f"{x:.12g}") for x in row] for row in np.round(values_mm, 6) * scale + 0.0]
