"""Contradictions of a scan's pose: faces that the adjustment rejected as outliers, but that agree on another pose.

Errors of single faces are outliers and are rejected. But a near wall with many points that moved during one scan may
determine the pose by itself (a leverage point): the correct faces are then rejected, and the wrong pose fits well.
For each rejected face the motion of the scan that would make it fit is tried. The rejected faces that fit after this
motion are compared in number with the accepted faces that no longer do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.adjustment.body_motions import distance_derivative
from processor.model import Columns, Floats, Ints
from processor.stitching.fine import bundle_adjustment, correspondences, normal_equations
from processor.stitching.fine.bundle_adjustment import REJECTION_SIGMAS, Solution
from processor.stitching.fine.correspondences import FLAT_SIGMAS, KINDS, Blocks, CellTable
from processor.stitching.planes import extraction, grouped_sums

AGREES = 4.0  # standard deviations of a face's misfit after the motion
LEAST_FACES = 4  # three of a hundred agree by chance in one of 90 scans of a truss
LEAST_RATIO = 0.14  # of the agreeing faces to the opposing ones


@dataclass(frozen=True)
class Contradiction:
    """Number of rejected faces of a scan that agree on a motion, of accepted faces that oppose it, and its size."""

    agree: int = 0
    oppose: int = 0
    shift_mm: float = 0.0
    turn_mrad: float = 0.0

    @property
    def is_significant(self) -> bool:
        """Whether more faces agree than objects moved between the scans would explain."""
        return self.agree > LEAST_RATIO * self.oppose


@dataclass(frozen=True)
class _Misfits(Columns):
    """Faces of all scans: distance from the plane of the other scans, its variance, and its derivative by the pose."""

    scan: Ints
    offset: Floats
    variance: Floats
    by_pose: Floats  # (n, 6): rotation about the scan's origin, shift


def of_scans(cells: CellTable, solution: Solution, gate_mm: float) -> list[Contradiction]:
    """Return the strongest contradiction of each scan's pose; faces up to ``gate_mm`` apart are taken as one."""
    count = len(solution.T)
    blocks = correspondences.segment(cells, solution.T, gate_mm).shared() if len(cells.sums) else None
    if blocks is None or not blocks.pieces:
        return [Contradiction()] * count
    misfits = _misfits(blocks, solution)
    return [_strongest(misfits.take(misfits.scan == s)) for s in range(count)]


def _misfits(blocks: Blocks, solution: Solution) -> _Misfits:
    """Compare each face with the plane of the other scans' points; only where both are planar within the noise."""
    weight = bundle_adjustment.weights_at(blocks, solution)
    # Where all faces of a piece but one are outliers, any may be wrong: each is compared with all others.
    left = np.bincount(blocks.piece, weight > bundle_adjustment.LEAST_INLIER_WEIGHT, blocks.pieces)
    weight = np.where(left[blocks.piece] < 2, 1.0, weight)
    moments = normal_equations.in_world(blocks, solution.T, *solution.of_scans[blocks.scan].T)
    world = extraction.triangle(moments)
    faces = extraction.planes_of(world)
    weighted = world * weight[:, None]
    rest = grouped_sums.summed(weighted, blocks.piece, blocks.pieces)[blocks.piece] - weighted
    others = extraction.planes_of(rest)
    counts = np.bincount(blocks.piece, blocks.count, blocks.pieces)[blocks.piece] - blocks.count
    limit = FLAT_SIGMAS**2
    flat = (faces.variance[:, 0] * faces.count <= limit * blocks.count) & (
        others.variance[:, 0] * others.count <= limit * counts
    )
    shift = faces.mean - others.mean
    along = np.einsum("bi,bij->bj", shift, others.axes[:, :, 1:])
    lean = (along**2 / np.maximum(others.variance[:, 1:], 1e-12)).sum(axis=1)
    variance = 1.0 / faces.count + (1.0 + lean) / np.maximum(others.count, 1e-12) + 2.0 * solution.tau[0] ** 2
    variance += solution.tau[KINDS] ** 2
    arm, n = faces.mean - solution.T[blocks.scan, :3, 3], others.normal
    return _Misfits(
        scan=blocks.scan[flat],
        offset=np.einsum("bi,bi->b", shift, n)[flat],
        variance=variance[flat],
        by_pose=distance_derivative(arm, n)[flat],
    )


def _strongest(misfits: _Misfits) -> Contradiction:
    """Try the motion that each rejected face of a scan suggests, and count the faces that agree."""
    offset, variance, by_pose = misfits.offset, misfits.variance, misfits.by_pose
    rejected: npt.NDArray[np.bool_] = np.abs(offset) / np.sqrt(variance) > REJECTION_SIGMAS
    information = np.einsum("b,bi,bj->ij", ~rejected / variance, by_pose, by_pose)
    information += np.diag([bundle_adjustment.PRIOR_RAD**-2] * 3 + [bundle_adjustment.PRIOR_MM**-2] * 3)
    best = Contradiction()
    for i in np.flatnonzero(rejected):
        # Of all motions that make this face fit, the one that changes the fit of the accepted faces least.
        easiest = np.linalg.solve(information, by_pose[i])
        motion = -offset[i] / (by_pose[i] @ easiest) * easiest
        after = np.abs(offset + by_pose @ motion) / np.sqrt(variance)
        agree, oppose = int((rejected & (after < AGREES)).sum()), int((~rejected & (after > REJECTION_SIGMAS)).sum())
        if agree >= LEAST_FACES and agree * max(best.oppose, 1) > best.agree * max(oppose, 1):
            shift_mm, turn_mrad = float(np.linalg.norm(motion[3:])), float(1e3 * np.linalg.norm(motion[:3]))
            best = Contradiction(agree=agree, oppose=oppose, shift_mm=shift_mm, turn_mrad=turn_mrad)
    return best
