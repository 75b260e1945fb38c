"""The scans of a scene as one source of points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from processor.bolt_balls.source import CHUNK_POINTS, UNKNOWN_STATION, Chunk
from processor.geometry import rigid
from processor.model import Floats, Labels, Scan, Scene


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
    chunk_size: int = CHUNK_POINTS

    @property
    def count(self) -> int:
        """Points in all."""
        return sum(len(scan.points) for scan in self.scans)

    def chunks(self) -> Iterator[Chunk]:
        """Pass over all points."""
        for scan, scanner in zip(self.scans, self.scanner_of, strict=True):
            T = _pose(scan)
            R = T[:3, :3]
            # offset less offset first: added to the points either would cost them their digits
            shift = R @ scan.origin + (T[:3, 3] - self.origin)
            still = np.array_equal(T, np.eye(4)) and not shift.any()
            for start in range(0, len(scan.points), self.chunk_size):
                part = slice(start, start + self.chunk_size)
                points = scan.points[part]
                yield Chunk(points if still else _moved(points, R, shift), self._stations(scan, scanner, part))

    def _stations(self, scan: Scan, scanner: int, part: slice) -> Labels:
        if scanner == UNKNOWN_STATION and len(scan.point_station) and len(self.scanners):
            return scan.point_station[part]
        return np.full(len(scan.points[part]), scanner, np.int32)


def of_scene(scene: Scene) -> SceneSource:
    """Make the source of a scene's points."""
    first = scene.scans[0] if scene.scans else None
    origin = np.zeros(3) if first is None else rigid.apply(_pose(first), first.origin[None])[0]
    names: list[str] = []
    places: list[Floats] = []
    if scene.stations is not None and any(len(scan.point_station) for scan in scene.scans):
        names, places = list(scene.stations.ids), list(scene.stations.positions - origin)
    scanner_of = []
    for scan in scene.scans:
        if len(scan.point_station) or not scan.position.size:
            scanner_of.append(UNKNOWN_STATION)
            continue
        T = _pose(scan)
        scanner_of.append(len(names))
        names.append(scan.station or scan.name)
        places.append(T[:3, :3] @ scan.position + (T[:3, 3] - origin))
    scanners = np.array(places, np.float64).reshape(-1, 3)
    return SceneSource(scene.scans, origin, scanners, tuple(names), tuple(scanner_of))


def _pose(scan: Scan) -> Floats:
    return scan.T_project_scan if scan.T_project_scan.size else np.eye(4)


def _moved(points: Floats, R: Floats, shift: Floats) -> Floats:
    """Move points (n, 3), each coordinate by a sum of its own: the same bytes wherever a point stands in its chunk."""
    found = np.empty_like(points)
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    for k in range(3):
        found[:, k] = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + shift[k]
    return found
