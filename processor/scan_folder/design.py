"""Designs from files: design.json of an arch bridge or a space frame, a table of nodes, and surfaces."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from processor.geometry import box_girder_mesh
from processor.language.messages import messages
from processor.meshes import faults
from processor.meshes.mesh_files import SUFFIXES as MESH_SUFFIXES
from processor.meshes.mesh_files import read_whole
from processor.model import (
    KEY_POINTS,
    SUPPORTS,
    ArchDesign,
    DesignBodies,
    DesignFaults,
    DesignPart,
    Floats,
    FrameDesign,
    InputError,
    Ints,
    did_you_mean,
)
from processor.scan_folder import cad, node_list
from processor.scan_folder.checked_table import LOG, Table, existing_file_in, ignore_unknown
from processor.scan_folder.text_files import read_text
from processor.scan_folder.units import MM_PER_UNIT
from processor.scene_cloud import design_faults


def read_design(folder: Path, path: Path, table_unit: str) -> ArchDesign | FrameDesign:
    """Read a design in mm. ``table_unit`` is the unit of a CSV file without one in its header.

    Raises InputError for missing, unknown or inconsistent entries.
    """
    suffix = path.suffix.lower()
    if suffix in node_list.SUFFIXES:
        return node_list.read_node_list(path, table_unit).design
    if is_surface(path):
        raise InputError(
            f"a {suffix[1:].upper()} file alone is a design of kind structure; an arch bridge or a space frame "
            "needs a design.json (its components may name such files as 'mesh')",
            path=path,
        )
    if suffix != ".json":
        raise InputError(f"expected a design as .json or .csv, found {suffix or 'no suffix'}", path=path)
    design = read_json(path)
    kind = design.text("kind")
    if kind == "arch-bridge":
        return _arch(folder, design)
    if kind == "space-frame":
        return _frame(design)
    raise InputError(f"expected kind arch-bridge or space-frame, found {kind!r}", path=path)


def read_json(path: Path) -> Table:
    """Read a JSON file that holds an object. Raises InputError for any other."""
    return Table.of(str(path), read_json_value(path))


def read_json_value(path: Path) -> Any:
    """Read a JSON file that holds any value. Raises InputError for a file that is not JSON."""
    text = read_text(path)

    def distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        table = dict(pairs)
        if len(table) < len(pairs):
            twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
            raise InputError(f"expected each key once, found {twice!r} a second time", path=path)
        return table

    try:
        return json.loads(text, object_pairs_hook=distinct)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"not readable JSON: {error}", path=path) from None


def _arch(folder: Path, design: Table) -> ArchDesign:
    design.only(("units", "kind", "name", "unsure", "order", "components", "joints"))
    scale = MM_PER_UNIT[design.unit("units")]
    components = design.table("components")
    joints = _joints(design, scale)
    order = _order(design, list(components.values), joints)
    unknown = sorted({name for joint in joints for name in (joint.left, joint.right)} - set(components.values))
    if unknown:
        raise InputError(
            f"{design.where}: joint of {unknown[0]!r}, which is not in 'components' ({', '.join(components.values)})"
        )
    at = {name: _row_ends(name, joints) for name in order}
    parts = tuple(_part(folder, name, components.table(name), design.unit("units"), at[name]) for name in order)
    arch = ArchDesign(
        parts,
        joint_names=tuple(joint.name for joint in joints),
        joint_left=tuple(joint.left for joint in joints),
        joint_right=tuple(joint.right for joint in joints),
        joint_points=np.array([joint.points for joint in joints]).reshape(-1, 8, 3),
    )
    if not arch.in_row:
        _check_graph(design, arch)
    return arch


class _Joint(NamedTuple):
    """A joint of two components, and its key points (8, 3), mm."""

    name: str
    left: str
    right: str
    points: Floats


def _joints(design: Table, scale: float) -> list[_Joint]:
    joints: list[_Joint] = []
    tables = design.tables("joints")
    ignore_unknown(f"{design.where}: joints", tables, ("name", "left", "right", "points"))
    for joint in tables:
        points = joint.table("points")
        points.only(KEY_POINTS)
        corners = np.stack([points.array(key, 3) for key in KEY_POINTS]) * scale
        made = _Joint(joint.text("name"), joint.text("left"), joint.text("right"), corners)
        if any((made.left, made.right) == (other.left, other.right) for other in joints):
            raise InputError(f"{joint.where}: expected one joint of {made.left} and {made.right}, found a second")
        joints.append(made)
    return joints


def _order(design: Table, components: list[str], joints: list[_Joint]) -> list[str]:
    """Return the components in assembly order, and put ``joints`` in the order of a row if they form one.

    ``order`` in the file gives all of them, some, or none: the others follow in the order of 'components', unless all
    joints form one row.
    """
    given = design.values.get("order")
    if given is None:
        given = _row_of(components, joints)
    if not isinstance(given, list) or not all(isinstance(name, str) for name in given) or (not given and joints == []):
        raise InputError(f"{design.where}: expected 'order', the names of the components from one end to the other")
    if len(set(given)) != len(given) or not set(given) <= set(components):
        raise InputError(
            f"{design.where}: expected each component ({', '.join(components)}) once in 'order', found "
            f"{', '.join(given)}"
        )
    pairs = {(joint.left, joint.right) for joint in joints}
    neighbours = list(pairwise(given))
    missing = sorted(set(neighbours) - pairs)
    # A joint too many beside one too few has a wrong name; other joints make another graph than a row.
    for left, right in sorted(pairs - set(neighbours)) if missing and set(given) == set(components) else ():
        raise InputError(
            f"{design.where}: joint of {left!r} and {right!r}, which are not neighbours in 'order'; correct one of them"
        )
    for left, right in missing:
        raise InputError(
            f"{design.where}: no joint of the neighbours {left!r} (left) and {right!r} (right); add it to 'joints'"
        )
    number = {pair: k for k, pair in enumerate(neighbours)}
    joints.sort(key=lambda joint: number.get((joint.left, joint.right), len(number)))
    return [*given, *(name for name in components if name not in given)]


def _row_of(components: list[str], joints: list[_Joint]) -> list[str]:
    """Return the components from one end to the other if their joints form one row; else none."""
    after = {joint.left: joint.right for joint in joints}
    first = [name for name in components if name not in after.values()]
    if len(after) != len(joints) or len(set(after.values())) != len(joints) or len(first) != 1:
        return []
    row = [first[0]]
    while row[-1] in after:
        row.append(after[row[-1]])
    return row if set(row) == set(components) else []


def _row_ends(name: str, joints: list[_Joint]) -> list[Floats | None]:
    """Key points (8, 3) at the start and at the end of a component; None where it has none or several."""
    starts = [joint.points for joint in joints if joint.right == name]
    ends = [joint.points for joint in joints if joint.left == name]
    return [points[0] if len(points) == 1 else None for points in (starts, ends)]


def _check_graph(design: Table, arch: ArchDesign) -> None:
    """Raise InputError for joints that do not join all components, share a name, or have left and right swapped."""
    for name, left, right in zip(arch.joint_names, arch.joint_left, arch.joint_right, strict=True):
        if left == right:
            raise InputError(
                f"{design.where}: joint {name!r}: expected two components, found {left!r} joined to itself"
            )
    if len(set(arch.joint_names)) != len(arch.joint_names):
        raise InputError(
            f"{design.where}: expected a name of its own for each joint, found {', '.join(arch.joint_names)}"
        )
    joined = arch.joined
    reached = {0}
    for _ in arch.parts:
        reached |= {part for pair in joined.tolist() if reached & set(pair) for part in pair}
    apart = [part.name for k, part in enumerate(arch.parts) if k not in reached]
    if apart:
        raise InputError(
            f"{design.where}: no chain of joints joins {apart[0]!r} to {arch.parts[0].name!r}; add the joints"
        )
    for name, points, (left, right) in zip(arch.joint_names, arch.joint_points, joined.tolist(), strict=True):
        along = np.cross(points[0] - points[1], points[3] - points[0])  # from left to right
        for part, sense, side in ((left, -1.0, "left"), (right, 1.0, "right")):
            x = (arch.parts[part].vertices - points[:4].mean(axis=0)) @ along
            if sense * (x.max() + x.min()) < 0.0:
                raise InputError(
                    f"{design.where}: joint {name!r}: {arch.parts[part].name!r} is not on the {side} by P1..P4, "
                    "counted from bottom left as seen from the left part; correct them or swap left and right"
                )


def _part(folder: Path, name: str, part: Table, unit: str, joints: Sequence[Floats | None]) -> DesignPart:
    """Read a component; without a mesh one is made from its edges and the key points (8, 3), mm, of its joints."""
    scale = MM_PER_UNIT[unit]
    part.only(("mesh", "bottom_edge_left", "bottom_edge_right", "plate_mm"))
    if "mesh" in part.values and not any(f"bottom_edge_{side}" in part.values for side in ("left", "right")):
        return DesignPart(name, *_mesh(folder, part, unit))
    edges = [part.array(f"bottom_edge_{side}", -1, 3) * scale for side in ("left", "right")]
    for side, edge in zip(("left", "right"), edges, strict=True):
        if len(edge) < 2 or (np.abs(np.diff(edge, axis=0)).max(axis=1) == 0).any():
            raise InputError(f"{part.where}: expected two points or more in bottom_edge_{side}, none repeated in a row")
    plate_mm = part.number("plate_mm", box_girder_mesh.PLATE_MM, positive=True)
    if "mesh" in part.values:
        return DesignPart(name, *_mesh(folder, part, unit), edges[0], edges[1])
    try:
        vertices, faces = box_girder_mesh.mesh(edges[0], edges[1], joints[0], joints[1], plate_mm)
    except InputError as error:
        raise InputError(f"{part.where}: without a mesh: {error}") from None
    return DesignPart(name, vertices, faces, edges[0], edges[1], source=box_girder_mesh.SOURCE)


def _mesh(folder: Path, part: Table, unit: str) -> tuple[Floats, Ints]:
    """Read a component's mesh; facets given several times are logged. Ends may be left open, and normals any."""
    path = existing_file_in(folder, part.text("mesh"), part.where)
    surface = read_surface(path, unit)
    for found in design_faults(surface.faults and replace(surface.faults, turned=0, open_edges=0)):
        LOG.warning("%s: %s", path, messages("en").text(found))
    return surface.vertices, surface.faces


