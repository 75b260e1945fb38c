"""Errors of a scan's ranges by direction and by incidence, which an adjustment of independent pieces takes for noise.

A scanner errs alike over whole walls: its ranges drift while it turns, and depend on the incidence. The errors of a
scan in each of 24 directions, quarters of the sides of a cube in its own frame, are taken as independent, with one
variance for all scans. It is estimated from the misfits between scans, with all other unknowns eliminated, and
propagated into the poses. A scan that something moved in, or whose ranges are bent, has such errors as well; so has a
cloud of which the scanner's place is unknown, across its faces.

The bias by incidence is the same in all scans: a floor is bent alike in each, which tilts those that see more of it on
one side, and few misfits show it. Its size is that of the scanner's class.
"""

from __future__ import annotations

import numpy as np

from processor.adjustment import scanner_class_errors
from processor.model import Floats, Ints
from processor.stitching.fine import bundle_adjustment
from processor.stitching.fine.bundle_adjustment import Solution
from processor.stitching.fine.correspondences import KINDS, Blocks
from processor.stitching.fine.normal_equations import linearize
from processor.stitching.planes import extraction

DIRECTIONS = 24  # of a scan: 45 degrees wide. With 8 or 48 of them the estimates were within a tenth of the same
# Bins of the cosine of incidence, and the cosine below which the bias is that at 74 degrees: the law of the class,
# 1 / cos - 1, grows without bound, to millimetres at 85 degrees, and no measurement supports it there.
INCIDENCES, GRAZING_COS = 64, 0.28


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
    k = len(solution.T)
    used, number = np.unique(DIRECTIONS * blocks.scan + directions(blocks), return_inverse=True)
    N, g, unknowns, own = _with_errors(blocks, solution, reference, number.ravel(), len(used))
    if not (unknowns < 6 * k).any():
        return np.zeros((6 * k, 6 * k)), 0.0
    if variance is None:
        variance = bundle_adjustment.variance_of_errors(N, g, np.zeros(len(used)), unknowns, own)
    moved = _moved(N, unknowns, own, k)
    return variance * moved @ moved.T, variance


def covariance_by_incidence(blocks: Blocks, solution: Solution, reference: int) -> Floats:
    """Return what the bias by incidence of the scanner's class adds to the poses' covariance (6k, 6k)."""
    ray, normal = blocks.rays[:, :, 3], extraction.planes_of(blocks.sums).normal
    length = np.linalg.norm(ray, axis=1)
    cosine = np.where(length > 0.0, np.abs(np.einsum("bi,bi->b", ray, normal)) / np.maximum(length, 1e-12), 1.0)
    in_bin = np.minimum((INCIDENCES * cosine).astype(np.int64), INCIDENCES - 1)
    N, _, unknowns, own = _with_errors(blocks, solution, reference, in_bin, INCIDENCES)
    middle = np.maximum((np.arange(INCIDENCES) + 0.5) / INCIDENCES, GRAZING_COS)
    bias = scanner_class_errors.known().incidence_mm * (1.0 / middle - 1.0)
    moved = _moved(N, unknowns, own, len(solution.T)) @ bias
    return np.outer(moved, moved)


def _with_errors(
    blocks: Blocks, solution: Solution, reference: int, number: Ints, count: int
) -> tuple[Floats, Floats, Ints, Ints]:
    """Return normal equations with errors of ranges by their ``number`` (b,), and the rows of unknowns and of these."""
    k, ranges = len(solution.T), solution.ranges
    size = 6 * k + len(ranges)
    equations = linearize(
        blocks, solution.T, np.append(ranges, np.zeros(count)), np.array(solution.tau), solution.weight, number
    )
    N, g = equations.N, equations.g
    prior = bundle_adjustment.prior_information(len(ranges), k, solution.tau[KINDS])
    N[:size, :size] += np.diag(prior)
    g[6 * k : size] += prior[6 * k :] * ranges
    return N, g, bundle_adjustment.unknowns_of(blocks, len(ranges), k, reference), size + np.arange(count)


def _moved(N: Floats, unknowns: Ints, own: Ints, k: int) -> Floats:
    """Return the changes (6k, d) of the poses by a unit of each error; those of the reference are 0."""
    moved = np.zeros((6 * k, len(own)))
    poses = unknowns[unknowns < 6 * k]
    if len(poses):
        moved[poses] = np.linalg.solve(N[np.ix_(unknowns, unknowns)], N[np.ix_(unknowns, own)])[: len(poses)]
    return moved
