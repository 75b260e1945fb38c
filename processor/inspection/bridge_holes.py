"""Bolt holes of the parts of a bridge, joint by joint, by the scans where step preassemble registered them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from processor.components import bridge_parts
from processor.inspection import flat_faces, holes
from processor.inspection.characteristic import Characteristic
from processor.inspection.design_holes import Hole
from processor.model import ArchDesign, Floats, Scene


def of_parts(scene: Scene, assembled: Any) -> dict[str, list[Characteristic]]:
    """Return the characteristics of the holes of each part that has any, numbered over the part from joint to joint."""
    if scene.arch is None or not any(len(scan.points) for scan in scene.scans):
        return {}
    drilled = {}
    for part in scene.arch.parts:
        origin, found = flat_faces.holes_of(part.vertices, part.faces)
        if found:
            drilled[part.name] = (origin, found)
    characteristics: dict[str, list[Characteristic]] = {}
    for placed in bridge_parts.of_bridge(scene, assembled, "inspect") if drilled else ():
        if placed.name in drilled and placed.scene is not None:
            origin, found = drilled[placed.name]
            cloud = holes.cloud_of(placed.scene, np.eye(4), None, origin)
            characteristics[placed.name] = list(_by_joint(scene.arch, placed.name, found, cloud, origin))
    return characteristics


def _by_joint(
    design: ArchDesign, name: str, found: list[Hole], cloud: holes.Cloud, origin: Floats
) -> Iterator[Characteristic]:
    """Yield the characteristics of the holes at each joint of a part, plate by plate."""
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
            yield from holes.measured(cloud, group, first)
            first += len(group.holes)
