"""The turn of a round tube about its axis: what of the design shows it, and poses by what a scan shows of that.

A plain straight tube looks the same whatever it is turned by. A gusset, a hole, a bend show its turn.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from processor.geometry import rigid
from processor.model import Bools, Floats, Ints

STEP_RAD = np.radians(5.0)  # of the search: a mark of 200 mm on a tube of 500 mm moves by less than it is seen from
TESTED_RAD = np.radians(30.0)  # between turns by which the surface is compared with itself
MARK_SHARE = 0.5  # of the turns, after which a sample of a mark has no surface beside it


def about(centre: Floats, axis: Floats, angle: float) -> Floats:
    """Turn by an angle about an axis (3,) through a centre (3,), as (4, 4)."""
    R = rigid.rotation_from_vector(angle * axis)
    return rigid.transform(R, centre - R @ centre)


def tested(centre: Floats, axis: Floats) -> list[Floats]:
    """Turns (4, 4) by which a tube is compared with itself, without the identity."""
    return [about(centre, axis, angle) for angle in np.arange(TESTED_RAD, 2.0 * np.pi - 1e-9, TESTED_RAD)]


def marks(samples: Floats, absent: list[Bools]) -> Floats:
    """Return the samples (m, 3), of all (n, 3), that most turns move off the surface; ``absent`` (n,) of each turn."""
    share: Floats = np.mean(absent, axis=0)
    found: Floats = samples[share >= MARK_SHARE]
    return found


def searched(centre: Floats, axis: Floats, across: Floats, T: Floats, count: Callable[[Floats], int]) -> list[Floats]:
    """Return T_bridge_scan (4, 4), turned about the axis so that ``count`` is largest, in either sense of the tube."""
    poses = []
    for sense in (np.eye(4), about(centre, across, np.pi)):
        turned = [about(centre, axis, angle) @ sense @ T for angle in np.arange(0.0, 2.0 * np.pi - 1e-9, STEP_RAD)]
        counts: Ints = np.array([count(pose) for pose in turned])
        # The middle of the turns that show as much.
        best = np.flatnonzero(counts >= 0.9 * counts.max())
        first = int(np.argmax(counts))
        near = np.exp(1j * STEP_RAD * (best - first))
        near = near[near.real > 0.8]
        poses.append(about(centre, axis, float(np.angle(near.mean()))) @ turned[first])
    return poses


def in_either_sense(candidates: list[Floats], axis: Floats) -> list[int]:
    """Return the numbers of the first of the poses (4, 4) in each sense of the tube, by the first one's axis (3,)."""
    ahead = [float(axis @ T[:3, :3] @ candidates[0][:3, :3].T @ axis) > 0.0 for T in candidates]
    return [ahead.index(sense) for sense in (True, False) if sense in ahead]


def shifted(poses: list[Floats], centre: Floats, axis: Floats, most_rad: float, least_mm: float) -> list[int]:
    """Return the numbers of the poses (4, 4) that lie ``least_mm`` or more along the axis from the first one.

    Poses turned by ``most_rad`` or more against the first are left out.
    """
    found = []
    for k, T in enumerate(poses):
        between = T @ rigid.invert(poses[0])
        along = abs(float((rigid.apply(between, centre) - centre) @ axis))
        if rigid.rotation_angle(between[:3, :3]) < most_rad and along >= least_mm:
            found.append(k)
    return found
