"""The views of a scene: from where its points were seen. The only place that numbers stations.

A view is what one scanner measured from one position. A scan with a position is one view. The points of a scan without
one, a merged cloud, may name stations of the scene: each station is a view, whichever scans name it, and the points of
the scan that name none are one view more, of unknown position.

Views are numbered: first the stations in their order, if any scan has no position of its own, then one view a scan.
"""
# Numba infers the types of the kernel's arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit

from processor import large_arrays
from processor.geometry import rigid
from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats, Ints, Labels, Scan, Scene

LEAST_RANGE = 100_000  # points per task of a thread: a point takes some nanoseconds


class PointReader(Protocol):
    """Reads the points of a scene's scans piece by piece, where the scene was read without them."""

    def counts(self) -> tuple[int, ...]:
        """Return the number of points of each scan."""

    def read(self, scan: int, size: int) -> Iterator[tuple[Floats, Labels]]:
        """Yield points (n, 3) of a scan, less its origin, and the station (n,) of each, or an empty one."""


@dataclass(frozen=True)
class _InScans:
    """Reads the points from the scans' own arrays."""

    scans: tuple[Scan, ...]

    def counts(self) -> tuple[int, ...]:
        """Return the number of points of each scan."""
        return tuple(len(scan.points) for scan in self.scans)

    def read(self, scan: int, size: int) -> Iterator[tuple[Floats, Labels]]:
        """Yield the points of a scan and their stations."""
        for rows in large_arrays.blocks(len(self.scans[scan].points), size):
            yield self.scans[scan].points[rows], self.scans[scan].point_station[rows]


class SeenBlock(NamedTuple):
    """Some points (n, 3), mm, of the frame that was requested, and the view (n,) that each is of."""

    points: Floats
    view: Labels


@dataclass(frozen=True)
class Views:
    """Views of a scene in a frame less ``origin`` (3,), mm.

    ``names`` (v,) are ids of stations, or the station or else the name of a scan; ``positions`` (v, 3) those of the
    scanners, NaN = unknown. Of the first ``stations`` views each is the row of Scene.stations; ``poses`` (4, 4) map the
    points of each scan, less its origin, to the frame.
    """

    names: tuple[str, ...]
    positions: Floats
    stations: int
    origin: Floats
    scans: tuple[Scan, ...]
    poses: tuple[Floats, ...]
    reader: PointReader

    @property
    def count(self) -> int:
        """Number of points."""
        return sum(self.reader.counts())

    @property
    def unnamed(self) -> bool:
        """Whether the points are one scan, which may be merged from several views of which nothing is known."""
        only = self.scans[0] if len(self.scans) == 1 else None
        return only is not None and not only.position.size and not (self.stations and len(only.point_station))

    def of_scan(self, scan: int) -> int:
        """Return the view of the points of a scan that name no station."""
        return self.stations + scan

    def of_points(self, scan: int, station: Ints | Labels | Sequence[int], count: int) -> Labels:
        """Return the views (n,) of ``count`` points of a scan by their ``station`` (n,), -1 = none; () = all none."""
        own = self.of_scan(scan)
        if self.scans[scan].position.size or not self.stations or not len(station):
            return np.full(count, own, np.int32)
        return np.where(np.asarray(station) < 0, own, station).astype(np.int32)

    def scanners(self, view: Ints | Labels) -> Floats | None:
        """Return the positions (v, 3) of all views; None where that of any of the points' views (n,) is unknown."""
        used = np.zeros(len(self.names), bool)
        for rows in large_arrays.blocks(len(view)):
            used[view[rows]] = True
        return self.positions if np.isfinite(self.positions[used]).all() else None

    def blocks(self, size: int = 0, scan: int | None = None, view: int | None = None) -> Iterator[SeenBlock]:
        """Pass over all points in the order of the scans, or those of one ``scan`` or one ``view``.

        The coordinates of a point are the same bytes whatever the ``size`` of the blocks; 0 = of large_arrays.
        """
        for number in range(len(self.scans)) if scan is None else [scan]:
            if view not in (None, self.of_scan(number)) and (view >= self.stations or self.scans[number].position.size):
                continue
            for points, station in self.reader.read(number, size or large_arrays.BLOCK_ROWS):
                of_points = self.of_points(number, station, len(points))
                if view is not None:
                    points, of_points = points[of_points == view], of_points[of_points == view]
                if len(points) or view is None:
                    yield SeenBlock(_placed(points, self.poses[number]), of_points)
                large_arrays.release()

    def placed(self) -> SeenBlock:
        """Return all points (n, 3) in the order of the scans, and their views (n,); many lie in files."""
        points, view = large_arrays.allocate(self.count, 3), large_arrays.allocate(self.count, dtype=np.int32)
        done = 0
        for block in self.blocks():
            part = slice(done, done + len(block.points))
            points[part], view[part], done = block.points, block.view, part.stop
        return SeenBlock(points, view)


def views(
    scene: Scene, T: Floats | None = None, origin: Floats | None = None, reader: PointReader | None = None
) -> Views:
    """Return the views of a scene, mm, in the frame that T (4, 4) maps the project's to; without it in the project's.

    A scan without a pose is taken to be in the project's frame already. Coordinates are less ``origin`` (3,); without
    it, less that of the first scan. ``reader`` reads the points where the scene was read without them.
    """
    T = np.eye(4) if T is None else T
    if origin is None:
        origin = rigid.apply(T @ scene.scans[0].pose, scene.scans[0].origin) if scene.scans else np.zeros(3)
    named = scene.stations if any(not scan.position.size for scan in scene.scans) else None
    names = [] if named is None else list(named.ids)
    to_frame = rigid.between_origins(T, np.zeros(3), origin)
    positions = [] if named is None else list(rigid.apply(to_frame, named.positions))
    poses, stations = [], len(names)
    for scan in scene.scans:
        pose = rigid.between_origins(T @ scan.pose, scan.origin, origin)
        poses.append(pose)
        names.append(scan.name if scan.station in ("", *names) else scan.station)
        known = scan.position.size > 0
        positions.append(rigid.apply(pose, scan.position - scan.origin) if known else np.full(3, np.nan))
    return Views(
        names=tuple(names), positions=np.reshape(positions, (-1, 3)), stations=stations, origin=origin,
        scans=scene.scans, poses=tuple(poses), reader=reader or _InScans(scene.scans),
    )  # fmt: skip


def _placed(points: Floats, T: Floats) -> Floats:
    """Map points (n, 3) by sums of products a coordinate: the rounding of a matrix product depends on the row."""
    if np.array_equal(T, np.eye(4)):
        return points
    placed = np.empty(points.shape)
    points = large_arrays.read_only(np.ascontiguousarray(points, np.float64))  # the kernel is compiled for one kind
    R, shift = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
    over_ranges(partial(_place, points, R, shift, placed), len(points), least=LEAST_RANGE)
    return placed


@njit(cache=True, nogil=True)
def _place(points, R, shift, placed, first, last):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(3):
            placed[i, k] = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + shift[k]
