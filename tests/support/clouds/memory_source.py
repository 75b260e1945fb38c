"""A source of points for tests: a cloud in memory, in chunks of any size."""

from dataclasses import dataclass, field

import numpy as np

from processor.space_frame.points.source import CHUNK_POINTS, UNKNOWN_STATION, Chunk


@dataclass(frozen=True)
class InMemory:
    """Points (n, 3) less ``origin`` and their stations (n,), empty = all unknown, in chunks of ``chunk_size``."""

    points: np.ndarray
    station: np.ndarray = field(default_factory=lambda: np.empty(0, np.int32))
    scanners: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    chunk_size: int = CHUNK_POINTS

    @property
    def count(self):
        return len(self.points)

    def chunks(self):
        for start in range(0, len(self.points), self.chunk_size):
            points = self.points[start : start + self.chunk_size]
            if len(self.station):
                station = self.station[start : start + self.chunk_size].astype(np.int32, copy=False)
            else:
                station = np.full(len(points), UNKNOWN_STATION, np.int32)
            yield Chunk(points, station)
