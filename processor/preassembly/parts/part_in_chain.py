"""A measured part as a member of the chain."""

from __future__ import annotations

from dataclasses import dataclass

from processor.model import Floats
from processor.preassembly.ends.bottom_edges import EdgeDepartures
from processor.preassembly.ends.joint_end import JointEnd


@dataclass(frozen=True)
class Member:
    """Ends of a part, its edges, and the centre (3,) of its motions; bridge frame.

    The ends are start and end (None without a joint), or those of a branch: see :mod:`processor.preassembly.topology`.
    ``pose`` (6, 6) is the covariance of its registration, about the bridge's origin.
    """

    ends: tuple[JointEnd | None, ...]
    edges: EdgeDepartures
    centre: Floats
    pose: Floats
