"""Correspondence of found nodes to a design's, in the same frame or in any other.

The design's own frame is tried first. Where it does not explain the pattern of nodes, poses are searched for
(:mod:`processor.space_frame.design.constellation`) and scored by all evidence: the number of nodes that agree and how
closely, the spheres' radii, the members. A regular grid looks the same one bay on, or turned; then the differences
decide, and without any the answer is ``ambiguous`` and lists every candidate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.adjustment.robust_least_squares import inverse_of
from processor.geometry import rigid
from processor.model import (
    DESIGN_FRAMES,
    Checked,
    Floats,
    FrameDesign,
    Ints,
    Reason,
    Status,
    Word,
    column,
    described,
    reason,
    reasons,
)
from processor.robust_statistics import TUKEY, biweight
from processor.space_frame.design import constellation

TOLERANCE_MM = 60.0  # largest deviation of a node from its nominal place
LEAST_SHARE = 0.5  # of the smaller pattern's nodes that must agree
DOUBTFUL_SHARE = 0.05  # of missing and of extra nodes: beyond it another pose may explain them
DOUBTED_SHARE = 0.1  # of the nodes: where a pose leads by fewer, the spheres' radii are used too
FAR = 2.0  # tolerances: a node farther from its nominal place is another node
NODE_ODDS = 4.0  # log odds that a pose loses by a found node without a design node while a design node is missing
INDEPENDENT = 20  # nodes at most whose distances count as independent: those of neighbours are correlated
DECISIVE = 7.0  # log odds, 1000 to 1
NEAR = 19  # nodes about one that may be a bay's length off
UPRIGHT_COS = 0.996  # 5 degrees
MEDIAN_OF_3 = 1.538  # of the length of a normal vector in space, per sd
RADIUS_ODDS = 4.0  # lost at most by a sphere of another size
RADIUS_SD_MM = 1.0  # of spheres against the catalogue, beside the measurement's
MEMBER_ODDS = 2.0  # lost by a member that is not in the design


class FrameRelation(Word):
    """How the frame of the found nodes is related to the design's."""

    SAME = "same frame"
    REGISTERED = "registered"


@dataclass(frozen=True)
class NodePattern:
    """Found nodes (k, 3) less ``origin``, mm; radii and their sd (k,) of fitted spheres, NaN or empty = unknown.

    ``node_a`` and ``node_b`` are the rows of the nodes at both ends of each member found, -1 = none.
    """

    positions: Floats
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    radii: Floats = field(default_factory=lambda: np.empty(0))
    radius_sd: Floats = field(default_factory=lambda: np.empty(0))
    node_a: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    node_b: Ints = field(default_factory=lambda: np.empty(0, np.int64))


@dataclass(frozen=True)
class Matching(Checked):
    """Correspondence of each found node, and the pose that it rests on.

    ``T_design_scan`` maps coordinates of the scan (the origin added) to the design's frame; its ``covariance`` (turn
    about the design frame's axes, translation; T = exp(xi) T) treats the nodes' movements as random. It is 0 where the
    frame is the same, for then nothing was estimated. ``T_best_fit`` is the best fit over all matched nodes in either
    case.
    """

    status: Status = described(words=Status)  # ok | ambiguous | failed
    relation: FrameRelation = described(FrameRelation.REGISTERED, words=FrameRelation)
    reasons: tuple[Reason, ...] = reasons()
    T_design_scan: Floats = column(4, 4)
    covariance: Floats = column(6, 6)
    T_best_fit: Floats = column(4, 4)
    assignment: Ints = column("k", dtype=np.int64)  # row of the design of each found node, -1 = extra
    nearby: bool = False  # in the scan's own coordinates most nodes are nearest to the design node they are matched to
    weight: Floats = column("k")  # of each node in the best fit
    missing: Ints = column("d", dtype=np.int64)  # rows of the design without a node
    rivals: Floats = column("r", 4, 4)  # other T_design_scan that explain as much


@dataclass(frozen=True)
class _Candidate:
    """A pose T_design_found of local coordinates, its assignment, and its log odds (less is better)."""

    T: Floats
    assignment: Ints
    weight: Floats
    odds: float

    @property
    def matched(self) -> int:
        return int((self.assignment >= 0).sum())


@dataclass(frozen=True)
class _Problem:
    """The nodes and the design; ``nominal`` places (d, 3) are less ``middle``."""

    nodes: NodePattern
    design: FrameDesign
    nominal: Floats
    middle: Floats
    tolerance_mm: float

    @cached_property
    def tree(self) -> cKDTree:
        """Tree of the nominal places."""
        return cKDTree(self.nominal)

    @property
    def fewer(self) -> int:
        """Number of nodes of the smaller pattern."""
        return min(len(self.nodes.positions), len(self.nominal))


