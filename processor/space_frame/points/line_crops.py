"""Points near lines: for each line as many as its room holds, chosen by their hash, in one pass over the cloud.

A line keeps the points whose hash is below its threshold. When its room overflows the threshold is halved. At the end
it is the largest power of two for which the points fit, so that the choice does not depend on their order.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry.linalg_small import assign
from processor.geometry.point_grid import FREE, hash_table, slot_of
from processor.geometry.thread_ranges import over_ranges, usable
from processor.model import Floats, Ints, Labels
from processor.space_frame.points.hash_sampling import REACH, STEPS_PER_MM, WHOLE, hashed

CELL_MM = 200.0  # work, not result: about as wide as the lines' reach
FIELD = 21  # bits for each coordinate of a point less its line's middle
HALF = 1 << (FIELD - 1)  # 10.5 m in steps of 0.01 mm
CELL_FIELD = 20  # bits for each coordinate of a cell: 105 km either way
LEAST_RANGE = 50_000  # points that a thread takes at once


class Gathered(NamedTuple):
    """Points near lines: of line i those in rows ``i * room`` to ``i * room + counts[i]``.

    ``places`` are points in whole steps less ``middles`` (m, 3), 21 bits a coordinate, ``stations`` where each was
    seen from; both are sorted, by station first. ``shares`` (m,) of all points near the line are kept.
    """

    room: int
    counts: Ints
    places: Ints
    stations: npt.NDArray[np.int16]
    middles: Ints
    shares: Floats


class Corridors(NamedTuple):
    """Lines (m,) and the cells about them: within ``reach_mm``, from ``low`` to ``high`` along each line."""

    points: Floats
    directions: Floats
    low: Floats
    high: Floats
    reach_mm: float
    keys: Ints  # open table of cells
    spans: Ints  # (slots, 2): first and last entry of a cell
    lines: Labels  # of all cells, one after another


class Entries(NamedTuple):
    """Points near lines (n,): the line, the place as in :class:`Gathered`, and the station."""

    lines: Labels
    places: Ints
    stations: npt.NDArray[np.int16]


@njit(cache=True, nogil=True)
def cells_near(points, directions, low, high, reach, keys, lines):  # type: ignore[no-untyped-def]
    """Write the cells that the lines' corridors touch, with their lines; returns their number. Empty: only count."""
    n = 0
    count_only = len(keys) == 0
    cell = CELL_MM
    slack = reach + 0.5 * np.sqrt(3.0) * cell
    half = 1 << (CELL_FIELD - 1)
    for m in range(len(points)):
        x0 = y0 = z0 = 0
        box_lo, box_hi = np.empty(3), np.empty(3)
        for i in range(3):
            a, b = points[m, i] + low[m] * directions[m, i], points[m, i] + high[m] * directions[m, i]
            box_lo[i], box_hi[i] = min(a, b) - reach, max(a, b) + reach
        # Slabs of cells along the coordinate axis nearest to the line; in each slab only those near the line.
        k = 0
        for i in range(1, 3):
            if abs(directions[m, i]) > abs(directions[m, k]):
                k = i
        i1, i2 = (k + 1) % 3, (k + 2) % 3
        dk = directions[m, k]
        for ck in range(int(np.floor(box_lo[k] / cell)), int(np.floor(box_hi[k] / cell)) + 1):
            t = ((ck + 0.5) * cell - points[m, k]) / dk
            c1, c2 = points[m, i1] + t * directions[m, i1], points[m, i2] + t * directions[m, i2]
            wide = slack / abs(dk)
            for a in range(int(np.floor((c1 - wide) / cell)), int(np.floor((c1 + wide) / cell)) + 1):
                if (a + 1) * cell < box_lo[i1] or a * cell > box_hi[i1]:
                    continue
                for b in range(int(np.floor((c2 - wide) / cell)), int(np.floor((c2 + wide) / cell)) + 1):
                    if (b + 1) * cell < box_lo[i2] or b * cell > box_hi[i2]:
                        continue
                    vk = (ck + 0.5) * cell - points[m, k]
                    v1, v2 = (a + 0.5) * cell - points[m, i1], (b + 0.5) * cell - points[m, i2]
                    along = vk * dk + v1 * directions[m, i1] + v2 * directions[m, i2]
                    if vk * vk + v1 * v1 + v2 * v2 - along * along > slack * slack:
                        continue
                    if not count_only:
                        if k == 0:
                            x0, y0, z0 = ck, a, b
                        elif k == 1:
                            x0, y0, z0 = b, ck, a
                        else:
                            x0, y0, z0 = a, b, ck
                        keys[n] = ((x0 + half) << (2 * CELL_FIELD)) | ((y0 + half) << CELL_FIELD) | (z0 + half)
                        lines[n] = m
                    n += 1
    return n


