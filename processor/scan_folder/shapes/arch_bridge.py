"""The design of parts that meet end to end, a mesh for each: order, joints with P1 to P8, bottom edges of a row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from processor.model import ArchDesign, DesignPart, Floats
from processor.scan_folder.component_names import numbered_backwards
from processor.scan_folder.shapes import chain as chains
from processor.scan_folder.shapes import connected
from processor.scan_folder.shapes.body import Body, Unsure
from processor.scan_folder.shapes.bottom_edges import BEVEL_MM, follow, smooth
from processor.scan_folder.shapes.connected import Assembly
from processor.scan_folder.shapes.contact_faces import Contact, PlaneFace, contacts
from processor.scan_folder.shapes.sections import LEFT, STRAIGHT_MM, SectionPlane, corners, key_points, skin_at_end

SAME_MM = 0.5  # between the corners of two ends, and between a corner and the skin's
SKIN_MM = 0.5
OVERLAP_MM = 0.2
PLAUSIBLE_MM = (150.0, 10_000.0)  # sizes of a section
END_MM = 0.5  # between the end of a bottom edge and the corner of the next joint
REACH_SHARE = 0.6  # of a foot's length that its bottom edges have to reach from the joint
ASIDE_MM = 100.0  # corners of two ends that differ more are not of one section
UPRIGHT_COS = 0.8  # of the normal of a section that has neither left nor right by Z
ALIKE = 0.1  # relative difference of the lengths of a part's two bottom edges
SIDES = ("left", "right")


@dataclass(frozen=True)
class GuessedArch:
    """A design, or None, with what is not sure about it and the reason.

    ``root_gap_mm`` is the modelled gap between the ends at the joints, NaN where it differs. ``arched``: the parts rise
    from both ends. ``row``: each part is joined to the next alone. ``unsure``: the joints and parts with doubts.
    """

    design: ArchDesign | None
    doubts: tuple[str, ...]
    root_gap_mm: float = 0.0
    arched: bool = False
    row: bool = True
    unsure: tuple[Unsure, ...] = ()


@dataclass(frozen=True)
class _End:
    corners: Floats  # P1..P4 (4, 3)
    outward: Floats  # (4, 3) where the edges lead a mm farther along the normal
    doubt: str = ""


@dataclass(frozen=True)
class _Joint:
    name: str
    plane: SectionPlane
    left: _End  # of the left part
    right: _End
    points: Floats  # P1..P8
    doubts: tuple[str, ...]


def find(bodies: Sequence[Body]) -> GuessedArch:
    """Return the design of parts that meet end to end, in the bridge's frame, mm; without one the reason.

    The parts of a row have bottom edges; those of a ring or with branches have joints alone.
    """
    found = _assembly(bodies)
    problem = found if isinstance(found, str) else chains.frame_problem(found) if found.row else ""
    if isinstance(found, str) or problem:
        return GuessedArch(None, (problem,))
    doubts = list(found.doubts)
    unsure, joints = [Unsure(body.name, body.centre) for body in found.left_out], []
    for number in range(len(found.contacts)):
        joint = _joint(found, number)
        if isinstance(joint, str):
            return GuessedArch(None, (joint, *doubts))
        joints.append(joint)
        doubts += [f"joint {joint.name} of {_pair(found, number)}: {text}" for text in joint.doubts]
        unsure += [Unsure(joint.name, joint.points[:4].mean(axis=0))] if joint.doubts else []
    parts = []
    for number, body in enumerate(found.parts):
        part, doubt = _part(found, joints, number) if found.row else (_without_edges(body), "")
        parts.append(part)
        doubts += [doubt] if doubt else []
        unsure += [Unsure(body.name, body.centre)] if doubt or body.step_mm else []
    doubts += _numbering(found) if found.row else []
    rounded = [part.name for part in found.parts if part.step_mm]
    if rounded:
        doubts.append(f"corners and edges: the coordinates of {', '.join(rounded)} are rounded to 0.1 mm or more")
    gaps = [contact.gap_mm for contact in found.contacts]
    alike = max(gaps) - min(gaps) < SAME_MM
    if not alike:
        doubts.append(f"root gap: from {min(gaps):.2f} to {max(gaps):.2f} mm at the joints")
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


def _assembly(bodies: Sequence[Body]) -> Assembly | str:
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
    if isinstance(found, str):
        return found
    doubts = [
        f"{connected.listed(bodies, which)}: taken as {what}, so no part"
        for what, which in (("splice plates", plates), ("bolts or the like", small))
        if which
    ]
    return replace(found, doubts=(*doubts, *found.doubts))


def _without(between: dict[tuple[int, int], Contact], bodies: Sequence[int]) -> dict[tuple[int, int], Contact]:
    """Return the contacts of other bodies."""
    return {pair: one for pair, one in between.items() if not set(pair) & set(bodies)}


def _without_edges(body: Body) -> DesignPart:
    return DesignPart(body.name, body.vertices, body.faces)


def _pair(found: Assembly, number: int) -> str:
    left, right = found.links[number]
    return f"{found.parts[left].name} and {found.parts[right].name}"


# --- joints -----------------------------------------------------------------------------------------------------------


def _joint(found: Assembly, number: int) -> _Joint | str:
    contact = found.contacts[number]
    a, b = (found.parts[part] for part in found.links[number])
    normal = _normal(contact, a, b)
    way = LEFT if found.row else _left(normal)
    plane = SectionPlane.across(0.5 * (contact.a.origin + contact.b.origin), normal, way)
    if plane is None:
        return f"{_pair(found, number)}: their ends do not face along the span, so left and right are not clear"
    left, right = _end(a, contact.a, plane, -1.0, way), _end(b, contact.b, plane, 1.0, way)
    if left is None or right is None:
        return f"{_pair(found, number)}: the end of {(b if left else a).name} encloses no area"
    doubts = ["they meet in a second pair of faces that is nearly as large"] if contact.rival else []
    doubts += [f"{part.name}: {end.doubt}" for part, end in ((a, left), (b, right)) if end.doubt]
    # Edges that are skew to the joint go on across the gap.
    middles = [plane.flat(end.corners + 0.5 * contact.gap_mm * end.outward) for end in (left, right)]
    in_plane = np.abs(middles[0] - middles[1]).max()
    if in_plane > ASIDE_MM and not found.row:
        return f"{_pair(found, number)}: one of them ends on a side of the other, where they have no common section"
    if in_plane > SAME_MM:
        doubts.append(f"the corners of the two ends differ by {in_plane:.1f} mm")
    gaps = (right.corners - left.corners) @ plane.normal
    if contact.gap_mm < -OVERLAP_MM:
        doubts.append(f"the ends overlap by {-contact.gap_mm:.1f} mm")
    if np.ptp(gaps) > SAME_MM:
        doubts.append(f"its gap is not even ({gaps.min():.2f} to {gaps.max():.2f} mm)")
    four = plane.flat(0.5 * (left.corners + right.corners))
    size = np.ptp(four, axis=0)
    if not (PLAUSIBLE_MM[0] < size.min() and size.max() < PLAUSIBLE_MM[1]):
        doubts.append(f"a section of {size[0]:.4g} x {size[1]:.4g} mm is unusual: is the unit right?")
    return _Joint(f"J{number + 1}", plane, left, right, points=key_points(plane, four), doubts=tuple(doubts))


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
    skin = skin_at_end(body, plane, inward)
    outward = np.broadcast_to(-inward * normal, (4, 3))
    if skin is None:
        return _End(plane.space(found.places), outward, found.doubt or "the sections behind its end have other corners")
    at_end, change = skin
    outward = outward + change[:, :1] * plane.left + change[:, 1:] * plane.up
    off = float(np.abs(at_end - found.places).max())
    if found.doubt or off > SKIN_MM:
        doubt = found.doubt or f"the corners of its end are {off:.1f} mm off its outer faces; these are taken"
        return _End(plane.space(at_end), outward, doubt)
    return _End(plane.space(found.places), outward)


# --- parts ------------------------------------------------------------------------------------------------------------


def _part(chain: Assembly, joints: Sequence[_Joint], number: int) -> tuple[DesignPart, str]:
    """Return a part with its bottom edges from start to end, or none, and why they are not sure."""
    body = chain.parts[number]
    start = joints[number - 1] if number else None
    end = joints[number] if number < len(joints) else None
    edges, doubts = [], []
    for k, side in enumerate(SIDES):
        near, far = (start.right, end.left if end else None) if start else (end.left if end else None, None)
        assert near is not None
        edge = follow(body, near.corners[k], -near.outward[k])
        edge, doubt = _between(edge, near.corners[k], None if far is None else far.corners[k])
        if len(edge) and far is None and _reach(body, edge) < REACH_SHARE:
            doubt = f"ends {np.linalg.norm(edge[-1] - edge[0]):.0f} mm from the joint"
        doubts += [f"the lower {side} edge {doubt}"] if doubt else []
        edges.append(smooth(edge if start is not None else edge[::-1]))
    lengths = [float(np.linalg.norm(np.diff(edge, axis=0), axis=1).sum()) for edge in edges]
    if min(lengths) == 0.0:
        text = f"bottom edges of {body.name}: left out: {'; '.join(doubts)}"
        return DesignPart(body.name, body.vertices, body.faces), text
    if abs(lengths[0] - lengths[1]) > ALIKE * max(lengths):
        doubts.append(f"its bottom edges are {lengths[0]:.0f} and {lengths[1]:.0f} mm long")
    text = f"bottom edges of {body.name}: {'; '.join(doubts)}" if doubts else ""
    return DesignPart(body.name, body.vertices, body.faces, edges[0], edges[1]), text


def _between(edge: Floats, first: Floats, last: Floats | None) -> tuple[Floats, str]:
    """Return an edge (n, 3) that begins and ends at the corners (3,) of the joints, and why it is not sure.

    n = 0 for none.
    """
    if not len(edge):
        return edge, "is not sharp at the corner of the joint"
    doubt = ""
    if np.linalg.norm(edge[0] - first) > END_MM:
        edge, doubt = np.vstack([first, edge]), "begins behind the corner"
    else:
        edge = np.vstack([first, edge[1:]])
    if last is None:
        return edge, doubt
    away = np.linalg.norm(edge - last, axis=1)
    if away[-1] <= END_MM:
        return np.vstack([edge[:-1], last]), doubt
    if away.min() < BEVEL_MM:
        kept = edge[: max(1, int((away > BEVEL_MM).sum()))]
        return np.vstack([kept, last]), "ends before the corner of the next joint"
    return edge[:0], "does not lead from joint to joint"


def _reach(body: Body, edge: Floats) -> float:
    """Return how far an edge reaches, as a share of how far the body reaches from the edge's first point."""
    farthest = np.linalg.norm(body.vertices - edge[0], axis=1).max()
    return float(np.linalg.norm(edge[-1] - edge[0]) / farthest)


def _numbering(chain: Assembly) -> list[str]:
    """Return a doubt where the names are numbered against X."""
    names = [part.name for part in chain.parts]
    if not numbered_backwards(names):
        return []
    return [
        f"order: {', '.join(names)} along X, but their names are numbered the other way; does X point the right way?"
    ]
