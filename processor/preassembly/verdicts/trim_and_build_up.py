"""Proposal for a joint: nothing, cut the right part's end, or build it up, and the probability of conformity after it.

A cut is a plane, an offset and a tilt about two axes, or straight along each plate from corner to corner. It opens the
gap by its depth, which is 0 or more everywhere. The assembled pose does not change. Candidates are

* the even plane: the ends are parallel after it, the gap as near to the wanted one as a cut can bring it;
* the nearest plane: least squares of the differences from the wanted gap;
* the least plane after which the gap is nowhere narrower than wanted;
* what each corner lacks by itself.

Planes that would cut a corner wider than the groove's limit are left out: nothing is cut to be filled again. The last
two are also tried with shims or weld build-up where the gap is wider than wanted, and these without a cut. Proposed is
the candidate that most probably keeps the groove gap, if its probability is at least LEAST_PROBABILITY; of equal
candidates the smaller. A cut must raise the probability by CUT_GAIN, build-up by BUILD_UP_GAIN. No cut changes the
misalignment across the joint, which the reasons state. Nothing is proposed where a part's pose is ambiguous or an end
may be that of another plate side.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import linprog

from processor.adjustment import normal_draws
from processor.limits import limit_bounds
from processor.model import (
    AMOUNT,
    COORDINATE,
    KEY_POINTS,
    NUMBER,
    SHARE,
    Bools,
    Checked,
    Floats,
    Limit,
    Reason,
    Tolerance,
    Verdict,
    Word,
    column,
    described,
    reason,
    reasons,
)
from processor.preassembly.chain.joint_measures import ACROSS, Measures
from processor.preassembly.params import TrimParams
from processor.preassembly.verdicts.joints import conforms, draws, joint_limits, judge, share

SHOWN_MM = 0.1  # resolution of amounts in the reasons
ALIKE = 0.01  # difference of probabilities that does not count
CUT_GAIN, BUILD_UP_GAIN = 0.05, 0.1  # chosen: of probability; welding on costs more than a cut
LEAST_PROBABILITY = 0.1  # of the groove gap
SURELY_NOT = 0.005  # a probability that would print as 0 %


class Work(Word):
    """What a proposal is to do to the right part's end."""

    UNKNOWN = "unknown"
    NOTHING = "nothing"
    TRIM = "trim"
    BUILD_UP = "build up"
    TRIM_AND_BUILD_UP = "trim and build up"


class EndWork(Word):
    """A work on the right part's end, followed by its amount."""

    CUT = "cut the right part's end by"
    FILL = "fill by shims or weld build-up"


class JointPoint(Word):
    """A key point of a joint, and where it is."""

    P1 = "P1 bottom left"
    P2 = "P2 bottom right"
    P3 = "P3 top right"
    P4 = "P4 top left"
    P5 = "P5 bottom"
    P6 = "P6 right"
    P7 = "P7 top"
    P8 = "P8 left"


class OffsetDirection(Word):
    """To where the right part is off."""

    LEFT = "to the left"
    RIGHT = "to the right"
    UP = "up"
    DOWN = "down"


POINTS = tuple(JointPoint)
DIRECTIONS = {  # by axis, and whether the gap is negative
    (1, False): OffsetDirection.LEFT,
    (1, True): OffsetDirection.RIGHT,
    (2, False): OffsetDirection.UP,
    (2, True): OffsetDirection.DOWN,
}


@dataclass(frozen=True)
class Proposal(Checked):
    """What to do at one joint. NaN where the gaps are not known. Lengths mm, amounts at P1..P8 of the right part's end.

    ``plane`` of the cut: depth at the joint's middle (mm), and by how much it grows to the left and upward (mm per m);
    NaN of a cut that goes from corner to corner and is no plane. ``gap_before`` and ``gap_after`` are along the bridge.
    Probabilities: that all limits hold after the work and as it is; that the groove gap holds after it; that the
    misalignment does, with or without it. ``misaligned_by`` is the greatest |across| at P1..P8 beyond its limit; 0
    within, NaN without a limit.
    """

    action: Work = described(Work.UNKNOWN, words=Work)
    cut: Floats = column(8, json="cut.*", keys=KEY_POINTS, means=AMOUNT)
    build_up: Floats = column(8, json="build_up.*", keys=KEY_POINTS, means=AMOUNT)
    plane: Floats = column(3, json="", means=NUMBER)
    gap_before: Floats = column(8, json="", means=COORDINATE)
    gap_after: Floats = column(8, json="", means=COORDINATE)
    wanted_gap: float = described(float("nan"), json="", means=COORDINATE)
    probability: float = described(float("nan"), means=SHARE)
    probability_as_is: float = described(float("nan"), means=SHARE)
    groove_probability: float = described(float("nan"), json="", means=SHARE)
    misalignment_probability: float = described(float("nan"), json="", means=SHARE)
    misaligned_by: Floats = column(8, json="", means=AMOUNT)
    reasons: tuple[Reason, ...] = reasons(sentence="sentence")


