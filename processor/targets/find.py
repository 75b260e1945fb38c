"""Targets of a scene: found in its scans, named by the known coordinates, and put among its control points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from processor.adjustment import scanner_class_errors
from processor.geometry import rigid
from processor.model import Control, Floats, Ints, Reason, Scene, TargetKind, Targets, TargetSearch, reason
from processor.scene_cloud import MergedCloud
from processor.space_frame.params import Params
from processor.space_frame.result import Balls, Flag
from processor.space_frame.spheres import search_without_design
from processor.targets import checkerboard, naming
from processor.targets.checkerboard import Checkerboard
from processor.views import Views, views

# Covariance of a place beside that of its fit, which does not see how flat the sheet is: 0.05 mm along each axis.
# Real repeats from one place scatter by 0.02 to 0.09 mm where fits of 8,000 points state 0.01 (3.6 to 22.5 m).
LEAST = 0.05**2 * np.eye(3)
MOST_SPHERES = 30  # of a view


@dataclass(frozen=True, kw_only=True)
class Found:
    """A target in a scan, in the scan's frame; ``station`` as in Control.

    ``covariance`` (3, 3) has what the class of the scanner, or its check, says of a sighting: no fit of one target
    shows it. ``scanner`` (3,) is where it was seen from, None if not known.
    """

    kind: TargetKind
    scan: int
    station: int
    place: Floats
    scanner: Floats | None
    covariance: Floats
    points: int
    fit: float

    @property
    def sd(self) -> float:
        """The largest standard deviation along any direction, mm."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


def with_targets(scene: Scene) -> Scene:
    """Return the scene with the targets that it is searched for; as it is where it asks for none, or has some."""
    search = scene.target_search
    if search is None or scene.targets is not None:
        return scene
    found: list[Found] = []
    remarks: list[Reason] = []
    for row, scan in enumerate(scene.scans):
        with scanner_class_errors.used(scanner_class_errors.of_scan(scene.instruments, scan.name)):
            found += found_in(scene, row, search, remarks)
    names = _names(scene, found, remarks)
    return replace(
        scene,
        targets=Targets.from_items(
            found,
            name=tuple("" if row < 0 or scene.control is None else scene.control.ids[row] for row in names.tolist()),
            places=np.array([one.place for one in found]).reshape(-1, 3),
            sd=np.array([one.sd for one in found]),
        ),
        target_remarks=tuple(remarks),
        control=_with_sightings(scene.control, found, names),
    )


def found_in(scene: Scene, row: int, search: TargetSearch, remarks: list[Reason]) -> Iterator[Found]:
    """Yield the targets of a scan; what is to be said of the search is added to ``remarks``."""
    scan = scene.scans[row]
    if not np.isnan(search.checkerboard_mm) and not np.isfinite(scan.intensity).any():
        remarks.append(reason("targets.no-intensities", scan=scan.name))
    for station, points, bright, scanner in _of_views(views(scene), row):
        if not np.isnan(search.checkerboard_mm):
            boards, left_out = checkerboard.search(points, bright, search.checkerboard_mm)
            for one in boards:
                yield _of_board(one, row, station, scan.origin, scanner)
            if left_out:
                looked_at = checkerboard.MOST_SEEDS
                remarks.append(reason("targets.most-places", scan=scan.name, places=looked_at, left=left_out))
        if not np.isnan(search.sphere_radius_mm):
            balls = _spheres(points, scanner, search.sphere_radius_mm)
            for k in (k for k, flag in enumerate(balls.flag) if flag is Flag.OK):
                yield _of_sphere(balls, k, row, station, scan.origin, scanner)
            if len(balls) >= MOST_SPHERES:
                remarks.append(reason("targets.most-spheres", scan=scan.name, spheres=len(balls)))


def _spheres(points: Floats, scanner: Floats | None, radius_mm: float) -> Balls:
    """Return the spheres among points (n, 3), flagged ones too, by the search of step ``spheres``.

    ``scanner`` (3,) is where the points were seen from, None if not known.
    """
    seen_from = None if scanner is None else np.broadcast_to(scanner, points.shape)
    params = Params(radius_mm=radius_mm, max_balls=MOST_SPHERES)
    return search_without_design.search(MergedCloud(points, np.zeros(3), seen_from), params).balls


