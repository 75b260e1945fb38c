"""The scans of a scene as one source of points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numba import njit

from processor.geometry import rigid
from processor.geometry.parallel import over_ranges
from processor.model import Floats, InputError, Ints, Labels, Scan, Scene
from processor.space_frame.design import unit_mistakes
from processor.space_frame.points.source import CHUNK_POINTS, UNKNOWN_STATION, Chunk
from processor.space_frame.stations.control_points import ControlPoints

FARTHEST_MM = 1000.0  # control points that lie farther from where they were seen are of another frame


class PointReader(Protocol):
    """Points of a scene's scans, piece by piece, where the scene was read without them."""

    def counts(self) -> tuple[int, ...]:
        """Points of all scans."""

    def read(self, scan: int, size: int) -> Iterator[tuple[Floats, Labels]]:
        """Yield points (n, 3) of a scan, less its origin, and the station (n,) of each, or an empty one."""


@dataclass(frozen=True)
class InScans:
    """The points that the scans hold themselves."""

    scans: tuple[Scan, ...]

    def counts(self) -> tuple[int, ...]:
        """Points of all scans."""
        return tuple(len(scan.points) for scan in self.scans)

    def read(self, scan: int, size: int) -> Iterator[tuple[Floats, Labels]]:
        """Yield the points of a scan and their stations."""
        one = self.scans[scan]
        for start in range(0, len(one.points), size):
            yield one.points[start : start + size], one.point_station[start : start + size]


@dataclass(frozen=True)
class SceneSource:
    """Points of all scans in the project's frame less ``origin``; a scan without a pose is taken to be in it already.

    ``names`` (s,) are those of the scanners: of the scene's stations where points name them, else a scanner a scan.
    """

    scans: tuple[Scan, ...]
    origin: Floats
    scanners: Floats
    names: tuple[str, ...]
    scanner_of: tuple[int, ...]  # of each scan; -1 = unknown, or its points say it
    points: PointReader
    chunk_size: int = CHUNK_POINTS

    @property
    def count(self) -> int:
        """Points in all."""
        return sum(self.points.counts())

    def chunks(self) -> Iterator[Chunk]:
        """Pass over all points."""
        for number, (scan, scanner) in enumerate(zip(self.scans, self.scanner_of, strict=True)):
            T = _pose(scan)
            R = T[:3, :3]
            # offset less offset first: added to the points either would cost them their digits
            shift = R @ scan.origin + (T[:3, 3] - self.origin)
            still = np.array_equal(R, np.eye(3)) and not shift.any()
            for points, own in self.points.read(number, self.chunk_size):
                known = scanner == UNKNOWN_STATION and len(own) > 0 and len(self.scanners) > 0
                station = own if known else np.full(len(points), scanner, np.int32)
                yield Chunk(points if still else _moved(points, R, shift), station)


def of_scene(scene: Scene, points: PointReader | None = None) -> SceneSource:
    """Make the source of a scene's points, or of those that ``points`` reads of it."""
    first = scene.scans[0] if scene.scans else None
    origin = np.zeros(3) if first is None else rigid.apply(_pose(first), first.origin[None])[0]
    names: list[str] = []
    places: list[Floats] = []
    # A scan of one station has a position of its own; the points of a merged one name their stations.
    if scene.stations is not None and any(not scan.position.size for scan in scene.scans):
        names, places = list(scene.stations.ids), list(scene.stations.positions - origin)
    scanner_of = []
    for scan in scene.scans:
        if not scan.position.size:
            scanner_of.append(UNKNOWN_STATION)
            continue
        T = _pose(scan)
        scanner_of.append(len(names))
        names.append(scan.station or scan.name)
        places.append(T[:3, :3] @ scan.position + (T[:3, 3] - origin))
    scanners = np.array(places, np.float64).reshape(-1, 3)
    return SceneSource(scene.scans, origin, scanners, tuple(names), tuple(scanner_of), points or InScans(scene.scans))


def control_of(scene: Scene, source: SceneSource) -> ControlPoints | None:
    """Return the scene's control points as its scanners saw them; None without any from a scanner that is known.

    Raises InputError where they are known in another frame than the scans are in.
    """
    if scene.control is None or not len(scene.control.scan):
        return None
    own = scene.control
    scanner = np.array([source.scanner_of[s] if k < 0 else k for s, k in zip(own.scan, own.station, strict=True)])
    held = np.flatnonzero((scanner >= 0) & (scanner < len(source.scanners)))
    if not len(held):
        return None
    measured = np.empty((len(held), 3))
    for i, row in enumerate(held.tolist()):
        T = _pose(scene.scans[own.scan[row]])
        measured[i] = T[:3, :3] @ own.seen[row] + (T[:3, 3] - source.origin)
    target = own.positions[own.point[held]] - source.origin
    off = float(np.median(np.linalg.norm(target - measured, axis=1)))
    if off > FARTHEST_MM:
        factor = unit_mistakes.between(*_spans(own.point[held], scanner[held], target, measured))
        if factor:
            raise InputError(
                f"{scene.name}: control points lie {factor} times as far apart as the scans have them: one of the two "
                "is in another unit; correct the unit of the control points or of the scans"
            )
        raise InputError(
            f"{scene.name}: control points lie {off / 1000.0:.3g} m from where the scans have them (median); give "
            "the scans poses in the frame of the control points, or their coordinates in the scans' frame"
        )
    return ControlPoints(
        tuple(own.ids[k] for k in own.point[held].tolist()),
        measured,
        target,
        np.repeat(own.seen_sd[held, None], 3, axis=1),
        np.eye(len(source.scanners))[scanner[held]],
        own.point[held],
        own.sd[own.point[held]],
        source.names,
    )


def _spans(point: Ints, scanner: Ints, target: Floats, measured: Floats) -> tuple[Floats, Floats]:
    """Distances (n,) between control points that one scanner saw, as known, and as it saw them; poses play no part."""
    a, b = np.triu_indices(len(point), 1)
    both = (scanner[a] == scanner[b]) & (point[a] != point[b])
    a, b = a[both], b[both]
    return np.linalg.norm(target[a] - target[b], axis=1), np.linalg.norm(measured[a] - measured[b], axis=1)


def _pose(scan: Scan) -> Floats:
    return scan.T_project_scan if scan.T_project_scan.size else np.eye(4)


def _moved(points: Floats, R: Floats, shift: Floats) -> Floats:
    """Move points (n, 3), each coordinate by a sum of its own: the same bytes wherever a point stands in its chunk."""
    found = np.empty(points.shape)
    points = np.ascontiguousarray(points, np.float64).view()
    points.flags.writeable = False  # whatever it was: the kernel is compiled for one kind alone
    over_ranges(partial(_move, points, np.ascontiguousarray(R), shift, found), len(points), least=100_000)
    return found


@njit(cache=True, nogil=True)
def _move(points, R, shift, found, first, last):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(3):
            found[i, k] = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + shift[k]
