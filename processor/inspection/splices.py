"""Bolted splices: whether splice plates drilled as designed fit the holes of both parts at a joint.

The parts need not be where the assembly has them: bolts pull the right part to where its holes fit best. Each plate may
be moved and turned in its plane. What is left is by how much the holes of the two parts disagree.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from processor.geometry import rigid
from processor.inspection import holes
from processor.inspection.bridge_holes import DrilledGroup
from processor.inspection.result import Quantity
from processor.limits.judging import Measured
from processor.model import ArchDesign, Floats, Ints, reason

DETERMINED = 1e-9  # least singular value of a motion that the holes determine, by the largest
FEWEST_SEEN = 2  # holes of a plate on each side of the joint
# Largest distance of a bolt from the end of its plate, the larger of the two (EN 1993-1-8, table 3.3).
END_DISTANCE_MM, END_DISTANCE_THICKNESSES = 125.0, 8.0
SAME_PLANE = 0.5  # of the thinner plate: distance of the middles of two plates that one splice plate covers


class Splice(NamedTuple):
    """The groups of holes of the left and the right part that one splice plate covers."""

    left: DrilledGroup
    right: DrilledGroup


class HolesSeen(NamedTuple):
    """The holes seen of the plates of a joint: places (n, 3) from their middle, plate and part (n,), 1 = right.

    ``departure`` (n, 2) along the ``axes`` (n, 2, 3), and by how much a radius is ``wider`` (n,) than designed, with
    their covariance (3n, 3n): hole by hole for departures, then radii.
    """

    places: Floats
    plate: Ints
    part: Ints
    axes: Floats
    departure: Floats
    wider: Floats
    covariance: Floats


def of_joints(design: ArchDesign, drilled: Sequence[DrilledGroup]) -> dict[str, list[Measured]]:
    """Return the characteristics of the splices of each joint that has any, by the joint's name."""
    found = {}
    for joint, name in enumerate(design.joint_names):
        plates = list(_plates(design, joint, drilled))
        if plates:
            found[name] = list(_characteristics(plates))
    return found


def _plates(design: ArchDesign, joint: int, drilled: Sequence[DrilledGroup]) -> Iterator[Splice]:
    """Yield the groups of both parts at a joint that lie in one plane."""
    left, right = (
        [group for group in drilled if group.joint == joint and group.part == part and _at_joint(design, group)]
        for part in (design.joint_left[joint], design.joint_right[joint])
    )
    taken: list[DrilledGroup] = []
    for one in left:
        for other in right:
            if any(other is known for known in taken) or not _in_one_plane(one, other):
                continue
            taken.append(other)
            yield Splice(one, other)
            break


def _at_joint(design: ArchDesign, drilled: DrilledGroup) -> bool:
    """Whether holes are those of bolts at their joint: several, and as near to it as bolts are to the end of a plate.

    A lifting lug has one bore, some metres away.
    """
    p1, p2, p3, p4 = design.joint_points[drilled.joint, :4]
    along = np.cross(p4 - p2, p3 - p1)
    middles = np.array([hole.middle for hole in drilled.group.holes]) + drilled.origin
    off = np.abs((middles - 0.25 * (p1 + p2 + p3 + p4)) @ along) / np.linalg.norm(along)
    thickness = drilled.group.holes[0].depth
    return len(middles) >= FEWEST_SEEN and bool(off.min() <= max(END_DISTANCE_MM, END_DISTANCE_THICKNESSES * thickness))


def _in_one_plane(left: DrilledGroup, right: DrilledGroup) -> bool:
    hole, other = left.group.holes[0], right.group.holes[0]
    off = (other.middle + right.origin - hole.middle - left.origin) @ hole.axis
    return bool(abs(hole.axis @ other.axis) > holes.PARALLEL and abs(off) < SAME_PLANE * min(hole.depth, other.depth))