def corridors(points: Floats, directions: Floats, low: Floats, high: Floats, reach_mm: float) -> Corridors:
    """Prepare lines through points (m, 3) along unit directions (m, 3), from ``low`` to ``high`` (m,) along each."""
    count = cells_near(points, directions, low, high, reach_mm, np.empty(0, np.int64), np.empty(0, np.int32))
    keys, lines = np.empty(count, np.int64), np.empty(count, np.int32)
    cells_near(points, directions, low, high, reach_mm, keys, lines)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    table, row = hash_table(keys[first])
    starts = np.append(first, count)
    return Corridors(
        points=points,
        directions=directions,
        low=low,
        high=high,
        reach_mm=reach_mm,
        keys=table,
        spans=np.stack([starts[row], starts[row + 1]], axis=1) * (row >= 0)[:, None],
        lines=lines[order],
    )


@njit(cache=True, nogil=True)
def near(coordinates, scale, station, corridors, thresholds, middles, entries):  # type: ignore[no-untyped-def]
    """Write an entry for every point and each line that it is near; returns their number, at most the room there is."""
    points, directions, low, high, reach, table, spans, lines = corridors
    n = 0
    half = 1 << (CELL_FIELD - 1)
    last_key, at = np.int64(-2), np.uint64(0)
    mm, per_cell = 1.0 / STEPS_PER_MM, 1.0 / CELL_MM
    for i in range(len(coordinates)):
        fx, fy, fz = coordinates[i, 0] * scale, coordinates[i, 1] * scale, coordinates[i, 2] * scale
        if not (abs(fx) < REACH and abs(fy) < REACH and abs(fz) < REACH):
            continue
        x, y, z = np.int64(np.rint(fx)), np.int64(np.rint(fy)), np.int64(np.rint(fz))
        px, py, pz = x * mm, y * mm, z * mm
        key = (
            ((np.int64(np.floor(px * per_cell)) + half) << (2 * CELL_FIELD))
            | ((np.int64(np.floor(py * per_cell)) + half) << CELL_FIELD)
            | (np.int64(np.floor(pz * per_cell)) + half)
        )
        if key != last_key:
            at, last_key = slot_of(table, key), key
        if table[at] == FREE:
            continue
        h = hashed(x, y, z)
        for e in range(spans[at, 0], spans[at, 1]):
            m = lines[e]
            if h >= thresholds[m]:
                continue
            dx, dy, dz = px - points[m, 0], py - points[m, 1], pz - points[m, 2]
            t = dx * directions[m, 0] + dy * directions[m, 1] + dz * directions[m, 2]
            if t < low[m] or t > high[m] or dx * dx + dy * dy + dz * dz - t * t > reach * reach:
                continue
            qx, qy, qz = x - middles[m, 0] + HALF, y - middles[m, 1] + HALF, z - middles[m, 2] + HALF
            if min(qx, qy, qz) < 0 or max(qx, qy, qz) >= 2 * HALF or n >= len(entries.lines):
                continue
            entries.lines[n] = m
            entries.places[n] = (qx << (2 * FIELD)) | (qy << FIELD) | qz
            entries.stations[n] = station[i] if len(station) else -1
            n += 1
    return n


