"""Evidence, flag and reasons of each fitted sphere: those of a frame, those fitted one by one, those without points.

Spheres without points are hidden or missing, by where the rays towards them end.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numba import njit
from scipy.special import chdtrc

from processor.adjustment import scanner_class_errors
from processor.geometry.sphere import BANDS, SECTORS, Sphere, visible_fraction
from processor.geometry.thread_ranges import over_ranges
from processor.limits import limit_bounds, standards
from processor.model import NORMAL_95, Bools, Floats, Ints, Reason, Status, Tolerance, Verdict, reason
from processor.space_frame.ball_catalogue import Catalogue
from processor.space_frame.design import unit_mistakes
from processor.space_frame.members.records import Nodes
from processor.space_frame.params import NAN, Params
from processor.space_frame.points.source import Source
from processor.space_frame.result import Balls, Evidence, Flag, Result
from processor.space_frame.spheres.records import (
    AMBIGUOUS,
    CELLS,
    CENTRE_CHI2,
    DEGREES,
    POINTS,
    RMS,
    SCALE,
    STATIONS,
    Fits,
    Spheres,
    ViewErrors,
)

LEAST_POINTS = 8  # twice the unknowns of a sphere
LARGEST_LOWEST_SD_MM = 0.8  # an error of 3 mm is then nearly four standard deviations
LARGEST_RADIUS_SD = 0.05  # in radii
LARGEST_SCALE = 1.6  # scatter by the noise model's: chance exceeds it once in 1,000 at 15 degrees of freedom
UNLIKELY = 1e-3  # probability below which points and priors disagree
LEAST_GAIN = 0.02  # share of a prior's variance that points must remove to be tested against it
SURE = 3.0  # standard deviations beyond which an offset of all radii is reported
UNLISTED = 6.0  # scatters of radii off its size, from which on a sphere is of no size of the catalogue
FEW = 30  # chosen: points below which sizes of a catalogue fit almost alike, and FEW_MARGIN is asked for
FEW_MARGIN = 10.0  # added to the margin that the runner-up must lose by, where points are few
LEAST_VISIBLE = 0.05  # share of the sphere
LEAST_INLIERS = 0.3  # share of the crop
LARGEST_RMS = 0.1  # of the residuals, in radii
PAPER_RADIUS_ERROR_MM = 3.0  # paper 001, table 2: RANSAC keeps radii within 0-3 mm
CENTRAL = 0.7  # of the radius: rays that pass the centre within this meet the sphere in spite of noise
CLEAR = 1.5  # radii before or behind the centre: a ray that ends there does not end on the sphere
LEAST_RAYS = 5  # chosen: that agree on what is at a place; fewer may be outliers
UNKNOWN_RADIUS_MM = 40.0  # where neither design nor catalogue gives one
DOWN = np.array([0.0, 0.0, 1.0, -1.0])  # height of the lowest point by (x, y, z, radius)


@dataclass(frozen=True)
class FitContext:
    """Facts about a whole fit that each sphere is assessed by.

    ``radius_offset`` is the mean deviation of radii from their sizes and its standard deviation, mm. It may come from
    an offset of all ranges or from the beam's width, so it is not removed: it enters the covariances of radii. The
    lowest point of a ball seen from below is not affected: centre and radius change by the same amount. ``views`` are
    the errors of views that a merged cloud does not name, None = views are named. ``limits`` has the tolerance of a
    sphere's blank, by which a size is wrong where no catalogue decides it.
    """

    catalogue: Catalogue
    scanners_known: bool
    noise: Floats
    radius_sd: float
    station_sd: float
    radius_offset: tuple[float, float]
    views: ViewErrors | None
    limits: Tolerance


def assess(fits: Fits, nodes: Nodes, nominal: Floats, context: FitContext) -> Spheres:
    """Return the spheres with evidence, flag and reasons; ``nominal`` (k,) are nominal radii, NaN = none."""
    state, covariance = _states(fits, nodes, nominal, context)
    evidence, flags, reasons = _assessments(fits, nodes, nominal, context, state, covariance)
    centres = nodes.positions + state[:, :3]
    bound = fits.bound
    lowest_sd = np.sqrt(np.einsum("i,kij,j->k", DOWN, covariance, DOWN))
    bound_lowest = np.sqrt(np.einsum("i,kij,j->k", DOWN, bound, DOWN))
    with np.errstate(invalid="ignore"):
        by_centre = np.sqrt(np.einsum("kii->k", bound[:, :3, :3]) / np.einsum("kii->k", covariance[:, :3, :3]))
        by_radius = np.sqrt(bound[:, 3, 3] / covariance[:, 3, 3])
    return Spheres(
        centres=centres,
        radii=state[:, 3],
        lowest=centres - state[:, 3:] * np.array([0.0, 0.0, 1.0]),
        covariance=covariance,
        lowest_sd=lowest_sd,
        bound=bound,
        bound_lowest_sd=bound_lowest,
        efficiency_centre=by_centre,
        efficiency_radius=by_radius,
        efficiency_lowest=bound_lowest / lowest_sd,
        points=fits.numbers[:, POINTS].astype(np.int64),
        visible_fraction=fits.numbers[:, CELLS] / (BANDS * SECTORS),
        stations=fits.numbers[:, STATIONS].astype(np.int64),
        axes=nodes.axis_count,
        rms=fits.numbers[:, RMS],
        scale=fits.numbers[:, SCALE],
        sizes=fits.sizes,
        second_sizes=fits.second,
        margin=fits.margin,
        nominal=nominal,
        evidence=tuple(evidence),
        flag=tuple(flags),
        reasons=tuple(reasons),
        noise=context.noise,
        radius_sd=context.radius_sd,
        station_sd=context.station_sd,
        messages=_messages(context),
        views=context.views,
    )


def _states(fits: Fits, nodes: Nodes, nominal: Floats, context: FitContext) -> tuple[Floats, Floats]:
    """States (k, 4) and their covariances: those of the fits, or of the axes and the design where there is no fit."""
    state = fits.states.copy()
    degrees = fits.numbers[:, DEGREES]
    # The scale is estimated: the variance of Student's t is wider than the normal one.
    wider = np.where(degrees > 4.0, degrees / np.maximum(degrees - 2.0, 1.0), 2.0)
    covariance = fits.covariance * wider[:, None, None]
    if context.views is None:
        offset, offset_sd = context.radius_offset  # without sizes of balls, the class of the scanners bounds it
        common = np.array([0.0, 0.0, 1.0, 1.0]) * (
            offset if np.isfinite(offset_sd) else scanner_class_errors.known().offset_mm
        )
        covariance = covariance + np.outer(common, common)
    else:  # they include the offset of radii
        covariance = covariance + context.views.covariance
    for i in np.flatnonzero(~fits.fitted).tolist():
        state[i, :3] = 0.0
        state[i, 3] = nominal[i]
        covariance[i] = np.nan
        covariance[i, :3, :3] = nodes.covariance[i]
        if context.views is not None:
            covariance[i, :3, :3] += context.views.covariance[i, :3, :3]
        if np.isfinite(nominal[i]):
            covariance[i, 3, :], covariance[i, :, 3] = 0.0, 0.0
            covariance[i, 3, 3] = context.radius_sd**2
    return state, covariance


def _assessments(
    fits: Fits, nodes: Nodes, nominal: Floats, context: FitContext, state: Floats, covariance: Floats
) -> tuple[list[Evidence], list[Flag], list[tuple[Reason, ...]]]:
    """Evidence, flag and reasons of each node."""
    sized = len(context.catalogue.radii) > 0
    axes_known = np.asarray(np.isfinite(nodes.covariance).all(axis=(1, 2)))
    agreement = agreements(fits, nodes, context.radius_sd if sized else np.inf)
    margin = fits.margin
    # An error that all spheres share is part of the intervals, and no doubt of one of them.
    own = covariance if context.views is None else covariance - context.views.of_all
    evidence: list[Evidence] = []
    flags: list[Flag] = []
    reasons: list[tuple[Reason, ...]] = []
    for i, fitted in enumerate(fits.fitted.tolist()):
        if not fitted:
            axes = int(nodes.axis_count[i])
            flag, causes = _without_points(axes, bool(axes_known[i]), bool(np.isfinite(nominal[i])))
            evidence.append(Evidence.AXES)
        else:
            fused = axes_known[i] and fits.numbers[i, CENTRE_CHI2] > 0.0
            evidence.append(Evidence.FUSED if fused else Evidence.BALL)
            doubts = _doubts(fits, i, margin[i], state[i], covariance[i], own[i])
            flag, causes = _assessment(
                doubts, state[i], float(np.sqrt(covariance[i, 3, 3])), fits.sizes[i], nominal[i],
                bool(agreement[i] < UNLIKELY), context,
            )  # fmt: skip
        flags.append(flag)
        reasons.append(causes)
    return evidence, flags, reasons


def _without_points(axes: int, axes_known: bool, radius_known: bool) -> tuple[Flag, tuple[Reason, ...]]:
    """Flag and reasons of a node whose sphere no point lies on."""
    if not axes_known or axes < 2:
        return Flag.NOT_FOUND, (reason("spheres.no-ball-no-axes"),)
    source = reason("spheres.nominal-radius") if radius_known else reason("spheres.unknown-radius")
    return Flag.LOW_CONFIDENCE, (reason("spheres.axes-alone", axes=axes), source)


def _doubts(fits: Fits, i: int, margin: float, state: Floats, C: Floats, own: Floats) -> list[Reason]:
    """Reasons against relying on fit ``i``, from its points alone; of its covariance C (4, 4) ``own`` is not shared."""
    n, scale = int(fits.numbers[i, POINTS]), fits.numbers[i, SCALE]
    lowest_sd = float(np.sqrt(max(DOWN @ own @ DOWN, 0.0)))
    doubts: list[Reason] = []
    if n < LEAST_POINTS:
        doubts.append(reason("spheres.few-points", points=n, least=LEAST_POINTS))
    if not lowest_sd <= LARGEST_LOWEST_SD_MM:
        doubts.append(reason("spheres.uncertain-lowest-point", sd=lowest_sd))
    if not np.sqrt(C[3, 3]) <= LARGEST_RADIUS_SD * state[3]:
        doubts.append(reason("spheres.uncertain-radius", sd=np.sqrt(C[3, 3])))
    if margin < AMBIGUOUS + (FEW_MARGIN if n < FEW else 0.0):
        doubts.append(reason("spheres.ambiguous-size", size=fits.second[i], margin=margin))
    if scale > LARGEST_SCALE:
        doubts.append(reason("spheres.not-round", times=scale))
    return doubts


def _assessment(
    doubts: list[Reason],
    state: Floats,
    radius_sd: float,
    size: float,
    nominal: float,
    disagrees: bool,
    context: FitContext,
) -> tuple[Flag, tuple[Reason, ...]]:
    """Flag and reasons of a fitted sphere, by its doubts, its priors (``disagrees``) and its nominal radius."""
    catalogue = context.catalogue
    away, off = float(np.linalg.norm(state[:3])), float(state[3] - size)
    # Whether a sphere without other doubts may be of a size that the catalogue does not list. Without a catalogue
    # every sphere may. With one, points and priors must disagree, and the radius must be ``off`` mm from the size by
    # far more than radii scatter.
    far = abs(off) > UNLISTED * context.radius_sd
    if not doubts and (disagrees and far if len(catalogue.radii) else not disagrees):
        wrong = beyond(state[3], nominal, NORMAL_95 * radius_sd, context.limits)
        if wrong is not None:
            return Flag.WRONG_SIZE, (wrong,)
    if disagrees and len(catalogue.radii):
        doubts = [*doubts, reason("spheres.axes-and-size-disagree", distance=away, off=off)]
    elif disagrees:
        doubts = [*doubts, reason("spheres.axes-disagree", distance=away)]
    if doubts:
        return Flag.LOW_CONFIDENCE, tuple(doubts)
    if np.isfinite(nominal) and len(catalogue.radii) and size != nominal:
        return Flag.WRONG_SIZE, (reason("spheres.other-size", size=size, nominal=nominal),)
    return Flag.OK, ()


def _messages(context: FitContext) -> tuple[Reason, ...]:
    """Return the reasons that are about all spheres of a fit."""
    offset, offset_sd = context.radius_offset
    catalogue = context.catalogue
    messages = [reason("spheres.ranges") if context.scanners_known else reason("spheres.orthogonal-distances")]
    if context.station_sd > 0.0:
        messages.append(reason("spheres.stations-disagree", sd=context.station_sd))
    if context.views is not None:
        messages.append(
            reason(
                "spheres.unnamed-views",
                sd=context.views.sd,
                common=context.views.common_sd,
                shift=scanner_class_errors.SHIFT_SD_MM,
                offset=context.views.offset_sd,
            )
        )
    if abs(offset) > SURE * offset_sd:
        messages.append(reason("spheres.radius-offset", offset=offset))
    if catalogue.estimated:
        messages.append(reason("spheres.estimated-sizes", sizes=tuple(f"{radius:.1f}" for radius in catalogue.radii)))
    elif len(catalogue.radii) and not catalogue.verified:
        messages.append(reason("spheres.unverified-catalogue", catalogue=catalogue.name))
    return tuple(messages)


def agreements(fits: Fits, nodes: Nodes, radius_sd: float) -> Floats:
    """Probabilities (k,) that points and priors of one sphere differ by as much as they do or more; 1 without both.

    The change of an estimate by the points has the covariance by which they reduce that of the prior.
    """
    probability = np.ones(nodes.count)
    placed = np.isfinite(nodes.covariance).all(axis=(1, 2)) & np.asarray(fits.numbers[:, CENTRE_CHI2] > 0.0)
    sized = bool(np.isfinite(radius_sd))
    change = fits.states - fits.sizes[:, None] * np.array([0.0, 0.0, 0.0, 1.0])
    for has_place in (True, False):
        known = np.flatnonzero([has_place] * 3 + [sized])
        rows = np.flatnonzero(fits.fitted & (placed == has_place))
        if not len(known) or not len(rows):
            continue
        prior = np.zeros((len(rows), 4, 4))
        if has_place:
            prior[:, :3, :3] = nodes.covariance[rows]
        if sized:
            prior[:, 3, 3] = radius_sd**2
        L = np.linalg.inv(np.linalg.cholesky(prior[:, known[:, None], known]))
        C = fits.covariance[rows][:, known[:, None], known]
        reduction, axes = np.linalg.eigh(np.eye(len(known)) - L @ C @ np.swapaxes(L, 1, 2))
        along = np.einsum("kji,kjl,kl->ki", axes, L, change[rows][:, known])
        probability[rows] = chdtrc(len(known), np.sum(along**2 / np.maximum(reduction, LEAST_GAIN), axis=1))
    return probability


# --- later changes of flags and reasons ------------------------------------------------------------------------------


def with_shared_offset(spheres: Spheres, covariance: Floats) -> Spheres:
    """Flag spheres whose lowest points are too uncertain with a further covariance (k, 3, 3) of their centres.

    What moves these moves radii, too: another size than designed is then a doubt, as it is beside any other doubt.
    """
    sd = np.sqrt(spheres.lowest_sd**2 + covariance[:, 2, 2])
    sure = (Flag.OK, Flag.WRONG_SIZE)
    rows = [i for i, flag in enumerate(spheres.flag) if flag in sure and not sd[i] <= LARGEST_LOWEST_SD_MM]
    flags, reasons = list(spheres.flag), list(spheres.reasons)
    for i in rows:
        flags[i] = Flag.LOW_CONFIDENCE
        reasons[i] = (reason("spheres.common-offset", sd=sd[i]), *reasons[i])
    return replace(spheres, flag=tuple(flags), reasons=tuple(reasons))


def with_ambiguous_matching(spheres: Spheres, rows: Bools, listed: bool) -> Spheres:
    """Doubt the missing spheres among (k,) whose matching with the design is ambiguous, and the wrong sizes.

    Where all other poses are ``listed``, a size that is wrong by each of them remains so.
    """
    doubted = (Flag.NOT_FOUND,) if listed else (Flag.NOT_FOUND, Flag.WRONG_SIZE)
    flags, reasons = list(spheres.flag), list(spheres.reasons)
    for i in np.flatnonzero(rows).tolist():
        if flags[i] in doubted:
            reasons[i] = (*reasons[i], reason("spheres.ambiguous-matching"))
            flags[i] = Flag.LOW_CONFIDENCE if flags[i] is Flag.WRONG_SIZE else flags[i]
    return replace(spheres, flag=tuple(flags), reasons=tuple(reasons))


# --- deviation of a radius from the nominal one, by a standard's limits on the blank's diameter ----------------------


def blank_tolerance(radius: float, limits: Tolerance) -> tuple[float, float]:
    """Return by how much (mm) a radius may be smaller and larger: half of the limits on the blank's diameter.

    Where ``limits`` has none for spheres, those of the default standard are used.
    """
    for standard in (limits, standards.load(standards.DEFAULT)):
        for limit in standard.limits:
            if limit.key.startswith("ball_blank_diameter_") and limit_bounds.applies(limit, 2.0 * radius):
                low, high = limit_bounds.bounds(limit, {"diameter": 2.0 * radius})
                return -0.5 * low, 0.5 * high
    return NAN, NAN


def beyond(radius: float, nominal: float, margin: float, limits: Tolerance) -> Reason | None:
    """Return a reason if a radius exceeds the blank's tolerance by more than ``margin`` mm; else None."""
    below, above = blank_tolerance(nominal, limits)
    error = radius - nominal
    if not (error < -below - margin or error > above + margin):
        return None
    return reason("spheres.beyond-blank", error=error, above=above, below=below, margin=margin)


