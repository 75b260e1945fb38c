"""The design of parts that meet end to end, a mesh for each: order, joints with P1 to P8, bottom edges of a row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from processor.model import ArchDesign, DesignPart, Floats, Reason, reason
from processor.scan_folder.component_names import numbered_backwards
from processor.scan_folder.shapes import chain as chains
from processor.scan_folder.shapes import connected
from processor.scan_folder.shapes.body import Body, Unsure
from processor.scan_folder.shapes.bottom_edges import BEVEL_MM, follow, smooth
from processor.scan_folder.shapes.connected import Assembly
from processor.scan_folder.shapes.contact_faces import Contact, PlaneFace, contacts
from processor.scan_folder.shapes.sections import LEFT, STRAIGHT_MM, SectionPlane, corners, key_points, skin_at_end

SAME_MM = 0.5  # between the corners of two ends, and between a corner and the skin's
SKIN_MM = 0.5  # as SAME_MM, of an end's corners from the part's outer faces
OVERLAP_MM = 0.2  # rounding and chords of a mesh; parts that overlap by more do not meet end to end
PLAUSIBLE_MM = (150.0, 10_000.0)  # sizes of a section
END_MM = 0.5  # between the end of a bottom edge and the corner of the next joint
REACH_SHARE = 0.6  # of a foot's length that its bottom edges have to reach from the joint
ASIDE_MM = 100.0  # corners of two ends that differ more are not of one section
UPRIGHT_COS = 0.8  # of the normal of a section that has neither left nor right by Z
ALIKE = 0.1  # relative difference of the lengths of a part's two bottom edges
KEY_CORNERS = 4  # P1..P4
LOWER_LEFT, LOWER_RIGHT = 0, 1  # rows of the lower corners of an end


@dataclass(frozen=True)
class GuessedArch:
    """A design and the doubts about it; None and the reasons where there is none.

    ``root_gap_mm`` is the modelled gap between the ends at the joints, NaN where it differs. ``arched``: the parts rise
    from both ends. ``row``: each part is joined to the next alone. ``unsure``: the joints and parts with doubts.
    """

    design: ArchDesign | None
    doubts: tuple[Reason, ...]
    root_gap_mm: float = 0.0
    arched: bool = False
    row: bool = True
    unsure: tuple[Unsure, ...] = ()


@dataclass(frozen=True)
class _End:
    corners: Floats  # P1..P4 (4, 3); P1..P8 (8, 3) of a round section
    outward: Floats  # (4, 3) or (8, 3) where the edges lead a mm farther along the normal
    doubt: Reason | None = None

    @property
    def is_round(self) -> bool:
        """Whether it is of a round tube."""
        return len(self.corners) > KEY_CORNERS


@dataclass(frozen=True)
class _Joint:
    name: str
    left: _End  # of the left part
    right: _End
    points: Floats  # P1..P8
    doubts: tuple[Reason, ...]


def find(bodies: Sequence[Body]) -> GuessedArch:
    """Return the design of parts that meet end to end, in the bridge's frame, mm; without one the reason.

    The parts of a row have bottom edges; those of a ring or with branches have joints alone.
    """
    found = _assembly(bodies)
    if isinstance(found, Reason):
        return GuessedArch(None, (found,))
    problem = chains.frame_problem(found) if found.row else None
    if problem:
        return GuessedArch(None, (problem,))
    doubts = list(found.doubts)
    unsure, joints = [Unsure(body.name, body.centre) for body in found.left_out], []
    for number in range(len(found.contacts)):
        joint = _joint(found, number)
        if isinstance(joint, Reason):
            return GuessedArch(None, (joint, *doubts))
        joints.append(joint)
        left, right = (found.parts[part].name for part in found.links[number])
        doubts += [
            reason("init.at-joint", joint=joint.name, left=left, right=right, reason=doubt) for doubt in joint.doubts
        ]
        unsure += [Unsure(joint.name, joint.points[:4].mean(axis=0))] if joint.doubts else []
    parts = []
    for number, body in enumerate(found.parts):
        part, of_part = _part(found, joints, number) if found.row else (_without_edges(body), [])
        parts.append(part)
        doubts += of_part
        unsure += [Unsure(body.name, body.centre)] if of_part or body.step_mm else []
    numbered = tuple(part.name for part in found.parts)
    if found.row and numbered_backwards(numbered):
        doubts.append(reason("init.numbered-backwards", parts=numbered))
    rounded = tuple(part.name for part in found.parts if part.step_mm)
    if rounded:
        doubts.append(reason("init.rounded-parts", parts=rounded))
    gaps = [contact.gap_mm for contact in found.contacts]
    alike = max(gaps) - min(gaps) < SAME_MM
    if not alike:
        doubts.append(reason("init.root-gaps-differ", least=min(gaps), most=max(gaps)))
    design = ArchDesign(
        tuple(parts),
        joint_names=tuple(joint.name for joint in joints),
        joint_left=tuple(parts[left].name for left, _ in found.links),
        joint_right=tuple(parts[right].name for _, right in found.links),
        joint_points=np.array([joint.points for joint in joints]),
    )
    gap = max(0.0, round(float(np.mean(gaps)), 2)) if alike else float("nan")
    arched = found.row and chains.rises(found)
    return GuessedArch(design, tuple(doubts), root_gap_mm=gap, arched=arched, row=found.row, unsure=tuple(unsure))


def _assembly(bodies: Sequence[Body]) -> Assembly | Reason:
    """Return the parts among bodies and how they are joined, without splices; or why it is not clear."""
    between = contacts(bodies)
    small = connected.fasteners(bodies, between)
    between = _without(between, small)
    plates = [i for i in connected.splice_plates(bodies, between) if i not in small]
    between = _without(between, plates)
    if connected.branched(between):
        between = {pair: one for pair, one in between.items() if one.fits}
    kept = [i for i in range(len(bodies)) if i not in {*plates, *small}]
    parts = [bodies[i] for i in kept]
    between = {(kept.index(i), kept.index(k)): one for (i, k), one in between.items()}
    found = connected.find(parts, between) if connected.branched(between) else chains.find(parts, between)
    if isinstance(found, Reason):
        return found
    doubts = [reason("init.splice-plates", parts=connected.listed(bodies, plates))] if plates else []
    doubts += [reason("init.fasteners", parts=connected.listed(bodies, small))] if small else []
    return replace(found, doubts=(*doubts, *found.doubts))


def _without(between: dict[tuple[int, int], Contact], bodies: Sequence[int]) -> dict[tuple[int, int], Contact]:
    """Return the contacts of other bodies."""
    return {pair: one for pair, one in between.items() if not set(pair) & set(bodies)}


def _without_edges(body: Body) -> DesignPart:
    return DesignPart(body.name, body.vertices, body.faces)


# --- joints -----------------------------------------------------------------------------------------------------------


def _joint(found: Assembly, number: int) -> _Joint | Reason:
    contact = found.contacts[number]
    a, b = (found.parts[part] for part in found.links[number])
    normal = _normal(contact, a, b)
    way = LEFT if found.row else _left(normal)
    plane = SectionPlane.across(0.5 * (contact.a.origin + contact.b.origin), normal, way)
    if plane is None:
        return reason("init.sides-not-clear", left=a.name, right=b.name)
    left, right = _end(a, contact.a, plane, -1.0, way), _end(b, contact.b, plane, 1.0, way)
    if left is None or right is None:
        return reason("init.end-without-area", left=a.name, right=b.name, part=(b if left else a).name)
    doubts = [reason("init.second-contact")] if contact.rival else []
    doubts += [
        reason("init.of-part", part=part.name, reason=end.doubt) for part, end in ((a, left), (b, right)) if end.doubt
    ]
    if left.is_round != right.is_round:
        return reason("init.round-and-other", left=a.name, right=b.name)
    # Edges that are skew to the joint go on across the gap.
    middles = [plane.flat(end.corners + 0.5 * contact.gap_mm * end.outward) for end in (left, right)]
    in_plane = np.abs(middles[0] - middles[1]).max()
    if in_plane > ASIDE_MM and not found.row:
        return reason("init.end-on-side", left=a.name, right=b.name)
    if in_plane > SAME_MM:
        doubts.append(reason("init.corners-differ", mm=in_plane))
    gaps = (right.corners - left.corners) @ plane.normal
    if contact.gap_mm < -OVERLAP_MM:
        doubts.append(reason("init.ends-overlap", mm=-contact.gap_mm))
    if np.ptp(gaps) > SAME_MM:
        doubts.append(reason("init.gap-uneven", least=gaps.min(), most=gaps.max()))
    places = plane.flat(0.5 * (left.corners + right.corners))
    size = np.ptp(places, axis=0)
    if not (PLAUSIBLE_MM[0] < size.min() and size.max() < PLAUSIBLE_MM[1]):
        doubts.append(reason("init.section-unusual", width=size[0], height=size[1]))
    return _Joint(f"J{number + 1}", left, right, points=key_points(plane, places), doubts=tuple(doubts))


def _normal(contact: Contact, a: Body, b: Body) -> Floats:
    """Return the normal (3,) of the plane midway between two ends, from the left part to the right one."""
    normals = [
        face.normal if face.normal @ (b.centre - a.centre) > 0 else -face.normal for face in (contact.a, contact.b)
    ]
    normal = normals[0] + normals[1]
    return np.asarray(normal / np.linalg.norm(normal))


def _left(normal: Floats) -> Floats:
    """Return the way (3,) to the left of a section with a normal, Z being up; +Y of a level section."""
    if abs(normal[2]) > UPRIGHT_COS:
        return LEFT
    left = np.array([-normal[1], normal[0], 0.0])
    return np.asarray(left / np.linalg.norm(left))


def _end(body: Body, face: PlaneFace, joint: SectionPlane, inward: float, way: Floats) -> _End | None:
    """Return a part's end; ``inward`` is 1 where the part lies on the side of the joint's normal, else -1."""
    normal = face.normal if face.normal @ joint.normal > 0 else -face.normal
    plane = SectionPlane.across(face.origin, normal, way)
    found = None if plane is None else corners(plane.flat(face.points), max(STRAIGHT_MM, 2.0 * body.step_mm))
    if plane is None or found is None:
        return None
    places, doubt = found
    skin = skin_at_end(body, plane, inward)
    outward = np.broadcast_to(-inward * normal, (len(places), 3))
    if skin is None or len(skin[0]) != len(places):
        return _End(plane.space(places), outward, doubt or reason("init.other-corners-behind"))
    at_end, change = skin
    outward = outward + change[:, :1] * plane.left + change[:, 1:] * plane.up
    off = float(np.abs(at_end - places).max())
    if doubt or off > SKIN_MM:
        return _End(plane.space(at_end), outward, doubt or reason("init.off-outer-faces", mm=off))
    return _End(plane.space(places), outward)


# --- parts ------------------------------------------------------------------------------------------------------------


def _part(chain: Assembly, joints: Sequence[_Joint], number: int) -> tuple[DesignPart, list[Reason]]:
    """Return a part with its bottom edges from start to end, or none, and the doubts about them."""
    body = chain.parts[number]
    start = joints[number - 1] if number else None
    end = joints[number] if number < len(joints) else None
    if any(one is not None and one.left.is_round for one in (start, end)):
        return _without_edges(body), []
    edges, doubts = [], list[Reason]()
    for k in (LOWER_LEFT, LOWER_RIGHT):
        near, far = (start.right, end.left if end else None) if start else (end.left if end else None, None)
        assert near is not None
        edge = follow(body, near.corners[k], -near.outward[k])
        edge, doubt = _between(edge, near.corners[k], None if far is None else far.corners[k])
        if len(edge) and far is None and _reach(body, edge) < REACH_SHARE:
            doubt = reason("init.edge-short", mm=np.linalg.norm(edge[-1] - edge[0]))
        if doubt:
            doubts.append(
                reason("init.left-edge", reason=doubt) if k == LOWER_LEFT else reason("init.right-edge", reason=doubt)
            )
        edges.append(smooth(edge if start is not None else edge[::-1]))
    lengths = [float(np.linalg.norm(np.diff(edge, axis=0), axis=1).sum()) for edge in edges]
    if min(lengths) == 0.0:
        left_out = reason("init.bottom-edges-left-out", part=body.name, reasons=tuple(doubts))
        return _without_edges(body), [left_out]
    if abs(lengths[0] - lengths[1]) > ALIKE * max(lengths):
        doubts.append(reason("init.edges-differ", left=lengths[0], right=lengths[1]))
    part = DesignPart(body.name, body.vertices, body.faces, edges[0], edges[1])
    return part, [reason("init.bottom-edges", part=body.name, reasons=tuple(doubts))] if doubts else []


def _between(edge: Floats, first: Floats, last: Floats | None) -> tuple[Floats, Reason | None]:
    """Return an edge (n, 3) that begins and ends at the corners (3,) of the joints, and the doubt about it.

    n = 0 for none.
    """
    if not len(edge):
        return edge, reason("init.edge-not-sharp")
    doubt = None
    if np.linalg.norm(edge[0] - first) > END_MM:
        edge, doubt = np.vstack([first, edge]), reason("init.edge-begins-late")
    else:
        edge = np.vstack([first, edge[1:]])
    if last is None:
        return edge, doubt
    away = np.linalg.norm(edge - last, axis=1)
    if away[-1] <= END_MM:
        return np.vstack([edge[:-1], last]), doubt
    if away.min() < BEVEL_MM:
        kept = edge[: max(1, int((away > BEVEL_MM).sum()))]
        return np.vstack([kept, last]), reason("init.edge-ends-early")
    return edge[:0], reason("init.edge-ends-elsewhere")


def _reach(body: Body, edge: Floats) -> float:
    """Return how far an edge reaches, as a share of how far the body reaches from the edge's first point."""
    farthest = np.linalg.norm(body.vertices - edge[0], axis=1).max()
    return float(np.linalg.norm(edge[-1] - edge[0]) / farthest)