def expanded(design: FrameDesign, expansion: float) -> tuple[Floats, Floats]:
    """Nominal places (d, 3) less their mean, all lengths times ``expansion``, and the mean (3,)."""
    middle = design.centres.mean(axis=0) if len(design.centres) else np.zeros(3)
    return (design.centres - middle) * expansion, middle


def match(
    nodes: NodePattern,
    design: FrameDesign,
    tolerance_mm: float = TOLERANCE_MM,
    expansion: float = 1.0,
    sized: Callable[[], NodePattern] | None = None,
) -> Matching:
    """Match found nodes with a design's, each being up to about ``tolerance_mm`` off its nominal place.

    ``expansion`` is the factor of all lengths by temperature. Up to half of the nodes may be missing or extra. A design
    whose coordinates are stated to be its own is registered, one that is stated to be in the project's frame is not:
    where its nodes are not at their places there, the status is ``weak``.
    ``sized`` returns the same nodes with their spheres' radii, where ``nodes`` has none: it is called once at most,
    where the pattern of the nodes is like itself elsewhere.
    """
    nominal, middle = expanded(design, expansion)
    k, d = len(nodes.positions), len(nominal)
    if k == 0 or d == 0:
        return _failed(k, d, reason("spheres.no-nodes") if k == 0 else reason("spheres.no-design-nodes"))
    problem = _Problem(nodes, design, nominal, middle, tolerance_mm)
    sized = None if sized is None else cache(sized)
    to_design = rigid.transform(np.eye(3), nodes.origin - middle)
    least = LEAST_SHARE * problem.fewer
    same = _candidate(to_design, problem, fit=False)
    if same is not None and same.matched < least:
        same = None
    if same is not None:
        few = min(1.0 - same.matched / d, 1.0 - same.matched / k) <= DOUBTFUL_SHARE or k < 4
        if few or not _better_nearby(to_design, same.matched, problem):
            return _answer(same, [], _relation(design), problem, ())
    candidates = _searched(problem) if k >= 4 and d >= 4 else []
    candidates = [candidate for candidate in candidates if candidate.matched >= max(least, 4)]
    every = _with_radii([same, *candidates] if same is not None else candidates, problem, sized)
    if same is not None:
        same, candidates = every[0], every[1:]
        rivals = [
            rival for rival in candidates
            if rival.odds < same.odds - DECISIVE and not _alike(rival.T, to_design, nodes.positions, 5.0 * tolerance_mm)
        ]  # fmt: skip
        doubts = (reason("spheres.better-pose"),) if rivals else ()
        return _answer(same, rivals[:1], _relation(design), problem, doubts)
    if not every:
        return _failed(k, d, reason("spheres.no-pose"))
    best = _best(every, problem)
    if design.coordinates == DESIGN_FRAMES[0]:
        best = _as_stated(best, problem)
    leftover = min(len(best.missing), int((best.assignment < 0).sum()))
    if sized is not None and len(every) > 1 and leftover and sizes_contradict(sized(), design, best.assignment):
        return replace(best, status=Status.AMBIGUOUS, reasons=(*best.reasons, reason("spheres.sizes-contradict")))
    return best


def _relation(design: FrameDesign) -> FrameRelation:
    """Return the relation of frames whose nodes have the same coordinates."""
    return FrameRelation.REGISTERED if design.coordinates == DESIGN_FRAMES[1] else FrameRelation.SAME


def _as_stated(registered: Matching, problem: _Problem) -> Matching:
    """Return a matching in the project's frame, as the project states it against the nodes' places."""
    nodes = problem.nodes
    on = registered.assignment >= 0
    off = rigid.apply(registered.T_best_fit, nodes.positions[on] + nodes.origin) - nodes.positions[on] - nodes.origin
    contradiction = reason(
        "spheres.frame-contradicted",
        distance=float(np.median(np.linalg.norm(off, axis=1))),
        turn=1000.0 * rigid.rotation_angle(registered.T_best_fit[:3, :3]),
    )
    return replace(
        registered,
        status=Status.WEAK if registered.status is Status.OK else registered.status,
        relation=FrameRelation.SAME,
        reasons=(*registered.reasons, contradiction),
        T_design_scan=np.eye(4),
        covariance=np.zeros((6, 6)),
        nearby=True,
    )


# --- candidates ------------------------------------------------------------------------------------------------------


