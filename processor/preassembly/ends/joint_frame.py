"""The frame of a joint, and the place of a part's end in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.geometry.mesh_distance import MeshSurface
from processor.model import Floats
from processor.preassembly.ends import section
from processor.preassembly.ends.section import Section


@dataclass(frozen=True)
class EndPlace:
    """A part's end as designed: T_bridge_joint (4, 4), its section, and the direction of the part.

    ``outward`` is +1 where the part ends at the joint and -1 where it starts.
    """

    T_bridge_joint: Floats
    section: Section
    outward: float

    @property
    def half(self) -> Floats:
        """Half the section's size (3,), mm."""
        return self.section.half


def joint_frame(key_points: Floats) -> Floats:
    """T_bridge_joint (4, 4) of a joint from its P1..P8: origin in the middle, x along the bridge, y left, z up."""
    p1, p2, p3, p4 = key_points[:4]
    y = (p1 - p2) + (p4 - p3)
    z = (p4 - p1) + (p3 - p2)
    x = np.cross(y, z)
    x /= np.linalg.norm(x)
    z = np.cross(x, y)
    z /= np.linalg.norm(z)
    return rigid.transform(np.stack([x, np.cross(z, x), z], axis=1), key_points[:4].mean(axis=0))


def end_place(key_points: Floats, outward: float, surface: MeshSurface | None = None) -> EndPlace:
    """Place of the end of a part at a joint with the design's P1..P8 (8, 3).

    Its section is round by its key points, else by the design's ``surface``, or a box.
    """
    frame = joint_frame(key_points)
    local = rigid.apply(rigid.invert(frame), key_points)
    half = 0.5 * np.ptp(local[:4], axis=0)
    radius = section.round_radius(local)
    if radius:
        return EndPlace(frame, section.of_round(half, radius), outward)
    of_end = section.of_box(half) if surface is None else section.of_surface(half, frame, surface)
    return EndPlace(frame, of_end, outward)
