"""The parts of an arch bridge in the order of their joints, from small to large X."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from processor.model import Floats, Reason, reason
from processor.scan_folder.shapes.body import Body
from processor.scan_folder.shapes.contact_faces import Contact, contact

GAP_MM = 60.0  # largest root gap of a joint
SPAN_RAD = np.radians(10.0)  # largest angle in plan between the span and X
RISE_SHARE = 0.01  # of the span: less is no arch


@dataclass(frozen=True)
class Chain:
    """Parts (n) in order and the contact of each two neighbours (n - 1), a = left, b = right."""

    parts: tuple[Body, ...]
    contacts: tuple[Contact, ...]
    doubts: tuple[Reason, ...] = ()

    @property
    def middles(self) -> Floats:
        """Middle (n - 1, 3) of each joint, mm."""
        middles: Floats = np.array([0.5 * (_middle(one.a.points) + _middle(one.b.points)) for one in self.contacts])
        return middles


def _middle(points: Floats) -> Floats:
    return np.asarray(0.5 * (points.min(axis=0) + points.max(axis=0)))


def find(bodies: Sequence[Body]) -> Chain | Reason:
    """Return the longest chain of bodies that meet end to end, or why there is none."""
    contacts: dict[tuple[int, int], Contact] = {}
    for i, k in combinations(range(len(bodies)), 2):
        far = (bodies[i].bounds[0] - GAP_MM > bodies[k].bounds[1]) | (
            bodies[k].bounds[0] - GAP_MM > bodies[i].bounds[1]
        )
        if far.any():
            continue
        one = contact(bodies[i], bodies[k], GAP_MM)
        if one is not None:
            contacts[i, k] = one
    beside: dict[int, list[int]] = {i: [] for i in range(len(bodies))}
    for i, k in contacts:
        beside[i].append(k)
        beside[k].append(i)
    crowded = [i for i, others in beside.items() if len(others) > 2]
    if crowded:
        i = crowded[0]
        return reason("init.crowded", part=bodies[i].name, others=_names(bodies, beside[i]))
    chains = _paths(beside)
    everything, unclosed = _names(bodies, range(len(bodies))), _unclosed(bodies)
    if not chains and contacts:
        return reason("init.ring", parts=everything)
    if not chains:
        return reason("init.none-meet", parts=everything, gap_mm=GAP_MM, unclosed=unclosed)
    chains.sort(key=lambda chain: -len(chain))
    if len(chains) > 1:
        first, second = (_names(bodies, chain) for chain in chains[:2])
        return reason("init.several-chains", first=first, second=second, unclosed=unclosed)
    order = chains[0]
    if _joint_x(contacts, order[0], order[1]) > _joint_x(contacts, order[-2], order[-1]) or (
        len(order) == 2 and bodies[order[0]].centre[0] > bodies[order[1]].centre[0]
    ):
        order = order[::-1]
    return _chain(bodies, order, contacts)


def _chain(bodies: Sequence[Body], order: Sequence[int], contacts: Mapping[tuple[int, int], Contact]) -> Chain:
    doubts = []
    left_out = tuple(body.name for i, body in enumerate(bodies) if i not in order)
    if left_out:
        doubts.append(reason("init.parts-left-out", parts=left_out, unclosed=_unclosed(bodies)))
    joints = []
    for i, k in pairwise(order):
        one = contacts[min(i, k), max(i, k)]
        joints.append(one if i < k else Contact(one.b, one.a, one.gap_mm, one.rival))
    return Chain(tuple(bodies[i] for i in order), tuple(joints), tuple(doubts))


def _unclosed(bodies: Sequence[Body]) -> tuple[Reason, ...]:
    """Return which bodies are not closed, () for none: they may lack the faces of their ends."""
    names = [body.name for body in bodies if body.open_edges]
    shown = (*names[:6], *(["..."] if len(names) > 6 else []))
    return (reason("init.unclosed", parts=shown),) if names else ()


def _joint_x(contacts: Mapping[tuple[int, int], Contact], i: int, k: int) -> float:
    return float(contacts[min(i, k), max(i, k)].a.origin[0])


def _names(bodies: Sequence[Body], which: Sequence[int]) -> tuple[str, ...] | Reason:
    names = tuple(bodies[i].name for i in which)
    return names if len(names) <= 6 else reason("init.and-others", names=names[:6], others=len(names) - 6)


def _paths(beside: Mapping[int, Sequence[int]]) -> list[list[int]]:
    """Return the paths of two nodes or more of a graph whose nodes have two neighbours at most; circles are none."""
    paths, seen = [], set[int]()
    for start in sorted(beside):
        if len(beside[start]) != 1 or start in seen:
            continue
        path = [start]
        while len(path) == 1 or len(beside[path[-1]]) == 2:
            path.append(next(k for k in beside[path[-1]] if k not in path))
        seen.update(path)
        paths.append(path)
    return paths


def frame_problem(chain: Chain) -> Reason | None:
    """Return why a chain is not in the bridge's frame (X along the span, Z up); None if it is."""
    points = np.vstack([chain.parts[0].centre, chain.middles, chain.parts[-1].centre])
    span = points[-1] - points[0]
    off = float(np.arctan2(abs(span[1]), abs(span[0])))
    rise = _rise(points)
    arched = np.linalg.norm(rise) > RISE_SHARE * np.linalg.norm(span)
    if abs(span[2]) > max(abs(span[0]), abs(span[1])):
        found = reason("init.along-z")
    elif off > np.pi / 2 - SPAN_RAD:
        found = reason("init.along-y")
    elif off > SPAN_RAD:
        found = reason("init.off-x", degrees=np.degrees(off))
    elif (np.diff(points[:, 0]) <= 0.0).any():
        found = reason("init.not-along-x")
    elif arched and abs(rise[1]) > abs(rise[2]):
        found = reason("init.rises-along-y")
    elif arched and rise[2] < 0.0:
        found = reason("init.hangs-down")
    else:
        return None
    return reason("init.other-frame", reason=found)


def rises(chain: Chain) -> bool:
    """Whether the parts make up an arch, which shows where up is."""
    points = np.vstack([chain.parts[0].centre, chain.middles, chain.parts[-1].centre])
    return bool(_rise(points)[2] > RISE_SHARE * np.linalg.norm(points[-1] - points[0]))


def _rise(points: Floats) -> Floats:
    """Return the departure (3,) from the chord of the point (n, 3) that is farthest from it."""
    chord = points[-1] - points[0]
    off = points - points[0]
    off = off - (off @ chord / (chord @ chord))[:, None] * chord
    return np.asarray(off[np.linalg.norm(off, axis=1).argmax()])
