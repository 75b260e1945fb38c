"""Movement of every node from its nominal place, with its uncertainty.

A movement is found minus nominal in the design's frame, relative to a datum (gauge). In the design's coordinates it is
the difference of coordinates, and the uncertainty of the scan's place in this frame is part of every interval. By a
best fit over all matched nodes a movement common to all is removed, and the uncertainty of the fit, which comes from
the nodes it rests on, is part of every interval (Teunissen 2000, S-transformations). Where the scan had to be
registered there is the best fit alone. Both are rigid motions of each other: what a node moved relative to its
neighbours is the same in both, how far the whole moved is in the design's coordinates alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.adjustment.body_motions import point_covariances
from processor.adjustment.robust_least_squares import inverse_of
from processor.geometry import rigid
from processor.limits import judging
from processor.limits.judging import Judged, Measured
from processor.model import NORMAL_95, Checked, Floats, FrameDesign, Ints, Limit, Tolerance, column, described
from processor.space_frame.design.matching import FrameRelation, Matching, NodePattern, expanded
from processor.space_frame.result import MovementGauge


@dataclass(frozen=True)
class Movement(Checked):
    """Movements of matched nodes, a row each: mm, design frame.

    ``gauge`` names the datum. ``ci95`` is the half-width of the 95 % interval along each axis.
    """

    gauge: MovementGauge = described(words=MovementGauge)
    found: Ints = column("n", dtype=np.int64)  # rows of the found nodes
    design: Ints = column("n", dtype=np.int64)  # and of the design
    vector: Floats = column("n", 3)
    covariance: Floats = column("n", 3, 3)
    ci95: Floats = column("n", 3)


def movement(
    matching: Matching,
    nodes: NodePattern,
    covariance: Floats,
    design: FrameDesign,
    datum: Floats | None = None,
    datum_place: Floats | None = None,
    shared: Floats | None = None,
    gauge: MovementGauge | None = None,
    expansion: float = 1.0,
) -> Movement:
    """Return the movements of all matched nodes.

    Parameters
    ----------
    covariance : (k, 3, 3) of the found nodes, without the motion common to all
    datum : (6, 6) covariance of the common motion: turn about ``datum_place`` (3,), which is less the nodes' origin,
        and translation; None = none. A best fit removes it.
    shared : (k, 3, q) changes of the found nodes by standard normal variates that they have in common, without those of
        ``covariance`` and ``datum``; a best fit removes what is a common motion of them
    gauge : by default the design's frame where the frames are the same, else the best fit
    expansion : factor of all lengths by temperature; nominal places are expanded about their mean
    """
    if gauge is None:
        same = matching.relation is FrameRelation.SAME
        gauge = MovementGauge.DESIGN if same else MovementGauge.BEST_FIT
    in_frame = gauge is MovementGauge.DESIGN
    rows = np.flatnonzero(matching.assignment >= 0)
    assigned = matching.assignment[rows]
    nominal, middle = expanded(design, expansion)
    T = np.eye(4) if in_frame else matching.T_best_fit
    R = T[:3, :3]
    # offset less offset first: adding either to the nodes would lose digits
    positions = nodes.positions[rows] @ R.T + (R @ nodes.origin + T[:3, 3] - middle)
    C = R @ covariance[rows] @ R.T
    changes = np.zeros((len(rows), 3, 0)) if shared is None else R @ shared[rows]
    if in_frame and datum is not None:
        arm = nodes.positions[rows] - (np.zeros(3) if datum_place is None else datum_place)
        C = C + R @ point_covariances(arm, datum) @ R.T
    elif not in_frame and len(rows):
        C, changes = _relative(positions, C, changes, matching.weight[rows])
    C = C + changes @ np.swapaxes(changes, 1, 2)
    return Movement(
        gauge=gauge,
        found=rows,
        design=assigned,
        vector=positions - nominal[assigned],
        covariance=C,
        ci95=NORMAL_95 * np.sqrt(np.maximum(np.einsum("nii->ni", C), 0.0)),
    )


def _relative(nodes: Floats, C: Floats, changes: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Covariance (n, 3, 3) and changes (n, 3, q) of nodes (n, 3) relative to their own fit with weights (n,)."""
    J = rigid.motion(nodes - nodes.mean(axis=0))
    inverse = inverse_of(np.einsum("n,nip,niq->pq", weight, J, J))
    gain = np.einsum("pq,niq,n->npi", inverse, J, weight)
    fit = np.einsum("npi,nij,nqj->pq", gain, C, gain)
    cross = np.einsum("nip,npj,njk->nik", J, gain, C)
    relative: Floats = C - cross - np.swapaxes(cross, 1, 2) + J @ fit @ np.swapaxes(J, 1, 2)
    return relative, changes - np.einsum("nip,pq->niq", J, np.einsum("npi,niq->pq", gain, changes))


# --- comparison with a limit -----------------------------------------------------------------------------------------


def size_of(vector: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return the sizes (k,) of movements (k, 3) of covariance (k, 3, 3), and their 95 % half-widths (k,), mm.

    The half-width is along the movement: a size that is not well above it is mostly noise.
    """
    size: Floats = np.linalg.norm(vector, axis=1)
    along = vector / np.where(size > 0.0, size, 1.0)[:, None]
    variance = np.einsum("ki,kij,kj->k", along, covariance, along)
    return size, NORMAL_95 * np.sqrt(np.maximum(variance, 0.0))


def judge(size: float, ci95: float, limit: float, certain: bool, tolerance: Tolerance) -> Judged:
    """Judge the size of a movement with its half-width by a limit, mm, NaN = none, and the rule of a ``tolerance``.

    ``certain`` is False where other poses of the design fit the nodes as well, and for a sphere that was
    not seen: the point where its axes meet is not the sphere's centre. Such a movement is indeterminate.
    """
    measured = Measured.within("node", size, ci95, doubtful=not certain)
    limited = not (np.isnan(size) or np.isnan(limit))
    return judging.judge(Limit("node_place", "place of a node", high=limit) if limited else None, measured, tolerance)