def _of_board(one: Checkerboard, scan: int, station: int, origin: Floats, scanner: Floats | None) -> Found:
    return Found(
        kind=TargetKind.CHECKERBOARD, scan=scan, station=station, place=one.centre + origin,
        scanner=None if scanner is None else scanner + origin,
        covariance=one.covariance + LEAST + _by_class(one.centre, scanner, of_range=True),
        points=one.points, fit=one.fit,
    )  # fmt: skip


def _of_sphere(balls: Balls, row: int, scan: int, station: int, origin: Floats, scanner: Floats | None) -> Found:
    return Found(
        kind=TargetKind.SPHERE, scan=scan, station=station, place=balls.centres[row] + origin,
        scanner=None if scanner is None else scanner + origin,
        # A ball's own has the range of the class.
        covariance=balls.covariance[row, :3, :3] + LEAST + _by_class(balls.centres[row], scanner, of_range=False),
        points=int(balls.points[row]), fit=float("nan"),
    )  # fmt: skip


def _by_class(place: Floats, scanner: Floats | None, of_range: bool) -> Floats:
    """Return the covariance (3, 3) of a sighting by the scanner's errors: along its ray, and across it."""
    known = scanner_class_errors.known()
    if scanner is None:  # of unknown range: from any side
        return known.view_mm**2 * np.eye(3) if of_range else np.zeros((3, 3))
    length = float(np.linalg.norm(place - scanner))
    along = np.outer(place - scanner, place - scanner) / max(length, 1e-9) ** 2
    variance = known.view_mm**2 + (known.scale * length) ** 2 if of_range else 0.0
    covariance: Floats = variance * along + (known.direction_rad * length) ** 2 * (np.eye(3) - along)
    return covariance


def _of_views(seen: Views, row: int) -> Iterator[tuple[int, Floats, Floats, Floats | None]]:
    """Yield station, points, intensities and the scanner's place, the latter less the scan's origin, of each view."""
    scan, back = seen.scans[row], rigid.invert(seen.poses[row])
    bright = scan.intensity if len(scan.intensity) else np.full(len(scan.points), np.nan)
    of_points = seen.of_points(row, scan.point_station, len(scan.points))
    for view in np.unique(of_points).tolist():
        rows, position = of_points == view, seen.positions[view]
        at = rigid.apply(back, position) if np.isfinite(position).all() else None
        yield view if view < seen.stations else -1, scan.points[rows], bright[rows], at


def _names(scene: Scene, found: list[Found], remarks: list[Reason]) -> Ints:
    """Return the row (t,) of the control point that each target is, -1 = none.

    A remark on targets that contradict the others is added to ``remarks``.
    """
    rows = np.full(len(found), -1, np.int64)
    if scene.control is None:
        return rows
    for key in dict.fromkeys((one.scan, one.station) for one in found):
        of_view = [i for i, one in enumerate(found) if (one.scan, one.station) == key]
        places = np.array([found[i].place for i in of_view])
        scan = scene.scans[key[0]]
        named, near = np.full(len(of_view), -1, np.int64), 0
        if scan.T_project_scan.size or key[1] >= 0:
            posed = rigid.apply(scan.pose, places)
            near = int((naming.nearest(posed, scene.control.positions) >= 0).sum())
            named = naming.by_pose(posed, scene.control.positions)
        if (named < 0).all():
            named = naming.by_pattern(places, scene.control.positions)
        contradict = near - int((named >= 0).sum())
        if contradict > 0:
            remarks.append(reason("targets.contradict", scan=scan.name, targets=contradict, mm=naming.NEAR_MM))
        rows[of_view] = named
    return rows


def _with_sightings(control: Control | None, found: list[Found], names: Ints) -> Control | None:
    """Add the named targets to the sightings; one that the project states already stays as stated."""
    if control is None:
        return None
    stated = set(zip(control.point.tolist(), control.scan.tolist(), control.station.tolist(), strict=True))
    new = [
        (row, one)
        for row, one in zip(names.tolist(), found, strict=True)
        if row >= 0 and (row, one.scan, one.station) not in stated
    ]
    return replace(
        control,
        point=np.concatenate([control.point, np.array([row for row, _ in new], np.int64)]),
        scan=np.concatenate([control.scan, np.array([one.scan for _, one in new], np.int64)]),
        station=np.concatenate([control.station, np.array([one.station for _, one in new], np.int64)]),
        seen=np.concatenate([control.seen, np.array([one.place for _, one in new]).reshape(-1, 3)]),
        seen_sd=np.concatenate([control.seen_sd, np.array([one.sd for _, one in new])]),
    )
