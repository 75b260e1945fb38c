"""Self-registration of single stations on the tubes that they see, with its covariance.

Every station s was registered into the project's frame with a small error of its own. Tubes are straight (or slightly
bowed) and round, so that the stations that see one must agree on its axis. The corrections x_s of all stations (turn
about the scanner, translation) are estimated together; the tubes' axes, radii and bows are nuisance parameters, which
are eliminated tube by tube (Schur complement). Residuals run along the ray, as the noise does.

The tubes determine the stations relative to each other, but not their common motion in the project's frame. A priori
every x_s is normal about zero, with variances of turn and translation that are estimated from the data (variance
components, as in MacKay 1992). The result is the posterior mean with the posterior covariance: a motion common to all
stations has the variance of their mean there, and a motion that no tube determines has the prior's variance. Control
points fix the datum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from processor.adjustment import scanner_class_errors
from processor.adjustment.control_points import Sightings
from processor.adjustment.data_snooping import Snooped
from processor.geometry import rigid
from processor.geometry.linalg_small import product
from processor.model import Bools, Floats, Ints, Reason, reason
from processor.robust_statistics import TUKEY, huber, robust_sd
from processor.space_frame.result import StationMotion
from processor.space_frame.stations import normal_equations as normals
from processor.space_frame.stations import residual_kernels as kernels
from processor.space_frame.stations.control_points import doubts, misfits
from processor.space_frame.stations.posterior import Posterior, common_motion, corrections
from processor.space_frame.stations.records import Stations, StationStatus, TubePoints

MOST_STATIONS = 10  # of those that see a tube: the others are far away and have few points on it
ROUNDS = 3  # work: of linearised tubes; control points join from the second on
STEEPEST = 0.3  # least cosine of incidence: below it the beam is split at the limb
FIRST_CUT_MM = 15.0  # of Tukey's biweight in the first round
BOW_SHARE = 0.6e-3  # of a tube's length: prior sd of its bow; uniform up to L/1000 has this one
SCATTER = 0.661  # mean of psi squared over that of the weights, of the biweight under normal noise
FIXED = 1e12  # information on an unknown that a tube does not have
LOOSE_MM = 1e3  # prior sd of a tube's own axis and radius
OFF_MM = 0.3  # deviation of an observation that the score tests for
DOUBT = 3.0  # scores beyond the square of this times their mean lose weight
TAKEN = 6.0  # effective unknowns of a tube: seven, of which the bow's have a prior
LEAST_POINTS = 20  # of a station, for a scale of its own
SMALLEST_MM = 1e-3  # scale of residuals
WEAK_MM, WEAK_RAD = 0.1, 1e-5  # a motion of a smaller sd is not weak
REPORTED_MM = 0.3  # offset of all ranges that is reported
WIDE_MM = 0.5  # offset of all ranges beyond which a wide beam may explain the stations' errors
WEAK_SHARE = 0.5  # of the prior variance remaining: the motion is weakly determined


@dataclass(frozen=True)
class _Estimate:
    """Unknowns of the stations (7 s,) with their covariance, and the estimates that go with them."""

    x: Floats
    C: Floats
    axes: kernels.Axes
    scale: Floats  # (s,) of residuals, mm
    floor: float  # variance of observations beyond the points' noise, mm^2
    seen_by: Ints  # (s,) tubes that a station has in common with others
    doubt: Snooped | None


def register(
    points: TubePoints,
    axis_points: Floats,
    axis_directions: Floats,
    radii: Floats,
    scanners: Floats,
    control: Sightings | None = None,
    datum_mm: float = 0.0,
) -> Stations:
    """Estimate the corrections of all stations from points on tubes with axes (m, 3), (m, 3) and radii (m,), mm.

    ``scanners`` (s, 3) are the stations' places; coordinates are less the same origin. ``datum_mm`` is the standard
    deviation, along each axis, of a shift common to all stations beside their own.
    """
    count = len(scanners)
    if count < 2 and control is None:
        return _unmoved(
            StationStatus.SINGLE, reason("spheres.one-station"), scanners, axis_points, axis_directions, radii
        )
    order, pair_start = kernels.grouped(points.start, points.station.astype(np.int64), count, MOST_STATIONS)
    layout = _layout(pair_start, count, len(axis_points))
    shared = np.diff(layout.of_tube)[layout.tube] > 1
    if not shared.any() and control is None:
        return _unmoved(
            StationStatus.UNKNOWN, reason("spheres.no-common-tube"), scanners, axis_points, axis_directions, radii
        )
    ordered = np.ascontiguousarray(points.points[order])
    del points, order  # of a frame of many tubes they take a quarter of the memory
    start = np.append(layout.start[layout.of_tube[:-1]], layout.start[-1])
    axes = _axes(ordered, start, axis_points, axis_directions, radii)
    posterior = Posterior(scanners, None, datum_mm)
    estimate = _estimated(ordered, layout, axes, shared, posterior, control)
    stations = _result(estimate, posterior)
    if control is None or estimate.doubt is None:
        return stations
    return _controlled(stations, _without_mean_offset(estimate.x, estimate.C)[0], control, estimate.doubt)


def _layout(pair_start: Ints, stations: int, tubes: int) -> kernels.Layout:
    """Lay out the observations: pairs of a tube and a station with points."""
    used = np.flatnonzero(np.diff(pair_start))
    tube = used // stations
    return kernels.Layout(
        start=np.append(pair_start[used], pair_start[-1]),
        tube=tube,
        station=used % stations,
        of_tube=np.searchsorted(tube, np.arange(tubes + 1)),
    )


def _estimated(
    points: Floats,
    layout: kernels.Layout,
    axes: kernels.Axes,
    shared: Bools,
    posterior: Posterior,
    control: Sightings | None,
) -> _Estimate:
    """Alternate robust residuals, the stations' unknowns, the tubes, and the weights of observations."""
    places = posterior.places
    count, tubes = len(places), len(axes.half)
    x, weight, floor = np.zeros(kernels.STATION * count), np.ones(len(layout.tube)), 0.0
    scale, doubt, C = np.full(count, FIRST_CUT_MM / TUKEY), None, np.empty((0, 0))
    by_station, bounds = _by_station(layout.station, layout.start, count)
    for turn in range(ROUNDS):
        T, offset = corrections(x, places), x[6 :: kernels.STATION]
        seen = kernels.residuals(points, layout, T, offset, places, axes, STEEPEST)
        if turn:
            scale = _scales(seen, by_station, bounds, scale, tubes)
        equations = normals.Equations(*kernels.observations(seen, layout, scale, TUKEY), weight, floor)
        del seen  # before the next turn allocates its own
        geometry = normals.Geometry(axes, places, _prior(axes))
        last = turn == ROUNDS - 1
        if turn and control is not None:  # after the tubes have aligned the stations with each other
            posterior.hold(control)
            doubt = posterior.doubted(control, *normals.reduced(equations, layout, geometry), x)
            posterior.hold(control.take(doubt.accepted))
        for _ in range(2 if last else 1):
            H, g = normals.reduced(equations, layout, geometry)
            step, C = posterior.step(H, g, x, 5)
            unknown, scores = normals.tubes(equations, layout, geometry, step, OFF_MM**2)
            if turn:
                weight, floor = _reweighted(scores, shared, weight, floor)
                equations = equations._replace(weight=weight, floor=floor)
        if last:
            step, C = posterior.integrated(H, g, x)
        x, axes = x + step, _moved(axes, unknown)
    seen_by = np.bincount(layout.station[shared], minlength=count)
    return _Estimate(x=x, C=C, axes=axes, scale=scale, floor=floor, seen_by=seen_by, doubt=doubt)


