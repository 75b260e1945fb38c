"""Sources of points: any number of passes over a cloud in chunks, so that memory need not hold all of it.

All results of this package depend on the set of points alone: neither on their order nor on the chunks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from processor.model import Bools, Floats, Labels
from processor.views import Views

UNKNOWN_STATION = -1
CHUNK_POINTS = 1 << 20  # in memory at once: 25 MB; work, not result


@dataclass(frozen=True)
class Chunk:
    """Points (n, 3) in the project's frame less the source's origin, mm, and the station (n,) each was seen from.

    A station is a row of ``Source.scanners``; -1 = unknown.
    """

    points: Floats
    station: Labels


class Source(Protocol):
    """A cloud in chunks; every call of :meth:`chunks` starts a new pass over the same points.

    The coordinates of a point must be the same bytes in every pass and for every size of chunk: rotate points by sums
    of products a coordinate, not by matrix products, whose rounding depends on the row.
    """

    @property
    def origin(self) -> Floats:
        """Offset (3,) that was subtracted from all coordinates, mm, in the project's frame."""

    @property
    def scanners(self) -> Floats:
        """Positions (s, 3) of the scanners less the origin; (0, 3) where they are unknown."""

    @property
    def count(self) -> int:
        """Number of points."""

    def chunks(self) -> Iterator[Chunk]:
        """Pass over all points."""


@dataclass(frozen=True)
class SceneSource:
    """The points of a scene in the project's frame less an origin; its scanners are the views of known position."""

    views: Views
    chunk_size: int = CHUNK_POINTS

    @property
    def origin(self) -> Floats:
        """Offset (3,) that was subtracted from all coordinates, mm, in the project's frame."""
        return self.views.origin

    @property
    def scanners(self) -> Floats:
        """Positions (s, 3) of the scanners less the origin."""
        return self.views.positions[self._known]

    @property
    def names(self) -> tuple[str, ...]:
        """Names (s,) of the scanners."""
        return tuple(name for name, known in zip(self.views.names, self._known.tolist(), strict=True) if known)

    @property
    def count(self) -> int:
        """Number of points."""
        return self.views.count

    @property
    def _known(self) -> Bools:
        return np.asarray(np.isfinite(self.views.positions).all(axis=1))

    @property
    def station_of_view(self) -> Labels:
        """The row (v,) of the scanners that each view is, -1 = of unknown position."""
        return np.where(self._known, np.cumsum(self._known) - 1, UNKNOWN_STATION).astype(np.int32)

    def chunks(self) -> Iterator[Chunk]:
        """Pass over all points."""
        station = self.station_of_view
        for block in self.views.blocks(self.chunk_size):
            yield Chunk(block.points, station[block.view])