@njit(cache=True, nogil=True)
def insert(entries, middles, room, counts, thresholds, places, stations, first, last):  # type: ignore[no-untyped-def]
    """Put the entries of lines first..last into their room; on overflow halve the line's threshold and drop points."""
    for i in range(len(entries.lines)):
        m = entries.lines[i]
        if m < first or m >= last:
            continue
        base = m * room
        value = hash_of(entries.places[i], middles[m])
        if value >= thresholds[m]:
            continue
        while counts[m] == room:
            thresholds[m] = thresholds[m] >> np.uint64(1)
            n = 0
            for k in range(base, base + room):
                if hash_of(places[k], middles[m]) < thresholds[m]:
                    places[base + n], stations[base + n] = places[k], stations[k]
                    n += 1
            counts[m] = n
            if thresholds[m] == 0:
                break
        if counts[m] < room and value < thresholds[m]:
            places[base + counts[m]], stations[base + counts[m]] = entries.places[i], entries.stations[i]
            counts[m] += 1


@njit(cache=True, nogil=True, inline="always")
def hash_of(place, middle):  # type: ignore[no-untyped-def]
    """Hash of the point at a place."""
    mask = (1 << FIELD) - 1
    x = (place >> (2 * FIELD)) - HALF + middle[0]
    y = ((place >> FIELD) & mask) - HALF + middle[1]
    z = (place & mask) - HALF + middle[2]
    return hashed(np.int32(x), np.int32(y), np.int32(z))


@njit(cache=True, nogil=True)
def arrange(counts, room, places, stations, most_station, first, last):  # type: ignore[no-untyped-def]
    """Sort the points of lines first..last by station, then by place, so that sums over them do not vary."""
    heads = np.zeros(most_station + 3, np.int64)
    for m in range(first, last):
        base, n = m * room, counts[m]
        heads[:] = 0
        for i in range(base, base + n):
            heads[stations[i] + 2] += 1
        for s in range(1, len(heads)):
            heads[s] += heads[s - 1]
        starts = heads.copy()
        unsorted, at = places[base : base + n].copy(), stations[base : base + n].copy()
        for i in range(n):
            k = base + heads[at[i] + 1]
            places[k], stations[k] = unsorted[i], at[i]
            heads[at[i] + 1] += 1
        for s in range(len(starts) - 1):
            if starts[s + 1] - starts[s] > 1:
                # Not .sort(): numba gives it the same symbols as argsort, and kernels cached by two processes collide.
                run = places[base + starts[s] : base + starts[s + 1]]
                assign(run, run[np.argsort(run)])


def gather(
    stretches: Iterable[tuple[npt.NDArray[np.generic], Labels]],
    scale: float,
    lines: Corridors,
    room: int,
    threads: int = 0,
) -> Gathered:
    """Gather up to ``room`` points per line from stretches of (coordinates (n, 3), stations (n,) or empty).

    ``scale`` turns coordinates into steps of 0.01 mm: 100 for mm.
    """
    count = len(lines.points)
    middles = np.rint(lines.points * STEPS_PER_MM).astype(np.int64)
    thresholds = np.full(count, WHOLE, np.uint64)
    counts = np.zeros(count, np.int64)
    places, stations = np.empty(count * room, np.int64), np.full(count * room, -1, np.int16)
    least = max(count // (threads or usable()), 1)
    for coordinates, station in stretches:
        pieces: list[Entries] = []

        def find(first: int, last: int, coordinates=coordinates, station=station, pieces=pieces) -> None:  # type: ignore[no-untyped-def]
            n = 3 * (last - first) + 64  # entries: a point belongs to few lines
            seen_from = station[first:last] if len(station) else station
            while True:
                entries = Entries(np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n, np.int16))
                number = near(coordinates[first:last], scale, seen_from, lines, thresholds, middles, entries)
                if number < n:
                    break
                n *= 2
            pieces.append(Entries(entries.lines[:number], entries.places[:number], entries.stations[:number]))

        def keep(first: int, last: int, pieces=pieces) -> None:  # type: ignore[no-untyped-def]
            for entries in pieces:
                insert(entries, middles, room, counts, thresholds, places, stations, first, last)

        over_ranges(find, len(coordinates), threads, least=LEAST_RANGE)
        over_ranges(keep, count, threads, least=least)
    most_station = int(stations.max(initial=-1)) if count else -1
    over_ranges(partial(arrange, counts, room, places, stations, most_station), count, threads)
    return Gathered(
        room=room, counts=counts, places=places, stations=stations, middles=middles, shares=thresholds / WHOLE
    )
