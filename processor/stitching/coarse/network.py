"""Coarse registration of all scans, one after another by the scans placed before; competing poses are recorded."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from processor.distinct_rows import components
from processor.geometry import rigid
from processor.model import Floats, Ints
from processor.stitching.coarse import pairwise
from processor.stitching.coarse.pairwise import ScanPatches, ScoredPose

MOST_TRIED = 5  # work: groups of competing poses of a scan that are scored with all others
AMBIGUOUS = 0.75  # of the best pose's score: a competing pose that reaches it is as likely
LEAST_OVERLAP = 0.08  # chosen: of patches: below it a pair agrees or disagrees by chance

Pairs = dict[tuple[int, int], list[ScoredPose]]
RankedPoses = list[tuple[float, Floats]]  # (score, pose), the best first


@dataclass(frozen=True)
class CoarsePoses:
    """Poses T_ref_scan (k, 4, 4), NaN of scans without one; score of the best competing pose by theirs (k,), its pose.

    ``contrary`` (k,) is the contradiction of a scan's pose by its support, ``overlap`` (k,) the largest with another.
    """

    T: Floats
    rivalry: Floats
    T_rival: Floats
    contrary: Floats
    overlap: Floats


@dataclass(frozen=True)
class Network:
    """All scans with the candidate poses of their pairs, and the poses T (k, 4, 4) of those placed so far.

    Scores of relative poses are cached.
    """

    scans: list[ScanPatches]
    candidates: Pairs
    T: Floats
    placed: list[int]
    cache: dict[tuple[int, int, bytes, bytes], ScoredPose] = field(default_factory=dict)

    def poses_beside(self, i: int, j: int) -> list[tuple[Floats, float]]:
        """Return the candidate poses of scan j in scan i with their scores, in either order of the pair."""
        if (i, j) in self.candidates:
            return [(pose.T_a_b, pose.score) for pose in self.candidates[i, j]]
        return [(rigid.invert(pose.T_a_b), pose.score) for pose in self.candidates.get((j, i), [])]

    def score_beside(self, i: int, j: int, pose: Floats) -> ScoredPose:
        """Score a pose (4, 4) of scan j beside the placed scan i."""
        key = (i, j, self.T[i].tobytes(), pose.tobytes())
        if key not in self.cache:
            self.cache[key] = pairwise.score_pose(self.scans[i], self.scans[j], rigid.invert(self.T[i]) @ pose)
        return self.cache[key]

    def same(self, T: Floats, S: Floats, j: int) -> bool:
        """Return whether two poses of scan j are the same."""
        return pairwise.same(T, S, self.scans[0].side_mm, self.scans[j])


def place(scans: list[ScanPatches], candidates: Pairs, reference: int) -> CoarsePoses:
    """Place all scans that have candidate poses, the most certain first; the reference at the identity."""
    k = len(scans)
    T = np.full((k, 4, 4), np.nan)
    T[reference] = np.eye(4)
    network = Network(scans=scans, candidates=candidates, T=T, placed=[reference])
    while (best := _most_certain(network)) is not None:
        j, pose = best
        T[j] = pose
        network.placed.append(j)
    coarse = _rated(network, reference)
    moves = _moves(network, coarse, reference)
    for _ in range(k):
        better = max(moves, key=lambda move: move.ratio, default=None)
        if better is None or better.ratio <= 1.0:
            break
        for j in better.scans:
            T[j] = better.M @ T[j]
        coarse = _rated(network, reference)
        moves = _moves(network, coarse, reference)
    return _with_moves(coarse, moves)


@dataclass(frozen=True)
class Move:
    """A motion M (4, 4) of some scans together, and the score of what lies across by that without the motion."""

    scans: list[int]
    M: Floats
    ratio: float


def _moves(network: Network, coarse: CoarsePoses, reference: int) -> list[Move]:
    """Return the motions that rival poses of single pairs suggest, each of the scans that move along best.

    In a hall of nearly equal bays not one scan alone may stand a bay off, but all those beyond it too: beside these,
    any other pose of a single one is contradicted. Of a pair either scan moves, unless both are ambiguous already.
    """
    moves = list[Move]()
    ambiguous = set(np.flatnonzero(coarse.rivalry > AMBIGUOUS).tolist())
    for i, j in itertools.permutations(network.placed, 2):
        now = network.score_beside(i, j, network.T[j])
        for T_i_j, score in network.poses_beside(i, j):
            wanted = network.T[i] @ T_i_j
            if {i, j} <= ambiguous or score <= AMBIGUOUS * now.score or network.same(wanted, network.T[j], j):
                continue
            move = _followers(network, i, j, wanted @ rigid.invert(network.T[j]))
            if reference in move.scans:
                rest = [s for s in network.placed if s not in move.scans]
                move = Move(scans=rest, M=rigid.invert(move.M), ratio=move.ratio)
            moves.append(move)
            if move.ratio > AMBIGUOUS:
                ambiguous |= set(move.scans)
    return moves


def _followers(network: Network, i: int, j: int, M: Floats) -> Move:
    """Return the motion of j by M (4, 4) while i stays, with the scans that follow as the score across rises."""
    size = len(network.scans)
    before, after = np.zeros((size, size, 3)), np.zeros((size, size, 3))
    for a in network.placed:
        for b in set(network.placed) - {a}:
            for table, pose in ((before, network.T[b]), (after, M @ network.T[b])):
                scored = network.score_beside(a, b, pose)
                supports = scored.overlap > LEAST_OVERLAP
                table[a, b] = (scored.agree, scored.against, scored.agree / scored.overlap) if supports else (
                    0.0, scored.against, 0.0
                )  # fmt: skip

    def ratio(moving: list[int]) -> float:
        across = np.ix_([s for s in network.placed if s not in moving], moving)
        first, second = (pairwise.score(*table[across].sum(axis=(0, 1))) for table in (after, before))
        return first / max(second, 1e-12)

    moving, rest = [j], [s for s in network.placed if s not in (i, j)]
    best = ratio(moving)
    while rest:
        ratios = [ratio([*moving, s]) for s in rest]
        row = int(np.argmax(ratios))
        if ratios[row] <= best:
            break
        best = ratios[row]
        moving.append(rest.pop(row))
    return Move(scans=moving, M=M, ratio=best)


def _with_moves(coarse: CoarsePoses, moves: list[Move]) -> CoarsePoses:
    """Enter motions of groups of scans as rivals of the poses of all scans that move."""
    rivalry, T_rival = coarse.rivalry.copy(), coarse.T_rival.copy()
    for move in moves:
        for s in move.scans:
            if move.ratio > rivalry[s]:
                rivalry[s], T_rival[s] = move.ratio, move.M @ coarse.T[s]
    return replace(coarse, rivalry=rivalry, T_rival=T_rival)


def _most_certain(network: Network) -> tuple[int, Floats] | None:
    """Return the scan whose best pose leads the next best one by the largest score, and this pose."""
    best: tuple[int, Floats] | None = None
    best_lead = 0.0
    for j in sorted(set(range(len(network.scans))) - set(network.placed)):
        ranked = rank_poses(network, j, network.placed)
        if not ranked:
            continue
        lead = ranked[0][0] - (ranked[1][0] if len(ranked) > 1 else 0.0)
        if best is None or lead > best_lead:
            best, best_lead = (j, ranked[0][1]), lead
    return best


def _rated(network: Network, reference: int) -> CoarsePoses:
    """Compare each placed scan's pose with its competitors, beside all other placed scans."""
    T, k = network.T, len(network.scans)
    rivalry, T_rival = np.zeros(k), np.full((k, 4, 4), np.nan)
    contrary, overlap = np.zeros(k), np.ones(k)
    for j in network.placed:
        others = [i for i in network.placed if i != j]
        if j == reference or not others:
            continue
        ranked = rank_poses(network, j, others, T[j])
        # A pose that overlaps with none of the others, or that free space contradicts wholly, is not ranked.
        best = next((score for score, pose in ranked if network.same(pose, T[j], j)), 0.0)
        rivals = [(score, pose) for score, pose in ranked if not network.same(pose, T[j], j)]
        if rivals:
            rivalry[j] = rivals[0][0] / max(best, 1e-12)
            T_rival[j] = rivals[0][1]
        scored = [network.score_beside(i, j, T[j]) for i in others]
        agree = sum(pose.agree for pose in scored if pose.overlap > LEAST_OVERLAP)
        contrary[j] = sum(pose.against for pose in scored) / max(agree, 1e-12)
        overlap[j] = max(pose.overlap for pose in scored)
    return CoarsePoses(T=T, rivalry=rivalry, T_rival=T_rival, contrary=contrary, overlap=overlap)


