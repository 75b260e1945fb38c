"""How far poses scatter by regions of the structure: what neighbouring faces have in common shows here.

An adjustment takes the errors of pieces as independent. A scanner whose ranges or angles are bent, or a structure that
moved in between, makes them alike over whole walls, and the poses are far less sure than the adjustment says. So each
region is left out in turn (delete-a-group jackknife, one step of Newton each), and where a pose answers by more than
its covariance lets expect by chance, that is raised.
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

HALVINGS = 3  # 8 regions
LEAST_PIECES = 4  # of a region
ALMOST_NONE = 1e-9
BY_CHANCE = 1e-3


def honest(blocks: Blocks, solution: Solution, reference: int) -> Solution:
    """Return the solution with each scan's covariance raised to what the regions tell, never lowered."""
    factor = factors(blocks, solution, reference)
    by_row = np.repeat(factor, 6)
    return replace(solution, covariance=solution.covariance * by_row[:, None] * by_row[None])


def factors(blocks: Blocks, solution: Solution, reference: int) -> Floats:
    """Return the ratio (k,) of the standard deviations by regions to those of the adjustment; 1 where chance may be it.

    The mean square of as many motions as there are regions, less one, by their covariance: chi-square by its freedoms.
    """
    k, free = len(solution.T), 2**HALVINGS - 1
    found = np.ones(k)
    groups = 2**HALVINGS
    if blocks.pieces < groups * LEAST_PIECES:
        return found
    world = extraction.moved(blocks.sums, solution.T[blocks.scan])
    mean = extraction.scatter(hashing.summed(world, blocks.piece, blocks.pieces))[0]
    region = regions(mean)
    moved = np.stack(
        [
            bundle_adjustment.step_without(blocks, solution, reference, region[blocks.piece] == g, ALMOST_NONE)
            for g in range(groups)
        ]
    )
    moved = (moved - moved.mean(axis=0)).reshape(groups, k, 6)
    for s in range(k):
        own = solution.covariance[6 * s : 6 * s + 6, 6 * s : 6 * s + 6]
        if s == reference or not np.isfinite(own).all():
            continue
        ratio = np.einsum("gi,gi->", moved[:, s], np.linalg.solve(own, moved[:, s].T).T) * (groups - 1) / groups / 6.0
        found[s] = np.sqrt(ratio) if ratio > chi2.isf(BY_CHANCE, free) / free else 1.0
    return found


def regions(places: Floats) -> Ints:
    """Cut places (n, 3) in 2^HALVINGS regions (n,) of as many each, across their longest side in turn."""
    found = np.zeros(len(places), np.int64)
    for _ in range(HALVINGS):
        halves = 2 * found
        for g in np.unique(found):
            rows = np.flatnonzero(found == g)
            axis = int(np.argmax(np.ptp(places[rows], axis=0)))
            order = np.argsort(places[rows, axis], kind="stable")
            halves[rows[order[len(rows) // 2 :]]] += 1
        found = halves
    return found
