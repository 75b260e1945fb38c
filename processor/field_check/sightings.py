"""Targets of a field check: found in every scan, and the same ones recognised by their distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.adjustment import scanner_class_errors
from processor.field_check.variance_components import Sightings
from processor.geometry import rigid
from processor.model import Bools, Floats, InputError, Ints, Reason, Scene, TargetKind, reason
from processor.progress import tracked
from processor.robust_statistics import robust_sd_about_median
from processor.targets import find, naming

SAME_TRIPOD_MM = 20.0  # between two scans of one set-up: an instrument that was moved was moved by more
LEAST_SCANS, LEAST_TARGETS = 2, 3  # three targets make a pose
LEAST_POINTS = 30  # of a field or a sphere, whose scatter is the noise
INNER = 0.35  # of a side or a radius: the points about a centre whose scatter is the noise
NEAREST_MM = 300.0  # of a target from the origin of a scan: nearer there is no scanner there


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Scatter of ranges on targets (m,), mm, on white and on black, NaN where there are none, and black less white."""

    white: Floats
    black: Floats
    bias: Floats
    cosine: Floats  # of the angle of incidence


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What a folder shows: the sightings, their noise, the names of scans and targets, where the adjustment starts."""

    sightings: Sightings
    noise: Noise
    scans: tuple[str, ...]
    targets: tuple[str, ...]
    places: Floats
    poses: Floats
    reasons: tuple[Reason, ...]


@dataclass(frozen=True)
class _Sighting:
    """A target of a scan about its scanner, and the range noise on it: white, black, black less white, cosine."""

    place: Floats
    covariance: Floats
    noise: tuple[float, float, float, float]


def seen_in(scene: Scene) -> Seen:
    """Return the sightings of a scene's targets. Raises InputError where they do not make a field check."""
    search = scene.target_search
    if search is None:
        raise InputError(
            f"{scene.name}: expected [targets] with checkerboard_mm or sphere_radius_mm in project.toml, found none"
        )
    remarks: list[Reason] = []
    each: list[list[_Sighting]] = []
    with scanner_class_errors.without():
        for row, scan in enumerate(tracked(scene.scans)):
            at = scan.position if scan.position.size else np.zeros(3)
            found = list(find.found_in(scene, row, search, remarks))
            size = search.checkerboard_mm
            each.append(
                [
                    _Sighting(one.place - at, one.covariance, _noise(scene, row, one, at, size))
                    for one in found
                    if np.linalg.norm(one.place - at) > NEAREST_MM
                ]
            )
    return _matched(scene, each, remarks)


def _matched(scene: Scene, each: list[list[_Sighting]], remarks: list[Reason]) -> Seen:
    """Name the targets of all scans by their distances, in the frame of control points or of the fullest scan."""
    control = scene.control
    given = control is not None and len(control.ids) >= LEAST_TARGETS
    first = int(np.argmax([len(of_scan) for of_scan in each]))
    if control is not None and given:
        known, sd = control.positions, control.sd
    else:
        known = np.array([one.place for one in each[first]]).reshape(-1, 3)
        sd = np.full(len(known), np.nan)
    scans, rows, poses, sightings = [], [], [], []
    for number, of_scan in enumerate(each):
        places = np.array([one.place for one in of_scan]).reshape(-1, 3)
        named = naming.by_pattern(places, known) if len(places) and len(known) else np.zeros(0, np.int64)
        if (named >= 0).sum() < LEAST_TARGETS:
            remarks.append(
                reason("field-check.scan-left-out", scan=scene.scans[number].name, targets=int((named >= 0).sum()))
            )
            continue
        ok = named >= 0
        poses.append(rigid.fit(places[ok], known[named[ok]]))
        rows.append(named[ok])
        scans.append(number)
        sightings += [one for one, use in zip(of_scan, ok.tolist(), strict=True) if use]
    if len(scans) < LEAST_SCANS:
        raise InputError(
            f"{scene.name}: expected {LEAST_SCANS} scans or more with {LEAST_TARGETS} targets or more in common, found "
            f"{len(scans)} ({', '.join(f'{s.name}: {len(e)}' for s, e in zip(scene.scans, each, strict=True))} targets "
            "found); give the targets' size, and place them at distances that differ by more than 10 mm"
        )
    target = np.concatenate(rows)
    used, number_of = np.unique(target, return_inverse=True)
    names = control.ids if control is not None and given else tuple(f"T{k + 1}" for k in range(len(known)))
    noise = np.array([one.noise for one in sightings])
    scan = np.repeat(np.arange(len(scans)), [len(row) for row in rows])
    seen = Sightings(
        places=np.array([one.place for one in sightings]),
        covariance=np.array([one.covariance for one in sightings]),
        scan=scan,
        station=_stations(scene, scans, np.array(poses))[scan],
        target=number_of.reshape(-1),
        known=known[used] if given else np.full((len(used), 3), np.nan),
        known_sd=sd[used],
    )
    return Seen(
        sightings=seen,
        noise=Noise(white=noise[:, 0], black=noise[:, 1], bias=noise[:, 2], cosine=noise[:, 3]),
        scans=tuple(scene.scans[number].name for number in scans),
        targets=tuple(names[k] for k in used.tolist()),
        places=known[used],
        poses=np.array(poses),
        reasons=tuple(remarks),
    )


