"""Points on tubes for the stations' self-registration, out of those that the tubes were fitted to."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from functools import partial

import numpy as np
from numba import njit

from processor.geometry.parallel import over_ranges
from processor.model import Ints
from processor.space_frame.members.records import Tubes
from processor.space_frame.points.hash_sampling import STEPS_PER_MM, WHOLE
from processor.space_frame.points.line_crops import FIELD, HALF, Gathered, hash_of
from processor.space_frame.stations.records import TubePoints

MOST = 192  # points of a tube: the stations are told by all tubes together
PLENTY = 3.0  # times as many points are looked at as are wanted: not all lie on the tube
NEAR_MM = 12.0  # from a tube's surface, stations lying apart by some mm
END_SHARE = 0.95  # of a tube's length: near its ends cones begin


@njit(cache=True, nogil=True)
def choose(  # type: ignore[no-untyped-def]
    counts, room, places, stations, middles, shares, lines, axis, side, other, length, radius, bow, near, inner, most,
    number, kept, seen_from, first, last,
):  # fmt: skip
    """Choose by their hashes the points that lie on each tube's surface, in the order of their places."""
    mask = (1 << FIELD) - 1
    for j in range(first, last):
        base, line = lines[j] * room, lines[j]
        on, mixed = np.empty(counts[line], np.int64), np.empty(counts[line], np.uint64)
        # Hashes are even below the share that was gathered: a low part of them is enough, where points are many.
        part = np.uint64(min(shares[line] * PLENTY * most / max(counts[line], 1), 1.0) * WHOLE)
        n = 0
        for i in range(base, base + counts[line]):
            if stations[i] < 0:
                continue
            w = places[i]
            h = hash_of(w, middles[line])
            if h >= part:
                continue
            x = ((w >> (2 * FIELD)) - HALF + middles[line, 0]) / STEPS_PER_MM - axis[j, 0]
            y = (((w >> FIELD) & mask) - HALF + middles[line, 1]) / STEPS_PER_MM - axis[j, 1]
            z = ((w & mask) - HALF + middles[line, 2]) / STEPS_PER_MM - axis[j, 2]
            t = 2.0 * (x * axis[j, 3] + y * axis[j, 4] + z * axis[j, 5]) / length[j]
            if abs(t) > inner:
                continue
            arch = 1.0 - t * t
            a = x * side[j, 0] + y * side[j, 1] + z * side[j, 2] - arch * bow[j, 0]
            b = x * other[j, 0] + y * other[j, 1] + z * other[j, 2] - arch * bow[j, 1]
            if abs(np.sqrt(a * a + b * b) - radius[j]) > near:
                continue
            on[n], mixed[n] = i, h
            n += 1
        limit = np.uint64(0xFFFFFFFFFFFFFFFF)
        if n > most:
            limit = np.sort(mixed[:n])[most]
        chosen = np.empty(min(n, most), np.int64)
        k = 0
        for i in range(n):
            if (n <= most or mixed[i] < limit) and k < most:
                chosen[k] = on[i]
                k += 1
        key = np.empty(k, np.int64)
        for i in range(k):
            key[i] = places[chosen[i]]
        order = np.argsort(key)
        for i in range(k):
            kept[j, i], seen_from[j, i] = key[order[i]], stations[chosen[order[i]]]
        number[j] = k


def tube_points(gathered: Gathered, lines: Ints, tubes: Tubes, most: int = MOST, threads: int = 0) -> TubePoints:
    """Take up to ``most`` points a tube out of those gathered near its line; ``lines`` (m,) are the tubes' rows there.

    Which are taken depends on their coordinates alone, and so does their order.
    """
    axis = np.hstack([tubes.points, tubes.directions])
    m = len(lines)
    number, kept, station = np.zeros(m, np.int64), np.empty((m, most), np.int64), np.empty((m, most), np.int32)
    kernel = partial(
        choose, gathered.counts, gathered.room, gathered.places, gathered.stations, gathered.middles, gathered.shares,
        lines, axis, tubes.side, np.ascontiguousarray(tubes.other), tubes.lengths, tubes.radii, tubes.bow, NEAR_MM,
        END_SHARE, most, number, kept, station,
    )  # fmt: skip
    over_ranges(kernel, m, threads)
    used = np.arange(most) < number[:, None]
    places, owner = kept[used], np.repeat(lines, number)
    mask = (1 << FIELD) - 1
    steps = np.stack([places >> (2 * FIELD), (places >> FIELD) & mask, places & mask], axis=1) - HALF
    points = (steps + gathered.middles[owner]) / STEPS_PER_MM
    return TubePoints(points, station[used], np.concatenate([[0], np.cumsum(number)]))