# --- spheres that were fitted one by one -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One row of the result, less the cloud's origin; without a sphere it was not found; ``reasons`` state why."""

    id: int
    nominal: float
    sphere: Sphere | None
    points: int = 0
    visible: float = 0.0
    rms: float = NAN
    flag: Flag = Flag.NOT_FOUND
    reasons: tuple[Reason, ...] = ()
    stations: int = 0  # number that saw it; 0 = unknown
    bound: Floats = field(default_factory=lambda: np.full((4, 4), NAN))  # Cramér-Rao, of x, y, z, radius
    formal: Floats = field(default_factory=lambda: np.full((4, 4), NAN))  # covariance by the points alone


def generator(params: Params, purpose: str) -> np.random.Generator:
    """Return the random generator of a purpose, by the seed."""
    return np.random.default_rng([params.seed, zlib.crc32(purpose.encode())])


def missing(id_: int, nominal: float, points: int, cause: Reason) -> Row:
    """Return the row of a sphere that was not found."""
    return Row(id=id_, nominal=nominal, sphere=None, points=points, reasons=(cause,))


def assessed(
    id_: int, nominal: float, sphere: Sphere, points: Floats, share: float, params: Params, limits: Tolerance
) -> Row:
    """Return a fitted sphere with its flag and every reason for it."""
    visible = visible_fraction(points, sphere.centre)
    rms = float(np.sqrt(np.mean(sphere.residuals(points) ** 2)))
    sd = float(np.sqrt(sphere.covariance[3, 3]))
    implausible = unit_mistakes.implausible(sphere.radius)
    doubts = []
    if len(points) < params.min_points:
        doubts.append(reason("spheres.few-points", points=len(points), least=params.min_points))
    if visible < LEAST_VISIBLE:
        doubts.append(reason("spheres.little-visible", share=visible))
    if share < LEAST_INLIERS:
        doubts.append(reason("spheres.few-inliers", share=share))
    if not sd <= LARGEST_RADIUS_SD * sphere.radius:
        doubts.append(reason("spheres.uncertain-radius", sd=sd))
    if implausible is not None:
        doubts.append(implausible)
    if rms > LARGEST_RMS * sphere.radius:
        doubts.append(reason("spheres.large-residuals", rms=rms))
    flag = Flag.LOW_CONFIDENCE if doubts else Flag.OK
    error = sphere.radius - nominal
    below, above = blank_tolerance(nominal, limits)
    if not doubts and not np.isnan(nominal) and not -below <= error <= above:
        # The interval is formal: a size is wrong only beyond the errors that the method is known to have.
        margin = max(NORMAL_95 * sd, PAPER_RADIUS_ERROR_MM)
        wrong = beyond(sphere.radius, nominal, margin, limits)
        if params.method == "ransac" and wrong is not None:
            flag, doubts = Flag.WRONG_SIZE, [wrong]
        elif params.method == "least-squares":
            flag, doubts = Flag.LOW_CONFIDENCE, [reason("spheres.size-or-sleeves", error=error)]
    return Row(
        id=id_,
        nominal=nominal,
        sphere=sphere,
        points=len(points),
        visible=visible,
        rms=rms,
        flag=flag,
        reasons=tuple(doubts),
    )


