"""Assemblies of prismatic parts: girders in a row, a node with three branches, two ribs with bracing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from designgen.checks import expect
from designgen.designs import bolt_holes, prismatic_parts, sections
from designgen.designs.bolt_holes import Bore
from designgen.designs.parametric_face import Patch
from designgen.designs.prismatic_parts import End, Girder, Node, Part
from designgen.designs.sections import Section
from designgen.rigid import rigid
from processor.model import Floats

ABOUT = "assembly of box or I girders: a row, a node with three branches, two ribs with bracing"
TOP = 2  # edge of a box's outline


@dataclass(frozen=True)
class Params(sections.Params):
    """Sizes in mm. ``parts`` are those of a row; girders differ in length by ``step_mm``, not to be alike."""

    type: str = "row"
    parts: int = 3
    length_mm: float = 4000.0
    step_mm: float = 150.0
    stub_mm: float = 1400.0  # from the middle of a node to its joints
    spread_mm: float = 6000.0  # between two ribs

    def __post_init__(self) -> None:
        expect(self.type in TYPES, "assembly.type", self.type, f"one of {', '.join(TYPES)}")
        expect(2 <= self.parts <= 100, "assembly.parts", self.parts, "2 to 100")
        least = 2.0 * self.height_mm
        for key in ("length_mm",) if self.type == "row" else ("length_mm", "stub_mm"):
            expect(getattr(self, key) >= least, f"assembly.{key}", getattr(self, key), f"{least:g} or more")
        widest = 2.0 * prismatic_parts.PAD_SIZE_MM  # the mark lies on one half of the top
        expect(self.width_mm >= widest, "assembly.width_mm", self.width_mm, f"{widest:g} or more")
        box = self.type == "row" or self.section == "box"
        expect(box, "assembly.section", self.section, "box: nodes are made of plain boxes alone")


@dataclass(frozen=True)
class Joint:
    """A joint: its frame T_bridge_joint (4, 4), x from the left to the right part, and the section there."""

    name: str
    left: str
    right: str
    T: Floats
    section: Section


@dataclass(frozen=True)
class Assembly:
    """Parts and joints."""

    parts: tuple[Part, ...]
    joints: tuple[Joint, ...]


Shifts = Mapping[str, Floats]  # by girder: by how much each hole as drilled (n, 3) lies off its place, mm


def build(params: Params, bolts: bolt_holes.Params | None = None, shifts: Shifts | None = None) -> Assembly:
    """Build an assembly; of I girders with ``bolts`` at their joints, their holes drilled off by ``shifts``."""
    if bolts is not None:
        expect(
            params.section == "i" and params.type == "row", "bolts", params.section, 'a row of I girders, section "i"'
        )
    maker = _Maker(params, sections.make(params), bolts, shifts or {})
    TYPES[params.type](maker)
    return maker.assembly()


class _Maker:
    """Collects girders and nodes; joints are named by the order in which they are made."""

    def __init__(
        self, params: Params, section: Section, bolts: bolt_holes.Params | None = None, shifts: Shifts | None = None
    ) -> None:
        self.params, self.section, self.bolts, self.shifts = params, section, bolts, shifts or {}
        self.made_of: dict[str, Girder | Node] = {}
        self.faces: dict[str, list[Patch]] = {}
        self.reach: dict[str, float] = {}
        self.joints: list[Joint] = []

    def girder(self, name: str, T: Floats, length: float, joined: tuple[bool, bool] = (False, False)) -> Floats:
        """Add a girder from the origin of T (4, 4) along its x; return the frame at its end.

        It has bolt holes, if any, at the start and end that are ``joined``.
        """
        number = len(self.faces)
        outer = self.section.outlines[0]
        top = next(
            k
            for k, (a, b) in enumerate(zip(outer, np.roll(outer, -1, axis=0), strict=True))
            if a[1] == b[1] == outer[:, 1].max()
        )
        edge, mark = (outer[top], np.roll(outer, -1, axis=0)[top]), (0.25 + 0.03 * (number % 6)) * length
        bores = self._bores(name, length, joined)
        wall, *pad = prismatic_parts.marked(T, 0.0, length, edge, mark)
        faces = [*bolt_holes.holed(wall, T, length, *edge, bores), *pad]
        others = [k for k in range(len(outer)) if k != top]
        for k, wall in zip(others, prismatic_parts.walls(T, 0.0, length, outer, skip=[top]), strict=True):
            faces += bolt_holes.holed(wall, T, length, outer[k], outer[(k + 1) % len(outer)], bores)
        faces += [bolt_holes.bore_patch(f"bore{k}", T, bore) for k, bore in enumerate(bores)]
        for hole in self.section.outlines[1:]:
            faces += prismatic_parts.walls(T, 0.0, length, hole, "inner")
        faces += prismatic_parts.end_face(T, 0.0, self.section, "start") + prismatic_parts.end_face(
            T, length, self.section, "end"
        )
        self.faces[name], self.reach[name] = faces, min(prismatic_parts.FADES_MM, 0.4 * length)
        self.made_of[name] = Girder(T, length, self.section, mark, tuple(bores))
        return T @ _along(length)

    def _bores(self, name: str, length: float, joined: tuple[bool, bool]) -> list[Bore]:
        """Return the holes of a girder as drilled."""
        if self.bolts is None:
            return []
        bores = bolt_holes.of_girder(self.bolts, self.section, length, joined)
        shifts = self.shifts.get(name, np.zeros((len(bores), 3)))
        return [dataclasses.replace(bore, shift=shift) for bore, shift in zip(bores, shifts, strict=True)]

    def node(self, name: str, T: Floats) -> None:
        """Add a node with its middle at T (4, 4): stubs along x to both sides and a shorter one along z."""
        stub, h = self.params.stub_mm, 0.5 * self.section.height
        up, faces = T @ UP, []
        for number, outline in enumerate(self.section.outlines):
            # The web plates of both directions are in one plane, so the upright box is as deep as the chord is high.
            reach = h if number == 0 else h - self.params.flange_mm
            top = TOP if number == 0 else 0
            faces += prismatic_parts.walls(
                T, -stub, -reach, outline, f"chord{number}", skip=[top] if number == 0 else []
            )
            faces += prismatic_parts.walls(T, -reach, reach, outline, f"middle{number}", skip=[top])
            faces += prismatic_parts.walls(T, reach, stub, outline, f"chord{number}")
            faces += prismatic_parts.walls(up, reach, self.upright, outline, f"branch{number}")
        # Without its mark the node would look the same after half a turn about the third stub.
        outer, mark = self.section.outlines[0], -h - prismatic_parts.PAD_SIZE_MM
        faces += prismatic_parts.marked(T, -stub, -h, (outer[TOP], outer[TOP + 1]), mark)
        faces += prismatic_parts.end_face(T, -stub, self.section, "start") + prismatic_parts.end_face(
            T, stub, self.section, "end"
        )
        faces += prismatic_parts.end_face(up, self.upright, self.section, "end")
        self.faces[name], self.reach[name] = faces, 0.8 * (self.upright - h)
        self.made_of[name] = Node(T, stub, self.upright, self.section, mark)

    @property
    def upright(self) -> float:
        """Length of a node's third stub, from its middle: unlike the others, so that the axes can be told apart."""
        return 1.15 * self.params.stub_mm

    def join(self, left: str, right: str, T: Floats) -> None:
        """Add a joint at T (4, 4)."""
        self.joints.append(Joint(f"J{len(self.joints) + 1}", left, right, T, self.section))

    def assembly(self) -> Assembly:
        """Return what was collected."""
        parts = []
        for name, faces in self.faces.items():
            ends = [
                End(joint.name, joint.T, outward, self.section, self.reach[name])
                for joint in self.joints
                for part, outward in ((joint.left, 1.0), (joint.right, -1.0))
                if part == name
            ]
            parts.append(Part(name, tuple(faces), tuple(ends), self.made_of[name]))
        return Assembly(tuple(parts), tuple(self.joints))


