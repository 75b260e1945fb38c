"""Self-registration of single stations on the tubes they see, and what it leaves uncertain.

Every station s was registered into the project's frame with a small error of its own. Tubes are straight (or bowed a
little) and round, so the stations that see one must agree on its axis: the corrections x_s of all stations (turn about
the scanner, translation) are estimated at once, the tubes' axes, radii and bows being nuisances that are eliminated one
tube at a time (Schur complement). Residuals run along the ray, where the noise is.

The tubes say how the stations lie to each other, never how all of them lie in the project's frame. A priori every x_s
is normal about zero with variances of turn and translation that are estimated from the data themselves (variance
components, as MacKay 1992 estimates them); the answer is the mean a posteriori, and what remains is
the covariance a posteriori. In it a motion common to all stations has the variance of their mean, and a motion that no
tube tells of has the prior's variance: nothing is more certain than the data make it. Control points hold the datum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from processor.geometry.linalg_small import product
from processor.model import Floats, Ints
from processor.space_frame.stations import normal_equations as normals
from processor.space_frame.stations import residual_kernels as kernels
from processor.space_frame.stations.control_points import ControlPoints, Doubt
from processor.space_frame.stations.posterior import Posterior, common_motion, corrections
from processor.space_frame.stations.records import Stations, TubePoints

Bools = npt.NDArray[np.bool_]

MOST_STATIONS = 10  # of those that see a tube: the others, far off, have few points on it
ROUNDS = 3
STEEPEST = 0.3  # cosine of incidence: beyond it the beam is split at the limb
FIRST_CUT_MM, CUT = 15.0, 4.685  # Tukey's biweight: of the first round, then in scales
BOW_SHARE = 0.6e-3  # of a tube's length: prior sd of its bow; uniform up to L/1000 has this one
SCATTER = 0.661  # mean of psi squared over that of the weights, of the biweight under normal noise
FIXED = 1e12  # information on what a tube does not have
LOOSE_MM = 1e3  # prior sd of a tube's own axis and radius: next to none
OFF_MM = 0.3  # an observation that lies off by so much is what the score looks for
DOUBT = 3.0  # differences beyond this many times their mean lose weight
TAKEN = 6.0  # unknowns of a tube: seven, of which the bow's are held a little
LEAST_POINTS = 20  # of a station, for a scale of their own
SMALLEST_MM = 1e-3  # scale of residuals
WEAK_MM, WEAK_RAD = 0.1, 1e-5  # sd that is too small to be called weak
TOLD_MM = 0.3  # an offset of all ranges that is spoken of
WIDE_MM = 0.5  # one that, where stations seem off by no more, speaks against moving them
WEAK_SHARE = 0.5  # of the prior variance left: what the tubes told is not worth the name
MOTIONS = ("turn about x", "turn about y", "turn about z", "shift along x", "shift along y", "shift along z")


@dataclass(frozen=True)
class _Tubes:
    """Axes as the kernels take them: point and direction (m, 6), two unit vectors across, half length, radius."""

    axis: Floats
    e1: Floats
    e2: Floats
    half: Floats
    radius: Floats


def register(
    points: TubePoints,
    axis_points: Floats,
    axis_directions: Floats,
    radii: Floats,
    scanners: Floats,
    control: ControlPoints | None = None,
    datum_mm: float = 0.0,
) -> Stations:
    """Estimate the corrections of all stations from points on tubes with axes (m, 3), (m, 3) and radii (m,), mm.

    ``scanners`` (s, 3) are the stations' places; coordinates are less one origin. ``datum_mm`` is
    the standard deviation, along each axis, of a shift that all stations share beside their own.
    """
    count = len(scanners)
    if count < 2 and control is None:
        return _unmoved("single", "one station: its frame is the datum", scanners, axis_points, axis_directions, radii)
    order, pair_start = kernels.grouped(points.start, points.station.astype(np.int64), count, MOST_STATIONS)
    used = np.flatnonzero(np.diff(pair_start))
    start = np.append(pair_start[used], pair_start[-1])
    tube, station = used // count, used % count
    tube_obs = np.searchsorted(tube, np.arange(len(axis_points) + 1))
    shared = np.diff(tube_obs)[tube] > 1
    seen_by = np.bincount(station[shared], minlength=count)
    if not shared.any() and control is None:
        return _unmoved(
            "unknown", "no tube is seen from two stations: nothing tells how they lie to each other", scanners,
            axis_points, axis_directions, radii,
        )  # fmt: skip
    ordered = np.ascontiguousarray(points.points[order])
    tubes = _tubes(ordered, np.append(start[tube_obs[:-1]], start[-1]), axis_points, axis_directions, radii)
    x, weight, floor = np.zeros(kernels.STATION * count), np.ones(len(used)), 0.0
    posterior, doubt = Posterior(scanners, None, datum_mm), None
    scale = np.full(count, FIRST_CUT_MM / CUT)
    by_station, bounds = _by_station(station, start, count)
    for turn in range(ROUNDS):
        seen = kernels.residuals(
            ordered, start, tube, station, corrections(x, scanners), x[6 :: kernels.STATION], scanners, tubes.axis,
            tubes.e1, tubes.e2, tubes.half, tubes.radius, STEEPEST,
        )  # fmt: skip
        if turn:
            scale = _scales(seen, by_station, bounds, scale, len(radii))
        N, b, _ = kernels.observations(seen, start, station, scale, CUT)
        geometry = (tube_obs, station, tubes.axis, tubes.e1, tubes.e2, tubes.half, scanners, _prior(tubes))
        last = turn == ROUNDS - 1
        if turn and control is not None:  # once the tubes have laid the stations onto each other
            posterior.hold(control)
            doubt = posterior.doubted(*normals.reduced(N, b, weight, floor, *geometry), x)
            posterior.hold(control.only(doubt.kept))
        for _ in range(2 if last else 1):
            H, g = normals.reduced(N, b, weight, floor, *geometry)
            step, C = posterior.step(H, g, x, 5)
            unknown, differs = normals.tubes(N, b, weight, floor, *geometry, step, OFF_MM**2)
            if turn:
                weight, floor = _judged(differs, shared, weight, floor)
        if last:
            step, C = posterior.integrated(H, g, x)
        x, tubes = x + step, _moved(tubes, unknown)
    x, C, mean_offset = _apart(x, C)
    found = _result(x, C, posterior, seen_by, scale, floor, tubes, mean_offset)
    return found if control is None or doubt is None else _controlled(found, x, control, doubt)


def _apart(x: Floats, C: Floats) -> tuple[Floats, Floats, float]:
    """Take the mean of all range offsets out of the unknowns (7 s,) and their covariance; returns it as well.

    How residuals follow the incidence tells of an offset that all ranges share, but a beam that is wide on thin tubes
    looks the same: only differences between stations are corrected. What the tubes make of the mean is left behind.
    """
    of_range = np.zeros(len(x))
    of_range[kernels.STATION - 1 :: kernels.STATION] = 1.0
    count = len(x) // kernels.STATION
    shared = float(x[of_range > 0.0].mean())
    own = np.eye(len(x)) - np.outer(of_range, of_range) / count
    return (
        x - shared * of_range,
        product(product(own, C), np.ascontiguousarray(own.T)),
        shared,
    )


def _tubes(points: Floats, start: Ints, at: Floats, along: Floats, radii: Floats) -> _Tubes:
    """Axes about the middle of what is seen of each tube: points (n, 3) are sorted by tube."""
    low, high = kernels.extent(points, start, at, along)
    middle = at + (0.5 * (low + high))[:, None] * along
    e1, e2 = _across(along)
    return _Tubes(np.hstack([middle, along]), e1, e2, 0.5 * (high - low), radii.astype(np.float64))


def _across(along: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors (m, 3) each across directions (m, 3)."""
    least = np.eye(3)[np.argmin(np.abs(along), axis=1)]
    e1 = np.cross(along, least)
    e1 /= np.linalg.norm(e1, axis=1)[:, None]
    return e1, np.cross(along, e1)