def _stations(scene: Scene, scans: list[int], poses: Floats) -> Ints:
    """Return the station (s,) of each scan: scans of one name, or from one tripod, are repeats."""
    station = np.arange(len(scans))
    for i, number in enumerate(scans):
        for j in range(i):
            named = scene.scans[number].station
            alike = named == scene.scans[scans[j]].station if named else False
            if alike or np.linalg.norm(poses[i, :3, 3] - poses[j, :3, 3]) < SAME_TRIPOD_MM:
                station[i] = station[j]
                break
    return np.unique(station, return_inverse=True)[1].reshape(-1)


def _noise(scene: Scene, row: int, one: find.Found, at: Floats, side_mm: float) -> tuple[float, float, float, float]:
    """Return the scatter of ranges on white and black, black less white, and the cosine of incidence; NaN = none.

    On a sphere the scatter is that of its inner points about a plane and its curvature, all of them white.
    """
    scan, search, nan = scene.scans[row], scene.target_search, float("nan")
    sphere = one.kind is TargetKind.SPHERE
    radius = search.sphere_radius_mm if sphere and search is not None else side_mm
    off = scan.points - (one.place - scan.origin)
    ray = (one.place - at) / np.linalg.norm(one.place - at)
    if sphere:
        length = np.linalg.norm(off, axis=1)
        on = (length < 2.0 * radius) & (-(off @ ray) > 0.7 * length) & (np.abs(length - radius) < 0.3 * radius)
        if on.sum() < LEAST_POINTS:
            return nan, nan, nan, nan
        along = (length[on] - radius) / -(off[on] @ ray / length[on])
        return robust_sd_about_median(along), nan, nan, nan
    near = np.linalg.norm(off, axis=1) < INNER * radius * np.sqrt(2.0)
    if near.sum() < LEAST_POINTS:
        return nan, nan, nan, nan
    middle = off[near] - off[near].mean(axis=0)
    normal = np.linalg.svd(middle, full_matrices=False)[2][2]
    cosine = max(abs(float(normal @ ray)), 0.1)
    distance = middle @ normal * np.sign(normal @ ray) / cosine
    bright = scan.intensity[near]
    low, high = np.quantile(bright, [0.1, 0.9])
    fields: list[Bools] = [bright > 0.75 * high + 0.25 * low, bright < 0.25 * high + 0.75 * low]
    if min(int(field.sum()) for field in fields) < LEAST_POINTS:
        return nan, nan, nan, cosine
    white, black = (float(np.std(distance[field])) for field in fields)
    return white, black, float(distance[fields[1]].mean() - distance[fields[0]].mean()), cosine