# Frame whose x is the chord's z: y stays, z is the chord's -x.
UP = rigid(np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), np.zeros(3))


def _along(x: float) -> Floats:
    return rigid(np.eye(3), np.array([x, 0.0, 0.0]))


def _row(maker: _Maker) -> None:
    params, T = maker.params, np.eye(4)
    for k in range(params.parts):
        if k:
            maker.join(f"girder{k}", f"girder{k + 1}", T)
        joined = k > 0, k < params.parts - 1
        T = maker.girder(f"girder{k + 1}", T, params.length_mm + params.step_mm * k, joined)


def _node(maker: _Maker) -> None:
    params, stub = maker.params, maker.params.stub_mm
    maker.node("node", np.eye(4))
    ends = _along(-stub), _along(stub), UP @ _along(maker.upright)
    maker.girder("arm1", _along(-stub - params.length_mm), params.length_mm)
    maker.girder("arm2", ends[1], params.length_mm + params.step_mm)
    maker.girder("arm3", ends[2], params.length_mm + 2.0 * params.step_mm)
    maker.join("arm1", "node", ends[0])
    maker.join("node", "arm2", ends[1])
    maker.join("node", "arm3", ends[2])


def _ribs(maker: _Maker) -> None:
    """Two ribs of three girders and two nodes each, with two braces between the nodes: one closed loop."""
    params, stub = maker.params, maker.params.stub_mm
    middle = 0.5 * params.length_mm + stub  # half the distance between the nodes of a rib
    places = {}
    for name, sign in (("left", 1.0), ("right", -1.0)):
        R = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -sign], [0.0, sign, 0.0]])
        line = rigid(R, np.array([0.0, sign * 0.5 * params.spread_mm, 0.0]))
        length = params.length_mm + (params.step_mm if sign > 0.0 else -params.step_mm)
        parts = (
            (f"{name}1", -middle - stub - length, length),
            (f"{name}3", -middle + stub, params.length_mm),
            (f"{name}5", middle + stub, length + 0.5 * params.step_mm),
        )
        for k, x in ((2, -middle), (4, middle)):
            places[name, k] = line @ _along(x)
            maker.node(f"{name}{k}", places[name, k])
        for girder, x, size in parts:
            maker.girder(girder, line @ _along(x), size)
        for k, x in ((2, -middle), (4, middle)):
            maker.join(f"{name}{k - 1}", f"{name}{k}", line @ _along(x - stub))
            maker.join(f"{name}{k}", f"{name}{k + 1}", line @ _along(x + stub))
    for k, number in ((2, 1), (4, 2)):
        start, end = (places[name, k] @ UP @ _along(maker.upright) for name in ("left", "right"))
        back = end @ rigid(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        length = float(np.linalg.norm(back[:3, 3] - start[:3, 3]))
        maker.girder(f"brace{number}", start, length)
        maker.join(f"left{k}", f"brace{number}", start)
        maker.join(f"brace{number}", f"right{k}", start @ _along(length))


TYPES: dict[str, Callable[[_Maker], None]] = {"row": _row, "node": _node, "ribs": _ribs}
