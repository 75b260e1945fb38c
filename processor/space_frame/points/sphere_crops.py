"""The points about every node, gathered from the whole source in one pass, in bounded memory.

A node keeps the points whose hash lies below a threshold of its own, which is lowered a step where its points are more
than its room: at the end it is the highest for which they fit, and which points are kept depends on no order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints, Labels, UsageError
from processor.space_frame.points.hash_sampling import WHOLE, hashed
from processor.space_frame.points.source import Source

GREATEST_REACH_MM = 1000.0  # 21 bits an axis
BLOCK = 1 << 14
EMPTY = -1
MOST_POINTS = 2_000_000  # of all crops together, and of each
LEAST_ROOM = 512  # of a crop, however many there are


@dataclass(frozen=True)
class Crops:
    """Points about k nodes, those of node i in rows ``start[i]`` to ``start[i + 1]``.

    ``points`` (n, 3) mm less the node's own position, in steps of 0.001 mm; ``station`` (n,) rows of the source's
    scanners, -1 = unknown. A node's points are sorted by station, x, y and z: their order in the source is lost.
    """

    start: Ints
    points: Floats
    station: Labels


def gather(source: Source, nodes: Floats, reach_mm: float, threads: int = 0, most: int = MOST_POINTS) -> Crops:
    """Gather the points within ``reach_mm`` of nodes (k, 3), given less the source's origin; one pass over the source.

    A point near two nodes is gathered for both. Of a node with more than its share of ``most`` points some are kept,
    evenly. The answer does not depend on chunks, order of points or threads.
    """
    if not 0.0 < reach_mm <= GREATEST_REACH_MM:
        raise UsageError(f"reach of a crop: expected above 0 to {GREATEST_REACH_MM:g} mm, got {reach_mm!r}")
    nodes = np.array(nodes, dtype=np.float64)
    if not len(nodes):
        return Crops(np.zeros(1, np.int64), np.empty((0, 3)), np.empty(0, np.int32))
    lower = nodes.min(axis=0) - reach_mm
    upper = nodes.max(axis=0) + reach_mm
    table, cells = _cells(nodes, lower, reach_mm)
    kept = Kept(len(nodes), max(most // len(nodes), LEAST_ROOM), threads)
    for chunk in source.chunks():
        kept.add(
            *_near(
                _frozen(chunk.points, np.float64), _frozen(chunk.station, np.int32), nodes, lower, upper, reach_mm,
                table, cells, kept.thresholds, threads,
            )
        )  # fmt: skip
    return _sorted(*kept.all(), len(nodes), threads)


def _frozen(values: npt.NDArray[Any], dtype: type) -> npt.NDArray[Any]:
    """View values as a read-only array, whatever they were: the kernel is compiled for one kind alone."""
    found: npt.NDArray[Any] = np.ascontiguousarray(values, dtype=dtype).view()
    found.flags.writeable = False
    return found


def _cells(nodes: Floats, lower: Floats, reach: float) -> tuple[tuple[Ints, Labels], tuple[Ints, Labels]]:
    """Hash table of the cells that spheres about the nodes touch, and the nodes of each cell.

    A cell's edge is the spheres' diameter, so a sphere touches eight cells at most, and a point lies in one.
    """
    edge = 2.0 * reach
    first = np.floor((nodes - reach - lower) / edge).astype(np.int64)
    last = np.floor((nodes + reach - lower) / edge).astype(np.int64)
    keys, owners = [], []
    for corner in np.ndindex(2, 2, 2):
        cell = first + np.array(corner)
        held = np.flatnonzero((cell <= last).all(axis=1))
        keys.append((cell[held, 0] << 42) | (cell[held, 1] << 21) | cell[held, 2])
        owners.append(held)
    if int(last.max()) >= 1 << 21:
        raise UsageError("the nodes are too far apart for one run: more than two million crops in a row")
    key, owner = np.concatenate(keys), np.concatenate(owners)
    order = np.lexsort((owner, key))
    unique, begin = np.unique(key[order], return_index=True)
    bits = max(4, int(4 * len(unique) - 1).bit_length())
    table = np.full(1 << bits, EMPTY, np.int64)
    row = np.full(1 << bits, EMPTY, np.int32)
    _fill(unique, table, row)
    return (table, row), (np.append(begin, len(key)).astype(np.int64), owner[order].astype(np.int32))


@njit(cache=True, nogil=True, error_model="numpy")
def _slot(key, mask):  # type: ignore[no-untyped-def]
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((h >> np.uint64(29)) & np.uint64(mask))


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(keys, table, row):  # type: ignore[no-untyped-def]
    mask = len(table) - 1
    for i in range(len(keys)):
        at = _slot(keys[i], mask)
        while table[at] != EMPTY:
            at = (at + 1) & mask
        table[at] = keys[i]
        row[at] = i


def _near(
    points: Floats,
    station: Labels,
    nodes: Floats,
    lower: Floats,
    upper: Floats,
    reach: float,
    table: tuple[Ints, Labels],
    cells: tuple[Ints, Labels],
    thresholds: npt.NDArray[np.uint64],
    threads: int,
) -> tuple[Labels, Labels, Labels]:
    """Owner (m,), offset from it in steps (m, 3) and station (m,) of every pair of a node and a point near it."""
    n = len(points)
    blocks = (n + BLOCK - 1) // BLOCK
    cell, candidate = np.empty(n, np.int32), np.empty(n, np.int32)
    candidates, pairs = np.zeros(blocks, np.int64), np.zeros(blocks, np.int64)
    over_ranges(
        lambda a, b: _look(
            a,
            b,
            points,
            nodes,
            lower,
            upper,
            reach,
            *table,
            *cells,
            thresholds,
            candidate,
            cell,
            candidates,
            pairs,
        ),
        blocks,
        threads,
    )
    place = np.concatenate([np.zeros(1, np.int64), np.cumsum(pairs)])
    count = int(place[-1])
    owner, steps, seen = np.empty(count, np.int32), np.empty((count, 3), np.int32), np.empty(count, np.int32)
    over_ranges(
        lambda a, b: _take(
            a,
            b,
            points,
            station,
            nodes,
            reach,
            *cells,
            thresholds,
            candidate,
            cell,
            candidates,
            place,
            owner,
            steps,
            seen,
        ),
        blocks,
        threads,
    )
    return owner, steps, seen


@njit(cache=True, nogil=True, error_model="numpy")
def _look(  # type: ignore[no-untyped-def]
    begin, end, points, nodes, lower, upper, reach, table, row, cell_start, cell_nodes, thresholds, candidate, cell,
    candidates, pairs,
):  # fmt: skip
    """Fill, by blocks, which points are near a node, the cells they are in, and how many they and the pairs are."""
    n = len(points)
    mask = len(table) - 1
    inverse = 1.0 / (2.0 * reach)
    reach2 = reach * reach
    for block in range(begin, end):
        kept, total = 0, 0
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
            at = _slot(key, mask)
            while table[at] != EMPTY and table[at] != key:
                at = (at + 1) & mask
            if table[at] == EMPTY:
                continue
            here = row[at]
            near = 0
            for j in range(cell_start[here], cell_start[here + 1]):
                node = cell_nodes[j]
                dx, dy, dz = x - nodes[node, 0], y - nodes[node, 1], z - nodes[node, 2]
                if dx * dx + dy * dy + dz * dz <= reach2 and taken(dx, dy, dz, thresholds[node]):
                    near += 1
            if near > 0:
                candidate[base + kept] = i
                cell[base + kept] = here
                kept += 1
                total += near
        candidates[block] = kept
        pairs[block] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _take(  # type: ignore[no-untyped-def]
    begin, end, points, station, nodes, reach, cell_start, cell_nodes, thresholds, candidate, cell, candidates,
    place, owner, steps, seen,
):  # fmt: skip
    """Fill the pairs of blocks from their places on."""
    for block in range(begin, end):
        to = place[block]
        base = block * BLOCK
        for k in range(base, base + candidates[block]):
            i, here = candidate[k], cell[k]
            for j in range(cell_start[here], cell_start[here + 1]):
                node = cell_nodes[j]
                dx = points[i, 0] - nodes[node, 0]
                dy = points[i, 1] - nodes[node, 1]
                dz = points[i, 2] - nodes[node, 2]
                if dx * dx + dy * dy + dz * dz <= reach * reach and taken(dx, dy, dz, thresholds[node]):
                    owner[to] = node
                    steps[to, 0] = np.int32(np.rint(dx * STEPS_PER_MM))
                    steps[to, 1] = np.int32(np.rint(dy * STEPS_PER_MM))
                    steps[to, 2] = np.int32(np.rint(dz * STEPS_PER_MM))
                    seen[to] = station[i]
                    to += 1


def _sorted(owner: Labels, steps: Labels, station: Labels, nodes: int, threads: int) -> Crops:
    """Crops of the pairs, every node's in canonical order."""
    start = np.concatenate([np.zeros(1, np.int64), np.cumsum(np.bincount(owner, minlength=nodes))])
    by_node = _by_node(owner, start)
    points, seen = np.empty((len(owner), 3)), np.empty(len(owner), np.int32)
    over_ranges(lambda a, b: _sort(a, b, start, by_node, steps, station, points, seen), nodes, threads)
    return Crops(start, points, seen)


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
def _sort(begin, end, start, by_node, steps, station, points, seen):  # type: ignore[no-untyped-def]
    """Fill points (n, 3) mm and station (n,) of nodes in canonical order."""
    for k in range(begin, end):
        first, last = start[k], start[k + 1]
        key = np.empty(last - first, np.int64)
        for j in range(first, last):
            i = by_node[j]
            x, y, z = np.int64(steps[i, 0]), np.int64(steps[i, 1]), np.int64(steps[i, 2])
            key[j - first] = ((x + (1 << 20)) << 42) | ((y + (1 << 20)) << 21) | (z + (1 << 20))
        by_place = np.argsort(key)
        # stable, by counting: within a station the points keep their order by place, and what is equal in both is the
        # same; stations are few
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
            seen[first + to[s]] = station[i]
            to[s] += 1