def rank_poses(network: Network, j: int, others: list[int], current: Floats | None = None) -> RankedPoses:
    """Rank poses of scan j by their joint scores beside placed scans ``others``; ``current`` is one more candidate.

    Candidates from different scans differ slightly. One that is a decimetre off may be contradicted by the other scans
    although it is right: a group of candidates that are the same pose has the score of its best member.
    """
    groups: list[tuple[list[Floats], float]] = [] if current is None else [([current], np.inf)]
    for i in others:
        for T_i_j, score in network.poses_beside(i, j):
            pose = network.T[i] @ T_i_j
            for row, (members, total) in enumerate(groups):
                if network.same(members[0], pose, j):
                    groups[row] = ([*members, pose], total + score)
                    break
            else:
                groups.append(([pose], score))
    groups.sort(key=lambda group: -group[1])
    ranked = []
    for members, _ in groups[:MOST_TRIED]:
        scores = [joint_score(network, j, others, pose) for pose in members]
        best = int(np.argmax(scores))
        if scores[best] > 0.0:
            ranked.append((scores[best], members[best]))
    ranked.sort(key=lambda pair: -pair[0])
    return ranked


def joint_score(network: Network, j: int, others: list[int], pose: Floats) -> float:
    """Return the score of a pose (4, 4) of scan j beside placed scans together; 0 if it overlaps with none of them."""
    agree, against, total = 0.0, 0.0, 0.0
    for i in others:
        scored = network.score_beside(i, j, pose)
        against += scored.against
        if scored.overlap > LEAST_OVERLAP:
            agree += scored.agree
            total += scored.agree / scored.overlap
    return pairwise.score(agree, against, total)


