"""Covariances of poses raised to their scatter between regions of the structure.

An adjustment takes the errors of pieces as independent. A scanner with systematic range or angle errors, or a structure
that moved in between, makes them alike over whole walls, and the covariance is then far too small. Each region is left
out in turn (delete-a-group jackknife, one Newton step each). Independent errors move a pose by as much as its
covariance grows without the region. Where a pose reacts by more, beyond chance, its covariance is raised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from processor.model import Floats, Ints
from processor.stitching.fine import bundle_adjustment
from processor.stitching.fine.bundle_adjustment import Solution
from processor.stitching.fine.correspondences import Blocks
from processor.stitching.fine.pairs_and_loops import Pair
from processor.stitching.planes import extraction, grouped_sums

HALVINGS = 3
REGIONS = 2**HALVINGS
LEAST_PIECES = 4  # of a region
ALMOST_NONE = 1e-9  # weight of the pieces left out
BY_CHANCE = 1e-3
LEAST_GROWTH = 0.01  # of a pose's covariance: a region that holds less of it decides nothing


def with_raised_covariance(solution: Solution, pairs: Sequence[Pair], factor: Floats) -> tuple[Solution, list[Pair]]:
    """Return a solution and pairs with covariances raised by each scan's ``factor`` (k,), of a pair by the larger."""
    by_row = np.repeat(factor, 6)
    return (
        replace(solution, covariance=solution.covariance * by_row[:, None] * by_row[None]),
        [replace(pair, covariance=pair.covariance * max(factor[pair.a], factor[pair.b]) ** 2) for pair in pairs],
    )


def factors(blocks: Blocks, solution: Solution, reference: int) -> Floats:
    """Return the ratio (k,) of the standard deviations by regions to those of the adjustment; 1 if it may be chance.

    The mean square of the motions without a region each, by the growth of their covariance, is chi-square by its
    degrees of freedom. A region that a pose rests on may be large: by the covariance alone it would count as a
    contradiction.
    """
    k, dof = len(solution.T), REGIONS - 1
    factor = np.ones(k)
    if blocks.pieces < REGIONS * LEAST_PIECES:
        return factor
    world = extraction.transformed(blocks.sums, solution.T[blocks.scan])
    mean = extraction.scatter(grouped_sums.summed(world, blocks.piece, blocks.pieces))[0]
    region = regions(mean)[blocks.piece]
    none = np.zeros(len(region), bool)
    rest, whole = bundle_adjustment.solve_without(blocks, solution, reference, none, ALMOST_NONE)
    square = np.zeros(k)
    for g in range(REGIONS):
        step, covariance = bundle_adjustment.solve_without(blocks, solution, reference, region == g, ALMOST_NONE)
        square += _squares(step - rest, covariance - whole, whole)
    for s in range(k):
        ratio = square[s] / (6.0 * REGIONS)
        factor[s] = np.sqrt(ratio) if ratio > chdtri(dof, BY_CHANCE) / dof else 1.0
    return factor


def _squares(step: Floats, growth: Floats, whole: Floats) -> Floats:
    """Return the square (k,) of each pose's step by the growth of its covariance; 0 for poses that are not adjusted."""
    square = np.zeros(len(step) // 6)
    for s in range(len(square)):
        rows = slice(6 * s, 6 * s + 6)
        if whole[rows, rows].any():
            C = growth[rows, rows] + LEAST_GROWTH * whole[rows, rows]
            square[s] = float(step[rows] @ np.linalg.solve(C, step[rows]))
    return square


def regions(places: Floats) -> Ints:
    """Divide points (n, 3) into REGIONS (n,) of equal numbers by repeated bisection across the longest side."""
    region = np.zeros(len(places), np.int64)
    for _ in range(HALVINGS):
        halves = 2 * region
        for g in np.unique(region):
            rows = np.flatnonzero(region == g)
            axis = int(np.argmax(np.ptp(places[rows], axis=0)))
            order = np.argsort(places[rows, axis], kind="stable")
            halves[rows[order[len(rows) // 2 :]]] += 1
        region = halves
    return region
