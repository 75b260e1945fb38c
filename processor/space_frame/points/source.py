"""Where points come from: any number of passes over a cloud in chunks, so that no one needs to hold all of it.

All results of this package depend on the set of points alone: neither on their order nor on how they are cut up.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from processor.model import Floats, Labels

UNKNOWN_STATION = -1
CHUNK_POINTS = 1 << 20


@dataclass(frozen=True)
class Chunk:
    """Points (n, 3) in the project's frame less the source's origin, mm, and the station (n,) each was seen from.

    A station is a row of ``Source.scanners``; -1 = unknown.
    """

    points: Floats
    station: Labels


class Source(Protocol):
    """A cloud in chunks; every call of :meth:`chunks` starts a new pass over the same points.

    The coordinates of one point must be the same bytes in every pass and in every way of cutting up the cloud: turn
    points by sums of products a coordinate, not by matrix products whose rounding depends on where a row stands.
    """

    @property
    def origin(self) -> Floats:
        """What was taken off all coordinates (3,), mm, in the project's frame."""

    @property
    def scanners(self) -> Floats:
        """Positions (s, 3) of the scanners less the origin; (0, 3) where they are unknown."""

    @property
    def count(self) -> int:
        """Points in all."""

    def chunks(self) -> Iterator[Chunk]:
        """Pass over all points."""


@dataclass(frozen=True)
class InMemory:
    """A cloud that is held in memory: points (n, 3) less ``origin``, in chunks of ``chunk_size``.

    ``station`` (n,) may be left out (empty): then all are unknown.
    """

    points: Floats
    station: Labels = field(default_factory=lambda: np.empty(0, np.int32))
    scanners: Floats = field(default_factory=lambda: np.empty((0, 3)))
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    chunk_size: int = CHUNK_POINTS

    @property
    def count(self) -> int:
        """Points in all."""
        return len(self.points)

    def chunks(self) -> Iterator[Chunk]:
        """Pass over all points."""
        for start in range(0, len(self.points), self.chunk_size):
            points = self.points[start : start + self.chunk_size]
            if len(self.station):
                station = self.station[start : start + self.chunk_size].astype(np.int32, copy=False)
            else:
                station = np.full(len(points), UNKNOWN_STATION, np.int32)
            yield Chunk(points, station)
