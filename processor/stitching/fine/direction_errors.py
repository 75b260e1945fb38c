"""Errors of a scan's ranges by their direction, which an adjustment of independent pieces takes for noise.

A scanner errs alike over whole walls: its ranges drift while it turns, and depend on the incidence. The errors of a
scan in each of 24 directions, quarters of the sides of a cube in its own frame, are taken as independent, with one
variance for all scans. It is estimated from the misfits between scans, with all other unknowns eliminated, and
propagated into the poses. A scan that something moved in, or whose ranges are bent, has such errors as well; so has a
cloud of which the scanner's place is unknown, across its faces.
"""

from __future__ import annotations

import numpy as np

from processor.model import Floats, Ints
from processor.stitching.fine import bundle_adjustment
from processor.stitching.fine.bundle_adjustment import Solution
from processor.stitching.fine.correspondences import KINDS, Blocks
from processor.stitching.fine.normal_equations import linearize
from processor.stitching.planes import extraction

DIRECTIONS = 24  # of a scan: 45 degrees wide. With 8 or 48 of them the estimates were within a tenth of the same


def directions(blocks: Blocks) -> Ints:
    """Return the direction (b,), 0 to 23, in which a scan's points on a piece lie, as seen by the scanner.

    Where its place is unknown, as seen from the middle of the cloud.
    """
    ray = blocks.rays[:, :, 3]  # sum of the unit vectors
    ray = np.where((ray == 0.0).all(axis=1)[:, None], extraction.scatter(blocks.sums)[0], ray)
    axis = np.argmax(np.abs(ray), axis=1)
    in_turn = (axis[:, None] + np.arange(3)) % 3
    direction: Ints = 8 * axis + np.take_along_axis(ray < 0.0, in_turn, axis=1) @ np.array([4, 2, 1])
    return direction


def added_covariance(
    blocks: Blocks, solution: Solution, reference: int, variance: float | None = None
) -> tuple[Floats, float]:
    """Return what errors by direction add to the poses' covariance (6k, 6k), and their variance, mm2.

    The variance is estimated unless given. The reference, and scans without blocks, have 0.
    """
    k, ranges = len(solution.T), solution.ranges
    unknowns = bundle_adjustment.unknowns_of(blocks, len(ranges), k, reference)
    poses, size = unknowns[unknowns < 6 * k], 6 * k + len(ranges)
    added = np.zeros((6 * k, 6 * k))
    if not len(poses):
        return added, 0.0
    used, number = np.unique(DIRECTIONS * blocks.scan + directions(blocks), return_inverse=True)
    errors = np.zeros(len(used))
    equations = linearize(
        blocks, solution.T, np.append(ranges, errors), np.array(solution.tau), solution.weight, number.ravel()
    )
    N, g, own = equations.N, equations.g, size + np.arange(len(used))
    prior = bundle_adjustment.prior_information(len(ranges), k, solution.tau[KINDS])
    N[:size, :size] += np.diag(prior)
    g[6 * k : size] += prior[6 * k :] * ranges
    if variance is None:
        variance = bundle_adjustment.variance_of_errors(N, g, errors, unknowns, own)
    moved = np.linalg.solve(N[np.ix_(unknowns, unknowns)], N[np.ix_(unknowns, own)])[: len(poses)]
    added[np.ix_(poses, poses)] = variance * moved @ moved.T
    return added, variance
