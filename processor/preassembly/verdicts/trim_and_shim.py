"""What to do at a joint: nothing, cut the right part's end, or build it up, and how likely it then keeps its limits.

A cut is a plane, an offset and a tilt about two axes, or goes straight along each plate from corner to corner. It opens
the gap by its depth and takes nothing on, so its least depth is 0 or more. The assembled pose stays as it is. Tried are

* the even plane: the ends are parallel after it, the gap as near to the wanted one as a cut can bring it;
* the nearest plane: the squared differences from the wanted gap are least;
* the least plane with which the gap is nowhere narrower than wanted;
* what each corner lacks by itself.

Planes that would cut a corner wider than the groove's limit are left out: nothing is cut to be filled again. The last
two also with shims or weld build-up where the gap is wider than wanted, and these without a cut. Proposed is what keeps
the groove gap most probably, if it does with HOLDS at all; of works alike the lesser. A cut must be worth its while,
build-up more so. No cut mends what is misaligned across the joint: that is said with it. Where a part may lie the other
way round, or the end may be another one, nothing is proposed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import linprog

from processor.limits import standards as limits_of
from processor.model import KEY_POINTS, Checked, Floats, Limit, Tolerance, UsageError, column
from processor.preassembly.verdicts.joint_measures import ACROSS, SEED, Measures, draws
from processor.preassembly.verdicts.joints import NO_SIZES, Marks, held, judge, keeps

PLACES = ("bottom left", "bottom right", "top right", "top left", "bottom", "right", "top", "left")
SHOWN_MM = 0.1  # amounts are said to this
ALIKE = 0.01  # probabilities that differ by less are alike
CUT_GAIN, BUILD_UP_GAIN = 0.05, 0.1  # of probability, for which a cut, and for which build-up is worth its while
HOLDS = 0.1  # probability of the groove gap below which a work is no proposal
SURELY_NOT = 0.005  # less is said to be no proposal: it would print as 0 %
SIDES = {(1, False): "to the left", (1, True): "to the right", (2, False): "up", (2, True): "down"}


@dataclass(frozen=True)
class TrimParams:
    """Parameters of the proposals (mm)."""

    cut_sd_mm: float = 1.0  # of a cut or build-up, at the corners of the section
    aim_mm: float = 0.0  # wanted gap after it, less the design's root gap
    least_mm: float = 0.5  # less, at its deepest, is not worth a cut or build-up

    def __post_init__(self) -> None:
        amounts = self.cut_sd_mm, self.least_mm
        if not (all(0.0 <= one < math.inf for one in amounts) and math.isfinite(self.aim_mm)):
            raise UsageError(f"preassemble.trim: expected numbers, cut_sd_mm and least_mm of 0 or more, got {self}")


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
    plane: Floats
    cut: Floats
    build_up: Floats

    def on(self, gaps: Floats, error: Floats) -> Floats:
        """Gaps (n, 8, 3) after it, with the error (n, 8) of doing it."""
        if self.amount == 0.0:
            return gaps
        done: Floats = gaps.copy()
        done[:, :, 0] += self.cut - self.build_up + error
        return done

    @property
    def amount(self) -> float:
        """Sum of what is taken off and what is put on."""
        return float(self.cut.sum() + self.build_up.sum())

    @property
    def action(self) -> str:
        """The name of what is done."""
        done = [name for name, by in (("trim", self.cut), ("build up", self.build_up)) if by.max() > 0.0]
        return " and ".join(done) or "nothing"


def propose(
    joint: str,
    measures: Measures,
    tolerance: Tolerance,
    params: TrimParams | None = None,
    sizes_mm: Mapping[str, float] = NO_SIZES,
    unsure: str = "",
    rests_on: str = "",
) -> Proposal:
    """Propose what to do at a joint so that it keeps the limits of ``tolerance``; ``joint`` is its name.

    ``unsure`` says why the gaps may be wrong altogether: then nothing is proposed. ``rests_on`` says which part beside
    the joint is weak: that is said with what is proposed. The probabilities are shares of draws of the gaps and of the
    cut's errors, NaN where a limit hangs on a size that is not among ``sizes_mm``. Limits without a groove gap leave
    nothing to cut for.
    """
    params = params or TrimParams()
    known = bool(np.isfinite(measures.gaps).all() and np.isfinite(measures.covariance).all())
    if unsure or not known:
        no, said = np.full(8, np.nan), "the gaps are not known, so nothing is proposed: scan both ends of the joint"
        if known:
            said = f"nothing proposed until this is settled: {unsure}"
        return Proposal("unknown", no, no, no[:3], no, no, misaligned_by=no, sentence=f"{joint}: {said}.")
    limits = {limit.measure: limit for limit in reversed(held(tolerance))}
    drawn = draws(measures.gaps.ravel(), measures.covariance).reshape(-1, 8, 3)

    def kept(limit: Limit, gaps: Floats) -> Marks | None:
        low, high = limits_of.bounds(limit, sizes_mm)
        if math.isnan(low) or math.isnan(high):
            return None
        return keeps(gaps, measures.points, limit, low, high, tolerance.root_gap_mm)

    across = [kept(limit, drawn) for limit in held(tolerance) if limit.measure != "groove_gap"]
    nothing = _Work(np.zeros(3), np.zeros(8), np.zeros(8))
    groove, best = limits.get("groove_gap"), nothing
    before: list[Marks | None] = []
    after: list[Marks | None] = []
    wanted = tolerance.root_gap_mm + params.aim_mm
    if groove is not None:
        error = _cut_errors(measures.points, params.cut_sd_mm, len(drawn))
        works = [nothing]
        if _verdict(measures, tolerance, groove, sizes_mm) != "pass":
            room = limits_of.bounds(groove, sizes_mm)[1] - params.aim_mm
            works += _works(measures, wanted, max(params.least_mm, SHOWN_MM), room)
        marks = [kept(groove, work.on(drawn, error)) for work in works]
        chosen = _chosen(works, [_share([one]) for one in marks])
        best, before, after = works[chosen], marks[:1], [marks[chosen]]
    found = Proposal(
        best.action,
        best.cut,
        best.build_up,
        best.plane * [1.0, 1e3, 1e3],
        measures.gaps[:, 0],
        measures.gaps[:, 0] + best.cut - best.build_up,
        wanted,
        _share([*across, *after]),
        _share([*across, *before]),
        _share(after),
        _share(across),
        _misaligned_by(measures, limits.get("misalignment"), sizes_mm).max(axis=1),
    )
    return replace(found, sentence=_sentence(joint, found, measures, limits, sizes_mm, params.cut_sd_mm, rests_on))


def _verdict(measures: Measures, tolerance: Tolerance, limit: Limit, sizes_mm: Mapping[str, float]) -> str:
    return judge(measures, replace(tolerance, limits=(limit,)), sizes_mm).verdict


def _share(marks: Sequence[Marks | None]) -> float:
    """Share of draws that keep all; NaN where there is nothing to keep or a limit is not known."""
    known = [one for one in marks if one is not None]
    return float(np.all(known, axis=0).mean()) if known and len(known) == len(marks) else float("nan")


def _cut_errors(points: Floats, sd_mm: float, count: int) -> Floats:
    """Errors (count, 8) of cuts: planes off in depth and both tilts, alike in size, by sd_mm in all at a corner."""
    half = np.abs(points).max(axis=0)
    shape = np.column_stack([np.ones(8), points[:, 1] / half[1], points[:, 2] / half[2]]) / np.sqrt(3.0)
    plain = np.random.default_rng([SEED, 1]).standard_normal((count // 2, 3))
    found: Floats = sd_mm * np.concatenate([plain, -plain]) @ shape.T
    return found


def _chosen(works: Sequence[_Work], shares: Sequence[float]) -> int:
    """Row of the work to propose; the first is to do nothing, and stays where a share is not known."""
    best = 0
    cuts = [k for k, work in enumerate(works) if k and not work.build_up.any()]
    fills = [k for k, work in enumerate(works) if work.build_up.any()]
    for rows, gain in ((cuts, CUT_GAIN), (fills, BUILD_UP_GAIN)):
        top = max((shares[k] for k in rows), default=0.0)
        if top >= shares[best] + gain:
            best = min((k for k in rows if shares[k] >= top - ALIKE), key=lambda k: works[k].amount)
    return best if shares[best] >= HOLDS else 0


def _works(measures: Measures, wanted: float, least_mm: float, room: float) -> Iterator[_Work]:
    """Yield what could be done: the cuts, build-up after the last two, and build-up alone.

    ``room`` is by how much a gap may be wider than wanted.
    """
    A = np.column_stack([np.ones(8), measures.points[:, 1:]])
    lacking = wanted - measures.gaps[:, 0]
    nothing, no_plane = np.zeros(3), np.full(3, np.nan)
    corners = _from_corner_to_corner(np.maximum(lacking[:4], 0.0))
    for plane, fill in (
        (_even(A, lacking), False),
        (_nearest(A, lacking), False),
        (_covering(A, lacking), False),
        (no_plane, False),
        (_covering(A, lacking), True),
        (no_plane, True),
        (nothing, True),
    ):
        cut = corners if np.isnan(plane).any() else np.maximum(A @ plane, 0.0)
        if cut.max() < least_mm:
            plane, cut = nothing, np.zeros(8)
        at_corner = cut[:4]
        put = np.maximum(cut - lacking, 0.0) if fill else np.zeros(8)
        if ((at_corner > np.maximum(lacking[:4] + room, 0.0) + SHOWN_MM) | _both(at_corner, put[:4])).any():
            continue
        if put.max() >= least_mm or (cut.any() and not fill):
            yield _Work(plane, cut, put)


def _both(cut: Floats, put: Floats) -> Marks:
    """Mark where something would be cut in order to be filled again."""
    found: Marks = np.minimum(cut, put) > SHOWN_MM
    return found


def _from_corner_to_corner(corners: Floats) -> Floats:
    """Amounts (8,) at P1..P8 of what is straight between P1..P4."""
    return np.concatenate([corners, 0.5 * (corners + np.roll(corners, -1))])


def _even(A: Floats, lacking: Floats) -> Floats:
    """Plane (3,) that leaves an even gap, its mean the wanted one or, where that would add material, more."""
    plane: Floats = np.asarray(np.linalg.lstsq(A, lacking, rcond=None)[0], np.float64)
    plane[0] -= min(0.0, float((A @ plane).min()))
    return plane


def _covering(A: Floats, lacking: Floats) -> Floats:
    """Plane (3,) of least depth in all that takes off what the gap lacks everywhere, and nowhere below 0."""
    scale = np.abs(A).max(axis=0)
    found = linprog((A / scale).sum(axis=0), -A / scale, -np.maximum(lacking, 0.0), bounds=(None, None))
    plane: Floats = np.asarray(found.x / scale, np.float64)
    return plane


def _nearest(A: Floats, lacking: Floats) -> Floats:
    """Plane p (3,) nearest to what the gap lacks (8,), nowhere below 0: least |A p - lacking| with A p >= 0.

    The least lies where some of the points, three at most, are just not cut: all such sets are tried.
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
    found: Floats = best / np.abs(A).max(axis=0)
    return found


