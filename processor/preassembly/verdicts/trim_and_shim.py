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
misalignment across the joint, which the sentence states. Nothing is proposed where a part's pose is ambiguous or an end
may be that of another plate side.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import linprog

from processor.adjustment.extremes import SEED, draws
from processor.limits import standards as limits_of
from processor.model import KEY_POINTS, Checked, Floats, Limit, Tolerance, column
from processor.preassembly.params import TrimParams
from processor.preassembly.verdicts.joint_measures import ACROSS, Measures
from processor.preassembly.verdicts.joints import NO_SIZES, Bools, allowed, conforms, joint_limits, judge

PLACES = ("bottom left", "bottom right", "top right", "top left", "bottom", "right", "top", "left")
SHOWN_MM = 0.1  # resolution of amounts in the sentence
ALIKE = 0.01  # difference of probabilities that does not count
CUT_GAIN, BUILD_UP_GAIN = 0.05, 0.1
LEAST_PROBABILITY = 0.1  # of the groove gap
SURELY_NOT = 0.005  # a probability that would print as 0 %
SIDES = {(1, False): "to the left", (1, True): "to the right", (2, False): "up", (2, True): "down"}


@dataclass(frozen=True)
class Proposal(Checked):
    """What to do at one joint. NaN where the gaps are not known. Lengths mm, amounts at P1..P8 of the right part's end.

    ``plane`` of the cut: depth at the joint's middle (mm), and by how much it grows to the left and upward (mm per m);
    NaN of a cut that goes from corner to corner and is no plane.
    """

    action: str = "unknown"  # nothing | trim | build up | trim and build up | unknown
    cut: Floats = column(8)
    build_up: Floats = column(8)
    plane: Floats = column(3)
    gap_before: Floats = column(8)  # along the bridge
    gap_after: Floats = column(8)
    wanted_gap: float = float("nan")
    probability: float = float("nan")  # that all limits hold after it
    probability_as_is: float = float("nan")  # that they hold when nothing is done
    groove_probability: float = float("nan")  # after it, of the groove gap alone
    misalignment_probability: float = float("nan")  # with or without it: a cut does not change it
    misaligned_by: Floats = column(8)  # greatest |across| at P1..P8 beyond its limit; 0 within, NaN without a limit
    sentence: str = ""


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
    def action(self) -> str:
        """Name of the work."""
        names = [name for name, by in (("trim", self.cut), ("build up", self.build_up)) if by.max() > 0.0]
        return " and ".join(names) or "nothing"


NO_WORK = _Work(np.zeros(3), np.zeros(8), np.zeros(8))


def propose(
    joint: str,
    measures: Measures,
    tolerance: Tolerance,
    params: TrimParams | None = None,
    sizes_mm: Mapping[str, float] = NO_SIZES,
    unsure: str = "",
    rests_on: str = "",
) -> Proposal:
    """Propose work on a joint, by its name, after which it keeps the limits of ``tolerance``.

    ``unsure`` is a reason why the gaps may be wrong altogether: then nothing is proposed. ``rests_on`` names a weak
    part beside the joint, for the sentence. Probabilities are shares of draws of the gaps and of the cut's errors, NaN
    where a limit depends on a size that is not among ``sizes_mm``. Without a limit of the groove gap nothing is cut.
    """
    params = params or TrimParams()
    if unsure or not measures.known:
        return _nothing_known(joint, unsure if measures.known else "")
    limits = {limit.measure: limit for limit in reversed(joint_limits(tolerance))}
    drawn = draws(measures.gaps.ravel(), measures.covariance).reshape(-1, 8, 3)

    def conforming(limit: Limit, gaps: Floats) -> Bools | None:
        bounds = allowed(limit, tolerance, sizes_mm)
        return conforms(gaps, measures.points, bounds) if bounds.known else None

    across = [conforming(limit, drawn) for limit in joint_limits(tolerance) if limit.measure != "groove_gap"]
    groove, best = limits.get("groove_gap"), NO_WORK
    before: list[Bools | None] = []
    after: list[Bools | None] = []
    wanted = tolerance.root_gap_mm + params.aim_mm
    if groove is not None:
        error = _cut_errors(measures.points, params.cut_sd_mm, len(drawn))
        works = [NO_WORK]
        if judge(measures, replace(tolerance, limits=(groove,)), sizes_mm).verdict != "pass":
            room = limits_of.bounds(groove, sizes_mm)[1] - params.aim_mm
            works += _works(measures, wanted, max(params.least_mm, SHOWN_MM), room)
        marks = [conforming(groove, work.on(drawn, error)) for work in works]
        chosen = _choice(works, [_share([mark]) for mark in marks])
        best, before, after = works[chosen], marks[:1], [marks[chosen]]
    proposal = Proposal(
        action=best.action,
        cut=best.cut,
        build_up=best.build_up,
        plane=best.plane * [1.0, 1e3, 1e3],
        gap_before=measures.gaps[:, 0],
        gap_after=measures.gaps[:, 0] + best.cut - best.build_up,
        wanted_gap=wanted,
        probability=_share([*across, *after]),
        probability_as_is=_share([*across, *before]),
        groove_probability=_share(after),
        misalignment_probability=_share(across),
        misaligned_by=_misaligned_by(measures, limits.get("misalignment"), sizes_mm).max(axis=1),
    )
    return replace(
        proposal, sentence=_sentence(joint, proposal, measures, limits, sizes_mm, params.cut_sd_mm, rests_on)
    )


def _nothing_known(joint: str, unsure: str) -> Proposal:
    """Return no proposal, with the reason: gaps that may be wrong, or are not known."""
    nan = np.full(8, np.nan)
    reason = "the gaps are not known, so nothing is proposed: scan both ends of the joint"
    if unsure:
        reason = f"nothing proposed until this is settled: {unsure}"
    return Proposal(
        cut=nan,
        build_up=nan,
        plane=nan[:3],
        gap_before=nan,
        gap_after=nan,
        misaligned_by=nan,
        sentence=f"{joint}: {reason}.",
    )