# --- Which of the points about a node are kept, where there are more than it has room for: those of the lowest hashes.


STEPS_PER_MM = 1000.0  # gathered coordinates are whole micrometres: sorting them is exact
THRESHOLDS = np.append(WHOLE * 2.0 ** (-0.25 * np.arange(120)), 0.0).astype(np.uint64)  # of hashes


class Kept:
    """What has been gathered so far, as pairs of a node and a point, and what each node still takes."""

    def __init__(self, nodes: int, room: int, threads: int = 0) -> None:
        self.room, self.threads = room, threads
        self.rank = np.zeros(nodes, np.int64)  # of each node's threshold
        self.counts = np.zeros(nodes, np.int64)
        self.pieces = [(np.empty(0, np.int32), np.empty((0, 3), np.int32), np.empty(0, np.int32))]
        self.loose = 0  # pairs added since all were last looked through

    @property
    def thresholds(self) -> npt.NDArray[np.uint64]:
        """Threshold (k,) below which the hashes lie of what a node takes."""
        return THRESHOLDS[self.rank]

    def add(self, owner: Labels, steps: Labels, station: Labels) -> None:
        """Add pairs; all are looked through again when those that came in are as many as there is room for."""
        self.pieces.append((owner, steps, station))
        self.counts += np.bincount(owner, minlength=len(self.counts))
        self.loose += len(owner)
        if self.loose > self.room * len(self.counts) // 4 and (self.counts > self.room).any():
            self.pieces = [self.all()]

    def all(self) -> tuple[Labels, Labels, Labels]:
        """Return owner, steps and station of all pairs that are kept."""
        owner, steps, station = (np.concatenate(parts) for parts in zip(*self.pieces, strict=True))
        self.loose = 0
        if (self.counts > self.room).any():
            rank = np.empty(len(steps), np.int64)
            over_ranges(partial(_ranks, steps, THRESHOLDS, rank), len(steps), self.threads)
            self.rank, self.counts = _lowered(owner, rank, self.rank, self.room, len(THRESHOLDS))
            held = np.flatnonzero(rank >= self.rank[owner])
            owner, steps, station = (np.take(one, held, axis=0) for one in (owner, steps, station))
        return owner, steps, station


