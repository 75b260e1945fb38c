"""Which bodies of a design are joined to which: a row, or a ring, or with branches; splice plates are left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from processor.distinct_rows import components, rows_by_label
from processor.model import Floats, Reason, reason
from processor.scan_folder.shapes.body import Body
from processor.scan_folder.shapes.contact_faces import Contact, same_place

SMALL_SHARE = 0.4  # of the largest section: a body that is smaller has no such section
AROUND_MM = 60.0  # how far splice plates and bolts project beyond a section
CROSSES_MM = 10.0  # how far a splice plate reaches on either side of a joint, at least


@dataclass(frozen=True)
class Assembly:
    """Parts (n), and joints (m) between them: ``links`` are their left and right parts, ``contacts`` has a = left.

    ``row``: each part is joined to the next alone. ``doubts``: what is not sure; ``left_out``: what meets no part.
    """

    parts: tuple[Body, ...]
    links: tuple[tuple[int, int], ...]
    contacts: tuple[Contact, ...]
    doubts: tuple[Reason, ...] = ()
    row: bool = False
    left_out: tuple[Body, ...] = ()

    @property
    def line(self) -> Floats:
        """Centre of the first part, middles of the joints, and centre of the last part (m + 2, 3), mm."""
        return np.vstack([self.parts[0].centre, *(one.middle for one in self.contacts), self.parts[-1].centre])


def listed(bodies: Sequence[Body], which: Sequence[int]) -> tuple[str, ...] | Reason:
    """Return the names of some bodies, of the first six."""
    names = tuple(bodies[i].name for i in which)
    return names if len(names) <= 6 else reason("init.and-others", names=names[:6], others=len(names) - 6)


def unclosed(bodies: Sequence[Body]) -> tuple[Reason, ...]:
    """Return which bodies are not closed, () for none: they may lack the faces of their ends."""
    names = [body.name for body in bodies if body.open_edges]
    shown = (*names[:6], *(["..."] if len(names) > 6 else []))
    return (reason("init.unclosed", parts=shown),) if names else ()


def splice_plates(bodies: Sequence[Body], contacts: Mapping[tuple[int, int], Contact]) -> list[int]:
    """Return the bodies that cross the plane in which two others meet, within or close around their section."""
    bounds = np.array([body.bounds for body in bodies]).reshape(-1, 2, 3)
    found = set[int]()
    for (i, k), joint in contacts.items():
        _, _, axes = np.linalg.svd(joint.a.points - joint.a.origin, full_matrices=False)
        section = (np.vstack([joint.a.points, joint.b.points]) - joint.middle) @ axes[:2].T
        low, high = section.min(axis=0) - AROUND_MM, section.max(axis=0) + AROUND_MM
        reach = float(np.linalg.norm(high - low))
        near = ((bounds[:, 0] - reach < joint.middle) & (bounds[:, 1] + reach > joint.middle)).all(axis=1)
        for other in set(np.flatnonzero(near).tolist()) - found - {i, k}:
            places = (bodies[other].vertices - joint.middle) @ axes.T
            across, least = places[:, 2], 0.5 * abs(joint.gap_mm) + CROSSES_MM
            inside = (places[:, :2] > low).all() and (places[:, :2] < high).all()
            if inside and across.min() < -least and across.max() > least:
                found.add(other)
    return sorted(found)


def fasteners(bodies: Sequence[Body], contacts: Mapping[tuple[int, int], Contact]) -> list[int]:
    """Return the bodies that are much smaller than the largest section in which two bodies meet."""
    sections = [min(float(np.linalg.norm(sides)) for sides in one.sizes) for one in contacts.values() if one.fits]
    least = SMALL_SHARE * max(sections, default=0.0)
    return [i for i, body in enumerate(bodies) if float(np.linalg.norm(np.ptp(body.bounds, axis=0))) < least]


def branched(contacts: Mapping[tuple[int, int], Contact]) -> bool:
    """Whether bodies that meet make up a ring, or one of them meets more than two others."""
    beside = neighbours(contacts)
    return any(len(others) > 2 for others in beside.values()) or any(
        sum(len(beside[i]) for i in group) >= 2 * len(group) for group in groups(beside)
    )


def find(bodies: Sequence[Body], contacts: Mapping[tuple[int, int], Contact]) -> Assembly | Reason:
    """Return bodies that make up a ring, or have branches, from one of an end on; or why their joints are not clear.

    Parts are in the order in which their joints lead from one to the next, left is the one that comes first; the joint
    that closes a ring leads from its last part to the first.
    """
    beside = neighbours(contacts)
    for i, others in beside.items():
        for k, m in combinations(others, 2):
            faces = [contacts[i, n].a if i < n else contacts[n, i].b for n in (k, m)]
            if same_place(*faces):
                return reason("init.crowded", first=bodies[k].name, second=bodies[m].name, part=bodies[i].name)
    apart = groups(beside)
    if len(apart) > 1:
        first, second = (listed(bodies, group) for group in apart[:2])
        return reason("init.several-groups", first=first, second=second, unclosed=unclosed(bodies))
    left_out = [i for i in range(len(bodies)) if i not in beside]
    return assembled(
        bodies, contacts, *walk(beside), reason("init.meets-no-part", parts=listed(bodies, left_out)), row=False
    )


def assembled(
    bodies: Sequence[Body],
    contacts: Mapping[tuple[int, int], Contact],
    order: Sequence[int],
    steps: Sequence[tuple[int, int]],
    doubt: Reason,
    row: bool,
) -> Assembly:
    """Return bodies in an order, joined step by step; there is the ``doubt`` where some are left out."""
    left_out = tuple(body for i, body in enumerate(bodies) if i not in order)
    return Assembly(
        tuple(bodies[i] for i in order),
        tuple((order.index(i), order.index(k)) for i, k in steps),
        tuple(contacts[i, k] if i < k else contacts[k, i].reverse for i, k in steps),
        (doubt,) if left_out else (),
        row=row,
        left_out=left_out,
    )


def neighbours(contacts: Mapping[tuple[int, int], Contact]) -> dict[int, list[int]]:
    """Return which bodies each of those that meet any meets."""
    beside: dict[int, list[int]] = {}
    for i, k in contacts:
        beside.setdefault(i, []).append(k)
        beside.setdefault(k, []).append(i)
    return {i: sorted(beside[i]) for i in sorted(beside)}


def groups(beside: Mapping[int, Sequence[int]]) -> list[list[int]]:
    """Return the nodes of each connected piece of a graph, the largest first."""
    if not beside:
        return []
    links = np.array([(i, k) for i, others in beside.items() for k in others], np.int64).reshape(-1, 2)
    label = components(max(beside) + 1, *links.T)
    found = [[i for i in rows.tolist() if i in beside] for rows in rows_by_label(label)]
    return sorted(filter(None, found), key=lambda group: -len(group))


def walk(beside: Mapping[int, Sequence[int]]) -> tuple[list[int], list[tuple[int, int]]]:
    """Return the nodes of a connected graph from a node of few neighbours on, depth first, and each edge once."""
    start = min(beside, key=lambda i: (len(beside[i]), i))
    order, steps, left = list[int](), list[tuple[int, int]](), [(start, start)]
    while left:
        before, node = left.pop()
        if node in order:
            if (node, before) not in steps and (before, node) not in steps:
                steps.append((before, node))
            continue
        order.append(node)
        steps += [(before, node)] if before != node else []
        left += [(node, other) for other in reversed(beside[node]) if other != before]
    return order, steps