def _moved(tubes: _Tubes, unknown: Floats) -> _Tubes:
    """Tubes after a change of their unknowns (m, 7); the bow stays beside the axis."""
    o1, o2, s1, s2 = unknown[:, :4].T[:, :, None]
    middle = tubes.axis[:, :3] + o1 * tubes.e1 + o2 * tubes.e2
    along = tubes.axis[:, 3:] + (s1 * tubes.e1 + s2 * tubes.e2) / tubes.half[:, None]
    along /= np.linalg.norm(along, axis=1)[:, None]
    e1, e2 = _across(along)
    return _Tubes(np.hstack([middle, along]), e1, e2, tubes.half, tubes.radius + unknown[:, 6])


def _prior(tubes: _Tubes) -> Floats:
    found = np.full((len(tubes.half), kernels.TUBE), LOOSE_MM**-2)
    found[:, 7] = FIXED
    found[:, 4:6] = (BOW_SHARE * 2.0 * tubes.half[:, None]) ** -2
    return found


def _by_station(station: Ints, start: Ints, count: int) -> tuple[Ints, Ints]:
    """Rows of points in the order of their stations, and where each station's begin (s + 1,)."""
    of_point = np.repeat(station, np.diff(start)).astype(np.int16)
    number = np.bincount(of_point, minlength=count)
    return np.argsort(of_point, kind="stable"), np.concatenate([[0], np.cumsum(number)])


def _scales(seen: Floats, by_station: Ints, bounds: Ints, before: Floats, tubes: int) -> Floats:
    """Scale (s,) of the residuals of each station's points, by their median; of few points the one before."""
    scale: Floats = before.copy()
    residual = np.where((seen[:, 1] > 0.0) & (np.abs(seen[:, 0]) < FIRST_CUT_MM), np.abs(seen[:, 0]), np.nan)[
        by_station
    ]
    # what the tubes' own unknowns took up of the scatter
    points = int(np.count_nonzero(np.isfinite(residual)))
    taken = np.sqrt(points / max(points - TAKEN * tubes, 0.25 * points)) if points else 1.0
    for s in range(len(before)):
        size = residual[bounds[s] : bounds[s + 1]]
        size = size[np.isfinite(size)]
        if len(size) >= LEAST_POINTS:
            scale[s] = max(1.4826 * taken * float(np.median(size)), SMALLEST_MM)
    return scale


