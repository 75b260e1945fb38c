"""Which node is which: the pattern of found nodes against a design's, in the same frame or in any other.

The design's own frame is tried first. Where it does not explain the pattern, poses are searched
(:mod:`processor.space_frame.design.constellation`) and held against all that is known: how many nodes agree and how
closely, the balls' radii, the members. A regular grid looks the same one bay on, or turned; then what differs must
decide, and if nothing does the answer is ``ambiguous`` and names every candidate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.model import Checked, Floats, FrameDesign, Ints, column
from processor.space_frame.design import constellation

SAME, REGISTERED = "same frame", "registered"
TOLERANCE_MM = 60.0  # that a node may be off its nominal place
LEAST_SHARE = 0.5  # of the smaller pattern's nodes that must agree
DOUBTFUL_SHARE = 0.05  # missing and extra nodes both: another pose may explain them
DOUBTED_SHARE = 0.1  # of the nodes: where a pose leads by no more of them, balls are asked too
FAR = 2.0  # tolerances: a node farther from its nominal place is another node
NODE_ODDS = 4.0  # log odds that a pose loses by a found node that is none of the design's while one of those is missing
INDEPENDENT = 20  # nodes' distances count as at most so many: those of neighbours go together
DECISIVE = 7.0  # log odds, 1000 to 1
NEAR = 19  # nodes about one that may be a bay's length off
UPRIGHT_COS = 0.996  # 5 degrees
TUKEY = 4.685
MEDIAN_OF_3 = 1.538  # of the length of a normal vector in space, per sd


@dataclass(frozen=True)
class Matching(Checked):
    """Which found node is which of the design, and the pose that says so.

    ``T_design_scan`` maps coordinates of the scan (the origin put back) to the design's frame; ``covariance`` (turn
    about the design frame's axes, translation; T = exp(xi) T) takes the nodes' movements for random: it says how well
    the nodes tell the frame. It is 0 where the frame was found to be the design's own, for then nothing was estimated.
    ``T_best_fit`` is the best fit over all matched nodes in either case.
    """

    status: str  # ok | ambiguous | failed
    how: str = ""  # same frame | registered
    message: str = ""
    T_design_scan: Floats = column(4, 4)
    covariance: Floats = column(6, 6)
    T_best_fit: Floats = column(4, 4)
    assignment: Ints = column("k", dtype=np.int64)  # row of the design of each found node, -1 = extra
    weight: Floats = column("k")  # of each node in the best fit
    missing: Ints = column("d", dtype=np.int64)  # rows of the design without a node
    rivals: Floats = column("r", 4, 4)  # other T_design_scan that explain as much
    scatter_mm: float = float("nan")  # of the matched nodes about their nominal places, sd an axis, robust


@dataclass(frozen=True)
class _Candidate:
    """A pose T_design_found of local coordinates, what it assigns, and its log odds (less is better)."""

    T: Floats
    assignment: Ints
    weight: Floats
    rms: float
    odds: float

    @property
    def matched(self) -> int:
        return int((self.assignment >= 0).sum())


def match(
    found: Found,
    design: FrameDesign,
    tolerance_mm: float = TOLERANCE_MM,
    expansion: float = 1.0,
    sized: Callable[[], Found] | None = None,
) -> Matching:
    """Match found nodes with a design's, each being up to about ``tolerance_mm`` off its nominal place.

    ``expansion`` is the factor of all lengths by temperature. Up to a good part of the nodes may be missing or extra.
    ``sized`` gives the same nodes with their balls' radii, where ``found`` has none: it is called only where the
    pattern leaves more than one pose.
    """
    k, middle = len(found.positions), design.centres.mean(axis=0) if len(design.centres) else np.zeros(3)
    nominal = (design.centres - middle) * expansion
    if k == 0 or len(nominal) == 0:
        return _failed(k, len(nominal), "no nodes" if k == 0 else "the design has no nodes")
    to_design = rigid.transform(np.eye(3), found.origin - middle)
    same = _judged(to_design, found, design, nominal, tolerance_mm, fit=False)
    least = LEAST_SHARE * min(k, len(nominal))
    fits = same is not None and same.matched >= least
    if same is not None and fits:
        lacking, extra = 1.0 - same.matched / len(nominal), 1.0 - same.matched / k
        few = min(lacking, extra) <= DOUBTFUL_SHARE or k < 4
        if few or not _better_nearby(to_design, same.matched, found.positions, nominal, tolerance_mm):
            return _answer(same, [], SAME, found, design, middle, nominal, "")
    candidates = _searched(found, design, nominal, tolerance_mm) if k >= 4 and len(nominal) >= 4 else []
    candidates = [one for one in candidates if one.matched >= max(least, 4)]
    every = [same, *candidates] if same is not None and fits else candidates
    every = _by_radii(every, design, min(k, len(nominal)), sized)
    if same is not None and fits:
        same, candidates = every[0], every[1:]
        apart = 5.0 * tolerance_mm
        rivals = [
            one for one in candidates
            if one.odds < same.odds - DECISIVE and not _alike(one.T, to_design, found.positions, apart)
        ]  # fmt: skip
        said = "the frames agree, but another pose explains more nodes" if rivals else ""
        return _answer(same, rivals[:1], SAME, found, design, middle, nominal, said)
    if not every:
        return _failed(k, len(nominal), "no pose lays half of the nodes onto the design's")
    return _chosen(every, found, design, middle, nominal)


def _by_radii(
    candidates: list[_Candidate], design: FrameDesign, most: int, sized: Callable[[], Found] | None
) -> list[_Candidate]:
    """Weigh candidates by the balls' radii too, if there are several that so many as ``most`` nodes do not decide on.

    A true pose may lose to a false one by the nodes that the one lacks and the other happens to have: what few nodes
    say is not taken for an answer before the balls were asked.
    """
    if sized is None or len(candidates) < 2:
        return candidates
    odds = np.sort([one.odds for one in candidates])
    lacking = most - max(one.matched for one in candidates)
    if odds[1] > odds[0] + DECISIVE + NODE_ODDS * max(lacking, DOUBTED_SHARE * most):
        return candidates
    found = sized()
    return [replace(one, odds=one.odds + radius_odds(found, design, one.assignment)) for one in candidates]


def _better_nearby(T: Floats, matched: int, positions: Floats, nominal: Floats, tolerance_mm: float) -> bool:
    """Whether more nodes agree one bay on, or turned by quarters about the design's middle: a grid's usual mistakes."""
    tree = cKDTree(nominal)
    middle = np.argsort(np.linalg.norm(nominal, axis=1), kind="stable")[:4]
    bays = (nominal[tree.query(nominal[middle], k=min(NEAR, len(nominal)))[1][:, 1:]] - nominal[middle, None]).reshape(
        -1, 3
    )
    centre = 0.5 * (nominal.min(axis=0) + nominal.max(axis=0))
    tried = [rigid.transform(np.eye(3), side * bay) for bay in bays for side in (-1.0, 1.0)]
    for quarter in range(1, 4):
        R = rigid.rotation_from_vector(np.array([0.0, 0.0, 0.5 * np.pi * quarter]))
        tried.append(rigid.transform(R, centre - R @ centre))
    moved = rigid.apply(T, positions)
    counts = [
        (tree.query(rigid.apply(one, moved), distance_upper_bound=tolerance_mm)[0] < np.inf).sum() for one in tried
    ]
    return bool(max(counts) > matched)


def _chosen(
    candidates: list[_Candidate], found: Found, design: FrameDesign, middle: Floats, nominal: Floats
) -> Matching:
    """Take the best of the candidates, if it is better by far; else an upright one before those that are not."""
    candidates = sorted(candidates, key=lambda one: one.odds)
    level = [one for one in candidates if one.odds < candidates[0].odds + DECISIVE]
    said = ""
    upright = [one for one in level if one.T[2, 2] > UPRIGHT_COS]
    if upright and len(upright) < len(level):
        said = "the pattern turned over fits as well: taken as it stands upright, gravity along -Z in both frames"
        level = upright
    if len(level) > 1:
        said = f"{len(level)} poses explain the pattern alike"
    return _answer(level[0], level[1:], REGISTERED, found, design, middle, nominal, said)


def _searched(found: Found, design: FrameDesign, nominal: Floats, tolerance_mm: float) -> list[_Candidate]:
    middle = np.median(found.positions, axis=0)
    back = rigid.transform(np.eye(3), -middle)
    found_poses = constellation.poses(found.positions - middle, nominal, tolerance_mm)
    judged = [_judged(T @ back, found, design, nominal, tolerance_mm, fit=True) for T in found_poses]
    return [one for one in judged if one is not None]


def _judged(
    T: Floats, found: Found, design: FrameDesign, nominal: Floats, tolerance_mm: float, *, fit: bool
) -> _Candidate | None:
    """Assign nodes under a pose (4, 4), fit it to them if asked, and weigh what speaks against it."""
    tree, reach = cKDTree(nominal), FAR * tolerance_mm
    assignment, weight = _mutual(T, found.positions, nominal, tree, reach), np.empty(0)
    for _ in range(5 if fit else 1):
        on = assignment >= 0
        if on.sum() < 3:
            if fit or not on.any():
                return None
            break
        best, weight = robust_fit(found.positions[on], nominal[assignment[on]])
        if not fit:
            break
        before, T = assignment, best
        assignment = _mutual(T, found.positions, nominal, tree, reach)
        if np.array_equal(before, assignment):
            break
    on = assignment >= 0
    if fit and on.sum() < 3:
        return None
    every = np.zeros(len(assignment))
    every[on] = weight if len(weight) == on.sum() else 1.0
    off = rigid.apply(T, found.positions[on]) - nominal[assignment[on]]
    rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    odds = -NODE_ODDS * int(on.sum()) + min(int(on.sum()), INDEPENDENT) * float(np.log(max(rms, 1e-6)))
    odds += radius_odds(found, design, assignment) + member_odds(found, design, assignment)
    return _Candidate(T, assignment, every, rms, odds)


def _mutual(T: Floats, positions: Floats, nominal: Floats, tree: cKDTree, reach: float) -> Ints:
    """Row of the nominal node (k,) that is each node's nearest and whose nearest it is; -1 = none within reach."""
    distance, index = tree.query(rigid.apply(T, positions), distance_upper_bound=reach, workers=-1)
    assignment = np.full(len(positions), -1, np.int64)
    near = np.flatnonzero(np.isfinite(distance))
    near = near[np.lexsort((distance[near], index[near]))]
    first = np.ones(len(near), bool)
    first[1:] = index[near][1:] != index[near][:-1]
    assignment[near[first]] = index[near[first]]
    return assignment


