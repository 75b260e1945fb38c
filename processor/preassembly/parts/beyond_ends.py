"""Steel in a scan beyond an end of its part that is no more of the part: splice plates; and steel before it not shown.

A part that is too long goes on with its own section. Splice plates lie on its faces, a plate's thickness off them and
on opposite sides; what the part rests on lies on one side alone.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.geometry.thinning import thinned
from processor.model import Floats
from processor.preassembly.ends.joint_frame import EndPlace

AROUND_MM = 60.0  # of the section
BEYOND_MM = (15.0, 215.0)  # of the end
SECTION_MM = (300.0, 500.0)  # behind the end, where the part has its section and plates have ended
OFF_MM = 7.0  # from the section: plates are thicker
FEWEST, POINTS = 60, 20_000  # points that show steel; points of the section that they are compared with (work)
OWN_SHARE = 0.05  # of the section's points on as much of its length
OFF_SHARE = 0.3  # of the points beyond the end: plates have two sides, one of them on the part's face
SIDE_SHARE = 0.15  # of the points off the section on either of two opposite sides
OUTERMOST = 10  # points on the part at an end of what is shown of it: fewer are strays


def plates(points: Floats, place: EndPlace) -> bool:
    """Whether points (n, 3) of a part in the bridge's frame, beyond its end, are of plates on it."""
    local = rigid.apply(rigid.invert(place.T_bridge_joint), points)
    out = place.outward * local[:, 0]
    reach = np.maximum(place.half[1:], place.section.radius) + AROUND_MM
    near = (np.abs(local[:, 1:]) < reach).all(axis=1)
    beyond = local[near & (out > BEYOND_MM[0]) & (out < BEYOND_MM[1]), 1:]
    own = local[near & (-out > SECTION_MM[0]) & (-out < SECTION_MM[1]), 1:]
    if len(beyond) < FEWEST or len(own) < FEWEST:
        return False
    own_few = thinned(own, POINTS)
    away, nearest = cKDTree(own_few, balanced_tree=False).query(beyond)
    off = (beyond - own_few[nearest])[away > OFF_MM]
    if len(off) < max(FEWEST, OWN_SHARE * len(own), OFF_SHARE * len(beyond)):
        return False
    share = np.stack([(off > OFF_MM).mean(axis=0), (off < -OFF_MM).mean(axis=0)])
    return bool((share > SIDE_SHARE).all(axis=0).any())


def not_shown(points: Floats, place: EndPlace) -> float:
    """Length before an end, mm, on which no points (n, 3) are; of those on the part's surface in the bridge's frame."""
    local = rigid.apply(rigid.invert(place.T_bridge_joint), points)
    reach = np.maximum(place.half[1:], place.section.radius) + AROUND_MM
    before = -place.outward * local[(np.abs(local[:, 1:]) < reach).all(axis=1), 0]
    return float(np.partition(before, OUTERMOST)[OUTERMOST]) if len(before) > OUTERMOST else float("inf")
