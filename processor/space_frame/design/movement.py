"""Movement of every node from its nominal place, with its uncertainty.

A movement is found minus nominal in the design's frame, relative to a datum. Where the scan is in the design's own
frame the datum is this frame, and its uncertainty is part of every interval. Where the scan had to be registered the
datum is the best fit over all matched nodes: a movement common to all is removed, and the uncertainty of the fit, which
comes from the nodes it rests on, is part of every interval (Teunissen 2000, S-transformations).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import NORMAL_95, Checked, Floats, FrameDesign, Ints, column
from processor.space_frame.design.matching import SAME, Matching, NodePattern, expanded

FRAME, BEST_FIT = "design frame", "best fit"


@dataclass(frozen=True)
class Movement(Checked):
    """Movements of matched nodes, a row each: mm, design frame.

    ``gauge`` names the datum. ``ci95`` is the half-width of the 95 % interval along each axis.
    """

    gauge: str  # design frame | best fit
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
    gauge: str = "",
    expansion: float = 1.0,
) -> Movement:
    """Return the movements of all matched nodes.

    Parameters
    ----------
    covariance : (k, 3, 3) of the found nodes, without the motion common to all
    datum : (6, 6) covariance of the common motion: turn about ``datum_place`` (3,), which is less the nodes' origin,
        and translation; None = none. A best fit removes it.
    gauge : ``design frame`` or ``best fit``; by default the first where the frames are the same.
    expansion : factor of all lengths by temperature; nominal places are expanded about their mean
    """
    gauge = gauge or (FRAME if matching.how == SAME else BEST_FIT)
    rows = np.flatnonzero(matching.assignment >= 0)
    assigned = matching.assignment[rows]
    nominal, middle = expanded(design, expansion)
    T = matching.T_design_scan if gauge == FRAME else matching.T_best_fit
    R = T[:3, :3]
    # offset less offset first: adding either to the nodes would lose digits
    positions = nodes.positions[rows] @ R.T + (R @ nodes.origin + T[:3, 3] - middle)
    C = np.einsum("ij,njk,lk->nil", R, covariance[rows], R)
    if gauge == FRAME and datum is not None:
        J = rigid.motion(nodes.positions[rows] - (np.zeros(3) if datum_place is None else datum_place))
        C = C + np.einsum("ij,njp,pq,nkq,lk->nil", R, J, datum, J, R, optimize=False)
    elif gauge != FRAME and len(rows):
        C = _relative(positions, C, matching.weight[rows])
    return Movement(
        gauge=gauge,
        found=rows,
        design=assigned,
        vector=positions - nominal[assigned],
        covariance=C,
        ci95=NORMAL_95 * np.sqrt(np.maximum(np.einsum("nii->ni", C), 0.0)),
    )


def _relative(nodes: Floats, C: Floats, weight: Floats) -> Floats:
    """Covariance (n, 3, 3) of nodes (n, 3) of covariance C relative to their own fit with weights (n,)."""
    J = rigid.motion(nodes - nodes.mean(axis=0))
    A = np.einsum("n,nip,niq->pq", weight, J, J)
    scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
    inverse = np.linalg.pinv(A / np.outer(scale, scale), rcond=1e-12) / np.outer(scale, scale)
    gain = np.einsum("pq,niq,n->npi", inverse, J, weight)
    fit = np.einsum("npi,nij,nqj->pq", gain, C, gain)
    cross = np.einsum("nip,npj,njk->nik", J, gain, C)
    relative: Floats = C - cross - np.swapaxes(cross, 1, 2) + np.einsum("nip,pq,njq->nij", J, fit, J)
    return relative