def _judged(differs: Floats, shared: Bools, weight: Floats, floor: float) -> tuple[Floats, float]:
    """Weights (q,) of observations, and the variance of what they lie off beyond noise, by their scores (q, 3)."""
    score, mean, growth = differs.T
    mean = SCATTER * mean
    ratio = np.where(shared & (mean > 0.0), score / np.maximum(mean, 1e-300), 0.0)
    new = np.minimum(1.0, DOUBT / np.sqrt(np.maximum(ratio, 1e-300)))
    good = shared & (ratio < DOUBT**2) & (mean > 0.0)
    if not good.any():
        return new, floor
    return new, max(0.0, floor + float((score[good] - mean[good]).sum() / growth[good].sum()))


def _result(
    x: Floats, C: Floats, posterior: Posterior, seen_by: Ints, scale: Floats, floor: float, tubes: _Tubes, shared: float
) -> Stations:
    places, count = posterior.places, len(posterior.places)
    before_rad, before_mm, offset_mm = np.sqrt(posterior.variance).tolist()
    left = np.diag(C).reshape(-1, kernels.STATION)[:, :6] / np.repeat(posterior.variance[:2], 3)
    # What all stations have in common is never told; its share of the variance is one station's in their number.
    bound = 1.0 / count + WEAK_SHARE * (1.0 - 1.0 / count)
    large = np.diag(C).reshape(-1, kernels.STATION)[:, :6] > np.repeat([WEAK_RAD**2, WEAK_MM**2], 3)
    weak = tuple(
        ", ".join(name for name, is_weak in zip(MOTIONS, row, strict=True) if is_weak) for row in (left > bound) & large
    )
    said = [f"stations lay {before_mm:.2g} mm and {1e3 * before_rad:.2g} mrad (sd an axis) off before"]
    if abs(shared) > TOLD_MM:
        said.append(
            f"an offset of {shared:+.1f} mm that all ranges seem to share is not applied: a wide beam looks alike"
        )
    said += [f"station {i}: {what} hardly told by the tubes" for i, what in enumerate(weak) if what]
    common = np.hypot(before_mm / np.sqrt(count), posterior.datum_mm)
    if posterior.control is None:
        datum = f"mean of {count} stations, {common:.2g} mm (sd an axis): no control points"
    elif posterior.free:
        datum = f"{posterior.control.count} control points"
    else:
        datum = f"mean of {count} stations and {posterior.control.count} control points, too few to hold it alone"
    spread = float(np.std(x[6 :: kernels.STATION], ddof=1)) / np.sqrt(count) if count > 1 else 0.0
    # What a wide beam does to thin tubes grows with the range, and over many stations that looks like a bend of all.
    beam = posterior.control is None and abs(shared) > WIDE_MM + 3.0 * spread and abs(shared) > before_mm
    if beam:
        said.append("which explains as much as the stations seem off: they were left where they are")
        x = np.zeros_like(x)
    return Stations(
        "doubtful" if beam else "weak" if any(weak) else "ok",
        "; ".join(said),
        corrections(x, places),
        places,
        C,
        before_mm,
        before_rad,
        x[6 :: kernels.STATION],
        offset_mm,
        abs(shared) if beam else spread,
        seen_by,
        weak,
        scale,
        float(np.sqrt(floor)),
        tubes.axis[:, :3],
        tubes.axis[:, 3:],
        tubes.radius,
        datum,
    )


def _controlled(found: Stations, x: Floats, control: ControlPoints, doubt: Doubt) -> Stations:
    """Return the answer with what is left at the control points, and in the covariance what they contradict by."""
    M = common_motion(found.places)[:, 3:]
    shift = np.mean(x.reshape(-1, kernels.STATION)[:, 3:6], axis=0)
    moved = f"all stations were moved to them by {np.linalg.norm(shift):.2g} mm (mean)"
    C = found.covariance + product(M * doubt.off, np.ascontiguousarray((M * doubt.off).T))
    return replace(
        found,
        status="weak" if doubt.off.any() else found.status,
        message="; ".join([found.message, f"datum: {found.datum}", moved, *doubt.said]),
        covariance=C,
        control=control.ids,
        control_scan=control.scans,
        control_off=control.off(x, found.places),
        control_used=doubt.kept.astype(np.int64),
    )


def _unmoved(status: str, message: str, places: Floats, at: Floats, along: Floats, radii: Floats) -> Stations:
    count = len(places)
    return Stations(
        status,
        message,
        np.tile(np.eye(4), (count, 1, 1)),
        places,
        np.full((kernels.STATION * count, kernels.STATION * count), 0.0 if status == "single" else np.nan),
        range_offset=np.zeros(count),
        observations=np.zeros(count, np.int64),
        weak=("",) * count if status == "single" else (", ".join(MOTIONS),) * count,
        range_sd=np.full(count, np.nan),
        axis_points=at,
        axis_directions=along,
        axis_radii=radii,
        datum=message,
    )
