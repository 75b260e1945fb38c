"""Designs from files: design.json of an arch bridge or a space frame, a table of nodes, and surfaces."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, make_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from processor.distinct_rows import components
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
)
from processor.model.inputs import (
    LARGEST_INTEGER,
    LOG,
    NOTHING,
    Kind,
    Place,
    array,
    entry,
    hidden,
    listed,
    named_tables,
    number,
    read,
    table,
    tables,
    text,
)
from processor.scan_folder import cad, node_list
from processor.scan_folder.file_values import FILE, UNIT
from processor.scan_folder.text_files import read_text
from processor.scan_folder.units import MM_PER_UNIT
from processor.scene_cloud import design_faults


def read_design(folder: Path, path: Path, table_unit: str) -> ArchDesign | FrameDesign:
    """Read a design in mm. ``table_unit`` is the unit of a CSV file without one in its header.

    Raises InputError for missing, unknown or inconsistent entries.
    """
    suffix = path.suffix.lower()
    if suffix in node_list.SUFFIXES:
        return node_list.read_node_list(path, table_unit)[0]
    if is_surface(path):
        raise InputError(
            f"a {suffix[1:].upper()} file alone is a design of kind structure; an arch bridge or a space frame "
            "needs a design.json (its components may name such files as 'mesh')",
            path=path,
        )
    if suffix != ".json":
        raise InputError(f"expected a design as .json or .csv, found {suffix or 'no suffix'}", path=path)
    content, place = read_json(path), Place(str(path), folder=folder)
    kind = content.get("kind", NOTHING) if isinstance(content, dict) else NOTHING
    if isinstance(content, dict):
        text("arch-bridge", "space-frame").value(kind, "kind", place)
    return _frame(read(FrameFile, content, place)) if kind == "space-frame" else _arch(read(ArchFile, content, place))


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises InputError for a file that is not JSON, or gives a key twice."""
    content = read_text(path)

    def distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        values = dict(pairs)
        if len(values) < len(pairs):
            twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
            raise InputError(f"expected each key once, found {twice!r} a second time", path=path)
        return values

    try:
        return json.loads(content, object_pairs_hook=distinct)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"not readable JSON: {error}", path=path) from None


# --- design.json as declared ----------------------------------------------------------------------------------------


WHOLE = number(whole=True)
ID = Kind(
    "a whole number or a text",
    lambda value, at: value if isinstance(value, str) and value else str(WHOLE.convert(value, at)),
    {"type": ["integer", "string"], "minLength": 1}
    | {"exclusiveMinimum": -LARGEST_INTEGER, "exclusiveMaximum": LARGEST_INTEGER},
)
# Two points at least show a direction
EDGE = Kind(array(-1, 3).expected, array(-1, 3).convert, {**array(-1, 3).schema, "minItems": 2})
KeyPoints = make_dataclass("KeyPoints", [(key, Floats, entry(array(3))) for key in KEY_POINTS], frozen=True)
UNSURE = entry(listed(text(empty=True), "a list of texts"), default=())


@dataclass(frozen=True)
class JointEntry:
    """A joint of two components."""

    IGNORES: ClassVar[bool] = True

    name: str = entry(text())
    left: str = entry(text())  # component before the joint
    right: str = entry(text())  # component after the joint
    # P1..P4: outer corners bottom-left, bottom-right, top-right, top-left, as seen from the left component towards
    # the right one (left = +Y); P5..P8: middles of the outer bottom, right, top, left edges
    points: Any = entry(table(KeyPoints))
    where: str = hidden("")