def groups(candidates: Pairs, count: int, known: list[int]) -> Ints:
    """Return the group (count,) of each scan: those joined by pairs with a pose that free space does not contradict.

    Scans of ``known`` poses are one group.
    """
    sure = [pair for pair, poses in candidates.items() if poses and poses[0].score > pairwise.SURE]
    sure += [(known[0], other) for other in known[1:]]
    return components(count, *np.reshape(np.array(sure, np.int64), (-1, 2)).T)


def without_moved(
    scans: Sequence[ScanPatches], T: Floats, poses: dict[tuple[int, int], ScoredPose]
) -> dict[tuple[int, int], ScoredPose]:
    """Return the adjusted ``poses`` of pairs without what contradicts them because it moved between the scans.

    A crane or truck is seen at its place by one scan alone, and several others look through that place. Where the poses
    are wrong, what one scan looks through is seen there by others as well, or by no other at all.
    """
    placed = sorted({s for pair in poses for s in pair})
    against: dict[tuple[int, int], Floats] = {}
    for a in placed:
        matches, refuters = np.zeros((2, len(scans[a].patches.weight)), np.int64)
        for b in placed:
            if a != b:
                match, against[a, b] = pairwise.compare(scans[a], scans[b], rigid.invert(T[b]) @ T[a])
                matches += match
                refuters += against[a, b] > 0.0
        for b in placed:
            if a != b:
                against[a, b] = against[a, b][(matches > 0) | (refuters < 2)].sum()
    return {(a, b): replace(pose, against=float(against[a, b] + against[b, a])) for (a, b), pose in poses.items()}


def links(poses: dict[tuple[int, int], ScoredPose]) -> list[tuple[int, int]]:
    """Return the pairs of scans that overlap and of which free space does not contradict the adjusted pose."""
    return [
        pair
        for pair, pose in poses.items()
        if pose.overlap > LEAST_OVERLAP and pose.against <= pairwise.LITTLE_AGAINST * pose.agree
    ]


def refuted(poses: dict[tuple[int, int], ScoredPose], count: int, reference: int) -> Floats:
    """Return the contradiction by free space of each scan's pose by its support (count,), 0 where it is negligible.

    ``poses`` are the adjusted relative poses of all pairs. Only scans that overlap with a single other one are checked:
    there a repetitive structure may be matched one bay off or turned round. Several overlaps are not all wrong.
    """
    ratio = np.zeros(count)
    for j in set(range(count)) - {reference}:
        of_scan = [pose for pair, pose in poses.items() if j in pair]
        supporting = [pose for pose in of_scan if pose.overlap > LEAST_OVERLAP]
        against = sum(pose.against for pose in of_scan)
        if len(supporting) == 1 and against > pairwise.LITTLE_AGAINST * supporting[0].agree:
            ratio[j] = against / supporting[0].agree
    return ratio
