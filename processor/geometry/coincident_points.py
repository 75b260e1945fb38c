"""Points at one place: duplicates, as after merging overlapping exports, told from places that rounding makes one.

Rounded coordinates lie on a lattice, and honest points of a dense cloud may then share a place. Where noise and surface
are wider than a step of the lattice, they share one as often as they lie at neighbouring places: along a line in at
most three of the 13 directions, in a plane or in space in more. More pairs at one place than that are duplicates, and
so are points of which every place has the same number, or a multiple of it. Copies that were rounded or registered on
their own lie beside each other: the nearest neighbour is far nearer than the fourth (Clark and Evans 1954).
"""

# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial import cKDTree

from processor import large_arrays
from processor.geometry.thinning import thinned
from processor.model import Bools, Floats, Ints

Keys = npt.NDArray[np.uint64]

SAMPLE = 1 << 17  # points that decide: those of some blocks of places, drawn by a hash
LATTICE_SAMPLE = 1 << 14  # points that show the step of an axis
LEAST_STEP = 1e-9  # of a cloud's extent: a thousandth of what scanners and files resolve
PRECISION = 1e-14  # of the greatest coordinate: several times the rounding of sums of float64
STEP_TOLERANCE = 0.01  # of a step: departure of a coordinate from a multiple of it
BLOCK = 16  # places along an edge of a block: few neighbours lie in another block
DIRECTIONS = 3  # in which the neighbours lie of points on a line, the fewest
FEWEST_PAIRS, SURE = 3.0, 3.0  # pairs that no share of points explains, and standard deviations of the pairs
FEWEST_PLACES = 32  # that all have even numbers by chance once in 4e9 clouds
BESIDE = 5  # the point itself and four neighbours
COPY_RATIO, LEAST_COPIES = 0.05, 0.05  # of distances to the first and fourth neighbour; 0.8 % of chance points are so
FEWEST_COPIED = 100  # points of a cloud, of which 5 lie so by chance once in 700
SMALL_STEP = 0.1  # of the distance to the fourth neighbour: coarser rounding makes neighbours of places
PLACES, PLACE_POINTS = 8, 2000  # of a cloud that are looked at: 45 points wide
LOOKED_AT = 500  # points of a place: a share of 5 % is known to 1 %
FEW: dict[str, bool] = {"balanced_tree": False, "compact_nodes": False}  # of trees that are asked for few points
NEIGHBOURS = np.array([step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)], np.int64)  # of 26
# Odd numbers that mix bits: of the golden ratio (SplitMix64), and two primes of xxHash64.
MIXERS = tuple(np.uint64(number) for number in (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9))


@dataclass(frozen=True)
class Lattice:
    """The ``lowest`` coordinates (3,) of a cloud and the ``step`` (3,) that they are rounded to; 0 = not rounded.

    Coordinates that are not rounded are told apart to ``least``. All are in the unit of the cloud.
    """

    lowest: Floats
    step: Floats
    least: float

    def places(self, points: Floats) -> Ints:
        """Return the place (n, 3) of points (n, 3), in steps from the lowest."""
        places: Ints = np.rint((points - self.lowest) / self.width).astype(np.int64)
        return places

    @property
    def width(self) -> Floats:
        """Width (3,) of a place."""
        width: Floats = np.maximum(self.step, self.least)
        return width


@dataclass(frozen=True)
class _Clouds:
    """Clouds (n, 3) of one frame as one; to the points of each its ``offset`` (3,) is added."""

    clouds: Sequence[Floats]
    offsets: Sequence[Floats]

    @property
    def count(self) -> int:
        return sum(map(len, self.clouds))

    def blocks(self) -> Iterator[tuple[slice, Floats, Floats]]:
        """Yield points (m, 3), their rows among all, and their offset."""
        first = 0
        for cloud, offset in zip(self.clouds, self.offsets, strict=True):
            for rows in large_arrays.blocks(len(cloud)):
                yield slice(first + rows.start, first + rows.stop), cloud[rows], offset
            first += len(cloud)

    def lattice(self) -> Lattice:
        share = LATTICE_SAMPLE // len(self.clouds)
        samples = [
            thinned(cloud, share)[: 2 * share] + offset for cloud, offset in zip(self.clouds, self.offsets, strict=True)
        ]
        return lattice_of(np.concatenate(samples))


def lattice_of(points: Floats) -> Lattice:
    """Find the lattice that the coordinates of points (n, 3) are rounded to, axis by axis."""
    sample = np.asarray(thinned(points, LATTICE_SAMPLE)[: 2 * LATTICE_SAMPLE])
    extent = float(large_arrays.span(sample).max())
    least = max(LEAST_STEP * extent, PRECISION * float(np.abs(sample).max()), 1e-300)
    return Lattice(
        large_arrays.corners(sample)[0], np.array([_step(np.sort(column), least) for column in sample.T]), least
    )


