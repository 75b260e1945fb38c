"""Bolt holes of the parts of a bridge, joint by joint, by the scans where step preassemble registered them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from processor.components import bridge_parts
from processor.inspection import flat_faces, holes, points_in_design_frame
from processor.inspection.bore_fit import Fitted
from processor.inspection.design_holes import Hole
from processor.inspection.points_in_design_frame import DesignCloud
from processor.limits.judging import Measured
from processor.model import ArchDesign, Floats, Scene


class DrilledGroup(NamedTuple):
    """The holes of a part through one plate at a joint, from an ``origin`` (3,), as designed and as measured.

    They are numbered from ``first`` over the part.
    """

    part: str
    joint: int
    origin: Floats
    group: holes.Group
    fitted: Fitted
    first: int


def of_parts(scene: Scene, assembled: Any) -> list[DrilledGroup]:
    """Return the groups of holes of all parts, from joint to joint."""
    if scene.arch is None or not any(len(scan.points) for scan in scene.scans):
        return []
    drilled = {}
    for part in scene.arch.parts:
        origin, found = flat_faces.holes_of(part.vertices, part.faces)
        if found:
            drilled[part.name] = (origin, found)
    groups: list[DrilledGroup] = []
    for placed in bridge_parts.of_bridge(scene, assembled, "inspect") if drilled else ():
        if placed.name in drilled and placed.scene is not None:
            origin, found = drilled[placed.name]
            cloud = points_in_design_frame.of_scene(placed.scene, np.eye(4), origin)
            groups += _by_joint(scene.arch, placed.name, found, cloud, origin)
    return groups


def characteristics(drilled: Sequence[DrilledGroup]) -> dict[str, list[Measured]]:
    """Return the characteristics of the holes of each part that has any."""
    found: dict[str, list[Measured]] = defaultdict(list)
    for one in drilled:
        found[one.part] += holes.characteristics(one.group, one.fitted, one.first)
    return dict(found)


def _by_joint(
    design: ArchDesign, name: str, found: list[Hole], cloud: DesignCloud, origin: Floats
) -> Iterator[DrilledGroup]:
    """Yield the holes at each joint of a part, plate by plate."""
    at = [
        j
        for j, (left, right) in enumerate(zip(design.joint_left, design.joint_right, strict=True))
        if name in (left, right)
    ]
    if not at:
        return
    middle = np.array([np.nanmean(design.joint_points[j], axis=0) for j in at]) - origin
    nearest = [int(np.argmin(np.linalg.norm(middle - hole.middle, axis=1))) for hole in found]
    first = 1
    for k in range(len(at)):
        own = [hole for hole, joint in zip(found, nearest, strict=True) if joint == k]
        p1, p2, p3, p4 = design.joint_points[at[k], :4]
        along = np.cross(p4 - p2, p3 - p1)  # square to the section, from the left part to the right
        for group in holes.groups(own, [along / np.linalg.norm(along)]):
            yield DrilledGroup(name, at[k], origin, group, fitted=holes.fitted(cloud, group), first=first)
            first += len(group.holes)
