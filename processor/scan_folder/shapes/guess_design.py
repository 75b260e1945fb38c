"""A design.json from the surfaces in a folder: of parts that meet end to end, or of a space frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import KEY_POINTS, ArchDesign, Floats, FrameDesign, Ints, Reason, reason
from processor.scan_folder import component_names
from processor.scan_folder.shapes import arch_bridge, guess_unit, space_frame, surface_files
from processor.scan_folder.shapes.body import Body, Unsure, stacked, welded
from processor.scan_folder.units import MM_PER_UNIT

PARTS = ("foot", "rib", "crown")  # words in the names of an arch bridge's parts


@dataclass(frozen=True)
class GuessedDesign:
    """A design as guessed from surfaces.

    A doubt is a reason why something in it may be wrong, or why ``design`` is None. ``kind_doubts`` and ``unit_doubts``
    are () where kind and unit are sure, ``other_doubts`` are about all else; ``reasons`` say what shows the design.
    ``units`` are those of design.json, ``meshes`` the files (path below the folder, vertices (v, 3) in mm, triangles)
    to be written beside it, by part.
    """

    design: ArchDesign | FrameDesign | None = None
    other_doubts: tuple[Reason, ...] = ()
    units: str = "mm"
    reasons: tuple[Reason, ...] = ()
    kind_doubts: tuple[Reason, ...] = ()
    unit_doubts: tuple[Reason, ...] = ()
    root_gap_mm: float = 0.0
    files: tuple[str, ...] = ()
    mesh_of: dict[str, str] = field(default_factory=dict)
    meshes: tuple[tuple[str, Floats, Ints], ...] = ()
    unsure: tuple[Unsure, ...] = ()  # joints, parts, nodes and members with doubts

    @property
    def doubts(self) -> tuple[Reason, ...]:
        """All doubts but those about the kind."""
        return (*self.unit_doubts, *self.other_doubts)


@dataclass(frozen=True)
class _Parts:
    """Bodies in mm, the file of each one's mesh, the meshes that are to be written, and doubts about names."""

    bodies: list[Body]
    mesh_of: dict[str, str]
    meshes: tuple[tuple[str, Floats, Ints], ...] = ()
    doubts: tuple[Reason, ...] = ()


def guess(
    folder: Path,
    group: Sequence[Path],
    scans: Sequence[tuple[float, str]],
    given_unit: str = "",
    stems: Sequence[str] = (),
) -> GuessedDesign:
    """Guess the design that the files of one folder hold.

    ``scans`` are the radius of each scan and the unit that its format states, ``stems`` the names of their files
    without suffix. Raises InputError for a file that cannot be read.
    """
    chosen, doubts = surface_files.one_a_stem(group)
    surfaces = [surface_files.read(folder, path, given_unit or "mm") for path in chosen]
    names = tuple(str(path.relative_to(folder)) for path in chosen)
    # Scans are of a whole frame, but of single parts of a bridge.
    unit, unit_doubts = guess_unit.guess(surfaces, scans, given_unit, as_whole=True)
    before = unit or "mm"
    surfaces = _in_unit(folder, surfaces, given_unit or "mm", before)
    bodies = _bodies(folder, surfaces, before).bodies
    if not bodies:
        return GuessedDesign(other_doubts=(*doubts, reason("init.no-area")), files=names)
    frame = space_frame.find(stacked("all", bodies))
    if frame is not None:
        return GuessedDesign(
            design=frame[0] if unit else None,
            other_doubts=(*doubts, *frame[1]),
            unit_doubts=unit_doubts,
            units=_json_unit(surfaces, before),
            reasons=(reason("init.shown-by-balls", files=_some(names)),),
            files=names,
            unsure=frame[2],
        )
    unit, unit_doubts = guess_unit.guess(surfaces, scans, given_unit, as_whole=len(surfaces) == 1)
    if not unit:
        return GuessedDesign(other_doubts=tuple(doubts), unit_doubts=unit_doubts, files=names)
    surfaces = _in_unit(folder, surfaces, before, unit)
    parts = _bodies(folder, surfaces, unit)
    # Two scans or more have the names of one body each, and none that of several
    of_bodies = [body.name for body in parts.bodies]
    of_scan = [component_names.components(stem, of_bodies) for stem in stems]
    single = [found[0] for found in of_scan if len(found) == 1]
    scanned = len(set(single)) > 1 and len(single) == len(stems)
    guessed = _bridge(parts, names, tuple(doubts), _json_unit(surfaces, unit), scanned)
    return replace(guessed, unit_doubts=unit_doubts)


def _in_unit(
    folder: Path, surfaces: Sequence[surface_files.Surface], before: str, unit: str
) -> list[surface_files.Surface]:
    """Return surfaces with the facets of ``unit``: CAD files without one were read as if in the unit ``before``."""
    return [
        surface_files.read(folder, surface.path, unit)
        if surface.bodies is not None and not surface.unit and unit != before
        else surface
        for surface in surfaces
    ]


def _json_unit(surfaces: Sequence[surface_files.Surface], unit: str) -> str:
    """Return the unit of design.json, which is also that of the meshes it names."""
    return "mm" if all(surface.unit for surface in surfaces) else unit


