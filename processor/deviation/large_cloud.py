"""A scan of more points than are held at once: sorted into slabs in files, with its outliers marked slab by slab.

Neighbours of a slab's points are searched for in it and in what lies within ``HALO`` spacings of it. Outliers are those
of the whole cloud, but for the distances of points that are alone, which are overstated. Within a slab the points are
in the order of a grid, so every k-th is an even sample.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from processor import tiles
from processor.deviation.surface_movement import Cloud
from processor.geometry import nearest_neighbours, rigid
from processor.large_arrays import allocate, blocks, release, taken
from processor.model import Bools, Floats, Ints, Labels
from processor.views import Views

SLAB_POINTS = 500_000  # work, not result: a slab and what its search needs are tens of MB
PASS_POINTS = 250_000  # in memory at once where no neighbours are searched for
BINS = 1 << 16  # across the longest axis, of which slabs consist
HALO = 20.0  # spacings about a slab: 20 neighbours of a point on a surface lie within three
SPACING_SAMPLE = 20_000  # points of a slab whose neighbours are searched: the spacing is known to better than 1 %
SAMPLE = 60_000  # points of a slab by which its spacing is estimated


@dataclass(frozen=True)
class LargeCloud:
    """Points (n, 3) in files, mm, slab by slab, the view (n,) of each, and which (n,) are inliers.

    ``scanners`` (v, 3) are the positions of the views, None where any is unknown. ``used`` are the views that are left,
    of all at first.
    """

    points: Floats
    view: Labels
    inlier: Bools
    scanners: Floats | None
    spacing_mm: float
    used: Ints

    def of(self, numbers: Ints) -> LargeCloud:
        """Return the points of some views alone."""
        return replace(self, used=numbers)

    @property
    def kept(self) -> int:
        """Number of points that are no outliers."""
        return sum(int((self.inlier[rows] & self._is_used(rows)).sum()) for rows in blocks(len(self.points)))

    def _is_used(self, rows: slice) -> Bools:
        return np.isin(self.view[rows], self.used)

    def thinned(self, inliers: bool, step: int) -> tuple[Floats, Ints]:
        """Return every k-th of the inliers, or of the others: points (k, 3) and their views (k,)."""
        chosen, count = [np.empty(0, np.int64)], 0
        for block in blocks(len(self.points), SLAB_POINTS):
            rows = np.flatnonzero(self.inlier[block] == inliers)
            chosen.append(block.start + rows[-count % step :: step])
            count += len(rows)
        rows = np.concatenate(chosen)
        return taken(self.points, rows), taken(self.view, rows).astype(np.int64)


@dataclass(frozen=True)
class Placed:
    """The points of a large cloud placed by T (4, 4): clouds of PASS_POINTS, the same in every pass."""

    cloud: LargeCloud
    T: Floats

    def __iter__(self) -> Iterator[Cloud]:
        """Pass over all points that are used."""
        large = self.cloud
        for block in blocks(len(large.points), PASS_POINTS):
            rows = np.flatnonzero(np.isin(large.view[block], large.used))
            if len(rows):
                placed = rigid.apply(self.T, large.points[block][rows])
                yield Cloud(placed, ~large.inlier[block][rows], large.view[block][rows].astype(np.int64))


def of_views(seen: Views, neighbours: int, ratio: float) -> LargeCloud:
    """Sort the points of views into slabs, and mark outliers as paper 002 does."""
    slabs = _Slabs.of(seen)
    n = int(slabs.ends[-1])
    points, view = allocate(n, 3), allocate(n, dtype=np.int32)
    place = slabs.ends - np.diff(slabs.ends, prepend=0)
    for block in seen.blocks():
        slab = slabs.of_points(block.points)
        order = np.argsort(slab, kind="stable")
        count = np.bincount(slab, minlength=len(place))
        rows = np.repeat(place - (np.cumsum(count) - count), count) + np.arange(len(slab))
        points[rows], view[rows] = block.points[order], block.view[order]
        place += count
    inlier, spacing = _inliers(slabs, points, view, neighbours, ratio)
    used = np.arange(len(seen.names))
    return LargeCloud(points, view, inlier, scanners=seen.scanners(view), spacing_mm=spacing, used=used)


@dataclass(frozen=True)
class _Slabs:
    """Slabs of about SLAB_POINTS points across an axis, in bins from ``low``; the row after the last of each (s,)."""

    axis: int
    low: float
    width: float  # of a bin
    slab_of_bin: Ints
    ends: Ints

    @classmethod
    def of(cls, seen: Views) -> _Slabs:
        """Return the slabs of points."""
        corners = [(block.points.min(axis=0), block.points.max(axis=0)) for block in seen.blocks()]
        low, high = np.min([low for low, _ in corners], axis=0), np.max([high for _, high in corners], axis=0)
        axis = int(np.argmax(high - low))
        width = max(float(high[axis] - low[axis]) / BINS, 1e-9)
        one = cls(axis, float(low[axis]), width, np.arange(BINS), ends=np.empty(0, np.int64))
        filled = np.zeros(BINS, np.int64)
        for block in seen.blocks():
            filled += np.bincount(one.of_points(block.points), minlength=BINS)
        slab_of_bin = tiles.grouped(filled, SLAB_POINTS)
        ends = np.cumsum(np.bincount(slab_of_bin, filled).astype(np.int64))
        return replace(one, slab_of_bin=slab_of_bin, ends=ends)

    def of_points(self, points: Floats) -> Ints:
        """Return the slab (n,) of points (n, 3)."""
        number = ((points[:, self.axis] - self.low) / self.width).astype(np.int64)
        return self.slab_of_bin[np.clip(number, 0, BINS - 1)]

    def rows(self, slab: int) -> slice:
        """Return the rows of a slab."""
        return slice(int(self.ends[slab - 1]) if slab else 0, int(self.ends[slab]))

    def bounds(self, slab: int) -> tuple[float, float]:
        """Return where a slab begins and ends along the axis."""
        bins = np.flatnonzero(self.slab_of_bin == slab)
        return self.low + self.width * float(bins[0]), self.low + self.width * float(bins[-1] + 1)


class _Slab(NamedTuple):
    """A slab's points and then those about it (n, 3), how many are its own, and which of these show the spacing."""

    points: Floats
    own: int
    step: int
    neighbours: int  # for the distance of outlier removal; 0: none is wanted


