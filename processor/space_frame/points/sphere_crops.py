"""Points about every node, gathered from the whole source in one pass, in bounded memory.

A node keeps the points whose hash is below its threshold, which is lowered a step where they are more than its room. At
the end it is the highest for which the points fit, so that the choice does not depend on their order.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry.point_grid import hash_table, slot_of
from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats, Ints, Labels, UsageError
from processor.space_frame.points.hash_sampling import WHOLE, hashed
from processor.space_frame.points.source import Source

GREATEST_REACH_MM = 1000.0  # 21 bits per axis
BLOCK = 1 << 14  # points of a thread's task: work, not result
MOST_POINTS = 2_000_000  # of all crops together, and of each
LEAST_ROOM = 512  # of a crop, however many there are
STEPS_PER_MM = 1000.0  # gathered coordinates are whole micrometres: sorting them is exact
THRESHOLDS = np.append(WHOLE * 2.0 ** (-0.25 * np.arange(120)), 0.0).astype(np.uint64)  # of hashes


@dataclass(frozen=True)
class Crops:
    """Points about k nodes, those of node i in rows ``start[i]`` to ``start[i + 1]``.

    ``points`` (n, 3) mm less the node's own position, in steps of 0.001 mm; ``station`` (n,) rows of the source's
    scanners, -1 = unknown. A node's points are sorted by station, x, y and z: their order in the source is lost.
    """

    start: Ints
    points: Floats
    station: Labels


class CropsWithRays(NamedTuple):
    """Points about k nodes with their rays: those of node i are rows ``start[i]`` to ``start[i + 1]``, by station."""

    start: Ints  # (k + 1,)
    points: Floats  # (n, 3) relative to their node, mm
    rays: Floats  # (n, 3) unit vectors from the scanner; 0 where it is unknown
    ranges: Floats  # (n,) mm
    station: Labels  # (n,) rows of the scanners; -1 = unknown

    def of_nodes(self, nodes: slice) -> CropsWithRays:
        """Return the points of some nodes."""
        start = self.start[nodes.start : nodes.stop + 1]
        rows = slice(start[0], start[-1])
        return CropsWithRays(
            start - start[0], self.points[rows], self.rays[rows], self.ranges[rows], self.station[rows]
        )


class NodeIndex(NamedTuple):
    """Nodes (k, 3), and a hash table of the cells that spheres about them touch.

    A cell's edge is the spheres' diameter, so that a sphere touches eight cells at most, and a point lies in one. Cell
    ``rows[slot]`` of ``keys[slot]`` has the nodes ``owners[starts[row]:starts[row + 1]]``.
    """

    nodes: Floats
    lower: Floats  # corner (3,) of the box about all spheres, and the upper one
    upper: Floats
    reach: float
    keys: Ints
    rows: Ints
    starts: Ints
    owners: Labels


class Pairs(NamedTuple):
    """Pairs (m,) of a node and a point: the node, the point's offset from it in steps (m, 3), and the station."""

    owner: Labels
    steps: Labels
    station: Labels


class _Candidates(NamedTuple):
    """By blocks: points (n,) near a node and the rows of their cells; numbers of candidates and of pairs (blocks,)."""

    points: Labels
    cells: Labels
    counts: Ints
    pairs: Ints


