"""A source, or gathered points, with the stations' corrections applied."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit

from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats
from processor.space_frame.points.hash_sampling import STEPS_PER_MM
from processor.space_frame.points.line_crops import FIELD, HALF, Gathered
from processor.space_frame.points.source import Chunk, Source
from processor.space_frame.stations.records import Stations


@dataclass(frozen=True)
class Corrected:
    """A source whose points and scanners are moved by the stations' corrections."""

    source: Source
    stations: Stations

    @property
    def origin(self) -> Floats:
        """Offset (3,) that was subtracted from all coordinates, mm."""
        return self.source.origin

    @property
    def scanners(self) -> Floats:
        """Corrected positions (s, 3) less the origin."""
        T = self.stations.T_project_station
        positions: Floats = np.einsum("sij,sj->si", T[:, :3, :3], self.source.scanners) + T[:, :3, 3]
        return positions

    @property
    def count(self) -> int:
        """Number of points."""
        return self.source.count

    def chunks(self) -> Iterator[Chunk]:
        """Pass over all points."""
        for chunk in self.source.chunks():
            yield Chunk(self.stations.corrected(chunk.points, chunk.station), chunk.station)


def corrected_gathered(gathered: Gathered, stations: Stations, threads: int = 0) -> Gathered:
    """Points gathered near lines, each moved by its station's correction; rounded to the same steps of 0.01 mm."""
    places = gathered.places.copy()
    kernel = partial(_correct, gathered, stations.places, stations.range_offset, stations.T_project_station, places)
    over_ranges(kernel, len(gathered.counts), threads)
    return gathered._replace(places=places)


@njit(cache=True, nogil=True)
def _correct(gathered, scanners, offset, T, corrected, first, last):  # type: ignore[no-untyped-def]
    """Write the corrected places of points near lines first..last; beyond a line's reach they stay at its edge."""
    places, room, middles = gathered.places, gathered.room, gathered.middles
    mask, most = (1 << FIELD) - 1, 2 * HALF - 1
    for m in range(first, last):
        for i in range(m * room, m * room + gathered.counts[m]):
            s = gathered.stations[i]
            if s < 0 or s >= len(scanners):
                continue
            w = places[i]
            x = ((w >> (2 * FIELD)) - HALF + middles[m, 0]) / STEPS_PER_MM
            y = (((w >> FIELD) & mask) - HALF + middles[m, 1]) / STEPS_PER_MM
            z = ((w & mask) - HALF + middles[m, 2]) / STEPS_PER_MM
            dx, dy, dz = x - scanners[s, 0], y - scanners[s, 1], z - scanners[s, 2]
            shorter = offset[s] / max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-300)
            x, y, z = x - shorter * dx, y - shorter * dy, z - shorter * dz
            place = 0
            for k in range(3):
                value = T[s, k, 0] * x + T[s, k, 1] * y + T[s, k, 2] * z + T[s, k, 3]
                step = np.int64(np.rint(value * STEPS_PER_MM)) - middles[m, k] + HALF
                place = (place << FIELD) | min(max(step, 0), most)
            corrected[i] = place
