"""The scans of a scene as one source of points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numba import njit

from processor import large_arrays
from processor.geometry import rigid
from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats, Labels, Scan, Scene
from processor.space_frame.points.source import CHUNK_POINTS, UNKNOWN_STATION, Chunk


class PointReader(Protocol):
    """Reads the points of a scene's scans piece by piece, where the scene was read without them."""

    def counts(self) -> tuple[int, ...]:
        """Return the number of points of each scan."""

    def read(self, scan: int, size: int) -> Iterator[tuple[Floats, Labels]]:
        """Yield points (n, 3) of a scan, less its origin, and the station (n,) of each, or an empty one."""


@dataclass(frozen=True)
class InScans:
    """Reads the points from the scans' own arrays."""

    scans: tuple[Scan, ...]

    def counts(self) -> tuple[int, ...]:
        """Return the number of points of each scan."""
        return tuple(len(scan.points) for scan in self.scans)

    def read(self, scan: int, size: int) -> Iterator[tuple[Floats, Labels]]:
        """Yield the points of a scan and their stations."""
        points, station = self.scans[scan].points, self.scans[scan].point_station
        for start in range(0, len(points), size):
            yield points[start : start + size], station[start : start + size]
            large_arrays.release()


@dataclass(frozen=True)
class SceneSource:
    """Points of all scans in the project's frame less ``origin``; a scan without a pose is assumed to be in that frame.

    ``names`` (s,) are those of the scanners: the scene's stations where points name them, else one scanner a scan.
    """

    scans: tuple[Scan, ...]
    origin: Floats
    scanners: Floats
    names: tuple[str, ...]
    scanner_of: tuple[int, ...]  # of each scan; -1 = unknown, or named by its points
    points: PointReader
    chunk_size: int = CHUNK_POINTS

    @property
    def count(self) -> int:
        """Number of points."""
        return sum(self.points.counts())

    def chunks(self) -> Iterator[Chunk]:
        """Pass over all points."""
        for number, (scan, scanner) in enumerate(zip(self.scans, self.scanner_of, strict=True)):
            T = rigid.between_origins(scan.pose, scan.origin, self.origin)
            R, shift = T[:3, :3], T[:3, 3]
            identity = np.array_equal(R, np.eye(3)) and not shift.any()
            for points, named in self.points.read(number, self.chunk_size):
                known = scanner == UNKNOWN_STATION and len(named) > 0 and len(self.scanners) > 0
                station = named if known else np.full(len(points), scanner, np.int32)
                yield Chunk(points if identity else _moved(points, R, shift), station)


def of_scene(scene: Scene, points: PointReader | None = None) -> SceneSource:
    """Return the source of a scene's points, or of those that ``points`` reads."""
    first = scene.scans[0] if scene.scans else None
    origin = np.zeros(3) if first is None else rigid.apply(first.pose, first.origin[None])[0]
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
        T = scan.pose
        scanner_of.append(len(names))
        names.append(scan.station or scan.name)
        places.append(T[:3, :3] @ scan.position + (T[:3, 3] - origin))
    scanners = np.array(places, np.float64).reshape(-1, 3)
    return SceneSource(
        scans=scene.scans,
        origin=origin,
        scanners=scanners,
        names=tuple(names),
        scanner_of=tuple(scanner_of),
        points=points or InScans(scene.scans),
    )


def _moved(points: Floats, R: Floats, shift: Floats) -> Floats:
    """Move points (n, 3) by sums of products a coordinate: the same bytes for every place in a chunk."""
    placed = np.empty(points.shape)
    points = np.ascontiguousarray(points, np.float64).view()
    points.flags.writeable = False  # the kernel is compiled for one kind of array only
    over_ranges(partial(_move, points, np.ascontiguousarray(R), shift, placed), len(points), least=100_000)
    return placed


@njit(cache=True, nogil=True)
def _move(points, R, shift, placed, first, last):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(3):
            placed[i, k] = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + shift[k]