def gather(source: Source, nodes: Floats, reach_mm: float, threads: int = 0, most: int = MOST_POINTS) -> Crops:
    """Gather the points within ``reach_mm`` of nodes (k, 3), given less the source's origin; one pass over the source.

    A point near two nodes is gathered for both. Of a node with more than its share of ``most`` points an even part is
    kept. The answer does not depend on chunks, order of points or threads.
    """
    if not 0.0 < reach_mm <= GREATEST_REACH_MM:
        raise UsageError(f"reach of a crop: expected above 0 to {GREATEST_REACH_MM:g} mm, got {reach_mm!r}")
    nodes = np.array(nodes, dtype=np.float64)
    if not len(nodes):
        return Crops(np.zeros(1, np.int64), np.empty((0, 3)), np.empty(0, np.int32))
    index = _indexed(nodes, reach_mm)
    buffer = PairBuffer(len(nodes), max(most // len(nodes), LEAST_ROOM), threads)
    for chunk in source.chunks():
        points, station = _frozen(chunk.points, np.float64), _frozen(chunk.station, np.int32)
        buffer.add(_near(points, station, index, buffer.thresholds, threads))
    return _sorted(buffer.all(), len(nodes), threads)


def _frozen(values: npt.NDArray[Any], dtype: type) -> npt.NDArray[Any]:
    """View values as a read-only array: the kernel is compiled for one kind of array only."""
    frozen: npt.NDArray[Any] = np.ascontiguousarray(values, dtype=dtype).view()
    frozen.flags.writeable = False
    return frozen


def _indexed(nodes: Floats, reach: float) -> NodeIndex:
    lower, upper = nodes.min(axis=0) - reach, nodes.max(axis=0) + reach
    edge = 2.0 * reach
    first = np.floor((nodes - reach - lower) / edge).astype(np.int64)
    last = np.floor((nodes + reach - lower) / edge).astype(np.int64)
    parts, owners = [], []
    for corner in np.ndindex(2, 2, 2):
        cell = first + np.array(corner)
        touching = np.flatnonzero((cell <= last).all(axis=1))
        parts.append((cell[touching, 0] << 42) | (cell[touching, 1] << 21) | cell[touching, 2])
        owners.append(touching)
    if int(last.max()) >= 1 << 21:
        raise UsageError("the nodes are too far apart for one run: more than two million crops in a row")
    key, owner = np.concatenate(parts), np.concatenate(owners)
    order = np.lexsort((owner, key))
    unique, begin = np.unique(key[order], return_index=True)
    keys, rows = hash_table(unique)
    return NodeIndex(
        nodes=nodes,
        lower=lower,
        upper=upper,
        reach=reach,
        keys=keys,
        rows=rows,
        starts=np.append(begin, len(key)).astype(np.int64),
        owners=owner[order].astype(np.int32),
    )


def _near(points: Floats, station: Labels, index: NodeIndex, thresholds: npt.NDArray[np.uint64], threads: int) -> Pairs:
    """Return all pairs of a node and a point near it whose hash is below the node's threshold."""
    n = len(points)
    blocks = (n + BLOCK - 1) // BLOCK
    candidates = _Candidates(
        np.empty(n, np.int32), np.empty(n, np.int32), np.zeros(blocks, np.int64), np.zeros(blocks, np.int64)
    )
    over_ranges(partial(_look, points, index, thresholds, candidates), blocks, threads)
    place = np.concatenate([np.zeros(1, np.int64), np.cumsum(candidates.pairs)])
    count = int(place[-1])
    pairs = Pairs(np.empty(count, np.int32), np.empty((count, 3), np.int32), np.empty(count, np.int32))
    over_ranges(partial(_take, points, station, index, thresholds, candidates, place, pairs), blocks, threads)
    return pairs


@njit(cache=True, nogil=True, error_model="numpy")
def _look(points, index, thresholds, candidates, begin, end):  # type: ignore[no-untyped-def]
    """Fill, by blocks, the points that are near a node and their cells, and the numbers of them and of the pairs."""
    n = len(points)
    nodes, lower, upper, reach, keys, rows, starts, owners = index
    inverse = 1.0 / (2.0 * reach)
    reach2 = reach * reach
    for block in range(begin, end):
        number, total = 0, 0
        base = block * BLOCK
        for i in range(base, min(n, base + BLOCK)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            # written so that a coordinate that is not a number is left out too
            if not (lower[0] <= x <= upper[0] and lower[1] <= y <= upper[1] and lower[2] <= z <= upper[2]):
                continue
            ix = np.int64((x - lower[0]) * inverse)
            iy = np.int64((y - lower[1]) * inverse)
            iz = np.int64((z - lower[2]) * inverse)
            key = (ix << 42) | (iy << 21) | iz
            here = rows[slot_of(keys, key)]
            if here < 0:
                continue
            near = 0
            for j in range(starts[here], starts[here + 1]):
                node = owners[j]
                dx, dy, dz = x - nodes[node, 0], y - nodes[node, 1], z - nodes[node, 2]
                if dx * dx + dy * dy + dz * dz <= reach2 and taken(dx, dy, dz, thresholds[node]):
                    near += 1
            if near > 0:
                candidates.points[base + number] = i
                candidates.cells[base + number] = here
                number += 1
                total += near
        candidates.counts[block] = number
        candidates.pairs[block] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _take(points, station, index, thresholds, candidates, place, pairs, begin, end):  # type: ignore[no-untyped-def]
    """Fill the pairs of blocks from their places on."""
    nodes, _, _, reach, _, _, starts, owners = index
    for block in range(begin, end):
        to = place[block]
        base = block * BLOCK
        for k in range(base, base + candidates.counts[block]):
            i, here = candidates.points[k], candidates.cells[k]
            for j in range(starts[here], starts[here + 1]):
                node = owners[j]
                dx = points[i, 0] - nodes[node, 0]
                dy = points[i, 1] - nodes[node, 1]
                dz = points[i, 2] - nodes[node, 2]
                if dx * dx + dy * dy + dz * dz <= reach * reach and taken(dx, dy, dz, thresholds[node]):
                    pairs.owner[to] = node
                    pairs.steps[to, 0] = np.int32(np.rint(dx * STEPS_PER_MM))
                    pairs.steps[to, 1] = np.int32(np.rint(dy * STEPS_PER_MM))
                    pairs.steps[to, 2] = np.int32(np.rint(dz * STEPS_PER_MM))
                    pairs.station[to] = station[i]
                    to += 1


@njit(cache=True, nogil=True, inline="always")
def taken(dx, dy, dz, threshold):  # type: ignore[no-untyped-def]
    """Whether the hash of a point at (dx, dy, dz) from its node is below the node's threshold."""
    if threshold >= WHOLE:
        return True
    x, y, z = (
        np.int32(np.rint(dx * STEPS_PER_MM)),
        np.int32(np.rint(dy * STEPS_PER_MM)),
        np.int32(np.rint(dz * STEPS_PER_MM)),
    )
    return hashed(x, y, z) < threshold


# --- canonical order -------------------------------------------------------------------------------------------------


def _sorted(pairs: Pairs, nodes: int, threads: int) -> Crops:
    """Crops of the pairs, every node's in canonical order."""
    start = np.concatenate([np.zeros(1, np.int64), np.cumsum(np.bincount(pairs.owner, minlength=nodes))])
    by_node = _by_node(pairs.owner, start)
    points, seen_from = np.empty((len(pairs.owner), 3)), np.empty(len(pairs.owner), np.int32)
    over_ranges(partial(_sort, start, by_node, pairs.steps, pairs.station, points, seen_from), nodes, threads)
    return Crops(start, points, seen_from)


@njit(cache=True, nogil=True, error_model="numpy")
def _by_node(owner, start):  # type: ignore[no-untyped-def]
    """Return the rows of pairs, node by node."""
    place = start[:-1].copy()
    rows = np.empty(len(owner), np.int64)
    for i in range(len(owner)):
        rows[place[owner[i]]] = i
        place[owner[i]] += 1
    return rows


@njit(cache=True, nogil=True, error_model="numpy")
def _sort(start, by_node, steps, station, points, seen_from, begin, end):  # type: ignore[no-untyped-def]
    """Fill points (n, 3) mm and station (n,) of nodes in canonical order."""
    for k in range(begin, end):
        first, last = start[k], start[k + 1]
        key = np.empty(last - first, np.int64)
        for j in range(first, last):
            i = by_node[j]
            x, y, z = np.int64(steps[i, 0]), np.int64(steps[i, 1]), np.int64(steps[i, 2])
            key[j - first] = ((x + (1 << 20)) << 42) | ((y + (1 << 20)) << 21) | (z + (1 << 20))
        by_place = np.argsort(key)
        # a stable counting sort by station (they are few): within a station points keep their order by place
        lowest, highest = 1 << 30, -1
        for j in range(first, last):
            lowest = min(lowest, np.int64(station[by_node[j]]))
            highest = max(highest, np.int64(station[by_node[j]]))
        if last == first:
            continue
        to = np.zeros(highest - lowest + 2, np.int64)
        for j in range(first, last):
            to[station[by_node[j]] - lowest + 1] += 1
        for s in range(1, len(to)):
            to[s] += to[s - 1]
        for j in range(last - first):
            i = by_node[first + by_place[j]]
            s = station[i] - lowest
            for axis in range(3):
                points[first + to[s], axis] = steps[i, axis] / STEPS_PER_MM
            seen_from[first + to[s]] = station[i]
            to[s] += 1


# --- the choice of points, where a node has more than its room: those of the lowest hashes ---------------------------


class PairBuffer:
    """Pairs gathered so far, and the threshold of each node."""

    def __init__(self, nodes: int, room: int, threads: int = 0) -> None:
        self.room, self.threads = room, threads
        self.rank = np.zeros(nodes, np.int64)  # of each node's threshold
        self.counts = np.zeros(nodes, np.int64)
        self.pieces = [Pairs(np.empty(0, np.int32), np.empty((0, 3), np.int32), np.empty(0, np.int32))]
        self.added = 0  # pairs added since the thresholds were last applied to all

    @property
    def thresholds(self) -> npt.NDArray[np.uint64]:
        """Thresholds (k,) of the hashes."""
        return THRESHOLDS[self.rank]

    def add(self, pairs: Pairs) -> None:
        """Add pairs; thresholds are lowered when the pairs added since exceed a quarter of the room."""
        self.pieces.append(pairs)
        self.counts += np.bincount(pairs.owner, minlength=len(self.counts))
        self.added += len(pairs.owner)
        if self.added > self.room * len(self.counts) // 4 and (self.counts > self.room).any():
            self.pieces = [self.all()]

    def all(self) -> Pairs:
        """Return all pairs that are kept."""
        pairs = Pairs(*(np.concatenate(parts) for parts in zip(*self.pieces, strict=True)))
        self.added = 0
        if (self.counts > self.room).any():
            rank = np.empty(len(pairs.steps), np.int64)
            over_ranges(partial(_ranks, pairs.steps, THRESHOLDS, rank), len(pairs.steps), self.threads)
            self.rank, self.counts = _lowered(pairs.owner, rank, self.rank, self.room, len(THRESHOLDS))
            rows = np.flatnonzero(rank >= self.rank[pairs.owner])
            pairs = Pairs(*(np.take(column, rows, axis=0) for column in pairs))
        return pairs


@njit(cache=True, nogil=True)
def _ranks(steps, thresholds, ranks, first, last):  # type: ignore[no-untyped-def]
    """Write the rank (n,) of the lowest threshold above each hash, first..last."""
    for i in range(first, last):
        value = hashed(steps[i, 0], steps[i, 1], steps[i, 2])
        low, high = 0, len(thresholds) - 1  # below the first, and never below the last
        while high - low > 1:
            mid = (low + high) // 2
            if value < thresholds[mid]:
                low = mid
            else:
                high = mid
        ranks[i] = low


@njit(cache=True, nogil=True)
def _lowered(owner, rank, at, room, ranks):  # type: ignore[no-untyped-def]
    """Ranks (k,) from ``at`` on at which each node's points fit its room, and their numbers then."""
    nodes = len(at)
    per = np.zeros((nodes, ranks), np.int64)
    for i in range(len(owner)):
        per[owner[i], rank[i]] += 1
    lowered, counts = at.copy(), np.zeros(nodes, np.int64)
    for k in range(nodes):
        total = 0
        for r in range(at[k], ranks):
            total += per[k, r]
        while total > room:
            total -= per[k, lowered[k]]
            lowered[k] += 1
        counts[k] = total
    return lowered, counts


# --- rays ------------------------------------------------------------------------------------------------------------


def with_rays(crops: Crops, nodes: Floats, scanners: Floats, threads: int) -> CropsWithRays:
    """Add unit rays and ranges, mm, of gathered points from the scanners (s, 3) that saw them.

    The points are relative to their ``nodes`` (k, 3); nodes and scanners are in one frame, mm.
    """
    rays, ranges = np.zeros((len(crops.points), 3)), np.zeros(len(crops.points))
    found = CropsWithRays(crops.start, crops.points, rays, ranges, crops.station)
    over_ranges(partial(_aim, found, nodes, scanners), len(nodes), threads)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _aim(crops, nodes, scanners, first, last):  # type: ignore[no-untyped-def]
    """Fill unit rays (n, 3), 0 where the scanner is unknown, and ranges (n,)."""
    points = crops.points
    for k in range(first, last):
        for i in range(crops.start[k], crops.start[k + 1]):
            s = crops.station[i]
            if s < 0 or s >= len(scanners):
                continue
            x = points[i, 0] + (nodes[k, 0] - scanners[s, 0])
            y = points[i, 1] + (nodes[k, 1] - scanners[s, 1])
            z = points[i, 2] + (nodes[k, 2] - scanners[s, 2])
            d = np.sqrt(x * x + y * y + z * z)
            if d > 0.0:
                crops.rays[i, 0], crops.rays[i, 1], crops.rays[i, 2] = x / d, y / d, z / d
                crops.ranges[i] = d