def robust_fit(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Rigid T_target_source (4, 4) of paired points (n, 3), n >= 3, and the weight (n,) of each pair, at most 1.

    Tukey's biweight on the distances, their scale from the median: a node that is far off does not draw the others.
    """
    weight = np.ones(len(source))
    T = rigid.fit(source, target)
    for _ in range(20):
        off = np.linalg.norm(rigid.apply(T, source) - target, axis=1)
        scale = max(float(np.median(off)) / MEDIAN_OF_3, 1e-6)
        weight = np.clip(1.0 - (off / (2.0 * TUKEY * scale)) ** 2, 0.0, 1.0) ** 2
        before, T = T, _weighted_fit(source, target, weight)
        if np.abs(rigid.apply(T, source[:1]) - rigid.apply(before, source[:1])).max() < 1e-6 * scale:
            break
    return T, weight


def _weighted_fit(source: Floats, target: Floats, weight: Floats) -> Floats:
    found: Floats = constellation.fitted(source[None], target[None], weight[None])[0]
    return found


def _alike(a: Floats, b: Floats, points: Floats, apart: float) -> bool:
    return bool(np.abs(rigid.apply(a, points) - rigid.apply(b, points)).max() < apart)


def _answer(
    chosen: _Candidate, rivals: list[_Candidate], how: str, found: Found, design: FrameDesign, middle: Floats,
    nominal: Floats, said: str,
) -> Matching:  # fmt: skip
    on = chosen.assignment >= 0
    nodes, places, weight = found.positions[on], nominal[chosen.assignment[on]], chosen.weight[on]
    best, covariance, scatter = chosen.T, np.zeros((6, 6)), float("nan")
    if on.sum() >= 3:
        best = _weighted_fit(nodes, places, weight)
        off = rigid.apply(best, nodes) - places
        scatter = float(np.median(np.linalg.norm(off, axis=1))) / MEDIAN_OF_3
        if how == REGISTERED:
            covariance = _covariance(rigid.apply(best, nodes), off, weight, middle)
    T = best if how == REGISTERED else rigid.transform(np.eye(3), found.origin - middle)
    missing = np.setdiff1d(np.arange(len(nominal)), chosen.assignment[on])
    told = f"{how}: {int(on.sum())} nodes of {len(nominal)}, {len(missing)} missing, {int((~on).sum())} extra"
    return Matching(
        "ambiguous" if rivals else "ok",
        how,
        "; ".join(one for one in (told, said) if one),
        _full(T, found.origin, middle),
        covariance,
        _full(best, found.origin, middle),
        chosen.assignment,
        chosen.weight,
        missing,
        np.array([_full(one.T, found.origin, middle) for one in rivals]).reshape(-1, 4, 4),
        scatter,
    )


def _full(T: Floats, origin: Floats, middle: Floats) -> Floats:
    """Pose of full coordinates from one of those less ``origin`` and less ``middle``."""
    full = rigid.with_origin(T, origin)
    full[:3, 3] += middle
    return full


def _covariance(placed: Floats, off: Floats, weight: Floats, middle: Floats) -> Floats:
    """Covariance (6, 6) of a fit, about the design frame's origin; ``placed`` (n, 3) nodes are less ``middle``."""
    J = rigid.motion(placed)
    A = np.einsum("n,nip,niq->pq", weight, J, J)
    scale = np.sqrt(np.diag(A))
    inverse = np.linalg.pinv(A / np.outer(scale, scale), rcond=1e-12) / np.outer(scale, scale)
    count = float(weight.sum()) ** 2 / max(float(np.sum(weight**2)), 1e-300)
    S = np.einsum("n,ni,nj->ij", weight**2, off, off) / float(np.sum(weight**2)) * count / max(count - 2.0, 1.0)
    meat = np.einsum("n,nip,ij,njq->pq", weight**2, J, S, J)
    about = np.eye(6)
    # a turn about the middle is one about the origin and a translation by - w x middle
    about[3:, :3] = [[0.0, -middle[2], middle[1]], [middle[2], 0.0, -middle[0]], [-middle[1], middle[0], 0.0]]
    one = about @ inverse @ meat @ inverse @ about.T
    found: Floats = 0.5 * (one + one.T)
    return found


def _failed(k: int, d: int, message: str) -> Matching:
    nothing = np.full((4, 4), np.nan)
    return Matching(
        "failed", "", message, nothing, np.full((6, 6), np.nan), nothing, np.full(k, -1), np.zeros(k), np.arange(d)
    )


# --- What balls' sizes and members say of which found node is which of the design.


RADIUS_ODDS = 4.0  # at most, by a ball of another size
RADIUS_SD_MM = 1.0  # of balls against the catalogue, beside the measurement's
MEMBER_ODDS = 2.0  # by a member that is not in the design


@dataclass(frozen=True)
class Found:
    """Found nodes (k, 3) less ``origin``, mm; radii and their sd (k,) where balls were fitted, NaN or empty = unknown.

    ``node_a`` and ``node_b`` are the rows of the nodes at both ends of each tube found, -1 = none.
    """

    positions: Floats
    origin: Floats
    radii: Floats
    radius_sd: Floats
    node_a: Ints
    node_b: Ints

    @classmethod
    def bare(cls, positions: Floats, origin: Floats | None = None) -> Found:
        """Make a record of nodes of which nothing but the places is known."""
        none, no_rows = np.empty(0), np.empty(0, np.int64)
        return cls(positions, np.zeros(3) if origin is None else origin, none, none, no_rows, no_rows)


def radius_odds(found: Found, design: FrameDesign, assignment: Ints) -> float:
    """Log odds that a pose loses by balls of other sizes than the design's."""
    if not len(found.radii) or not len(design.radii):
        return 0.0
    on = (assignment >= 0) & np.isfinite(found.radii)
    off = found.radii[on] - design.radii[assignment[on]]
    sd = np.hypot(found.radius_sd[on] if len(found.radius_sd) else 0.0, RADIUS_SD_MM)
    odds = np.minimum(0.5 * (off / np.where(np.isfinite(sd), sd, np.inf)) ** 2, RADIUS_ODDS)
    return float(np.sum(odds[np.isfinite(odds)]))


def member_odds(found: Found, design: FrameDesign, assignment: Ints) -> float:
    """Log odds that a pose loses by tubes between its nodes where the design has no member."""
    if not len(found.node_a) or not len(design.member_a):
        return 0.0
    rows, _ = match_members(assignment, found.node_a, found.node_b, design)
    a, b = _ends(assignment, found.node_a), _ends(assignment, found.node_b)
    return MEMBER_ODDS * float(((rows < 0) & (a >= 0) & (b >= 0)).sum())


def match_members(assignment: Ints, node_a: Ints, node_b: Ints, design: FrameDesign) -> tuple[Ints, Ints]:
    """Row of the design's member (m,) that each tube between found nodes is, -1 = extra; and the rows without a tube.

    ``node_a`` and ``node_b`` (m,) are rows of the found nodes, -1 = none.
    """
    row_of = {int(id_): row for row, id_ in enumerate(design.ids)}
    pairs = [
        (row_of.get(int(a), -1), row_of.get(int(b), -1)) for a, b in zip(design.member_a, design.member_b, strict=True)
    ]
    count = len(design.ids)
    nominal = {min(a, b) * count + max(a, b): row for row, (a, b) in enumerate(pairs)}
    a, b = _ends(assignment, node_a), _ends(assignment, node_b)
    rows = np.array(
        [
            nominal.get(min(i, j) * count + max(i, j), -1) if i >= 0 and j >= 0 else -1
            for i, j in zip(a.tolist(), b.tolist(), strict=True)
        ],
        np.int64,
    )
    return rows, np.setdiff1d(np.arange(len(pairs)), rows)


def _ends(assignment: Ints, node: Ints) -> Ints:
    found: Ints = np.where(node >= 0, assignment[node], -1) if len(assignment) else np.full(len(node), -1)
    return found
