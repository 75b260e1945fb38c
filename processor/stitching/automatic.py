"""Method ``automatic``: scans registered by the planar faces of the structure, coarsely and then all together."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from processor.adjustment import scanner_class_errors
from processor.geometry import rigid, thread_ranges
from processor.model import Control, Floats, Reason, Scan, reason
from processor.stitching import three_point
from processor.stitching.coarse import network, pairwise
from processor.stitching.coarse.pairwise import ScanPatches, ScoredPose
from processor.stitching.fine import (
    bundle_adjustment,
    contradictions,
    control_points,
    correspondences,
    direction_errors,
    edge_constraints,
    pairs_and_loops,
)
from processor.stitching.fine.bundle_adjustment import Solution
from processor.stitching.fine.correspondences import Blocks, CellTable
from processor.stitching.fine.pairs_and_loops import Pair
from processor.stitching.params import Params
from processor.stitching.planes import scan_planes
from processor.stitching.planes.scan_planes import Cloud
from processor.stitching.three_point import Picked
from processor.stitching.to_result import Network

# Lengths in sides of the cells.
GATES = (0.25, 0.15, 0.08)  # distance of faces of different scans that are taken as one, from adjustment to adjustment
REACH = 6.0  # the same along motions that only the ends of faces determine
END_GATES = (0.1, 0.05)  # distance of ends from the faces that bound them, in the first adjustments with ends
MOST_FINAL = 5  # adjustments without a gate
DEEP_PAIRS, DEEP_ROUNDS = 8, 12  # work: pairs that are searched deeply at once, some seconds each, and how often
STILL_MM = 0.02  # largest shift of a pose at convergence

Given = tuple[Picked, Mapping[int, Floats], Mapping[int, Floats]]  # picks, poses by control points, poses in the files


def stitch(
    scans: Sequence[Scan], params: Params, reference: int, picked: Picked, control: Control | None = None
) -> Network:
    """Register two or more scans in the frame of scan ``reference``, a row of ``scans``.

    Candidate poses of all pairs are scored by matching patches and free space, the scans are placed by these one after
    another, and all poses are adjusted on shared planar pieces and ends of faces. The pose by picked points is one of
    the candidates of its pair. If each scan of a pair saw enough control points to determine its pose, the pose by
    these is the only candidate, so that repetitive structures are not ambiguous. Scans that overlap with no other one
    have a pose of NaN.
    """
    count = sum(len(scan.points) for scan in scans)
    clouds = thread_ranges.each(
        lambda scan: scan_planes.extract(scan, params.cell_mm, scan_planes.points_a_cell(scan, count)), scans
    )
    side = pairwise.cube_side(clouds)
    patches = thread_ranges.each(lambda cloud: pairwise.prepare(cloud, side), clouds)
    known = control_points.poses_of_scans(control, [cloud.origin for cloud in clouds])
    starts = {
        s: scan.T_project_scan @ rigid.transform(np.eye(3), cloud.origin)
        for s, (scan, cloud) in enumerate(zip(scans, clouds, strict=True))
        if scan.T_project_scan.size
    }
    placed = _place(patches, params, reference, (picked, known, starts))
    candidates, coarse = placed.candidates, network.rated(placed, reference)
    cells = correspondences.gather(clouds)
    solution, blocks = _adjust(clouds, cells, coarse.T, reference)
    # All pairs that share enough pieces, each by itself
    with_pose = np.flatnonzero(np.isfinite(solution.T).all(axis=(1, 2)))
    added, variance = direction_errors.added_covariance(blocks, solution, reference)
    registered = [
        pairs_and_loops.register_pair(blocks, solution, a, b, variance)
        for a, b in itertools.combinations(with_pose.tolist(), 2)
    ]
    pairs = [pair for pair in registered if pair is not None]
    gross = {(pair.a, pair.b) for pair in pairs if pair.is_gross}
    if gross:
        solution, blocks = _without_gross_pairs(blocks, solution, gross, reference)
        added, _ = direction_errors.added_covariance(blocks, solution, reference)
    added += direction_errors.covariance_by_incidence(blocks, solution, reference)
    solution = replace(solution, covariance=solution.covariance + added)
    scores = network.scores(patches, solution.T, placed.still is not None)
    refuted = network.refuted(scores, len(scans), reference)
    refuted[list(known) if reference in known else []] = 0.0
    noise, class_mm = float(np.median([cloud.sigma_mm for cloud in clouds])), scanner_class_errors.known().view_mm
    # Where the prior determines a scan's range error better than the faces.
    unseen = tuple(scans[s].name for s in np.flatnonzero(solution.ranges_sd > np.sqrt(0.5) * class_mm).tolist())
    return Network(
        T=solution.T,
        covariance=solution.covariance,
        origins=np.stack([cloud.origin for cloud in clouds]),
        coarse=coarse,
        pairs=[_stated(pair, candidates[pair.a, pair.b], scores[pair.a, pair.b], patches[pair.b]) for pair in pairs],
        estimated=(noise, solution.tau[0], solution.tau[1]),
        point_mm=noise,
        reasons=(reason("stitch.ranges-by-class", scans=unseen, sd_mm=class_mm),) if unseen else (),
        contradictions=contradictions.of_scans(cells, solution, GATES[0] * cells.size_mm),
        refuted=refuted,
        links=sorted({*network.links(scores), *itertools.combinations(sorted(known), 2)}),
    )


def _stated(pair: Pair, candidates: list[ScoredPose], adjusted: ScoredPose, b: ScanPatches) -> Pair:
    """Return a pair with its overlap at the adjusted pose, and why it is not used, or what its best candidate says."""
    why: tuple[Reason, ...] = ()
    if pair.is_gross:
        why = (reason("stitch.pair-contradicts"),)
    elif not candidates or not pairwise.same(candidates[0].T_a_b, adjusted.T_a_b, b.side_mm, b):
        why = (reason("stitch.pair-elsewhere"),)
    return replace(pair, overlap=adjusted.overlap, used=not pair.is_gross, reasons=why)


def _place(patches: list[ScanPatches], params: Params, reference: int, given: Given) -> network.Network:
    """Find the candidate poses of all pairs and place the scans by them.

    If scans that all have starts are joined at poses near these, no more is searched for than quick rivals. Groups of
    scans that no sure pose joins are searched for one once more, as deeply as would take too long for all pairs: those
    that a pose has joined meanwhile are left out, and so is what is beyond DEEP_ROUNDS. Where no pair is sure even
    then, something is taken to move between any two scans.
    """
    known, starts = list(given[1]), given[2]
    if len(starts) == len(patches):
        found = _find_candidates(patches, params, given, (pairwise.QUICK,))
        placed = network.place(patches, found, reference, network.nothing_sure(found))
        if not network.groups(placed.candidates, len(patches), known).any() and all(
            pairwise.is_beside(rigid.invert(starts[reference]) @ starts[s], placed.T[s], patch)
            for s, patch in enumerate(patches)
        ):
            return placed
    found = _find_candidates(patches, params, given)
    evidence, is_moved = patches, False

    def deeper(key: tuple[int, int]) -> list[ScoredPose]:
        poses = pairwise.candidate_poses(evidence[key[0]], evidence[key[1]], _most_tilt(params), [pairwise.DEEP])
        sure = [pose for pose in poses if pose.score > pairwise.SURE]
        return sure + found[key] if sure else found[key]

    # Scans that follow each other overlap most often: those that lie nearest in the order of the scans come first.
    todo = sorted(found, key=lambda key: (key[1] - key[0], key))
    for _ in range(DEEP_ROUNDS):
        group = network.groups(found, len(patches), known)
        todo = [key for key in todo if group[key[0]] != group[key[1]]]
        some, todo = todo[:DEEP_PAIRS], todo[DEEP_PAIRS:]
        found |= dict(zip(some, thread_ranges.each(deeper, some), strict=True))
        if not is_moved and network.nothing_sure(found):
            is_moved, placed = True, network.place(patches, found, reference, True)
            found = dict(placed.candidates)
            evidence = [*map(pairwise.reduced, patches, placed.still)] if placed.still else patches
    return network.place(patches, found, reference, is_moved)


def _most_tilt(params: Params) -> float:
    """Return the largest angle, rad, between the third axes of two scans."""
    return 2e-3 * params.levelled_mrad if params.levelled_mrad else np.inf


def _find_candidates(
    patches: list[ScanPatches],
    params: Params,
    given: Given,
    efforts: Sequence[pairwise.Effort] = (pairwise.QUICK, pairwise.WIDE),
) -> network.Pairs:
    """Return the candidate poses of all pairs (a < b), the best first; of two scans of known poses that alone.

    A pose by picks, and the best one near the poses that are given, are among them.
    """
    picked, known, starts = given

    def candidates(key: tuple[int, int]) -> list[ScoredPose]:
        a, b = patches[key[0]], patches[key[1]]
        if not len(a.patches.weight) or not len(b.patches.weight):
            return []
        if key[0] in known and key[1] in known:
            T = rigid.invert(known[key[0]]) @ known[key[1]]
            refined = pairwise.refine(a, b, T)[0]
            return [pairwise.score_pose(a, b, refined if pairwise.same(refined, T, a.side_mm, b) else T)]
        poses = pairwise.candidate_poses(a, b, _most_tilt(params), efforts)
        if key[0] in starts and key[1] in starts:
            T = rigid.invert(starts[key[0]]) @ starts[key[1]]
            poses += pairwise.candidate_poses(a, b, np.inf, [pairwise.BESIDE], T)[:1]
        if key in picked:
            in_a, in_b = picked[key]
            with suppress(three_point.TooFewError):
                T = three_point.fit_pair(in_a - a.cloud.origin, in_b - b.cloud.origin, False).T_a_b
                poses.append(pairwise.score_pose(a, b, pairwise.refine(a, b, T)[0]))
        return sorted(poses, key=lambda pose: -pose.score)

    keys = list(itertools.combinations(range(len(patches)), 2))
    return dict(zip(keys, thread_ranges.each(candidates, keys), strict=True))


def _adjust(clouds: list[Cloud], cells: CellTable, T: Floats, reference: int) -> tuple[Solution, Blocks]:
    """Adjust all poses on shared pieces with narrowing gates: faces alone, then along loose motions, then with ends."""
    if not len(cells.sums):
        none = np.empty(0, np.int64)
        blocks = Blocks(
            piece=none, scan=none, sums=np.empty((0, 10)), count=np.empty(0), kind=none, pieces=0,
            rays=np.empty((0, 3, 7)), face=none,
        )  # fmt: skip
        return bundle_adjustment.solve(blocks, T, reference), blocks
    ranges = np.zeros((len(T), 2))
    for gate in GATES:
        blocks = correspondences.segment(cells, T, gate * cells.size_mm, ranges).shared()
        solution = bundle_adjustment.solve(blocks, T, reference, slack_mm=gate * cells.size_mm)
        T, ranges = solution.T, solution.of_scans
    pieces = correspondences.segment(cells, T, 0.0, ranges)
    faces = bundle_adjustment.solve(pieces.shared(), T, reference)
    T = edge_constraints.resolve_loose_motions(clouds, pieces, faces, REACH * cells.size_mm)
    for gate in (*END_GATES, *[0.0] * MOST_FINAL):
        pieces = correspondences.segment(cells, T, 0.0, ranges)
        blocks = edge_constraints.with_ends(clouds, pieces, T, gate * cells.size_mm).shared()
        solution = bundle_adjustment.solve(blocks, T, reference, slack_mm=gate * cells.size_mm)
        before, T, ranges = T, solution.T, solution.of_scans
        # Between the origins of the scans
        shift = np.linalg.norm(T[:, :3, 3] - before[:, :3, 3], axis=1)
        shift_mm = float(np.nanmax(shift)) if np.isfinite(shift).any() else 0.0
        if gate == 0.0 and shift_mm < STILL_MM:
            break
    return solution, blocks


def _without_gross_pairs(
    blocks: Blocks, solution: Solution, gross: set[tuple[int, int]], reference: int
) -> tuple[Solution, Blocks]:
    """Adjust again without the pieces that only the two scans (a, b) of a gross pair share."""
    scans_of: dict[int, set[int]] = {}
    for piece, scan in zip(blocks.piece.tolist(), blocks.scan.tolist(), strict=True):
        scans_of.setdefault(piece, set()).add(scan)
    out = {piece for piece, scans in scans_of.items() if len(scans) == 2 and (min(scans), max(scans)) in gross}
    keep = np.array([piece not in out for piece in blocks.piece.tolist()], bool)
    blocks = blocks.take(keep).shared()
    return bundle_adjustment.solve(blocks, solution.T, reference), blocks