def rounding_of(points: Floats) -> float:
    """Return the step that the coordinates of points (n, 3) are rounded to; 0 = not rounded.

    It is the least of the axes along which they differ: profiles at even distances, and the nodes of a grid in plan,
    have greater steps along one or two axes, and other coordinates with all their digits.
    """
    step = lattice_of(points).step[large_arrays.span(points) > 0.0]
    return float(step.min()) if len(step) else 0.0


def _step(values: Floats, least: float) -> float:
    """Return the greatest length that the differences of ascending values (n,) are multiples of (Euclid); 0 = none."""
    rest = np.diff(values)
    rest = rest[rest > 0.0]
    step = np.inf
    while len(rest):
        step = float(rest.min())
        if step < least:
            return 0.0
        rest = np.abs(rest - np.rint(rest / step) * step)
        rest = rest[rest > max(STEP_TOLERANCE * step, least)]
    if not np.isfinite(step):
        return 0.0
    extent = float(values[-1] - values[0])
    return extent / max(round(extent / step), 1)


def used_once(points: Floats) -> Bools | None:
    """Mark which of points (n, 3) to use so that each counts once; None where there are no duplicates.

    The first of coincident points in their order is used. Where all places hold multiples of a number, as many copies
    were merged: of a place every such share is used once.
    """
    used = used_once_of([points], [np.zeros(3)])
    return None if used is None else used[0]


def used_once_of(clouds: Sequence[Floats], offsets: Sequence[Floats]) -> list[Bools] | None:
    """Mark as :func:`used_once` does for clouds of one frame; to the points of each its offset (3,) is added."""
    filled = [(cloud, offset) for cloud, offset in zip(clouds, offsets, strict=True) if len(cloud)]
    if not filled:
        return None
    whole = _Clouds(*zip(*filled, strict=True))
    lattice = whole.lattice()
    if _are_duplicated(lattice, _sampled(whole, lattice)):
        used = _used(whole, lattice)
    else:  # within each: scans from one tripod lie beside each other, and are measurements of their own
        used = np.concatenate([_without_copies(cloud, float(lattice.step.max())) for cloud in whole.clouds])
    return None if used.all() else np.split(used, np.cumsum([len(cloud) for cloud in clouds])[:-1])