@njit(cache=True, nogil=True)
def _ranks(steps, thresholds, found, first, last):  # type: ignore[no-untyped-def]
    """Write the rank (n,) of the lowest threshold that each hash, first..last, still lies below."""
    for i in range(first, last):
        value = hashed(steps[i, 0], steps[i, 1], steps[i, 2])
        low, high = 0, len(thresholds) - 1  # below the first, and never below the last
        while high - low > 1:
            mid = (low + high) // 2
            if value < thresholds[mid]:
                low = mid
            else:
                high = mid
        found[i] = low


@njit(cache=True, nogil=True)
def _lowered(owner, rank, at, room, ranks):  # type: ignore[no-untyped-def]
    """Ranks (k,) from ``at`` on at which each node's points fit its room, and how many they then are."""
    nodes = len(at)
    per = np.zeros((nodes, ranks), np.int64)
    for i in range(len(owner)):
        per[owner[i], rank[i]] += 1
    found, counts = at.copy(), np.zeros(nodes, np.int64)
    for k in range(nodes):
        total = 0
        for r in range(at[k], ranks):
            total += per[k, r]
        while total > room:
            total -= per[k, found[k]]
            found[k] += 1
        counts[k] = total
    return found, counts


@njit(cache=True, nogil=True, inline="always")
def taken(dx, dy, dz, threshold):  # type: ignore[no-untyped-def]
    """Whether a node takes a point at (dx, dy, dz) from it."""
    if threshold >= WHOLE:
        return True
    x, y, z = (
        np.int32(np.rint(dx * STEPS_PER_MM)),
        np.int32(np.rint(dy * STEPS_PER_MM)),
        np.int32(np.rint(dz * STEPS_PER_MM)),
    )
    return hashed(x, y, z) < threshold