@dataclass(frozen=True)
class _Work:
    """A candidate: plane (3,) of the cut, amounts (8,) cut and built up at P1..P8."""

    plane: Floats
    cut: Floats
    build_up: Floats

    def on(self, gaps: Floats, error: Floats) -> Floats:
        """Gaps (n, 8, 3) after the work, with its errors (n, 8)."""
        if self.amount == 0.0:
            return gaps
        worked: Floats = gaps.copy()
        worked[:, :, 0] += self.cut - self.build_up + error
        return worked

    @property
    def amount(self) -> float:
        """Sum of what is cut off and built up."""
        return float(self.cut.sum() + self.build_up.sum())

    @property
    def action(self) -> Work:
        """Name of the work."""
        if self.cut.max() > 0.0:
            return Work.TRIM_AND_BUILD_UP if self.build_up.max() > 0.0 else Work.TRIM
        return Work.BUILD_UP if self.build_up.max() > 0.0 else Work.NOTHING


NO_WORK = _Work(np.zeros(3), np.zeros(8), np.zeros(8))  # no plane, cut and build-up


def propose(
    measures: Measures,
    tolerance: Tolerance,
    params: TrimParams | None = None,
    doubts: tuple[Reason, ...] = (),
    weak_parts: tuple[Reason, ...] = (),
    moved: tuple[Reason, ...] = (),
) -> Proposal:
    """Propose work on a joint after which it keeps the limits of ``tolerance``.

    ``doubts`` are reasons why the gaps may be wrong altogether: then nothing is proposed. ``weak_parts`` are stated
    with the proposal, and ``moved`` in place of the work where the joint closes by moving its parts alone.
    Probabilities are shares of draws of the gaps and of the cut's errors, NaN where a limit depends on an unknown size.
    Without a limit of the groove gap nothing is cut.
    """
    params = params or TrimParams()
    if doubts:
        return _no_proposal(reason("preassemble.doubtful-gaps", reasons=doubts))
    if not measures.known:
        return _no_proposal(reason("preassemble.gaps-unknown"))
    limits = {limit.measure: limit for limit in reversed(joint_limits(tolerance))}
    drawn = draws(measures)
    across = [
        conforms(drawn, measures.points, limit, tolerance)
        for limit in joint_limits(tolerance)
        if limit.measure != "groove_gap"
    ]
    groove, best = limits.get("groove_gap"), NO_WORK
    before: list[Bools | None] = []
    after: list[Bools | None] = []
    wanted = tolerance.root_gap_mm + params.aim_mm
    if groove is not None:
        best, before, after = _best_work(measures, replace(tolerance, limits=(groove,)), params, drawn)
    proposal = Proposal(
        action=best.action,
        cut=best.cut,
        build_up=best.build_up,
        plane=best.plane * [1.0, 1e3, 1e3],
        gap_before=measures.gaps[:, 0],
        gap_after=measures.gaps[:, 0] + best.cut - best.build_up,
        wanted_gap=wanted,
        probability=share([*across, *after]),
        probability_as_is=share([*across, *before]),
        groove_probability=share(after),
        misalignment_probability=share(across),
        misaligned_by=_misaligned_by(measures, limits.get("misalignment")).max(axis=1),
    )
    return replace(
        proposal,
        reasons=(
            *((reason("preassemble.weak-parts", parts=weak_parts),) if weak_parts else ()),
            *(moved or _work_reasons(proposal, "groove_gap" in limits)),
            _probability_reason(proposal, params.cut_sd_mm),
            *_misalignment_reasons(proposal, measures, limits.get("misalignment")),
        ),
    )


def _best_work(
    measures: Measures,
    groove: Tolerance,
    params: TrimParams,
    drawn: Floats,
) -> tuple[_Work, list[Bools | None], list[Bools | None]]:
    """Choose the work by the groove gap's limit alone, and mark the draws that keep it before and after the work."""
    limit = groove.limits[0]
    error = _cut_errors(measures.points, params.cut_sd_mm, len(drawn))
    works = [NO_WORK]
    if judge(measures, groove).verdict is not Verdict.PASS:
        room = limit_bounds.bounds(limit, {})[1] - params.aim_mm
        works += _works(measures, groove.root_gap_mm + params.aim_mm, max(params.least_mm, SHOWN_MM), room)
    marks = [conforms(work.on(drawn, error), measures.points, limit, groove) for work in works]
    chosen = _choice(works, [share([mark]) for mark in marks])
    return works[chosen], marks[:1], [marks[chosen]]


