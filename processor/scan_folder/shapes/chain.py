"""The parts of an arch bridge in the order of their joints, from small to large X."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from processor.model import Floats, Reason, reason
from processor.scan_folder.shapes.body import Body
from processor.scan_folder.shapes.connected import Assembly, listed, unclosed
from processor.scan_folder.shapes.contact_faces import GAP_MM, Contact

SPAN_RAD = np.radians(10.0)  # largest angle in plan between the span and X
RISE_SHARE = 0.01  # of the span: less is no arch


def find(bodies: Sequence[Body], contacts: Mapping[tuple[int, int], Contact]) -> Assembly | Reason:
    """Return the longest chain of bodies that meet end to end, no body more than two others; or why there is none."""
    beside: dict[int, list[int]] = {i: [] for i in range(len(bodies))}
    for i, k in contacts:
        beside[i].append(k)
        beside[k].append(i)
    chains = _paths(beside)
    if not chains:
        everything = listed(bodies, range(len(bodies)))
        return reason("init.none-meet", parts=everything, gap_mm=GAP_MM, unclosed=unclosed(bodies))
    chains.sort(key=lambda chain: -len(chain))
    if len(chains) > 1:
        first, second = (listed(bodies, chain) for chain in chains[:2])
        return reason("init.several-chains", first=first, second=second, unclosed=unclosed(bodies))
    order = chains[0]
    if _joint_x(contacts, order[0], order[1]) > _joint_x(contacts, order[-2], order[-1]) or (
        len(order) == 2 and bodies[order[0]].centre[0] > bodies[order[1]].centre[0]
    ):
        order = order[::-1]
    return _chain(bodies, order, contacts)


def _chain(bodies: Sequence[Body], order: Sequence[int], contacts: Mapping[tuple[int, int], Contact]) -> Assembly:
    doubts = []
    left_out = [i for i in range(len(bodies)) if i not in order]
    if left_out:
        doubts.append(reason("init.parts-left-out", parts=listed(bodies, left_out), unclosed=unclosed(bodies)))
    joints = []
    for i, k in pairwise(order):
        one = contacts[min(i, k), max(i, k)]
        joints.append(one if i < k else one.reverse)
    links = tuple(pairwise(range(len(order))))
    parts, others = (tuple(bodies[i] for i in which) for which in (order, left_out))
    return Assembly(parts, links, tuple(joints), tuple(doubts), row=True, left_out=others)


def _joint_x(contacts: Mapping[tuple[int, int], Contact], i: int, k: int) -> float:
    return float(contacts[min(i, k), max(i, k)].a.origin[0])


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


def frame_problem(chain: Assembly) -> Reason | None:
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


def rises(chain: Assembly) -> bool:
    """Whether the parts make up an arch, which shows where up is."""
    points = np.vstack([chain.parts[0].centre, chain.middles, chain.parts[-1].centre])
    return bool(_rise(points)[2] > RISE_SHARE * np.linalg.norm(points[-1] - points[0]))


def _rise(points: Floats) -> Floats:
    """Return the departure (3,) from the chord of the point (n, 3) that is farthest from it."""
    chord = points[-1] - points[0]
    off = points - points[0]
    off = off - (off @ chord / (chord @ chord))[:, None] * chord
    return np.asarray(off[np.linalg.norm(off, axis=1).argmax()])