def as_result(
    rows: list[Row], origin: Floats, params: Params, reasons: tuple[Reason, ...], complete: bool = True
) -> Result:
    """Return the result of rows, with the cloud's origin put back."""
    nowhere = Sphere(np.full(3, NAN), NAN, np.full((4, 4), NAN))
    spheres = [nowhere if row.sphere is None else row.sphere for row in rows]
    centres = np.array([sphere.centre + origin for sphere in spheres]).reshape(-1, 3)
    radii = np.array([sphere.radius for sphere in spheres])
    fitted = sum(row.sphere is not None for row in rows)
    balls = Balls(
        ids=np.array([row.id for row in rows], np.int64),
        centres=centres,
        radii=radii,
        lowest=centres - radii[:, None] * np.array([0.0, 0.0, 1.0]),
        covariance=np.array([sphere.covariance for sphere in spheres]),
        lowest_sd=np.array([sphere.lowest_sd for sphere in spheres]),
        points=np.array([row.points for row in rows], np.int64),
        visible_fraction=np.array([row.visible for row in rows]),
        rms=np.array([row.rms for row in rows]),
        nominal_radii=np.array([row.nominal for row in rows]),
        evidence=(Evidence.BALL,) * len(rows),
        flag=tuple(row.flag for row in rows),
        reasons=tuple(row.reasons for row in rows),
        verdict=(Verdict.NONE,) * len(rows),
    )
    status = Status.FAILED if fitted == 0 else Status.OK if complete and fitted == len(rows) else Status.PARTIAL
    return Result(status=status, method=params.method, reasons=reasons, balls=balls)


