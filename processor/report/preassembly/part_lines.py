"""The lines by which a part is drawn."""

from __future__ import annotations

import numpy as np

from processor.model import ArchDesign, Floats


def part_lines(design: ArchDesign, i: int) -> list[Floats]:
    """Lines (n, 3) that stand for a part: its bottom edges, or from its middle to its joints where it has none."""
    part = design.parts[i]
    if len(part.bottom_edge_left) or not len(part.vertices):
        return [part.bottom_edge_left, part.bottom_edge_right]
    middle = 0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0))
    joints = design.joint_points[(design.joined == i).any(axis=1), :4].mean(axis=1)
    return [np.stack([joint, middle]) for joint in joints]