def _no_proposal(why: Reason) -> Proposal:
    nan = np.full(8, np.nan)
    return Proposal(
        cut=nan, build_up=nan, plane=nan[:3], gap_before=nan, gap_after=nan, misaligned_by=nan, reasons=(why,)
    )


def _cut_errors(points: Floats, sd_mm: float, count: int) -> Floats:
    """Errors (count, 8) of cuts: planes with equal errors of depth and both tilts, together sd_mm at a corner."""
    half = np.abs(points).max(axis=0)
    shape = np.column_stack([np.ones(8), points[:, 1] / half[1], points[:, 2] / half[2]]) / np.sqrt(3.0)
    normal = np.random.default_rng([normal_draws.SEED, 1]).standard_normal((count // 2, 3))
    errors: Floats = sd_mm * np.concatenate([normal, -normal]) @ shape.T
    return errors


def _choice(works: Sequence[_Work], shares: Sequence[float]) -> int:
    """Row of the work to propose, by the shares of draws that keep the groove gap.

    The first work is to do nothing; it is chosen where a share is not known.
    """
    best = 0
    cuts = [k for k, work in enumerate(works) if k and not work.build_up.any()]
    fills = [k for k, work in enumerate(works) if work.build_up.any()]
    for rows, gain in ((cuts, CUT_GAIN), (fills, BUILD_UP_GAIN)):
        top = max((shares[k] for k in rows), default=0.0)
        if top >= shares[best] + gain:
            best = min((k for k in rows if shares[k] >= top - ALIKE), key=lambda k: works[k].amount)
    return best if shares[best] >= LEAST_PROBABILITY else 0


def _works(measures: Measures, wanted: float, least_mm: float, room: float) -> Iterator[_Work]:
    """Yield the candidates: cuts, build-up after the last two of them, and build-up alone.

    ``room`` is by how much a gap may be wider than wanted.
    """
    A = np.column_stack([np.ones(8), measures.points[:, 1:]])
    lacking = wanted - measures.gaps[:, 0]
    no_plane = np.full(3, np.nan)
    at_corners = np.maximum(lacking[:4], 0.0)  # of P1 to P4; linear between them
    corners = np.concatenate([at_corners, 0.5 * (at_corners + np.roll(at_corners, -1))])
    for plane, fill in (
        (_even(A, lacking), False),
        (_nearest(A, lacking), False),
        (_covering(A, lacking), False),
        (no_plane, False),
        (_covering(A, lacking), True),
        (no_plane, True),
        (NO_WORK.plane, True),
    ):
        cut = corners if np.isnan(plane).any() else np.maximum(A @ plane, 0.0)
        if cut.max() < least_mm:
            plane, cut = NO_WORK.plane, NO_WORK.cut
        build_up = np.maximum(cut - lacking, 0.0) if fill else np.zeros(8)
        too_deep = cut[:4] > np.maximum(lacking[:4] + room, 0.0) + SHOWN_MM
        refilled = np.minimum(cut[:4], build_up[:4]) > SHOWN_MM
        if (too_deep | refilled).any():
            continue
        if build_up.max() >= least_mm or (cut.any() and not fill):
            yield _Work(plane, cut, build_up)


def _even(A: Floats, lacking: Floats) -> Floats:
    """Plane (3,) after which the gap is even: the wanted gap in the mean or, where that would add material, wider."""
    plane: Floats = np.asarray(np.linalg.lstsq(A, lacking, rcond=None)[0], np.float64)
    plane[0] -= min(0.0, float((A @ plane).min()))
    return plane


def _covering(A: Floats, lacking: Floats) -> Floats:
    """Plane (3,) with the least sum of depths that removes what the gap lacks everywhere, nowhere below 0."""
    scale = np.abs(A).max(axis=0)
    solution = linprog((A / scale).sum(axis=0), -A / scale, -np.maximum(lacking, 0.0), bounds=(None, None))
    plane: Floats = np.asarray(solution.x / scale, np.float64)
    return plane


def _nearest(A: Floats, lacking: Floats) -> Floats:
    """Plane p (3,) nearest to what the gap lacks (8,), nowhere below 0: least |A p - lacking| with A p >= 0.

    At the minimum up to three points have depth 0: all such sets are tried.
    """
    best, least = np.zeros(3), float(np.linalg.norm(lacking))
    scaled = A / np.abs(A).max(axis=0)
    for count in range(3):
        for fixed in combinations(range(len(A)), count):
            free = np.linalg.svd(scaled[list(fixed)])[2][count:].T if count else np.eye(3)
            plane = free @ np.linalg.lstsq(scaled @ free, lacking, rcond=None)[0]
            misfit = float(np.linalg.norm(scaled @ plane - lacking))
            if (scaled @ plane).min() > -1e-9 and misfit < least:
                best, least = plane, misfit
    unscaled: Floats = best / np.abs(A).max(axis=0)
    return unscaled


def _misaligned_by(measures: Measures, limit: Limit | None) -> Floats:
    """Excess (8, 3) over the limit of misalignment at each point along each axis that counts there."""
    excess = np.full((8, 3), np.nan if limit is None else 0.0)
    if limit is not None:
        high = limit_bounds.bounds(limit, {})[1]
        for point, axis in ACROSS:
            excess[point, axis] = max(abs(measures.gaps[point, axis]) - high, 0.0) if not math.isnan(high) else np.nan
    return excess


def _work_reasons(proposal: Proposal, has_groove_limit: bool) -> Iterator[Reason]:
    """State the proposed work, or why none is proposed."""
    if not has_groove_limit:
        yield reason("preassemble.no-groove-limit")
    elif proposal.action is Work.NOTHING:
        if proposal.groove_probability < LEAST_PROBABILITY:
            yield reason("preassemble.no-work-holds")
        elif proposal.groove_probability < 0.95:
            yield reason("preassemble.no-work-gains")
        elif proposal.misalignment_probability < 0.95:
            yield reason("preassemble.nothing-to-cut")
        else:
            yield reason("preassemble.nothing-to-do")
    else:
        works = tuple(_amounts(proposal))
        if proposal.probability < SURELY_NOT:
            yield reason("preassemble.not-all-limits")
            yield reason("preassemble.groove-gap-alone", works=works)
        else:
            yield from works


def _amounts(proposal: Proposal) -> Iterator[Reason]:
    """State the amounts (8,) cut and built up: even all round, along a plane by its extremes, or at each corner."""
    for work, by in ((EndWork.CUT, proposal.cut), (EndWork.FILL, proposal.build_up)):
        least, most = int(np.argmin(by)), int(np.argmax(by))
        if by[most] <= 0.0:
            continue
        if by[most] - by[least] < SHOWN_MM:
            yield reason("preassemble.amount-even", work=work, amount=by.mean())
        elif abs(by[0] - by[1] + by[2] - by[3]) < SHOWN_MM:  # corners in a plane
            yield reason(
                "preassemble.amount-plane",
                work=work, most=by[most], most_at=POINTS[most], least=by[least], least_at=POINTS[least],
            )  # fmt: skip
        else:
            yield reason("preassemble.amount-corners", work=work, p1=by[0], p2=by[1], p3=by[2], p4=by[3])


def _probability_reason(proposal: Proposal, cut_sd_mm: float) -> Reason:
    if math.isnan(proposal.probability):
        return reason("preassemble.probability-unknown")
    if proposal.action is Work.NOTHING:
        if proposal.probability < SURELY_NOT:
            return reason("preassemble.as-is-not-all-limits")
        return reason("preassemble.all-limits", probability=proposal.probability)
    if proposal.probability < SURELY_NOT:
        return reason("preassemble.then-groove-gap", sd=cut_sd_mm, probability=proposal.groove_probability)
    return reason(
        "preassemble.then-all-limits",
        sd=cut_sd_mm,
        probability=proposal.probability,
        groove=proposal.groove_probability,
        as_is=proposal.probability_as_is,
    )


def _misalignment_reasons(proposal: Proposal, measures: Measures, limit: Limit | None) -> Iterator[Reason]:
    """State where the misalignment is beyond its limit or near it."""
    excess = _misaligned_by(measures, limit)
    beyond = sorted(((excess[p, a], p, a) for p, a in ACROSS if excess[p, a] > 0.0), reverse=True)
    if limit is not None and beyond:
        edges = tuple(
            reason(
                "preassemble.misaligned-edge",
                point=POINTS[p],
                offset=abs(measures.gaps[p, a]),
                direction=DIRECTIONS[a, bool(measures.gaps[p, a] < 0.0)],
                excess=by,
            )
            for by, p, a in beyond
        )
        yield reason("preassemble.misaligned", limit=limit_bounds.bounds(limit, {})[1], edges=edges)
    elif proposal.misalignment_probability < 0.95:
        yield reason("preassemble.misalignment-near-limit")