def some_places(points: Floats) -> list[Ints]:
    """Return the rows (m,) of all points at some places of a cloud (n, 3)."""
    sample = np.asarray(thinned(points, SAMPLE))
    share = -(-min(PLACE_POINTS, len(points)) * len(sample) // len(points))
    number = max(1, min(PLACES, len(points) // PLACE_POINTS))
    of_places = []
    for row in ((np.arange(number) + 0.5) * len(points) / number).astype(np.int64):
        square = np.partition(np.sum((sample - points[row]) ** 2, axis=1), share - 1)[share - 1]
        near = np.flatnonzero(np.abs(points[:, 0] - points[row, 0]) <= np.sqrt(square))
        of_places.append(near[np.sum((points[near] - points[row]) ** 2, axis=1) <= square])
    return of_places


def _without_copies(points: Floats, step: float) -> Bools:
    """Mark all points (n, 3) but those that lie beside an earlier one, if more do than by chance."""
    beside = np.zeros(len(points), bool)
    if not FEWEST_COPIED <= len(points) <= large_arrays.AT_ONCE:
        return ~beside
    points = np.asarray(points)
    near = [
        cKDTree(points[rows], **FEW).query(points[rows[:: max(len(rows) // LOOKED_AT, 1)]], k=BESIDE)[0]
        for rows in some_places(points)
    ]
    away = np.concatenate(near)
    copied = away[:, 1] < COPY_RATIO * away[:, -1]
    if np.mean(copied) < LEAST_COPIES or step > SMALL_STEP * float(np.median(away[:, -1])):
        return ~beside
    tree = cKDTree(points)
    for block in large_arrays.blocks(len(points)):
        away, row = tree.query(points[block], k=BESIDE)
        earlier = row < np.arange(block.start, block.stop)[:, None]
        beside[block] = np.any(earlier & (away < COPY_RATIO * away[:, -1:]), axis=1)
    return ~beside


@njit(cache=True, nogil=True)
def _fill_keys(points, offset, lowest, width, edge, keys):  # type: ignore[no-untyped-def]
    """Write a number (n,) for the blocks of places, ``edge`` (3,) places wide, of points (n, 3) + ``offset`` (3,).

    Two of a hundred million have one number with a chance of 3e-4.
    """
    for row in range(len(points)):
        key = np.uint64(0)
        for axis in range(3):
            place = int(np.rint((points[row, axis] + offset[axis] - lowest[axis]) / width[axis])) // edge[axis]
            key = (key ^ np.uint64(place)) * MIXERS[axis]
            key ^= key >> np.uint64(29)
        keys[row] = key * MIXERS[0]


def _keys(points: Floats, offset: Floats, lattice: Lattice, edge: int | Ints = 1) -> Keys:
    keys = np.empty(len(points), np.uint64)
    edges = np.broadcast_to(edge, 3).astype(np.int64)
    _fill_keys(large_arrays.read_only(np.ascontiguousarray(points)), offset, lattice.lowest, lattice.width, edges, keys)
    return keys


def _keys_of_places(places: Ints) -> Keys:
    return _keys(places.astype(np.float64), np.zeros(3), Lattice(np.zeros(3), np.ones(3), 1.0))


def _sampled(whole: _Clouds, lattice: Lattice) -> Ints:
    """Return the places (m, 3) of all points in some blocks of places, about SAMPLE of them."""
    edge = np.where(lattice.step > 0.0, BLOCK, 1)
    every = whole.count <= SAMPLE
    most = np.uint64(min(SAMPLE / whole.count, 0.5) * 2.0**64)
    parts = []
    for _, points, offset in whole.blocks():
        drawn = slice(None) if every else _keys(points, offset, lattice, edge) < most
        parts.append(lattice.places(points[drawn] + offset))
    return np.concatenate(parts)


def _are_duplicated(lattice: Lattice, places: Ints) -> bool:
    """Whether more of places (m, 3) coincide than the lattice explains."""
    every = _keys_of_places(places)
    ordered = np.sort(every)
    if not (ordered[1:] == ordered[:-1]).any():
        return False
    keys, first, count = np.unique(every, return_index=True, return_counts=True)
    pairs = float(np.sum(count * (count - 1.0)))
    rounded = lattice.step > 0.0
    across = int(np.ptp(places, axis=0).max())
    if pairs <= DIRECTIONS * FEWEST_PAIRS or across < (FEWEST_PLACES if rounded.any() else 1):
        return False  # by chance, or the cloud is hardly larger than a step
    if len(keys) >= FEWEST_PLACES and np.gcd.reduce(count) > 1:
        return True
    beside = 0.0
    for step in NEIGHBOURS[~np.any((NEIGHBOURS != 0) & ~rounded, axis=1)]:
        neighbour = _keys_of_places(places[first] + step)
        at = np.minimum(np.searchsorted(keys, neighbour), len(keys) - 1)
        beside = max(beside, float(np.sum(np.where(keys[at] == neighbour, count[at], 0.0) * count)))
    return bool(pairs > DIRECTIONS * (beside + SURE * np.sqrt(beside) + FEWEST_PAIRS))


def _used(whole: _Clouds, lattice: Lattice) -> Bools:
    """Mark (n,) the first points of each place: one, or its share where all places hold multiples of a number."""
    count = whole.count
    key, used = large_arrays.allocate(count, dtype=np.uint64), large_arrays.allocate(count, dtype=np.bool_)
    for rows, points, offset in whole.blocks():
        key[rows] = _keys(points, offset, lattice)
    groups = list(_by_key(key))
    copies = int(np.gcd.reduce([np.gcd.reduce(np.unique(own, return_counts=True)[1]) for own, _ in groups]))
    for own, rows_of in groups:
        order = np.argsort(own, kind="stable")
        begin = np.flatnonzero(np.append(True, np.diff(own[order]) != 0))
        at_place = np.diff(begin, append=len(own))
        share = at_place // copies if copies > 1 else np.ones_like(at_place)
        rank = np.arange(len(own)) - np.repeat(begin, at_place)
        used[rows_of[order]] = rank < np.repeat(share, at_place)
    return used


def _by_key(key: Keys) -> Iterator[tuple[Keys, Ints]]:
    """Yield keys (n,) and their rows, all of one key together: many through files, part by part."""
    if len(key) <= large_arrays.AT_ONCE:
        yield key, np.arange(len(key))
        return
    bits = int(np.ceil(np.log2(2.0 * len(key) / large_arrays.AT_ONCE)))

    def part_of(block: tuple[Keys, ...]) -> Ints:
        part: Ints = (block[0] >> np.uint64(64 - bits)).astype(np.int64)
        return part

    filled = np.zeros(1 << bits, np.int64)
    for rows in large_arrays.blocks(len(key)):
        filled += np.bincount(part_of((key[rows],)), minlength=len(filled))
    passed = ((key[rows], np.arange(rows.start, rows.stop)) for rows in large_arrays.blocks(len(key)))
    sorted_keys, row = large_arrays.in_parts(passed, part_of, np.cumsum(filled))
    for part in large_arrays.parts_of(np.cumsum(filled)):
        yield sorted_keys[part], row[part]