class _Near(NamedTuple):
    """Of a slab: its points' order (m,) in a grid, distances (m,) to neighbours, and the farthest (s,) of k."""

    order: Ints
    distance: Floats
    farthest: Floats
    k: int


def _near(slab: _Slab) -> _Near:
    """Search for the neighbours of a slab's points."""
    grid = nearest_neighbours.of_spacing(slab.points)
    own = np.flatnonzero(grid.order < slab.own)
    distance = nearest_neighbours.mean_distances(grid, slab.neighbours)[own] if slab.neighbours else np.zeros(len(own))
    farthest, k = nearest_neighbours.farthest_distances(grid, own[:: slab.step])
    return _Near(grid.order[own], distance, farthest, k)


def _inliers(slabs: _Slabs, points: Floats, view: Labels, neighbours: int, ratio: float) -> tuple[Bools, float]:
    """Mark (n,) the points that outlier removal keeps, put each slab in the order of a grid, and return the spacing."""
    n = len(points)
    distance, order = allocate(n), allocate(n, dtype=np.int32)
    farthest, total, k = list[Floats](), 0.0, 1
    filled = [slab for slab in range(len(slabs.ends)) if len(points[slabs.rows(slab)])]
    found = tiles.mapped(_near, _slabs(slabs, points, filled, neighbours if ratio > 0.0 else 0))
    for slab, near in zip(filled, found, strict=True):
        rows = slabs.rows(slab)
        order[rows], distance[rows], k = near.order, near.distance, near.k
        total += float(near.distance.sum())
        farthest.append(near.farthest)
        release()
    for slab in filled:  # not before all slabs were searched: those about a slab are parts of it
        rows = slabs.rows(slab)
        points[rows], view[rows] = points[rows][order[rows]], view[rows][order[rows]]
        release()
    inlier = allocate(n, dtype=np.bool_)
    mean = total / n
    square = sum(float(((distance[rows] - mean) ** 2).sum()) for rows in blocks(n)) if ratio > 0.0 else 0.0
    limit = mean + ratio * float(np.sqrt(square / n))
    for rows in blocks(n):
        inlier[rows] = distance[rows] <= limit if ratio > 0.0 else True
    return inlier, nearest_neighbours.spacing_of(np.concatenate(farthest), k)


def _slabs(slabs: _Slabs, points: Floats, numbers: Sequence[int], neighbours: int) -> Iterator[_Slab]:
    """Pass over slabs, each with the points about it after its own."""
    every = max(1, len(points) // SPACING_SAMPLE)
    for slab in numbers:
        own = points[slabs.rows(slab)]
        step = max(1, len(own) // SAMPLE)
        few = nearest_neighbours.spacing(nearest_neighbours.of_spacing(own[::step]))
        reach = HALO * few / np.sqrt(step) if few > 0.0 else 0.0
        low, high = slabs.bounds(slab)
        beside = [own]
        for other in range(len(slabs.ends)):
            start, stop = slabs.bounds(other)
            if other != slab and start <= high + reach and stop >= low - reach:
                part = points[slabs.rows(other)]
                along = part[:, slabs.axis]
                beside.append(part[(along >= low - reach) & (along <= high + reach)])
        yield _Slab(np.concatenate(beside), len(own), every, neighbours)
