"""Scans placed one after another, each where all that stand already speak for it; rivals are remembered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import Floats
from processor.stitching.coarse import pairwise
from processor.stitching.coarse.pairwise import Placing, View

MOST_TRIED = 5
AMBIGUOUS = 0.75  # of the best pose's score: a rival that reaches it cannot be told from it
LEAST_OVERLAP = 0.08

Candidates = dict[tuple[int, int], list[Placing]]
Asked = dict[tuple[int, int, bytes], Placing]  # poses of scan j beside scan i that have been looked at


@dataclass(frozen=True)
class Placed:
    """Poses T_ref_scan (k, 4, 4), NaN of scans without one; a rival's share of the best score (k,) and pose.

    ``contrary`` (k,) is what speaks against a scan's pose by what speaks for it, ``overlap`` (k,) its largest.
    """

    T: Floats
    rivalry: Floats
    T_rival: Floats
    contrary: Floats
    overlap: Floats


def towards(candidates: Candidates, i: int, j: int) -> list[tuple[Floats, float]]:
    """Poses of j in i with their scores, whichever of the two was the first of the pair."""
    if (i, j) in candidates:
        return [(one.T_a_b, one.score) for one in candidates[i, j]]
    return [(rigid.invert(one.T_a_b), one.score) for one in candidates.get((j, i), [])]


def place(views: list[View], candidates: Candidates, reference: int) -> Placed:
    """Place all scans that can be, the surest first."""
    k = len(views)
    T = np.full((k, 4, 4), np.nan)
    T[reference] = np.eye(4)
    rivalry, T_rival = np.zeros(k), np.full((k, 4, 4), np.nan)
    contrary, overlap = np.zeros(k), np.ones(k)
    done = [reference]
    asked: Asked = {}
    while len(done) < k:
        best: tuple[float, int, list[tuple[float, Floats]]] | None = None
        for j in sorted(set(range(k)) - set(done)):
            ranked = ranking(views, candidates, T, done, j, asked)
            if not ranked:
                continue
            sure = ranked[0][0] - (ranked[1][0] if len(ranked) > 1 else 0.0)
            if best is None or sure > best[0]:
                best = (sure, j, ranked)
        if best is None:
            break
        _, j, ranked = best
        T[j] = ranked[0][1]
        done.append(j)
    for j in done:
        others = [i for i in done if i != j]
        if j == reference or not others:
            continue
        ranked = ranking(views, candidates, T, others, j, asked, T[j])
        own = next(s for s, pose in ranked if pairwise.same(pose, T[j], views[0].side_mm, views[j]))
        rivals = [(s, p) for s, p in ranked if not pairwise.same(p, T[j], views[0].side_mm, views[j])]
        if rivals:
            rivalry[j] = rivals[0][0] / max(own, 1e-12)
            T_rival[j] = rivals[0][1]
        all_held = [held(views, T, i, j, T[j], asked) for i in others]
        agree = sum(one.agree for one in all_held if one.overlap > LEAST_OVERLAP)
        contrary[j] = sum(one.against for one in all_held) / max(agree, 1e-12)
        overlap[j] = max(one.overlap for one in all_held)
    return Placed(T, rivalry, T_rival, contrary, overlap)


def refuted(held: dict[tuple[int, int], Placing], count: int, reference: int) -> Floats:
    """Return what speaks against poses as found (count,), of what speaks for them; 0 where they are sure enough.

    ``held`` is what each pair has to say. Asked only of scans that rest on one other alone: a structure that repeats
    itself looks so, one bay on or turned round. Where several tell the same, they would all have to be wrong.
    """
    found = np.zeros(count)
    for j in set(range(count)) - {reference}:
        own = [one for pair, one in held.items() if j in pair]
        supporting = [one for one in own if one.overlap > LEAST_OVERLAP]
        against = sum(one.against for one in own)
        if len(supporting) == 1 and against > pairwise.LITTLE_AGAINST * supporting[0].agree:
            found[j] = against / supporting[0].agree
    return found


def held(views: list[View], T: Floats, i: int, j: int, pose: Floats, asked: Asked) -> Placing:
    """Count what speaks for and against a pose (4, 4) of scan j, beside scan i at its pose in T (k, 4, 4).

    T of a scan does not change once it has one: what was asked before is remembered.
    """
    key = (i, j, pose.tobytes())
    if key not in asked:
        side, T_i_j = views[i].side_mm, rigid.invert(T[i]) @ pose
        asked[key] = pairwise.held(views[i], views[j], T_i_j, pairwise.NEAR * side, pairwise.MARGIN * side)
    return asked[key]


def ranking(
    views: list[View],
    candidates: Candidates,
    T: Floats,
    done: list[int],
    j: int,
    asked: Asked,
    own: Floats | None = None,
) -> list[tuple[float, Floats]]:
    """Poses of scan j with the score that all of ``done`` give them together, the best first.

    Each scan has a pose a little elsewhere: by that from one alone, a decimetre off, the right one may look wrong to
    the others. A pose is worth what the best of them is.
    """
    poses: list[tuple[list[Floats], float]] = [] if own is None else [([own], np.inf)]
    for i in done:
        for T_i_j, score in towards(candidates, i, j):
            pose = T[i] @ T_i_j
            for row, (alike, sum_) in enumerate(poses):
                if pairwise.same(alike[0], pose, views[0].side_mm, views[j]):
                    poses[row] = ([*alike, pose], sum_ + score)
                    break
            else:
                poses.append(([pose], score))
    poses.sort(key=lambda one: -one[1])
    found = []
    for alike, _ in poses[:MOST_TRIED]:
        scores = [together(views, T, done, j, one, asked) for one in alike]
        best = int(np.argmax(scores))
        if scores[best] > 0.0:
            found.append((scores[best], alike[best]))
    found.sort(key=lambda one: -one[0])
    return found


def together(views: list[View], T: Floats, done: list[int], j: int, pose: Floats, asked: Asked) -> float:
    """Return the score that all of ``done`` give a pose (4, 4) of scan j together; 0 where none agrees."""
    agree, against, total = 0.0, 0.0, 0.0
    for i in done:
        one = held(views, T, i, j, pose, asked)
        against += one.against
        if one.overlap > LEAST_OVERLAP:
            agree += one.agree
            total += one.agree / one.overlap
    return pairwise.score(agree, against, total)
