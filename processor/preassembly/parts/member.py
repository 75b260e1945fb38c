"""A measured part as a member of the chain."""

from __future__ import annotations

from dataclasses import dataclass

from processor.model import Floats
from processor.preassembly.ends.bottom_edges import EdgeDepartures
from processor.preassembly.ends.joint_end import JointEnd


@dataclass(frozen=True)
class Member:
    """Ends of a part (start, end; None without a joint), its edges, and the centre (3,) of its motions; bridge frame.

    ``pose`` (6, 6) is the covariance of its registration, about the bridge's origin.
    """

    ends: tuple[JointEnd | None, JointEnd | None]
    edges: EdgeDepartures
    centre: Floats
    pose: Floats
