"""A design.json from the surfaces in a folder: of an arch bridge in parts, or of a space frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from processor.model import KEY_POINTS, ArchDesign, Floats, FrameDesign, Ints
from processor.scan_folder import component_names
from processor.scan_folder.shapes import arch, files, unit
from processor.scan_folder.shapes.body import Body, welded
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
    bodies, mesh_of, meshes, named = _bodies(folder, surfaces, units.unit)
    found = arch.find(bodies)
    whole = len(surfaces) == 1
    if found.design is None or (whole and not found.arched and not _named_as_parts(bodies)):
        why = [] if whole and not _named_as_parts(bodies) else [f"as an arch bridge: {text}" for text in found.doubts]
        return GuessedDesign(doubts=(*doubts, *why), files=_names(folder, chosen))
    kept = {part.name for part in found.design.parts}
    return GuessedDesign(
        design=found.design,
        doubts=(*doubts, *named, *found.doubts),
        units="mm" if meshes or not without else units.unit,
        reason=f"{len(kept)} parts that meet end to end, in {', '.join(_names(folder, chosen)[:3])}"
        + (" and more" if len(chosen) > 3 else ""),
        kind_doubt="" if found.arched else "the parts follow each other in a straight line, which is no arch",
        root_gap_mm=found.root_gap_mm,
        files=_names(folder, chosen),
        mesh_of={name: mesh for name, mesh in mesh_of.items() if name in kept},
        meshes=tuple(mesh for mesh in meshes if mesh[0] in {mesh_of[name] for name in kept}),
    )


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
    assert isinstance(guessed.design, ArchDesign)
    design, scale = guessed.design, 1.0 / MM_PER_UNIT[guessed.units]
    components = {
        part.name: {
            "mesh": guessed.mesh_of[part.name],
            "bottom_edge_left": _rounded(part.bottom_edge_left * scale),
            "bottom_edge_right": _rounded(part.bottom_edge_right * scale),
        }
        for part in design.parts
    }
    joints = [
        {"name": name, "left": left, "right": right, "points": dict(zip(KEY_POINTS, _rounded(p * scale), strict=True))}
        for name, left, right, p in zip(
            design.joint_names, design.joint_left, design.joint_right, design.joint_points, strict=True
        )
    ]
    head: dict[str, Any] = {"units": guessed.units, "kind": "arch-bridge"}
    if questions:
        head["unsure"] = [f"? {text}" for text in questions]
    return {**head, "order": [part.name for part in design.parts], "components": components, "joints": joints}


def _rounded(points: Floats) -> list[list[float]]:
    """Return points (n, 3) with 12 digits: far more than any coordinate has."""
    return [[float(f"{x:.12g}") for x in point] for point in points]