def _frame(design: Table) -> FrameDesign:
    design.only(("units", "kind", "name", "unsure", "nodes", "members"))
    scale = MM_PER_UNIT[design.unit("units")]
    ids, centres, radii = [], [], []
    supports, deflections = [], []
    nodes, members = design.tables("nodes"), design.tables("members")
    ignore_unknown(f"{design.where}: nodes", nodes, ("id", "centre", "radius", "support", "deflection"))
    ignore_unknown(f"{design.where}: members", members, ("a", "b", "tube_diameter"))
    for node in nodes:
        ids.append(_name(node, "id"))
        supports.append(_support(node))
        deflections.append(node.number("deflection", float("nan"), positive=True) * scale)
        centres.append(node.array("centre", 3) * scale)
        radii.append(node.number("radius", positive=True) * scale)
    node_list.check_names(design.where, ids)
    numbers, labels = node_list.numbered_names(ids)
    number_of = dict(zip(ids, numbers.tolist(), strict=True))
    a, b, diameters = [], [], []
    for member in members:
        ends = (_name(member, "a"), _name(member, "b"))
        if not number_of.keys() >= set(ends) or ends[0] == ends[1]:
            raise InputError(
                f"{member.where}: expected ids of two different nodes, found a member from {ends[0]} to {ends[1]}"
            )
        a.append(number_of[ends[0]])
        b.append(number_of[ends[1]])
        diameters.append(member.number("tube_diameter", positive=True) * scale)
    return FrameDesign(
        numbers,
        np.array(centres),
        np.array(radii),
        labels=labels,
        member_a=np.array(a, np.int64),
        member_b=np.array(b, np.int64),
        tube_diameters=np.array(diameters),
        supports=np.array(supports, np.uint8) if any(supports) else np.empty(0, np.uint8),
        deflections=np.array(deflections) if np.isfinite(deflections).any() else np.empty(0),
    )