def _bridge(
    parts: _Parts, names: Sequence[str], doubts: tuple[Reason, ...], json_unit: str, scanned: bool
) -> GuessedDesign:
    """Return the design of parts that meet end to end; ``scanned``: each scan has the name of one of them."""
    found = arch_bridge.find(parts.bodies)
    named = any(word in component_names.plain(body.name).split() for body in parts.bodies for word in PARTS)
    likely = named or scanned or len(names) > 1
    if found.design is None or not (found.arched or likely):
        of_bridge = [reason("init.as-arch-bridge", reason=doubt) for doubt in found.doubts if likely]
        return GuessedDesign(other_doubts=(*doubts, *of_bridge), files=tuple(names))
    mesh_of = {part.name: parts.mesh_of[part.name] for part in found.design.parts}
    return GuessedDesign(
        design=found.design,
        other_doubts=(*doubts, *parts.doubts, *found.doubts),
        units="mm" if parts.meshes else json_unit,
        reasons=(reason("init.shown-by-parts", parts=len(mesh_of), files=_some(names)),),
        kind_doubts=_kind_doubts(found, named),
        root_gap_mm=found.root_gap_mm,
        files=tuple(names),
        mesh_of=mesh_of,
        meshes=tuple(mesh for mesh in parts.meshes if mesh[0] in mesh_of.values()),
        unsure=found.unsure,
    )


def _kind_doubts(found: arch_bridge.GuessedArch, named: bool) -> tuple[Reason, ...]:
    if not found.row:
        return (reason("init.no-row"),)
    if not found.arched:
        return (reason("init.straight"),)
    return () if named else (reason("init.arch-not-named"),)


def _some(names: Sequence[str]) -> tuple[str, ...] | Reason:
    return tuple(names) if len(names) <= 3 else reason("init.and-more", names=tuple(names[:3]))


def _bodies(folder: Path, surfaces: Sequence[surface_files.Surface], units: str) -> _Parts:
    """Return the parts in mm: a part per file, or of one file per part a body."""
    bodies, mesh_of = list[Body](), dict[str, str]()
    scales = [1.0 if surface.unit else MM_PER_UNIT[units] for surface in surfaces]
    if len(surfaces) > 1:
        for surface, scale in zip(surfaces, scales, strict=True):
            body = welded(surface.path.stem, surface.vertices * scale, surface.faces)
            if body is not None:
                bodies.append(body)
                mesh_of[body.name] = str(surface.path.relative_to(folder))
        return _Parts(bodies, mesh_of)
    (surface,), (scale,) = surfaces, scales
    meshes, doubts = list[tuple[str, Floats, Ints]](), list[Reason]()
    for name, vertices, faces in surface_files.bodies(surface):
        body = welded(name, vertices * scale, faces)
        if body is not None:
            bodies.append(body)
            mesh_of[name] = f"{surface_files.MADE}/{_stem(name, mesh_of)}.ply"
            meshes.append((mesh_of[name], body.vertices, body.faces))
    if surface.bodies is None:
        doubts.append(reason("init.pieces-numbered", file=surface.path.name))
    elif surface.bodies.unnamed or surface.bodies.shared:
        unnamed, shared = surface.bodies.unnamed, surface.bodies.shared
        doubts.append(reason("init.bodies-numbered", file=surface.path.name, unnamed=unnamed, shared=shared))
    return _Parts(bodies, mesh_of, tuple(meshes), tuple(doubts))


def _stem(name: str, taken: dict[str, str]) -> str:
    """Return a part's name as that of a new file."""
    plain = "".join(c if c.isalnum() or c in "-_" else "_" for c in name) or "part"
    stems = {Path(path).stem.casefold() for path in taken.values()}
    stem, number = plain, 2
    while stem.casefold() in stems:
        stem, number = f"{plain}-{number}", number + 1
    return stem


def content(guessed: GuessedDesign, doubts: Sequence[str]) -> dict[str, Any]:
    """Return the object of design.json, with the doubts as texts."""
    head: dict[str, Any] = {"units": guessed.units}
    if doubts:
        head["unsure"] = [f"? {doubt}" for doubt in doubts]
    scale = 1.0 / MM_PER_UNIT[guessed.units]
    if isinstance(guessed.design, ArchDesign):
        return {**head, "kind": "arch-bridge", **_arch(guessed.design, guessed.mesh_of, scale)}
    assert guessed.design is not None
    return {**head, "kind": "space-frame", **_frame(guessed.design, scale)}


def _arch(design: ArchDesign, mesh_of: Mapping[str, str], scale: float) -> dict[str, Any]:
    components: dict[str, dict[str, Any]] = {}
    for part in design.parts:
        components[part.name] = {"mesh": mesh_of[part.name]} | {
            f"bottom_edge_{side}": _rounded(edge, scale)
            for side, edge in (("left", part.bottom_edge_left), ("right", part.bottom_edge_right))
            if len(edge)
        }
    joints = [
        {"name": name, "left": left, "right": right, "points": dict(zip(KEY_POINTS, _rounded(p, scale), strict=True))}
        for name, left, right, p in zip(
            design.joint_names, design.joint_left, design.joint_right, design.joint_points, strict=True
        )
    ]
    order = [part.name for part in design.parts]
    joined = {frozenset(pair) for pair in zip(design.joint_left, design.joint_right, strict=True)}
    in_order = all(frozenset(pair) in joined for pair in pairwise(order))
    return {**({"order": order} if in_order else {}), "components": components, "joints": joints}


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
