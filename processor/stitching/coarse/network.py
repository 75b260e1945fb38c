"""Coarse registration of all scans, one after another by the scans placed before; competing poses are recorded."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from processor.distinct_rows import components
from processor.geometry import rigid
from processor.model import Bools, Floats, Ints
from processor.stitching.coarse import pairwise
from processor.stitching.coarse.pairwise import ScanPatches, ScoredPose

MOST_TRIED = 5  # work: groups of competing poses of a scan that are scored with all others
MOST_PLACINGS = 4  # work: each leaves out what the poses of the one before say has moved
MOVED_SHARE = 0.1  # chosen: of a contradiction that is taken as of what moved: the fewer things moved the better
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

    @classmethod
    def unrivalled(cls, T: Floats) -> CoarsePoses:
        """Return poses that nothing is known against."""
        k = len(T)
        return cls(
            T=T, rivalry=np.zeros(k), T_rival=np.full((k, 4, 4), np.nan), contrary=np.zeros(k), overlap=np.ones(k)
        )


@dataclass(frozen=True)
class Network:
    """All scans with the candidate poses of their pairs, and the poses T (k, 4, 4) of those placed so far.

    ``still`` marks the patches of each scan that are evidence; without it all are, under any poses. Comparisons and
    scores of pairs are cached.
    """

    scans: list[ScanPatches]
    candidates: Pairs
    T: Floats
    placed: list[int]
    still: list[Bools] | None = None
    cache: dict[tuple[int, int, bytes], tuple[Bools, Floats]] = field(default_factory=dict)
    scores: dict[tuple[int, int, bytes], ScoredPose] = field(default_factory=dict)  # by all patches

    def poses_beside(self, i: int, j: int) -> list[tuple[Floats, float]]:
        """Return the candidate poses of scan j in scan i with their scores, in either order of the pair."""
        if (i, j) in self.candidates:
            return [(pose.T_a_b, pose.score) for pose in self.candidates[i, j]]
        return [(rigid.invert(pose.T_a_b), pose.score) for pose in self.candidates.get((j, i), [])]

    def compared(self, a: int, b: int, T_b_a: Floats) -> tuple[Bools, Floats]:
        """Compare the patches of scan a with scan b, see :func:`pairwise.compare`."""
        key = (a, b, T_b_a.tobytes())
        if key not in self.cache:
            self.cache[key] = pairwise.compare(self.scans[a], self.scans[b], T_b_a)
        return self.cache[key]

    def score_of(self, a: int, b: int, T_a_b: Floats, still: list[Bools] | None = None) -> ScoredPose:
        """Score a relative pose of two scans, by the patches ``still`` or those of the network."""
        still = still or self.still
        if still is None:
            key = (a, b, T_a_b.tobytes())
            if key not in self.scores:
                self.scores[key] = pairwise.score_pose(self.scans[a], self.scans[b], T_a_b)
            return self.scores[key]
        weights = [self.scans[s].patches.weight for s in (a, b)]
        compared = [self.compared(a, b, rigid.invert(T_a_b)), self.compared(b, a, T_a_b)]
        return pairwise.summed(T_a_b, weights, compared, [still[a], still[b]])

    def score_beside(self, i: int, j: int, pose: Floats, still: list[Bools] | None = None) -> ScoredPose:
        """Score a pose (4, 4) of scan j beside the placed scan i."""
        return self.score_of(i, j, rigid.invert(self.T[i]) @ pose, still)

    def still_with(self, moving: Sequence[int], poses: Sequence[Floats]) -> list[Bools] | None:
        """Return the patches that are evidence if the scans ``moving`` had other ``poses``; None: all, as by now."""
        if self.still is None:
            return None
        T = self.T.copy()
        for s, pose in zip(moving, poses, strict=True):
            T[s] = pose
        return self.without_moved(T)

    def without_moved(self, T: Floats, is_moved: bool = True) -> list[Bools]:
        """Mark the patches of scans at poses T (k, 4, 4) but those of what moved between the scans, and of panes.

        A crane or truck is seen at its place by one scan, or by few where it slid along itself, and more others look
        through that place. A scan that is wrong by itself looks through what the majority of the others sees, which
        remains. Of patches that one scan alone saw and one other looked through, either may be wrong: they are left
        out beside a larger weight of sure ones. Unless something ``is_moved`` between any two scans, those alone are
        left out that one scan saw and two or more look through.
        """
        placed = np.flatnonzero(np.isfinite(T).all(axis=(1, 2))).tolist()
        still = []
        for a, scan in enumerate(self.scans):
            weight = scan.patches.weight
            matches, refuters = np.zeros((2, len(weight)), np.int64)
            for b in set(placed) - {a} if a in placed else ():
                match, against = self.compared(a, b, rigid.invert(T[b]) @ T[a])
                matches += match
                refuters += against > 0.0
            moved = (refuters > 1) & (refuters > (matches if is_moved else refuters * (matches > 0)))
            undecided = (refuters == 1) & (matches == 0)
            if is_moved and weight[undecided].sum() < weight[moved].sum():
                moved |= undecided
            still.append(~moved)
        return still

    def same(self, T: Floats, S: Floats, j: int) -> bool:
        """Return whether two poses of scan j are the same."""
        return pairwise.same(T, S, self.scans[0].side_mm, self.scans[j])


def nothing_sure(candidates: Pairs) -> bool:
    """Return whether free space contradicts all poses of all pairs, as where something moves between any two scans.

    Else nothing is taken as moved: in a hall of equal bays scans that lie on each other explain all that tells bays
    apart as moved, and the right poses are preferred only because nothing has to move.
    """
    return not any(pose.score > pairwise.SURE for poses in candidates.values() for pose in poses)


def place(scans: list[ScanPatches], candidates: Pairs, reference: int, is_moved: bool) -> Network:
    """Place all scans that have candidate poses; if something ``is_moved``, without what these poses say it is."""
    network = _placed(Network(scans, candidates, np.full((len(scans), 4, 4), np.nan), []), reference)
    for _ in range(MOST_PLACINGS if is_moved else 0):
        still = network.without_moved(network.T)
        if all(map(np.array_equal, still, network.still or map(np.ones_like, still))):
            break
        network = replace(network, still=still)
        found = {
            (a, b): sorted((network.score_of(a, b, pose.T_a_b) for pose in poses), key=lambda pose: -pose.score)
            for (a, b), poses in candidates.items()
        }
        network = _placed(replace(network, candidates=found), reference)
        for j in set(network.placed) - {reference}:  # to the poses that are best with what would have moved by them
            if ranked := rank_poses(network, j, [i for i in network.placed if i != j], network.T[j]):
                network.T[j] = ranked[0][1]
        rated(network, reference)  # moves groups of scans
    return network


def _placed(network: Network, reference: int) -> Network:
    """Place scans one after another, the most certain first; the reference at the identity."""
    network = replace(network, T=np.full_like(network.T, np.nan), placed=[reference])
    network.T[reference] = np.eye(4)
    while (best := _most_certain(network)) is not None:
        j, pose = best
        network.T[j] = pose
        network.placed.append(j)
    return network


def rated(network: Network, reference: int) -> CoarsePoses:
    """Move groups of placed scans while that is better, and compare the poses with those that compete with them."""
    T = network.T
    coarse = _rated(network, reference)
    moves = _moves(network, coarse, reference)
    for _ in network.scans:
        better = max(moves, key=lambda move: move.ratio, default=None)
        if better is None or better.ratio <= 1.0:
            break
        for j in better.scans:
            T[j] = better.M @ T[j]
        network = replace(network, still=network.still_with((), ()))
        coarse = _rated(network, reference)
        moves = _moves(network, coarse, reference)
    for move in moves:  # rivals of the poses of all scans that move
        for s in move.scans:
            if move.ratio > coarse.rivalry[s]:
                coarse.rivalry[s], coarse.T_rival[s] = move.ratio, move.M @ coarse.T[s]
    return coarse


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
    tables = np.zeros((2, size, size, 3))  # before and after, by all patches
    for a, b in itertools.permutations(network.placed if network.still is None else (), 2):
        for table, pose in zip(tables, (network.T[b], M @ network.T[b]), strict=True):
            table[a, b] = _evidence(network.score_beside(a, b, pose))

    def ratio(moving: list[int]) -> float:
        rest = [s for s in network.placed if s not in moving]
        if network.still is None:
            now, then = (pairwise.score(*table[np.ix_(rest, moving)].sum(axis=(0, 1))) for table in tables)
        else:
            poses = [M @ network.T[s] for s in moving]
            now = _across(network, rest, moving, [network.T[s] for s in moving], network.still)
            then = _across(network, rest, moving, poses, network.still_with(moving, poses))
        return then / max(now, 1e-12)

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
    T, coarse = network.T, CoarsePoses.unrivalled(network.T)
    for j in network.placed:
        others = [i for i in network.placed if i != j]
        if j == reference or not others:
            continue
        ranked = rank_poses(network, j, others, T[j])
        # A pose that overlaps with none of the others, or that free space contradicts wholly, is not ranked.
        best = next((score for score, pose in ranked if network.same(pose, T[j], j)), 0.0)
        rivals = [(score, pose) for score, pose in ranked if not network.same(pose, T[j], j)]
        if rivals:
            coarse.rivalry[j] = rivals[0][0] / max(best, 1e-12)
            coarse.T_rival[j] = rivals[0][1]
        scored = [network.score_beside(i, j, T[j]) for i in others]
        agree = sum(pose.agree for pose in scored if pose.overlap > LEAST_OVERLAP)
        coarse.contrary[j] = sum(pose.against for pose in scored) / max(agree, 1e-12)
        coarse.overlap[j] = max(pose.overlap for pose in scored)
    return coarse


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
    is_whole = len(others) + 1 == len(network.placed)  # else what few scans have seen does not show what moved
    return _across(network, others, [j], [pose], network.still_with([j], [pose]) if is_whole else network.still)


def _across(
    network: Network, rest: list[int], moving: list[int], poses: list[Floats], still: list[Bools] | None
) -> float:
    """Return the score of scans ``moving`` at ``poses`` beside others together; 0 if no two of them overlap."""
    found = [
        _evidence(network.score_beside(i, j, pose, still))
        for i, (j, pose) in itertools.product(rest, zip(moving, poses, strict=True))
    ]
    return pairwise.score(*np.sum(found, axis=0).tolist())


def _evidence(scored: ScoredPose) -> tuple[float, float, float]:
    """Return the support of a pose, 0 by little overlap, what contradicts it, and the weight of all patches."""
    against = scored.against + MOVED_SHARE * scored.moved
    supports = scored.overlap > LEAST_OVERLAP
    return (scored.agree, against, scored.agree / scored.overlap) if supports else (0.0, against, 0.0)


def groups(candidates: Pairs, count: int, known: list[int]) -> Ints:
    """Return the group (count,) of each scan: those joined by pairs with a pose that free space does not contradict.

    Scans of ``known`` poses are one group.
    """
    sure = [pair for pair, poses in candidates.items() if poses and poses[0].score > pairwise.SURE]
    sure += [(known[0], other) for other in known[1:]]
    return components(count, *np.reshape(np.array(sure, np.int64), (-1, 2)).T)


def scores(scans: list[ScanPatches], T: Floats, is_moved: bool) -> dict[tuple[int, int], ScoredPose]:
    """Score the relative poses of all pairs of scans with poses T (k, 4, 4), without what moved between the scans.

    Unless something ``is_moved`` between any two of them, this is what one scan alone saw and two or more look through.
    """
    placed = np.flatnonzero(np.isfinite(T).all(axis=(1, 2))).tolist()
    network = Network(scans, {}, T, placed)
    still = network.without_moved(T, is_moved)
    return {(a, b): network.score_beside(a, b, T[b], still) for a, b in itertools.combinations(placed, 2)}


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