def _misaligned_by(measures: Measures, limit: Limit | None, sizes_mm: Mapping[str, float]) -> Floats:
    """How far (8, 3) each point is beyond the limit along each axis that counts there."""
    found = np.full((8, 3), np.nan if limit is None else 0.0)
    if limit is not None:
        high = limits_of.bounds(limit, sizes_mm)[1]
        for point, axis in ACROSS:
            found[point, axis] = max(abs(measures.gaps[point, axis]) - high, 0.0) if not math.isnan(high) else np.nan
    return found


def _sentence(
    joint: str,
    found: Proposal,
    measures: Measures,
    limits: Mapping[str, Limit],
    sizes_mm: Mapping[str, float],
    cut_sd_mm: float,
    rests_on: str,
) -> str:
    said = [f"rests on a weak part: {rests_on}"] if rests_on else []
    if "groove_gap" not in limits:
        said.append("nothing proposed, for the limits name no groove gap (groove_gap_mm)")
    elif found.action == "nothing":
        fits = "nothing to cut" if found.misalignment_probability < 0.95 else "nothing to do"
        unsure = "nothing proposed, for no cut or build-up makes the groove gap much surer"
        if found.groove_probability < HOLDS:
            unsure = "nothing proposed, for no cut or build-up makes the groove gap hold"
        said.append(unsure if found.groove_probability < 0.95 else fits)
    else:
        works = " and ".join(_works_in_words(found))
        if found.probability < SURELY_NOT:
            said.append("no cut or build-up makes all limits hold")
            works = f"for the groove gap alone, {works}"
        said.append(works)
    said.append(_chances(found, cut_sd_mm))
    high = limits_of.bounds(limits["misalignment"], sizes_mm)[1] if "misalignment" in limits else math.nan
    off = _misaligned_by(measures, limits.get("misalignment"), sizes_mm)
    beyond = sorted(((off[p, a], p, a) for p, a in ACROSS if off[p, a] > 0.0), reverse=True)
    if beyond:
        edges = ", ".join(
            f"{KEY_POINTS[p]} {PLACES[p]} {abs(measures.gaps[p, a]):.1f} mm {SIDES[a, measures.gaps[p, a] < 0.0]}"
            f" ({by:.1f} too much)"
            for by, p, a in beyond
        )
        said.append(f"no trim mends the misalignment, {high:g} mm at most, of the right part at {edges}")
    elif found.misalignment_probability < 0.95:
        said.append("no trim changes the misalignment, which is near its limit")
    return f"{joint}: {'; '.join(said)}."


def _works_in_words(found: Proposal) -> Iterator[str]:
    for what, by in (("cut the right part's end by", found.cut), ("fill by shims or weld build-up", found.build_up)):
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
            amounts = " / ".join(f"{one:.1f}" for one in by[:4])
            yield f"{what} {amounts} mm at P1 / P2 / P3 / P4, straight between them"


def _chances(found: Proposal, cut_sd_mm: float) -> str:
    if math.isnan(found.probability):
        return "the probability that all limits hold is not known, for a limit is missing or hangs on an unknown size"
    if found.action == "nothing":
        known = f"all limits hold with {found.probability:.0%}"
        return known if found.probability >= SURELY_NOT else "as it is not all limits hold"
    if found.probability < SURELY_NOT:
        return f"done to {cut_sd_mm:g} mm (one sd), the groove gap then holds with {found.groove_probability:.0%}"
    return (
        f"done to {cut_sd_mm:g} mm (one sd), all limits then hold with {found.probability:.0%} "
        f"(groove gap {found.groove_probability:.0%}), "
        f"as it is with {found.probability_as_is:.0%}"
    )