# --- spheres without points: hidden or missing -----------------------------------------------------------------------


def count_rays(source: Source, places: Floats, radii: Floats) -> Ints:
    """Count the rays (k, 3) aimed at spheres that ended before, at and beyond them; one pass over the source.

    ``places`` (k, 3) are relative to the source's origin. Points of unknown scanners are left out.
    """
    counts = np.zeros((len(places), 3), np.int64)
    scanners = np.ascontiguousarray(source.scanners)
    places, radii = np.ascontiguousarray(places), np.ascontiguousarray(radii)
    for chunk in source.chunks():
        points, station = np.ascontiguousarray(chunk.points, np.float64).view(), chunk.station.view()
        points.flags.writeable = station.flags.writeable = False  # the kernel is compiled for one kind alone
        over_ranges(partial(_count, points, station, scanners, places, radii, counts), len(places))
    return counts


@njit(cache=True, nogil=True, error_model="numpy")
def _count(points, station, scanners, places, radii, counts, first, last):  # type: ignore[no-untyped-def]
    """Add the rays at spheres ``first`` to ``last`` to their counts (k, 3)."""
    for k in range(first, last):
        reach = CENTRAL * radii[k]
        for i in range(len(points)):
            s = station[i]
            if s < 0 or s >= len(scanners):
                continue
            vx, vy, vz = points[i, 0] - scanners[s, 0], points[i, 1] - scanners[s, 1], points[i, 2] - scanners[s, 2]
            cx, cy, cz = places[k, 0] - scanners[s, 0], places[k, 1] - scanners[s, 1], places[k, 2] - scanners[s, 2]
            dot = vx * cx + vy * cy + vz * cz
            length2, away2 = vx * vx + vy * vy + vz * vz, cx * cx + cy * cy + cz * cz
            if dot <= 0.0 or away2 - dot * dot / length2 > reach * reach:
                continue
            behind = np.sqrt(length2) - np.sqrt(away2)
            counts[k, 0 if behind < -CLEAR * radii[k] else 2 if behind > CLEAR * radii[k] else 1] += 1