def _without_mean_offset(x: Floats, C: Floats) -> tuple[Floats, Floats, float]:
    """Subtract the mean of all range offsets from the unknowns (7 s,) and their covariance; returns it as well.

    The dependence of residuals on incidence shows an offset common to all ranges, but a wide beam on thin tubes looks
    the same: only differences between stations are corrected.
    """
    of_range = np.zeros(len(x))
    of_range[kernels.STATION - 1 :: kernels.STATION] = 1.0
    count = len(x) // kernels.STATION
    shared = float(x[of_range > 0.0].mean())
    relative = np.eye(len(x)) - np.outer(of_range, of_range) / count
    C = product(product(relative, C), np.ascontiguousarray(relative.T))
    return x - shared * of_range, C, shared


def _axes(points: Floats, start: Ints, at: Floats, along: Floats, radii: Floats) -> kernels.Axes:
    """Axes about the middle of the stretch seen of each tube: points (n, 3) are sorted by tube."""
    low, high = kernels.extent(points, start, at, along)
    middle = at + (0.5 * (low + high))[:, None] * along
    e1, e2 = _across(along)
    return kernels.Axes(np.hstack([middle, along]), e1, e2, 0.5 * (high - low), radii.astype(np.float64))


def _across(along: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors (m, 3) each across directions (m, 3)."""
    e1, e2 = rigid.axes_across(along).transpose(1, 0, 2)
    return np.ascontiguousarray(e1), np.ascontiguousarray(e2)


def _moved(axes: kernels.Axes, unknown: Floats) -> kernels.Axes:
    """Axes after a change of their unknowns (m, 8); the bow is not part of them."""
    o1, o2, s1, s2 = unknown[:, :4].T[:, :, None]
    middle = axes.line[:, :3] + o1 * axes.e1 + o2 * axes.e2
    along = axes.line[:, 3:] + (s1 * axes.e1 + s2 * axes.e2) / axes.half[:, None]
    along /= np.linalg.norm(along, axis=1)[:, None]
    e1, e2 = _across(along)
    return kernels.Axes(np.hstack([middle, along]), e1, e2, axes.half, axes.radius + unknown[:, 6])


def _prior(axes: kernels.Axes) -> Floats:
    """Prior information (m, 8) on the tubes' unknowns."""
    information = np.full((len(axes.half), kernels.TUBE), LOOSE_MM**-2)
    information[:, 7] = FIXED
    information[:, 4:6] = (BOW_SHARE * 2.0 * axes.half[:, None]) ** -2
    return information


def _by_station(station: Ints, start: Ints, count: int) -> tuple[Ints, Ints]:
    """Rows of points sorted by station, and the first of each station (s + 1,)."""
    of_point = np.repeat(station, np.diff(start)).astype(np.int16)
    number = np.bincount(of_point, minlength=count)
    return np.argsort(of_point, kind="stable"), np.concatenate([[0], np.cumsum(number)])


def _scales(seen: Floats, by_station: Ints, bounds: Ints, before: Floats, tubes: int) -> Floats:
    """Scale (s,) of the residuals of each station's points, by their median; for few points the one ``before``."""
    scale: Floats = before.copy()
    size = np.abs(seen[:, 0])
    residual = np.where((seen[:, 1] > 0.0) & (size < FIRST_CUT_MM), size, np.nan)[by_station]
    # the scatter that the tubes' own unknowns absorb
    points = int(np.count_nonzero(np.isfinite(residual)))
    absorbed = np.sqrt(points / max(points - TAKEN * tubes, 0.25 * points)) if points else 1.0
    for s in range(len(before)):
        size = residual[bounds[s] : bounds[s + 1]]
        size = size[np.isfinite(size)]
        if len(size) >= LEAST_POINTS:
            scale[s] = max(absorbed * robust_sd(size), SMALLEST_MM)
    return scale


def _reweighted(scores: Floats, shared: Bools, weight: Floats, floor: float) -> tuple[Floats, float]:
    """Weights (q,) of observations, and the variance of their deviations beyond noise, by their scores (q, 3)."""
    score, mean, growth = scores.T
    mean = SCATTER * mean
    ratio = np.where(shared & (mean > 0.0), score / np.maximum(mean, 1e-300), 0.0)
    new = huber(np.sqrt(np.maximum(ratio, 0.0)), DOUBT)
    good = shared & (ratio < DOUBT**2) & (mean > 0.0)
    if not good.any():
        return new, floor
    return new, max(0.0, floor + float((score[good] - mean[good]).sum() / growth[good].sum()))


def _result(estimate: _Estimate, posterior: Posterior) -> Stations:
    x, C, shared = _without_mean_offset(estimate.x, estimate.C)
    places, count = posterior.places, len(posterior.places)
    seeing = int(np.count_nonzero(estimate.seen_by)) or count
    before_rad, before_mm, offset_mm = np.sqrt(posterior.variance).tolist()
    weak = _weak_motions(C, posterior, seeing)
    messages = [reason("spheres.stations-before", mm=before_mm, mrad=1e3 * before_rad)]
    if abs(shared) > REPORTED_MM:
        messages.append(reason("spheres.range-offset", offset=shared))
    messages += [reason("spheres.weak-station", station=i, motions=names) for i, names in enumerate(weak) if names]
    square = float(np.sum(x[6 :: kernels.STATION] ** 2 + np.diag(C)[6 :: kernels.STATION]))
    spread = scanner_class_errors.mean_offset_sd(count, square, count - 1)
    # The effect of a wide beam on thin tubes grows with the range; over many stations that looks like a common bend.
    beam = posterior.control is None and abs(shared) > WIDE_MM + 3.0 * spread and abs(shared) > before_mm
    if beam:
        messages.append(reason("spheres.stations-left"))
        x = np.zeros_like(x)
    return Stations(
        status=StationStatus.DOUBTFUL if beam else StationStatus.WEAK if any(weak) else StationStatus.OK,
        messages=tuple(messages),
        T_project_station=corrections(x, places),
        places=places,
        covariance=C,
        before_mm=before_mm,
        before_rad=before_rad,
        range_offset=x[6 :: kernels.STATION],
        range_offset_sd=offset_mm,
        shared_offset_sd=max(abs(shared), spread) if beam else spread,
        shared_offset=0.0 if beam else shared,
        observations=estimate.seen_by,
        reasons=tuple(map(_weak, weak)),
        range_sd=estimate.scale,
        floor_mm=float(np.sqrt(estimate.floor)),
        axis_points=estimate.axes.line[:, :3],
        axis_directions=estimate.axes.line[:, 3:],
        axis_radii=estimate.axes.radius,
        datum=(_datum(posterior, before_mm, seeing),),
    )


def _weak(motions: tuple[StationMotion, ...]) -> tuple[Reason, ...]:
    return (reason("spheres.weak-motions", motions=motions),) if motions else ()


def _weak_motions(C: Floats, posterior: Posterior, count: int) -> tuple[tuple[StationMotion, ...], ...]:
    """Motions of each station that the tubes, which ``count`` stations see, hardly determine."""
    variance = np.diag(C).reshape(-1, kernels.STATION)[:, :6]
    remaining = variance / np.repeat(posterior.variance[:2], 3)
    # The common motion is never determined; its share of the variance is that of one station in their number.
    bound = 1.0 / count + WEAK_SHARE * (1.0 - 1.0 / count)
    weak = (remaining > bound) & (variance > np.repeat([WEAK_RAD**2, WEAK_MM**2], 3))
    return tuple(tuple(motion for motion, is_weak in zip(StationMotion, row, strict=True) if is_weak) for row in weak)


def _datum(posterior: Posterior, before_mm: float, count: int) -> Reason:
    if posterior.control is None:
        common = np.hypot(before_mm / np.sqrt(count), posterior.datum_mm)
        return reason("spheres.datum-stations", stations=count, sd=common)
    if posterior.free:
        return reason("spheres.datum-control", points=len(posterior.control.places))
    return reason("spheres.datum-stations-and-control", stations=count, points=len(posterior.control.places))


def _controlled(stations: Stations, x: Floats, control: Sightings, doubt: Snooped) -> Stations:
    """Add the deviations at the control points, and their contradictions to the covariance."""
    M = common_motion(stations.places)[:, 3:]
    shift = np.mean(x.reshape(-1, kernels.STATION)[:, 3:6], axis=0)
    shifted = reason("spheres.moved-to-control", distance=np.linalg.norm(shift))
    C = stations.covariance + product(M * doubt.off, np.ascontiguousarray((M * doubt.off).T))
    return replace(
        stations,
        status=StationStatus.WEAK if doubt.off.any() else stations.status,
        messages=(*stations.messages, reason("spheres.datum", datum=stations.datum), shifted, *doubts(control, doubt)),
        covariance=C,
        control=control.point_name,
        control_scan=control.body_name,
        control_off=misfits(control, x, stations.places),
        control_used=doubt.accepted.astype(np.int64),
    )


def _unmoved(
    status: StationStatus, cause: Reason, places: Floats, at: Floats, along: Floats, radii: Floats
) -> Stations:
    count, single = len(places), status is StationStatus.SINGLE
    return Stations(
        status=status,
        messages=(cause,),
        T_project_station=np.tile(np.eye(4), (count, 1, 1)),
        places=places,
        covariance=np.full((kernels.STATION * count, kernels.STATION * count), 0.0 if single else np.nan),
        range_offset=np.zeros(count),
        observations=np.zeros(count, np.int64),
        reasons=(_weak(() if single else tuple(StationMotion)),) * count,
        range_sd=np.full(count, np.nan),
        axis_points=at,
        axis_directions=along,
        axis_radii=radii,
        datum=(cause,),
    )
