"""Covariances of poses raised to their scatter between regions of the structure.

An adjustment takes the errors of pieces as independent. A scanner with systematic range or angle errors, or a structure
that moved in between, makes them alike over whole walls, and the covariance is then far too small. Each region is left
out in turn (delete-a-group jackknife, one Newton step each). Where a pose reacts by more than its covariance explains,
beyond chance, the covariance is raised.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from processor.model import Floats, Ints
from processor.stitching.fine import bundle_adjustment
from processor.stitching.fine.bundle_adjustment import Solution
from processor.stitching.fine.correspondences import Blocks
from processor.stitching.planes import extraction, hashing

HALVINGS = 3
REGIONS = 2**HALVINGS
LEAST_PIECES = 4  # of a region
ALMOST_NONE = 1e-9  # weight of the pieces left out
BY_CHANCE = 1e-3


def with_raised_covariance(blocks: Blocks, solution: Solution, reference: int) -> Solution:
    """Return the solution with each scan's covariance raised to its scatter between regions, never lowered."""
    by_row = np.repeat(factors(blocks, solution, reference), 6)
    return replace(solution, covariance=solution.covariance * by_row[:, None] * by_row[None])


def factors(blocks: Blocks, solution: Solution, reference: int) -> Floats:
    """Return the ratio (k,) of the standard deviations by regions to those of the adjustment; 1 if it may be chance.

    The mean square of the motions without a region each, by their covariance, is chi-square by its freedoms.
    """
    k, freedoms = len(solution.T), REGIONS - 1
    factor = np.ones(k)
    if blocks.pieces < REGIONS * LEAST_PIECES:
        return factor
    world = extraction.transformed(blocks.sums, solution.T[blocks.scan])
    mean = extraction.scatter(hashing.summed(world, blocks.piece, blocks.pieces))[0]
    region = regions(mean)
    steps = np.stack(
        [
            bundle_adjustment.step_without(blocks, solution, reference, region[blocks.piece] == g, ALMOST_NONE)
            for g in range(REGIONS)
        ]
    )
    steps = (steps - steps.mean(axis=0)).reshape(REGIONS, k, 6)
    for s in range(k):
        C = solution.covariance[6 * s : 6 * s + 6, 6 * s : 6 * s + 6]
        if s == reference or not np.isfinite(C).all():
            continue
        ratio = np.einsum("gi,gi->", steps[:, s], np.linalg.solve(C, steps[:, s].T).T) * freedoms / REGIONS / 6.0
        factor[s] = np.sqrt(ratio) if ratio > chi2.isf(BY_CHANCE, freedoms) / freedoms else 1.0
    return factor


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
