"""Closure of loops of parts by their joints alone: one joint of each loop is left open, and its gap is the closure.

In the adjustment itself a loop closes as well as its parts allow, since all joints are in it. The closure shows whether
they can: it is of the parts alone, whatever lambda is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.geometry import rigid
from processor.model import NORMAL_95, ArchDesign, Floats
from processor.preassembly import topology
from processor.preassembly.chain import adjustment, joint_measures
from processor.preassembly.chain.span_and_closure import JOINTS_ALONE
from processor.preassembly.parts.part_in_chain import Member
from processor.preassembly.result import Loops


def measure(members: Sequence[Member], design: ArchDesign, frames: Floats) -> Loops | None:
    """Measure the closure of each loop; ``frames`` (j, 4, 4) are T_bridge_joint. None without loops.

    The closure is the motion, in the axes of the joint left open, of its right part against its left one.
    """
    joined = design.joined
    found = topology.loops(joined, len(members))
    if not found:
        return None
    sides, points = topology.sides_of(joined), design.joint_points
    closures, widths = [], []
    for loop in found:
        gaps, covariance = adjustment.left_open(members, points, frames, JOINTS_ALONE, sides, loop.closing)
        frame = frames[loop.closing]
        local, spread = joint_measures.in_joint_axes(gaps, covariance, frame)
        solve = joint_measures.motion_of(rigid.apply(rigid.invert(frame), points[loop.closing]))
        turn_shift, variance = solve @ local.ravel(), np.diag(solve @ spread @ solve.T)
        unit = np.array([[1.0], [1e3]])  # mm; rad to mrad
        closures.append(turn_shift.reshape(2, 3)[::-1] * unit)
        widths.append(NORMAL_95 * np.sqrt(np.maximum(variance, 0.0)).reshape(2, 3)[::-1] * unit)
    return Loops(
        joint=tuple(design.joint_names[loop.closing] for loop in found),
        joints=tuple(tuple(design.joint_names[j] for j in loop.joints) for loop in found),
        closure=np.array(closures),
        closure_ci95=np.array(widths),
    )
