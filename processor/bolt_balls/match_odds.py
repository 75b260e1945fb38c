"""What balls' sizes and members say of which found node is which of the design."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Floats, FrameDesign, Ints

RADIUS_ODDS = 4.0  # at most, by a ball of another size
RADIUS_SD_MM = 1.0  # of balls against the catalogue, beside the measurement's
MEMBER_ODDS = 2.0  # by a member that is not in the design


@dataclass(frozen=True)
class Found:
    """Found nodes (k, 3) less ``origin``, mm; radii and their sd (k,) where balls were fitted, NaN or empty = unknown.

    ``node_a`` and ``node_b`` are the rows of the nodes at both ends of each tube found, -1 = none.
    """

    positions: Floats
    origin: Floats
    radii: Floats
    radius_sd: Floats
    node_a: Ints
    node_b: Ints

    @classmethod
    def bare(cls, positions: Floats, origin: Floats | None = None) -> Found:
        """Make a record of nodes of which nothing but the places is known."""
        none, no_rows = np.empty(0), np.empty(0, np.int64)
        return cls(positions, np.zeros(3) if origin is None else origin, none, none, no_rows, no_rows)


def radius_odds(found: Found, design: FrameDesign, assignment: Ints) -> float:
    """Log odds that a pose loses by balls of other sizes than the design's."""
    if not len(found.radii) or not len(design.radii):
        return 0.0
    on = (assignment >= 0) & np.isfinite(found.radii)
    off = found.radii[on] - design.radii[assignment[on]]
    sd = np.hypot(found.radius_sd[on] if len(found.radius_sd) else 0.0, RADIUS_SD_MM)
    odds = np.minimum(0.5 * (off / np.where(np.isfinite(sd), sd, np.inf)) ** 2, RADIUS_ODDS)
    return float(np.sum(odds[np.isfinite(odds)]))


def member_odds(found: Found, design: FrameDesign, assignment: Ints) -> float:
    """Log odds that a pose loses by tubes between its nodes where the design has no member."""
    if not len(found.node_a) or not len(design.member_a):
        return 0.0
    rows, _ = match_members(assignment, found.node_a, found.node_b, design)
    a, b = _ends(assignment, found.node_a), _ends(assignment, found.node_b)
    return MEMBER_ODDS * float(((rows < 0) & (a >= 0) & (b >= 0)).sum())


def match_members(assignment: Ints, node_a: Ints, node_b: Ints, design: FrameDesign) -> tuple[Ints, Ints]:
    """Row of the design's member (m,) that each tube between found nodes is, -1 = extra; and the rows without a tube.

    ``node_a`` and ``node_b`` (m,) are rows of the found nodes, -1 = none.
    """
    row_of = {int(id_): row for row, id_ in enumerate(design.ids)}
    pairs = [
        (row_of.get(int(a), -1), row_of.get(int(b), -1)) for a, b in zip(design.member_a, design.member_b, strict=True)
    ]
    count = len(design.ids)
    nominal = {min(a, b) * count + max(a, b): row for row, (a, b) in enumerate(pairs)}
    a, b = _ends(assignment, node_a), _ends(assignment, node_b)
    rows = np.array(
        [
            nominal.get(min(i, j) * count + max(i, j), -1) if i >= 0 and j >= 0 else -1
            for i, j in zip(a.tolist(), b.tolist(), strict=True)
        ],
        np.int64,
    )
    return rows, np.setdiff1d(np.arange(len(pairs)), rows)


def _ends(assignment: Ints, node: Ints) -> Ints:
    found: Ints = np.where(node >= 0, assignment[node], -1) if len(assignment) else np.full(len(node), -1)
    return found