def _searched(problem: _Problem) -> list[_Candidate]:
    positions = problem.nodes.positions
    middle = np.median(positions, axis=0)
    back = rigid.transform(np.eye(3), -middle)
    poses = constellation.poses(positions - middle, problem.nominal, problem.tolerance_mm)
    candidates = [_candidate(T @ back, problem, fit=True) for T in poses]
    return [candidate for candidate in candidates if candidate is not None]


def _candidate(T: Floats, problem: _Problem, *, fit: bool) -> _Candidate | None:
    """Assign nodes under a pose (4, 4), with ``fit`` fit it to them, and compute its odds; None for too few nodes."""
    positions, nominal = problem.nodes.positions, problem.nominal
    assignment, weight = _mutual(T, problem), np.empty(0)
    for _ in range(5 if fit else 1):
        on = assignment >= 0
        if on.sum() < 3:
            if fit or not on.any():
                return None
            break
        best, weight = robust_fit(positions[on], nominal[assignment[on]])
        if not fit:
            break
        before, T = assignment, best
        assignment = _mutual(T, problem)
        if np.array_equal(before, assignment):
            break
    on = assignment >= 0
    if fit and on.sum() < 3:
        return None
    weights = np.zeros(len(assignment))
    weights[on] = weight if len(weight) == on.sum() else 1.0
    off = rigid.apply(T, positions[on]) - nominal[assignment[on]]
    rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    odds = -NODE_ODDS * int(on.sum()) + min(int(on.sum()), INDEPENDENT) * float(np.log(max(rms, 1e-6)))
    odds += radius_odds(problem.nodes, problem.design, assignment)
    odds += member_odds(problem.nodes, problem.design, assignment)
    return _Candidate(T, assignment, weights, odds)


def _mutual(T: Floats, problem: _Problem) -> Ints:
    """Row of the nominal node (k,) that is each node's nearest and whose nearest it is; -1 = none within reach."""
    positions, reach = problem.nodes.positions, FAR * problem.tolerance_mm
    distance, index = problem.tree.query(rigid.apply(T, positions), distance_upper_bound=reach, workers=-1)
    assignment = np.full(len(positions), -1, np.int64)
    near = np.flatnonzero(np.isfinite(distance))
    near = near[np.lexsort((distance[near], index[near]))]
    first = np.ones(len(near), bool)
    first[1:] = index[near][1:] != index[near][:-1]
    assignment[near[first]] = index[near[first]]
    return assignment