def _name(table: Table, key: str) -> str:
    """Return an id, a whole number or a text, as a text."""
    return (
        table.text(key)
        if isinstance(table.values.get(key), str)
        else str(table.integer(key, "a whole number or a text"))
    )


def _support(node: Table) -> int:
    """Return the kind of support that a node is, as :class:`FrameDesign` has it: 0 of none."""
    kind = node.text("support", "")
    if kind and kind not in SUPPORTS:
        raise InputError(
            f"{node.where}: expected one of {', '.join(SUPPORTS)} as 'support', found {kind!r}"
            f"{did_you_mean(kind, SUPPORTS)}"
        )
    return SUPPORTS.index(kind) + 1 if kind else 0


def is_surface(path: Path) -> bool:
    """Whether a file is a mesh or a CAD file by its suffix."""
    return path.suffix.lower() in (*MESH_SUFFIXES, *cad.SUFFIXES)


class Surface(NamedTuple):
    """Vertices (v, 3) in mm and facets (f, 3) with outward normals, the bodies of a CAD file, and what was mended."""

    vertices: Floats
    faces: Ints
    bodies: DesignBodies | None
    faults: DesignFaults | None


def read_surface(path: Path, unit: str) -> Surface:
    """Read a mesh, or a CAD file with its bodies, and mend its facets.

    ``unit`` is that of a mesh, and of a CAD file that has none.
    """
    if path.suffix.lower() in cad.SUFFIXES:
        vertices, faces, bodies, _ = cad.read(path, unit)
    else:
        vertices, faces = read_whole(path)
        vertices, bodies = vertices * MM_PER_UNIT[unit], None
    mended = faults.mended(vertices, faces, None if bodies is None else bodies.of_facet)
    if not (mended.repeated or mended.turned or mended.open_edges):
        return Surface(vertices, faces, bodies, None)
    if bodies is not None and mended.repeated:
        bodies = replace(bodies, of_facet=bodies.of_facet[mended.rows])
    found = DesignFaults(
        turned=mended.turned,
        open_edges=mended.open_edges,
        open_parts=mended.open_parts,
        repeated=mended.repeated or None,
    )
    return Surface(vertices, mended.faces, bodies, found)