def _share(marks: Sequence[Bools | None]) -> float:
    """Share of draws that keep all limits; NaN without a limit or with an unknown one."""
    known = [mark for mark in marks if mark is not None]
    return float(np.all(known, axis=0).mean()) if known and len(known) == len(marks) else float("nan")


def _cut_errors(points: Floats, sd_mm: float, count: int) -> Floats:
    """Errors (count, 8) of cuts: planes with equal errors of depth and both tilts, together sd_mm at a corner."""
    half = np.abs(points).max(axis=0)
    shape = np.column_stack([np.ones(8), points[:, 1] / half[1], points[:, 2] / half[2]]) / np.sqrt(3.0)
    normal = np.random.default_rng([SEED, 1]).standard_normal((count // 2, 3))
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
    corners = _between_corners(np.maximum(lacking[:4], 0.0))
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


def _between_corners(corners: Floats) -> Floats:
    """Amounts (8,) at P1..P8, linear between those at P1..P4."""
    return np.concatenate([corners, 0.5 * (corners + np.roll(corners, -1))])


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


def _misaligned_by(measures: Measures, limit: Limit | None, sizes_mm: Mapping[str, float]) -> Floats:
    """Excess (8, 3) over the limit of misalignment at each point along each axis that counts there."""
    excess = np.full((8, 3), np.nan if limit is None else 0.0)
    if limit is not None:
        high = limits_of.bounds(limit, sizes_mm)[1]
        for point, axis in ACROSS:
            excess[point, axis] = max(abs(measures.gaps[point, axis]) - high, 0.0) if not math.isnan(high) else np.nan
    return excess


def _sentence(
    joint: str,
    proposal: Proposal,
    measures: Measures,
    limits: Mapping[str, Limit],
    sizes_mm: Mapping[str, float],
    cut_sd_mm: float,
    rests_on: str,
) -> str:
    parts = [f"rests on a weak part: {rests_on}"] if rests_on else []
    if "groove_gap" not in limits:
        parts.append("nothing proposed, for the limits name no groove gap (groove_gap_mm)")
    elif proposal.action == "nothing":
        fits = "nothing to cut" if proposal.misalignment_probability < 0.95 else "nothing to do"
        unsure = "nothing proposed, for no cut or build-up makes the groove gap much surer"
        if proposal.groove_probability < LEAST_PROBABILITY:
            unsure = "nothing proposed, for no cut or build-up makes the groove gap hold"
        parts.append(unsure if proposal.groove_probability < 0.95 else fits)
    else:
        works = " and ".join(_works_in_words(proposal))
        if proposal.probability < SURELY_NOT:
            parts.append("no cut or build-up makes all limits hold")
            works = f"for the groove gap alone, {works}"
        parts.append(works)
    parts.append(_chances(proposal, cut_sd_mm))
    high = limits_of.bounds(limits["misalignment"], sizes_mm)[1] if "misalignment" in limits else math.nan
    off = _misaligned_by(measures, limits.get("misalignment"), sizes_mm)
    beyond = sorted(((off[p, a], p, a) for p, a in ACROSS if off[p, a] > 0.0), reverse=True)
    if beyond:
        edges = ", ".join(
            f"{KEY_POINTS[p]} {PLACES[p]} {abs(measures.gaps[p, a]):.1f} mm {SIDES[a, measures.gaps[p, a] < 0.0]}"
            f" ({by:.1f} too much)"
            for by, p, a in beyond
        )
        parts.append(f"no trim mends the misalignment, {high:g} mm at most, of the right part at {edges}")
    elif proposal.misalignment_probability < 0.95:
        parts.append("no trim changes the misalignment, which is near its limit")
    return f"{joint}: {'; '.join(parts)}."


def _works_in_words(proposal: Proposal) -> Iterator[str]:
    for what, by in (
        ("cut the right part's end by", proposal.cut),
        ("fill by shims or weld build-up", proposal.build_up),
    ):
        if by.max() <= 0.0:
            continue
        least, most = int(np.argmin(by)), int(np.argmax(by))
        if by[most] - by[least] < SHOWN_MM:
            yield f"{what} {by.mean():.1f} mm all round"
        elif abs(by[0] - by[1] + by[2] - by[3]) < SHOWN_MM:  # corners in a plane
            yield (
                f"{what} {by[most]:.1f} mm at {KEY_POINTS[most]} {PLACES[most]} down to {by[least]:.1f} mm at "
                f"{KEY_POINTS[least]} {PLACES[least]}"
            )
        else:
            amounts = " / ".join(f"{amount:.1f}" for amount in by[:4])
            yield f"{what} {amounts} mm at P1 / P2 / P3 / P4, straight between them"


def _chances(proposal: Proposal, cut_sd_mm: float) -> str:
    if math.isnan(proposal.probability):
        return "the probability that all limits hold is not known, for a limit is missing or hangs on an unknown size"
    if proposal.action == "nothing":
        known = f"all limits hold with {proposal.probability:.0%}"
        return known if proposal.probability >= SURELY_NOT else "as it is not all limits hold"
    if proposal.probability < SURELY_NOT:
        return f"done to {cut_sd_mm:g} mm (one sd), the groove gap then holds with {proposal.groove_probability:.0%}"
    return (
        f"done to {cut_sd_mm:g} mm (one sd), all limits then hold with {proposal.probability:.0%} "
        f"(groove gap {proposal.groove_probability:.0%}), "
        f"as it is with {proposal.probability_as_is:.0%}"
    )
