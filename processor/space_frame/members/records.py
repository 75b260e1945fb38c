"""Records of a frame's members and nodes before any sphere is fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Checked, Columns, Floats, Ints, column


@dataclass(frozen=True)
class Nodes(Columns, Checked):
    """Nodes where the axes of their members meet: mm, less the origin of the source.

    ``covariance`` is that of the meeting point; it includes the axes' scatter by eccentric joints. A node of fewer than
    three axes has weak support: it needs a sphere to be confirmed.
    """

    positions: Floats = column("k", 3)
    covariance: Floats = column("k", 3, 3)
    axis_count: Ints = column("k", dtype=np.int64)  # axes that the position rests on
    scatter: Floats = column("k")  # distance of the axes from the position, rms, mm; NaN for one axis

    @property
    def count(self) -> int:
        """Number of nodes."""
        return len(self.positions)


@dataclass(frozen=True)
class Members(Columns, Checked):
    """Members as tubes: the straight line through the ends of each cylinder, and the bow beside it; mm.

    ``points`` are the middles of that line, ``directions`` run from node a to node b, ``side`` is a unit vector across
    and the other one is ``directions x side``. With t along the direction from the middle, the axis is at

        point + t direction + (1 - (2 t / length)^2) (bow[0] side + bow[1] other).

    ``covariance`` is of (offset along side, offset along other, turn along side, turn along other, radius): the line at
    t moves across by offset + t turn, mm and rad. That of the bow is its own.
    """

    points: Floats = column("m", 3)
    directions: Floats = column("m", 3)
    side: Floats = column("m", 3)
    lengths: Floats = column("m")  # of the cylinder
    radii: Floats = column("m")
    bow: Floats = column("m", 2)
    covariance: Floats = column("m", 5, 5)
    bow_covariance: Floats = column("m", 2, 2)
    node_a: Ints = column("m", dtype=np.int64)  # rows of Nodes; -1 = none
    node_b: Ints = column("m", dtype=np.int64)
    count: Ints = column("m", dtype=np.int64)  # points that the fit rests on
    rms: Floats = column("m")  # of their residuals, along the ray where scanners are known, mm
    around: Floats = column("m", 24)  # points of unknown scanners by sectors, from ``side`` to ``other``

    @property
    def other(self) -> Floats:
        """The second unit vectors (m, 3) across."""
        other: Floats = np.cross(self.directions, self.side)
        return other