def robust_fit(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Rigid T_target_source (4, 4) of paired points (n, 3), n >= 3, and the weight (n,) of each pair, at most 1.

    Tukey's biweight on the distances, with their scale from the median: distant nodes get no weight.
    """
    weight = np.ones(len(source))
    T = rigid.fit(source, target)
    for _ in range(20):
        off = np.linalg.norm(rigid.apply(T, source) - target, axis=1)
        scale = max(float(np.median(off)) / MEDIAN_OF_3, 1e-6)
        weight = biweight(off / (2.0 * TUKEY * scale))
        before, T = T, _weighted_fit(source, target, weight)
        if np.abs(rigid.apply(T, source[:1]) - rigid.apply(before, source[:1])).max() < 1e-6 * scale:
            break
    return T, weight


def _weighted_fit(source: Floats, target: Floats, weight: Floats) -> Floats:
    T: Floats = constellation.fitted(source[None], target[None], weight[None])[0]
    return T


def _with_radii(
    candidates: list[_Candidate], problem: _Problem, sized: Callable[[], NodePattern] | None
) -> list[_Candidate]:
    """Add the odds by the spheres' radii, if several candidates are left that the nodes do not decide on.

    A true pose may lose to a false one by a few nodes that are missing by chance: a lead of few nodes is not decisive
    without the radii.
    """
    if sized is None or len(candidates) < 2:
        return candidates
    most = problem.fewer
    odds = np.sort([candidate.odds for candidate in candidates])
    lacking = most - max(candidate.matched for candidate in candidates)
    if odds[1] > odds[0] + DECISIVE + NODE_ODDS * max(lacking, DOUBTED_SHARE * most):
        return candidates
    nodes = sized()
    return [replace(c, odds=c.odds + radius_odds(nodes, problem.design, c.assignment)) for c in candidates]


def _better_nearby(T: Floats, matched: int, problem: _Problem) -> bool:
    """Whether more nodes agree one bay on, or turned by quarters about the design's middle: a grid's usual mistakes."""
    nominal, tree = problem.nominal, problem.tree
    middle = np.argsort(np.linalg.norm(nominal, axis=1), kind="stable")[:4]
    neighbours = tree.query(nominal[middle], k=min(NEAR, len(nominal)))[1][:, 1:]
    bays = (nominal[neighbours] - nominal[middle, None]).reshape(-1, 3)
    centre = 0.5 * (nominal.min(axis=0) + nominal.max(axis=0))
    tried = [rigid.transform(np.eye(3), side * bay) for bay in bays for side in (-1.0, 1.0)]
    for quarter in range(1, 4):
        R = rigid.rotation_from_vector(np.array([0.0, 0.0, 0.5 * np.pi * quarter]))
        tried.append(rigid.transform(R, centre - R @ centre))
    placed, reach = rigid.apply(T, problem.nodes.positions), problem.tolerance_mm
    counts = [(tree.query(rigid.apply(pose, placed), distance_upper_bound=reach)[0] < np.inf).sum() for pose in tried]
    return bool(max(counts) > matched)


def _alike(a: Floats, b: Floats, points: Floats, distance: float) -> bool:
    return bool(np.abs(rigid.apply(a, points) - rigid.apply(b, points)).max() < distance)


# --- odds by radii and members ---------------------------------------------------------------------------------------


def radius_odds(nodes: NodePattern, design: FrameDesign, assignment: Ints) -> float:
    """Log odds that a pose loses by spheres of other sizes than the design's."""
    if not len(nodes.radii) or not len(design.radii):
        return 0.0
    on = (assignment >= 0) & np.isfinite(nodes.radii)
    return float(_lost_by_radii(nodes, on, design.radii[assignment[on]]).sum())


def sizes_contradict(nodes: NodePattern, design: FrameDesign, assignment: Ints) -> bool:
    """Whether the spheres' sizes agree with a pose no better than with sizes drawn from the design's at random.

    The loss by them is nearer to that of chance than to 0, where that of chance is decisive.
    """
    on = (assignment >= 0) & np.isfinite(nodes.radii) if len(nodes.radii) else np.zeros(len(assignment), bool)
    if not on.any() or not len(design.radii):
        return False
    sizes, counts = np.unique(design.radii, return_counts=True)
    drawn = [_lost_by_radii(nodes, on, size).sum() * count for size, count in zip(sizes, counts, strict=True)]
    chance = float(np.sum(drawn)) / int(counts.sum())
    return chance > 2.0 * DECISIVE and radius_odds(nodes, design, assignment) > 0.5 * chance


def _lost_by_radii(nodes: NodePattern, on: npt.NDArray[np.bool_], nominal: Floats) -> Floats:
    """Log odds (n,) that each of some spheres loses by its radius, against nominal radii."""
    sd = np.hypot(nodes.radius_sd[on] if len(nodes.radius_sd) else 0.0, RADIUS_SD_MM)
    off = (nodes.radii[on] - nominal) / np.where(np.isfinite(sd), sd, np.inf)
    odds: Floats = np.minimum(0.5 * off**2, RADIUS_ODDS)
    return odds[np.isfinite(odds)]


def member_odds(nodes: NodePattern, design: FrameDesign, assignment: Ints) -> float:
    """Log odds that a pose loses by members between its nodes where the design has none."""
    if not len(nodes.node_a) or not len(design.member_a):
        return 0.0
    rows = match_members(assignment, nodes.node_a, nodes.node_b, design)
    a, b = _ends(assignment, nodes.node_a), _ends(assignment, nodes.node_b)
    return MEMBER_ODDS * float(((rows < 0) & (a >= 0) & (b >= 0)).sum())


def match_members(assignment: Ints, node_a: Ints, node_b: Ints, design: FrameDesign) -> Ints:
    """Row of the design's member (m,) between the same nodes as each member found, -1 = extra.

    ``node_a`` and ``node_b`` (m,) are rows of the found nodes, -1 = none.
    """
    row_of = {int(id_): row for row, id_ in enumerate(design.ids)}
    count = len(design.ids)
    nominal = {}
    for row, (id_a, id_b) in enumerate(zip(design.member_a, design.member_b, strict=True)):
        a, b = row_of.get(int(id_a), -1), row_of.get(int(id_b), -1)
        nominal[min(a, b) * count + max(a, b)] = row
    ends = zip(_ends(assignment, node_a).tolist(), _ends(assignment, node_b).tolist(), strict=True)
    return np.array(
        [nominal.get(min(i, j) * count + max(i, j), -1) if i >= 0 and j >= 0 else -1 for i, j in ends], np.int64
    )


def _ends(assignment: Ints, node: Ints) -> Ints:
    rows: Ints = np.where(node >= 0, assignment[node], -1) if len(assignment) else np.full(len(node), -1)
    return rows


# --- the answer ------------------------------------------------------------------------------------------------------


def _best(candidates: list[_Candidate], problem: _Problem) -> Matching:
    """Take the best candidate if it leads decisively; else prefer upright ones, and report the rest as rivals."""
    candidates = sorted(candidates, key=lambda candidate: candidate.odds)
    level = [candidate for candidate in candidates if candidate.odds < candidates[0].odds + DECISIVE]
    doubts: tuple[Reason, ...] = ()
    if problem.design.coordinates == DESIGN_FRAMES[0]:
        level = [candidate for candidate in level if _is_nearby(candidate, problem)] or level
    upright = [candidate for candidate in level if candidate.T[2, 2] > UPRIGHT_COS]
    if upright and len(upright) < len(level):
        doubts = (reason("spheres.turned-over"),)
        level = upright
    if len(level) > 1:
        doubts = (reason("spheres.equal-poses", poses=len(level)),)
    return _answer(level[0], level[1:], FrameRelation.REGISTERED, problem, doubts)


def _is_nearby(candidate: _Candidate, problem: _Problem) -> bool:
    """Whether in the scan's own coordinates most nodes are nearest to the design's nodes they are assigned to."""
    on, to_design = candidate.assignment >= 0, problem.nodes.origin - problem.middle
    nearest = problem.tree.query(problem.nodes.positions[on] + to_design)[1]
    return bool(np.mean(nearest == candidate.assignment[on]) > LEAST_SHARE)


def _answer(
    chosen: _Candidate,
    rivals: list[_Candidate],
    relation: FrameRelation,
    problem: _Problem,
    doubts: tuple[Reason, ...],
) -> Matching:
    nodes, nominal, middle = problem.nodes, problem.nominal, problem.middle
    on = chosen.assignment >= 0
    positions, places, weight = nodes.positions[on], nominal[chosen.assignment[on]], chosen.weight[on]
    best, covariance = chosen.T, np.zeros((6, 6))
    if on.sum() >= 3:
        best = _weighted_fit(positions, places, weight)
        if relation is FrameRelation.REGISTERED:
            placed = rigid.apply(best, positions)
            covariance = _covariance(placed, placed - places, weight, middle)
    T = best if relation is FrameRelation.REGISTERED else rigid.transform(np.eye(3), nodes.origin - middle)
    missing = np.setdiff1d(np.arange(len(nominal)), chosen.assignment[on])
    summary = reason(
        "spheres.matched",
        frame=relation,
        nodes=int(on.sum()),
        nominal=len(nominal),
        missing=len(missing),
        extra=int((~on).sum()),
    )
    return Matching(
        status=Status.AMBIGUOUS if rivals else Status.OK,
        relation=relation,
        reasons=(summary, *doubts),
        T_design_scan=_full(T, nodes.origin, middle),
        covariance=covariance,
        T_best_fit=_full(best, nodes.origin, middle),
        assignment=chosen.assignment,
        nearby=_is_nearby(chosen, problem),
        weight=chosen.weight,
        missing=missing,
        rivals=np.array([_full(rival.T, nodes.origin, middle) for rival in rivals]).reshape(-1, 4, 4),
    )


def _full(T: Floats, origin: Floats, middle: Floats) -> Floats:
    """Pose of full coordinates from one of those less ``origin`` and less ``middle``."""
    full = rigid.with_origin(T, origin)
    full[:3, 3] += middle
    return full


def _covariance(placed: Floats, off: Floats, weight: Floats, middle: Floats) -> Floats:
    """Covariance (6, 6) of a fit, about the design frame's origin; ``placed`` (n, 3) nodes are less ``middle``."""
    J = rigid.motion(placed)
    inverse = inverse_of(np.einsum("n,nip,niq->pq", weight, J, J))
    count = float(weight.sum()) ** 2 / max(float(np.sum(weight**2)), 1e-300)
    S = np.einsum("n,ni,nj->ij", weight**2, off, off) / float(np.sum(weight**2)) * count / max(count - 2.0, 1.0)
    meat = np.einsum("n,nip,ij,njq->pq", weight**2, J, S, J)
    C = rigid.about_origin(inverse @ meat @ inverse, middle)
    symmetric: Floats = 0.5 * (C + C.T)
    return symmetric


def _failed(k: int, d: int, cause: Reason) -> Matching:
    nothing = np.full((4, 4), np.nan)
    return Matching(
        status=Status.FAILED,
        reasons=(cause,),
        T_design_scan=nothing,
        covariance=np.full((6, 6), np.nan),
        T_best_fit=nothing,
        assignment=np.full(k, -1),
        weight=np.zeros(k),
        missing=np.arange(d),
    )