def _characteristics(plates: list[Splice]) -> Iterator[Measured]:
    """Yield the share of the holes that a gauge pin passes, of each plate and of the whole joint."""
    number = np.array([len(group.group.holes) for plate in plates for group in plate]).reshape(-1, 2).sum(axis=1)
    seen = _seen(plates)
    ids = [f"plate-{k + 1}-pass-through" for k in range(len(plates))] if len(plates) > 1 else []
    if seen is None:
        for id_ in [*ids, "splice-pass-through"]:
            why = (reason("inspect.few-holes-of-splice"),)
            yield Measured(id_, what=Quantity.PASS_THROUGH, nominal=1.0, unit="1", reasons=why)
        return
    off, covariance = misfit(seen)
    passed = holes.passes(off, seen.wider, covariance)
    for k, id_ in enumerate(ids):
        yield holes.share_of(id_, passed[:, seen.plate == k], int(number[k]))
    yield holes.share_of("splice-pass-through", passed, int(number.sum()))


def _seen(plates: list[Splice]) -> HolesSeen | None:
    """Return the holes seen of the plates of which enough were seen on both sides; None without such a plate."""
    places, plate, part, axes, departure, blocks = [], [], [], [], [], []
    for k, splice in enumerate(plates):
        known = [np.flatnonzero(np.isfinite(drilled.fitted.departure).all(axis=1)) for drilled in splice]
        if min(map(len, known)) < FEWEST_SEEN:
            continue
        for side, (drilled, rows) in enumerate(zip(splice, known, strict=True)):
            at = (3 * rows[:, None] + np.arange(3)).ravel()
            blocks.append(drilled.fitted.covariance[np.ix_(at, at)])
            departure.append(drilled.fitted.departure[rows])
            places.append(np.array([drilled.group.holes[row].middle for row in rows]) + drilled.origin)
            axes.append(np.repeat(drilled.group.axes[None], len(rows), axis=0))
            plate.append(np.full(len(rows), k))
            part.append(np.full(len(rows), side))
    if not blocks:
        return None
    at, found = np.concatenate(places), np.concatenate(departure)
    # One covariance of all holes, places first, from those (3k, 3k) of groups: place and radius hole by hole. Errors
    # of stations that groups of one part share would cancel in the misfit; taken as independent they count.
    whole = block_diag(*blocks)
    hole = 3 * np.arange(len(whole) // 3)
    order = np.concatenate([(hole[:, None] + [0, 1]).ravel(), hole + 2])
    covariance: Floats = whole[np.ix_(order, order)]
    return HolesSeen(
        places=at - at.mean(axis=0),
        plate=np.concatenate(plate),
        part=np.concatenate(part),
        axes=np.concatenate(axes),
        departure=found[:, :2],
        wider=found[:, 2],
        covariance=covariance,
    )


def misfit(seen: HolesSeen) -> tuple[Floats, Floats]:
    """Return by how much holes (2n,) are off those of their plates at the best fit, and the covariance (3n, 3n).

    Least squares over the motion of the right part against the left one and that of each plate in its plane. The
    covariance is of these and of the radii.
    """
    count, size = len(seen.places), float(np.linalg.norm(seen.places, axis=1).max())
    arms = seen.places / size
    derivatives = np.zeros((count, 2, 6 + 3 * (int(seen.plate.max()) + 1)))
    for k, (axes, arm, plate) in enumerate(zip(seen.axes, arms, seen.plate, strict=True)):
        if seen.part[k]:
            derivatives[k, :, :3] = axes
            derivatives[k, :, 3:6] = -axes @ rigid.cross_matrix(arm)
        of_plate = seen.axes[np.argmax(seen.plate == plate)]
        at = 6 + 3 * plate
        derivatives[k, :, at : at + 2] = -axes @ of_plate.T
        derivatives[k, :, at + 2] = -axes @ np.cross(np.cross(*of_plate), arm)
    flat = derivatives.reshape(2 * count, -1)
    off_the_fit = np.eye(2 * count) - flat @ np.linalg.pinv(flat, rcond=DETERMINED)
    change = block_diag(off_the_fit, np.eye(count))
    return off_the_fit @ seen.departure.ravel(), change @ seen.covariance @ change.T
