"""Whether faces that an adjustment left aside agree on another pose of a scan.

Errors of single faces are outliers, and rightly left aside. But where a near wall of many points moved during one scan,
it may hold the scan by itself, and the others, which are right, are the ones left aside: the answer then fits well and
is wrong. So each face left aside says by which motion of the scan it would fit; those that others left aside share are
counted against the faces that such a motion would make misfits of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Floats, Ints
from processor.stitching.fine import bundle_adjustment, correspondences
from processor.stitching.fine.bundle_adjustment import DROPPED, Solution
from processor.stitching.fine.correspondences import FLAT_SIGMAS, Blocks, Gathered
from processor.stitching.planes import extraction, hashing

AGREES = 4.0  # standard deviations of a face's misfit once the scan has moved
LEAST_FACES = 4  # three of a hundred agree on something by chance: one of 90 scans of a truss
LEAST_SHARE = 0.14  # of the faces that hold the scan where it is


@dataclass(frozen=True)
class Dissent:
    """Of a scan: faces left aside that agree on a motion, faces that speak against it, and how far it goes."""

    agree: int = 0
    hold: int = 0
    shift_mm: float = 0.0
    turn_mrad: float = 0.0

    @property
    def counts(self) -> bool:
        """Whether it is more than the faces that things moved between scans leave aside."""
        return self.agree > LEAST_SHARE * self.hold


@dataclass(frozen=True)
class _Witnesses:
    """Faces of all scans: whose, distance from the plane that the other scans give, its variance, how poses move it."""

    scan: Ints
    offset: Floats
    variance: Floats
    follows: Floats  # (n, 6): turns about the scan's origin, shift


def of_scans(cells: Gathered, solution: Solution, gate_mm: float) -> list[Dissent]:
    """Return the strongest dissent about each scan's pose; faces up to ``gate_mm`` apart count as one."""
    count = len(solution.T)
    blocks = correspondences.shared(correspondences.pieces(cells, solution.T, gate_mm)) if len(cells.sums) else None
    if blocks is None or not blocks.pieces:
        return [Dissent()] * count
    every = _witnesses(blocks, solution)
    return [_strongest(every, every.scan == s) for s in range(count)]


def _witnesses(blocks: Blocks, solution: Solution) -> _Witnesses:
    """Hold each face against the plane of the other scans' points on it; only where both are as flat as the noise."""
    weight = bundle_adjustment.weights_at(blocks, solution.T, solution.tau)
    # Where all but one are left aside, nobody knows which is wrong: each is held against all others.
    left = np.bincount(blocks.piece, weight > bundle_adjustment.ASIDE, blocks.pieces)
    weight = np.where(left[blocks.piece] < 2, 1.0, weight)
    world = extraction.moved(blocks.sums, solution.T[blocks.scan])
    own = extraction.planes_of(world)
    weighted = world * weight[:, None]
    rest = hashing.summed(weighted, blocks.piece, blocks.pieces)[blocks.piece] - weighted
    others = extraction.planes_of(rest)
    counts = np.bincount(blocks.piece, blocks.count, blocks.pieces)[blocks.piece] - blocks.count
    limit = FLAT_SIGMAS**2
    flat = (own.variance[:, 0] * own.count <= limit * blocks.count) & (
        others.variance[:, 0] * others.count <= limit * counts
    )
    apart = own.mean - others.mean
    along = np.einsum("bi,bij->bj", apart, others.axes[:, :, 1:])
    lean = (along**2 / np.maximum(others.variance[:, 1:], 1e-12)).sum(axis=1)
    variance = 1.0 / own.count + (1.0 + lean) / np.maximum(others.count, 1e-12) + 2.0 * solution.tau[0] ** 2
    arm = own.mean - solution.T[blocks.scan, :3, 3]
    n = others.normal
    return _Witnesses(
        blocks.scan[flat],
        np.einsum("bi,bi->b", apart, n)[flat],
        variance[flat],
        np.concatenate([np.cross(arm, n), n], axis=1)[flat],
    )


def _strongest(every: _Witnesses, rows: np.ndarray) -> Dissent:
    """Try the motion that each face left aside asks for, and count who agrees."""
    offset, variance, follows = every.offset[rows], every.variance[rows], every.follows[rows]
    z = np.abs(offset) / np.sqrt(variance)
    aside = z > DROPPED
    held = ~aside
    information = np.einsum("b,bi,bj->ij", held / variance, follows, follows)
    information += np.diag([bundle_adjustment.PRIOR_RAD**-2] * 3 + [bundle_adjustment.PRIOR_MM**-2] * 3)
    best = Dissent()
    for i in np.flatnonzero(aside):
        # Of all motions that bring this face back, the one that the faces which hold the scan mind least.
        easiest = np.linalg.solve(information, follows[i])
        motion = -offset[i] / (follows[i] @ easiest) * easiest
        after = np.abs(offset + follows @ motion) / np.sqrt(variance)
        agree, hold = int((aside & (after < AGREES)).sum()), int((held & (after > DROPPED)).sum())
        if agree >= LEAST_FACES and agree * max(best.hold, 1) > best.agree * max(hold, 1):
            size = float(np.linalg.norm(motion[3:])), float(1e3 * np.linalg.norm(motion[:3]))
            best = Dissent(agree, hold, *size)
    return best
