"""Method ``automatic``: scans placed by the structure they saw, then adjusted all at once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import Floats, Scan
from processor.stitching import three_point
from processor.stitching import three_point as stitching_three_point  # fmt: skip
from processor.stitching.coarse import network, pairwise
from processor.stitching.coarse.pairwise import Placing, View
from processor.stitching.fine import (
    bundle_adjustment,
    contradictions,
    correspondences,
    edge_constraints,
    jackknife,
    pair_checks,
)
from processor.stitching.fine.bundle_adjustment import Solution
from processor.stitching.fine.contradictions import Dissent
from processor.stitching.fine.correspondences import Blocks
from processor.stitching.fine.pair_checks import Pair
from processor.stitching.params import Params
from processor.stitching.planes import scan_planes
from processor.stitching.planes.scan_planes import Cloud

GATES = (0.25, 0.15, 0.08)  # how far faces of scans may still be apart, by cells' side
REACH = 6.0  # the same of what only ends of faces tell
END_GATES = (0.1, 0.05)  # and once these have been looked at
LAST = 5  # adjustments at most without a gate
STILL_MM = 0.02


@dataclass(frozen=True)
class Found:
    """All that ``automatic`` finds, in the clouds' own frames; rows of ``pair_overlap`` are those of ``pairs``."""

    clouds: list[Cloud]
    placed: network.Placed
    solution: Solution
    blocks: Blocks
    pairs: list[Pair]
    overlap: list[float]
    elsewhere: list[bool]
    gross: list[bool]
    dissent: list[Dissent]  # about each scan's pose
    refuted: Floats  # (k,), see placing.refuted


def stitch(
    scans: Sequence[Scan], params: Params, reference: int, picked: stitching_three_point.Picked, threads: int = 0
) -> Found:
    """Place and adjust scans; see :class:`Found`. Pairs that were picked have the picks' pose among those tried."""
    with ThreadPoolExecutor(threads or _usable()) as pool:
        own = list(pool.map(lambda scan: scan_planes.prepared(scan, params.cell_mm), scans))
        side = pairwise.side_of(own)
        views = list(pool.map(lambda cloud: pairwise.view(cloud, side), own))
        tilt = 2e-3 * params.levelled_mrad if params.levelled_mrad else np.inf
        keys = list(itertools.combinations(range(len(own)), 2))
        lists = list(pool.map(lambda key: _candidates(views, key, tilt, picked), keys))
    candidates = dict(zip(keys, lists, strict=True))
    placed = network.place(views, candidates, reference)
    cells = correspondences.gather(own)
    solution, blocks = _adjusted(own, cells, placed.T, reference)
    measured, gross = _pairs(blocks, solution)
    if any(gross):
        bad = {(pair.a, pair.b) for pair, is_bad in zip(measured, gross, strict=True) if is_bad}
        blocks = _without(blocks, bad)
        solution = bundle_adjustment.solve(blocks, solution.T, reference)
    solution = jackknife.honest(blocks, solution, reference)
    standing = {key: rigid.invert(solution.T[key[0]]) @ solution.T[key[1]] for key in keys}
    held = {
        (a, b): pairwise.held(views[a], views[b], T, pairwise.NEAR * side, pairwise.MARGIN * side)
        for (a, b), T in standing.items()
        if np.isfinite(T).all()
    }
    elsewhere = []
    for pair in measured:
        first = candidates[pair.a, pair.b][:1]
        elsewhere.append(not first or not pairwise.same(first[0].T_a_b, standing[pair.a, pair.b], side, views[pair.b]))
    overlap = [held[pair.a, pair.b].overlap for pair in measured]
    apart = contradictions.of_scans(cells, solution, GATES[0] * cells.size_mm)
    refuted = network.refuted(held, len(own), reference)
    return Found(own, placed, solution, blocks, measured, overlap, elsewhere, gross, apart, refuted)


def _usable() -> int:
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _candidates(
    views: list[View], key: tuple[int, int], tilt: float, picked: stitching_three_point.Picked
) -> list[Placing]:
    a, b = views[key[0]], views[key[1]]
    found = pairwise.placings(a, b, tilt)
    if key in picked and len(a.coarse.points) and len(b.coarse.points):
        in_a, in_b, _ = picked[key]
        try:
            T = three_point.tie(in_a - a.cloud.origin, in_b - b.cloud.origin, False).T_a_b
        except three_point.TooFewError:
            return found
        found.append(
            pairwise.held(a, b, pairwise.refine(a, b, T)[0], pairwise.NEAR * a.side_mm, pairwise.MARGIN * a.side_mm)
        )
        found.sort(key=lambda one: -one.score)
    return found


def _adjusted(own: list[Cloud], cells: correspondences.Gathered, T: Floats, reference: int) -> tuple[Solution, Blocks]:
    """Adjust all poses, with narrowing gates for what is one face."""
    if not len(cells.sums):
        empty = np.empty(0, np.int64)
        blocks = Blocks(empty, empty, np.empty((0, 10)), np.empty(0), empty, 0)
        return bundle_adjustment.solve(blocks, T, reference), blocks
    for gate in GATES:
        blocks = correspondences.shared(correspondences.pieces(cells, T, gate * cells.size_mm))
        T = bundle_adjustment.solve(blocks, T, reference, slack_mm=gate * cells.size_mm).T
    pieces = correspondences.pieces(cells, T, 0.0)
    T = edge_constraints.settled(
        own, pieces, bundle_adjustment.solve(correspondences.shared(pieces), T, reference), REACH * cells.size_mm
    )
    for end_gate in (*END_GATES, *[0.0] * LAST):
        pieces = correspondences.pieces(cells, T, 0.0)
        blocks = correspondences.shared(edge_constraints.bounded(own, pieces, T, end_gate * cells.size_mm))
        before = T
        solution = bundle_adjustment.solve(blocks, T, reference, slack_mm=end_gate * cells.size_mm)
        T = solution.T
        if end_gate == 0.0 and correspondences.moved_apart(T, before) < STILL_MM:
            break
    return solution, blocks


def _pairs(blocks: Blocks, solution: Solution) -> tuple[list[Pair], list[bool]]:
    there = np.flatnonzero(np.isfinite(solution.T).all(axis=(1, 2)))
    found = [pair_checks.measure(blocks, solution, a, b) for a, b in itertools.combinations(there.tolist(), 2)]
    kept = [one for one in found if one is not None]
    return kept, [pair_checks.is_gross(one) for one in kept]


def _without(blocks: Blocks, bad: set[tuple[int, int]]) -> Blocks:
    """Leave out pieces that only the two scans of a bad pair share."""
    seen: dict[int, set[int]] = {}
    for piece, scan in zip(blocks.piece.tolist(), blocks.scan.tolist(), strict=True):
        seen.setdefault(piece, set()).add(scan)
    out = {piece for piece, who in seen.items() if len(who) == 2 and (min(who), max(who)) in bad}
    keep = np.array([piece not in out for piece in blocks.piece.tolist()], bool)
    return correspondences.shared(
        Blocks(blocks.piece[keep], blocks.scan[keep], blocks.sums[keep], blocks.count[keep], blocks.kind[keep], 0)
    )