def with_cause_of_absence(spheres: Spheres, source: Source, smallest_mm: float) -> Spheres:
    """Separate hidden spheres from missing ones, where scanners are known.

    A sphere is not found where rays passed through its place: its node is known from the axes, but the sphere is
    missing. ``smallest_mm`` is the radius taken where the design gives none; NaN = unknown.
    """
    without_points = [evidence is Evidence.AXES and flag is not Flag.NOT_FOUND
                      for evidence, flag in zip(spheres.evidence, spheres.flag, strict=True)]  # fmt: skip
    rows = np.flatnonzero(np.array(without_points, bool))
    if not len(rows) or not len(source.scanners):
        return spheres
    radii = np.where(np.isfinite(spheres.nominal[rows]), spheres.nominal[rows], smallest_mm)
    counts = count_rays(source, spheres.centres[rows], np.where(np.isfinite(radii), radii, UNKNOWN_RADIUS_MM))
    flags, reasons = list(spheres.flag), list(spheres.reasons)
    for row, (before, at, passed) in zip(rows.tolist(), counts.tolist(), strict=True):
        if passed >= max(LEAST_RAYS, at):
            flags[row] = Flag.NOT_FOUND
            reasons[row] += (reason("spheres.missing", rays=passed),)
        elif before >= LEAST_RAYS and before > at:
            reasons[row] += (reason("spheres.hidden"),)
        elif before + at + passed < LEAST_RAYS:
            reasons[row] += (reason("spheres.few-rays"),)
    return replace(spheres, flag=tuple(flags), reasons=tuple(reasons))