@dataclass(frozen=True)
class ComponentEntry:
    """A component of an arch bridge: its mesh, or its edges (n, 3)."""

    SCHEMA: ClassVar[Mapping[str, Any]] = {
        "anyOf": [
            {"required": ["bottom_edge_left", "bottom_edge_right"]},
            {
                "required": ["mesh"],
                "not": {"anyOf": [{"required": ["bottom_edge_left"]}, {"required": ["bottom_edge_right"]}]},
            },
        ]
    }

    # PLY, STL, OBJ, STEP or IFC file in the bridge's frame; without it the outer box between joints and bottom
    # edges is used
    mesh: Path | None = entry(FILE, default=None)
    # points from the start to the end of the component, no point twice in a row
    bottom_edge_left: Floats | None = entry(EDGE, default=None)
    # points from the start to the end of the component, no point twice in a row
    bottom_edge_right: Floats | None = entry(EDGE, default=None)
    # thickness of the plates of a component without a mesh
    plate_mm: float = entry(number(above=0), default=box_girder_mesh.PLATE_MM)
    where: str = hidden("")

    def contradiction(self) -> str:
        """Return an edge that is missing, or has no direction somewhere."""
        edges = {"bottom_edge_left": self.bottom_edge_left, "bottom_edge_right": self.bottom_edge_right}
        if self.mesh is not None and not any(edge is not None for edge in edges.values()):
            return ""
        for key, edge in edges.items():
            if edge is None:
                return f"expected {EDGE.expected} as {key!r}, found nothing"
            if len(edge) < 2 or (np.abs(np.diff(edge, axis=0)).max(axis=1) == 0).any():
                return f"expected two points or more in {key}, none repeated in a row"
        return ""


@dataclass(frozen=True, kw_only=True)
class ArchFile:
    """design.json of an arch bridge."""

    units: str = entry(UNIT)  # of all coordinates here and of the components' meshes
    kind: str = entry(text("arch-bridge"))
    name: str = entry(text(empty=True), default="")
    unsure: tuple[str, ...] = UNSURE  # what `processor init` is not sure of, for people; not used
    # names of the components from one end of the bridge to the other; some of them, or none, where the joints form
    # another graph
    order: tuple[str, ...] | None = entry(
        listed(text(), "the names of the components from one end to the other", minItems=1, uniqueItems=True),
        default=None,
    )
    components: dict[str, ComponentEntry] = entry(named_tables(ComponentEntry, minProperties=1))  # by name
    # one for each two neighbours in order, and others: the joints form any graph that joins all components
    joints: tuple[JointEntry, ...] = entry(tables(JointEntry), default=())
    where: str = hidden("")


@dataclass(frozen=True)
class NodeEntry:
    """A node of a space frame; centre (3,)."""

    IGNORES: ClassVar[bool] = True

    id: str = entry(ID)  # unique
    centre: Floats = entry(array(3))  # x, y, z
    radius: float = entry(number(above=0))  # of the ball
    # of a node that is a support: of a frame supported along its edges, or at single points
    support: str = entry(text(*SUPPORTS), default="")
    deflection: float = entry(number(above=0), default=float("nan"))  # computed deflection, downward


@dataclass(frozen=True)
class MemberEntry:
    """A tube of a space frame."""

    IGNORES: ClassVar[bool] = True

    a: str = entry(ID)  # id of a node
    b: str = entry(ID)  # id of another node
    tube_diameter: float = entry(number(above=0))
    where: str = hidden("")


@dataclass(frozen=True, kw_only=True)
class FrameFile:
    """design.json of a space frame."""

    units: str = entry(UNIT)
    kind: str = entry(text("space-frame"))
    name: str = entry(text(empty=True), default="")
    unsure: tuple[str, ...] = UNSURE  # what `processor init` is not sure of, for people; not used
    nodes: tuple[NodeEntry, ...] = entry(tables(NodeEntry, minItems=1))
    members: tuple[MemberEntry, ...] = entry(tables(MemberEntry), default=())
    where: str = hidden("")


def _arch(design: ArchFile) -> ArchDesign:
    scale = MM_PER_UNIT[design.units]
    pairs = [(joint.left, joint.right) for joint in design.joints]
    for joint, pair in zip(design.joints, pairs, strict=True):
        if pairs.count(pair) > 1:
            raise InputError(f"{joint.where}: expected one joint of {joint.left} and {joint.right}, found a second")
    joints = [replace(joint, points=np.stack(astuple(joint.points)) * scale) for joint in design.joints]
    order = _order(design, joints)
    unknown = sorted({name for pair in pairs for name in pair} - set(design.components))
    if unknown:
        raise InputError(
            f"{design.where}: joint of {unknown[0]!r}, which is not in 'components' ({', '.join(design.components)})"
        )
    parts = tuple(_part(name, design.components[name], design.units, _row_ends(name, joints)) for name in order)
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


