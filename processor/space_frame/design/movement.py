"""How far every node is from its nominal place, and how sure that is.

A movement is found minus nominal in the design's frame, after a datum. Where the scan is in the design's own frame the
datum is this frame, and what is uncertain about it is part of every interval. Where it had to be registered the datum
is the best fit over all matched nodes: a movement they have in common is gone, and the fit's own uncertainty, which
comes from the nodes it rests on, is part of every interval (Teunissen 2000, S-transformations).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import NORMAL_95, Checked, Floats, FrameDesign, Ints, column
from processor.space_frame.design.matching import SAME, Found, Matching

FRAME, BEST_FIT = "design frame", "best fit"
CHI2_95_OF_3 = 7.814727903251179


@dataclass(frozen=True)
class Movement(Checked):
    """Movements of matched nodes, a row each: mm, design frame.

    ``gauge`` says what they are relative to. ``ci95`` is the half-width of the 95 % interval along each axis;
    ``certain`` tells whether a movement differs from none at 95 %, all three axes together.
    """

    gauge: str  # design frame | best fit
    message: str
    found: Ints = column("n", dtype=np.int64)  # rows of the found nodes
    design: Ints = column("n", dtype=np.int64)  # and of the design
    vector: Floats = column("n", 3)
    covariance: Floats = column("n", 3, 3)
    ci95: Floats = column("n", 3)
    certain: Ints = column("n", dtype=np.int64)  # 1 = yes


def movement(
    matching: Matching,
    found: Found,
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
    covariance : (k, 3, 3) of the found nodes, each for itself, without what they all have in common
    datum : (6, 6) covariance of the motion they have in common: turn about ``datum_place`` (3,), which is less the
        nodes' origin, and translation; None = none. A best fit takes it away.
    gauge : ``design frame`` or ``best fit``; by default the first where the frames are the same.
    expansion : factor of all lengths by temperature; nominal places are expanded about their mean
    """
    gauge = gauge or (FRAME if matching.how == SAME else BEST_FIT)
    rows = np.flatnonzero(matching.assignment >= 0)
    nominal = matching.assignment[rows]
    middle = design.centres.mean(axis=0) if len(design.centres) else np.zeros(3)
    places = (design.centres[nominal] - middle) * expansion
    T = matching.T_design_scan if gauge == FRAME else matching.T_best_fit
    R = T[:3, :3]
    # offset less offset first: added to the nodes either would cost them their digits
    nodes = found.positions[rows] @ R.T + (R @ found.origin + T[:3, 3] - middle)
    vector = nodes - places
    own = np.einsum("ij,njk,lk->nil", R, covariance[rows], R)
    if gauge == FRAME:
        said = "in the design's own frame"
        if datum is not None:
            at = np.zeros(3) if datum_place is None else datum_place
            J = rigid.motion(found.positions[rows] - at)
            own = own + np.einsum("ij,njp,pq,nkq,lk->nil", R, J, datum, J, R, optimize=False)
    else:
        said = "relative to the best fit over all matched nodes: what they moved in common is not in it"
        if len(rows):
            own = _relative(nodes, own, matching.weight[rows])
    variance = np.maximum(np.einsum("nii->ni", own), 0.0)
    return Movement(gauge, said, rows, nominal, vector, own, NORMAL_95 * np.sqrt(variance), _certain(vector, own))


def _relative(nodes: Floats, own: Floats, weight: Floats) -> Floats:
    """Covariance (n, 3, 3) of nodes (n, 3) after the fit that rests on them with these weights (n,)."""
    J = rigid.motion(nodes - nodes.mean(axis=0))
    A = np.einsum("n,nip,niq->pq", weight, J, J)
    scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
    inverse = np.linalg.pinv(A / np.outer(scale, scale), rcond=1e-12) / np.outer(scale, scale)
    gain = np.einsum("pq,niq,n->npi", inverse, J, weight)
    moved = np.einsum("npi,nij,nqj->pq", gain, own, gain)
    cross = np.einsum("nip,npj,njk->nik", J, gain, own)
    found: Floats = own - cross - np.swapaxes(cross, 1, 2) + np.einsum("nip,pq,njq->nij", J, moved, J)
    return found


def _certain(vector: Floats, covariance: Floats) -> Ints:
    found = np.zeros(len(vector), np.int64)
    known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(vector).all(axis=1)
    # The variance along the movement's own direction could be called certain by chance of direction: all three axes.
    root = np.linalg.pinv(covariance[known], hermitian=True, rcond=1e-12)
    found[known] = np.einsum("ni,nij,nj->n", vector[known], root, vector[known]) > CHI2_95_OF_3
    return found
