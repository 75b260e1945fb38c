"""Points of a scene file piece by piece, for clouds larger than memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import processor.store.scan_tiles as scan_tiles
from processor.model import Floats, InputError, Labels
from processor.store.checksums import ChecksumError
from processor.store.codec import DecodeError
from processor.store.store import opened

PIECE = 1 << 20  # points read at once: 24 MB; work, not result


@contextmanager
def _naming_the_file(group: Any) -> Iterator[None]:
    """Raise InputError for damage that is found while points are read: steps take no other for the input's."""
    try:
        yield
    except (DecodeError, ChecksumError, OSError) as error:
        raise InputError(str(error), path=group.file.filename) from error


@dataclass(frozen=True)
class StoredPoints:
    """The points of the scans of an open scene file; a scan is named by its number in the file."""

    scans: tuple[Any, ...]

    def counts(self) -> tuple[int, ...]:
        """Return the number of points of each scan."""
        return tuple(len(scan_tiles.column(scan, "points")) for scan in self.scans)

    def read(self, scan: int, size: int = PIECE) -> Iterator[tuple[Floats, Labels]]:
        """Yield points (n, 3), relative to the scan's origin, and their stations: (n,), or empty where unknown."""
        with _naming_the_file(self.scans[scan]):
            stations = scan_tiles.pieces(self.scans[scan], "point_station", size)
            for points in scan_tiles.pieces(self.scans[scan], "points", size):
                yield points, next(stations, scan_tiles.NO_STATIONS)

    def column(self, scan: int, name: str) -> Any:
        """Return a per-point column of a scan, to be read in slices; one that is absent is empty."""
        return scan_tiles.column(self.scans[scan], name)

    def samples(self, tiles: int) -> Iterator[Floats]:
        """Yield the points (n, 3) of some whole tiles of each scan, spread evenly over it; ``tiles`` of all scans."""
        for scan in self.scans:
            with _naming_the_file(scan):
                yield scan_tiles.some_tiles(scan, max(1, tiles // len(self.scans)))

    def near(self, boxes: Sequence[tuple[Floats, Floats]]) -> NearBoxes:
        """Restrict each scan to the tiles about boxes: lower and upper corners (k, 3), mm, less the scan's origin."""
        return NearBoxes(self, tuple(boxes))

    def pieces(self, scan: int, name: str) -> tuple[tuple[int, ...], Iterator[Any]]:
        """Return the shape of a per-point column and an iterator over it; see :func:`.store.scene_hash`."""
        return self.column(scan, name).shape, scan_tiles.pieces(self.scans[scan], name, PIECE)


@dataclass(frozen=True)
class NearBoxes:
    """Points of the tiles that boxes of each scan touch, without their stations; other tiles are not read."""

    stored: StoredPoints
    boxes: tuple[tuple[Floats, Floats], ...]

    def counts(self) -> tuple[int, ...]:
        """Return the number of points of each scan in those tiles."""
        return tuple(sum(len(points) for points, _ in self.read(scan)) for scan in range(len(self.boxes)))

    def read(self, scan: int, size: int = PIECE) -> Iterator[tuple[Floats, Labels]]:
        """Yield points (n, 3), relative to the scan's origin, in the order of the file."""
        group = self.stored.scans[scan]
        with _naming_the_file(group):
            for points in scan_tiles.near_boxes(group, *self.boxes[scan], size):
                yield points, scan_tiles.NO_STATIONS


@contextmanager
def points_of(path: Path) -> Iterator[StoredPoints]:
    """Open a scene file for its points. Raises InputError for a file that is damaged or of another kind."""
    with opened(path, ["scene"]) as file:
        scans = file["scene"]["scans"]
        yield StoredPoints(tuple(scans[name] for name in scans) if hasattr(scans, "keys") else ())
