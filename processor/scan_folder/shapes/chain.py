"""The parts of an arch bridge in the order of their joints, from small to large X."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from processor.model import Floats, Reason, reason
from processor.scan_folder.shapes import connected
from processor.scan_folder.shapes.body import Body
from processor.scan_folder.shapes.connected import Assembly, listed, unclosed
from processor.scan_folder.shapes.contact_faces import GAP_MM, Contact

SPAN_RAD = np.radians(10.0)  # largest angle in plan between the span and X
RISE_SHARE = 0.01  # of the span: less is no arch


def find(bodies: Sequence[Body], contacts: Mapping[tuple[int, int], Contact]) -> Assembly | Reason:
    """Return the chain of bodies that meet end to end, no ring, no body more than two others; or why there is none."""
    beside = connected.neighbours(contacts)
    chains = [connected.walk({i: beside[i] for i in group})[0] for group in connected.groups(beside)]
    if not chains:
        everything = listed(bodies, range(len(bodies)))
        return reason("init.none-meet", parts=everything, gap_mm=GAP_MM, unclosed=unclosed(bodies))
    if len(chains) > 1:
        first, second = (listed(bodies, chain) for chain in chains[:2])
        return reason("init.several-chains", first=first, second=second, unclosed=unclosed(bodies))
    order = chains[0]
    if _joint_x(contacts, order[0], order[1]) > _joint_x(contacts, order[-2], order[-1]) or (
        len(order) == 2 and bodies[order[0]].centre[0] > bodies[order[1]].centre[0]
    ):
        order = order[::-1]
    left_out = [i for i in range(len(bodies)) if i not in order]
    doubt = reason("init.parts-left-out", parts=listed(bodies, left_out), unclosed=unclosed(bodies))
    return connected.assembled(bodies, contacts, order, list(pairwise(order)), doubt, row=True)


def _joint_x(contacts: Mapping[tuple[int, int], Contact], i: int, k: int) -> float:
    return float(contacts[min(i, k), max(i, k)].a.origin[0])


def frame_problem(chain: Assembly) -> Reason | None:
    """Return why a chain is not in the bridge's frame (X along the span, Z up); None if it is."""
    points = chain.line
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
    return bool(_rise(chain.line)[2] > RISE_SHARE * np.linalg.norm(chain.line[-1] - chain.line[0]))


def _rise(points: Floats) -> Floats:
    """Return the departure (3,) from the chord of the point (n, 3) that is farthest from it."""
    chord = points[-1] - points[0]
    off = points - points[0]
    off = off - (off @ chord / (chord @ chord))[:, None] * chord
    return np.asarray(off[np.linalg.norm(off, axis=1).argmax()])