def _order(design: ArchFile, joints: list[JointEntry]) -> list[str]:
    """Return the components in assembly order, and put ``joints`` in the order of a row if they form one.

    ``order`` in the file gives all of them, some, or none: the others follow in the order of 'components', unless all
    joints form one row.
    """
    components = list(design.components)
    given = _row_of(components, joints) if design.order is None else list(design.order)
    if not given and not joints:
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


def _row_of(components: list[str], joints: list[JointEntry]) -> list[str]:
    """Return the components from one end to the other if their joints form one row; else none."""
    after = {joint.left: joint.right for joint in joints}
    first = [name for name in components if name not in after.values()]
    if len(after) != len(joints) or len(set(after.values())) != len(joints) or len(first) != 1:
        return []
    row = [first[0]]
    while row[-1] in after:
        row.append(after[row[-1]])
    return row if set(row) == set(components) else []


def _row_ends(name: str, joints: list[JointEntry]) -> list[Floats | None]:
    """Key points (8, 3) at the start and at the end of a component; None where it has none or several."""
    starts = [joint.points for joint in joints if joint.right == name]
    ends = [joint.points for joint in joints if joint.left == name]
    return [points[0] if len(points) == 1 else None for points in (starts, ends)]


def _check_graph(design: ArchFile, arch: ArchDesign) -> None:
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
    piece = components(len(arch.parts), *joined.T)
    apart = [part.name for part, number in zip(arch.parts, piece.tolist(), strict=True) if number != piece[0]]
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


def _part(name: str, part: ComponentEntry, unit: str, joints: Sequence[Floats | None]) -> DesignPart:
    """Read a component; without a mesh one is made from its edges and the key points (8, 3), mm, of its joints."""
    edges = [edge * MM_PER_UNIT[unit] for edge in (part.bottom_edge_left, part.bottom_edge_right) if edge is not None]
    if part.mesh is not None:
        vertices, faces = _mesh(part.mesh, unit)
        return DesignPart(name, vertices, faces, *(edges or ()))
    try:
        vertices, faces = box_girder_mesh.mesh(edges[0], edges[1], joints[0], joints[1], part.plate_mm)
    except InputError as error:
        raise InputError(f"{part.where}: without a mesh: {error}") from None
    return DesignPart(name, vertices, faces, edges[0], edges[1], source=box_girder_mesh.SOURCE)


def _mesh(path: Path, unit: str) -> tuple[Floats, Ints]:
    """Read a component's mesh; facets given several times are logged. Ends may be left open, and normals any."""
    surface = read_surface(path, unit)
    for found in design_faults(surface.faults and replace(surface.faults, turned=0, open_edges=0)):
        LOG.warning("%s: %s", path, messages("en").text(found))
    return surface.vertices, surface.faces


def _frame(design: FrameFile) -> FrameDesign:
    scale = MM_PER_UNIT[design.units]
    ids = [node.id for node in design.nodes]
    node_list.check_names(design.where, ids)
    numbers, labels = node_list.numbered_names(ids)
    number_of = dict(zip(ids, numbers.tolist(), strict=True))
    for member in design.members:
        if not number_of.keys() >= {member.a, member.b} or member.a == member.b:
            raise InputError(
                f"{member.where}: expected ids of two different nodes, found a member from {member.a} to {member.b}"
            )
    # Kinds of support as FrameDesign has them: 0 of none
    supports = [SUPPORTS.index(node.support) + 1 if node.support else 0 for node in design.nodes]
    deflections = np.array([node.deflection for node in design.nodes]) * scale
    return FrameDesign(
        numbers,
        np.array([node.centre for node in design.nodes]) * scale,
        np.array([node.radius for node in design.nodes]) * scale,
        labels=labels,
        member_a=np.array([number_of[member.a] for member in design.members], np.int64),
        member_b=np.array([number_of[member.b] for member in design.members], np.int64),
        tube_diameters=np.array([member.tube_diameter for member in design.members]) * scale,
        supports=np.array(supports, np.uint8) if any(supports) else np.empty(0, np.uint8),
        deflections=deflections if np.isfinite(deflections).any() else np.empty(0),
    )


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
