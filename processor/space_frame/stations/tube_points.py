"""Points on tubes for the stations' self-registration, from those that the tubes were fitted to."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats, Ints, Labels
from processor.space_frame.members.records import Members
from processor.space_frame.points.hash_sampling import STEPS_PER_MM, WHOLE
from processor.space_frame.points.line_crops import FIELD, HALF, Gathered, hash_of
from processor.space_frame.stations.records import TubePoints

MOST = 192  # points of a tube: all tubes together determine the stations
PLENTY = 3.0  # times as many points are tested as are wanted: not all lie on the tube
NEAR_MM = 12.0  # from a tube's surface: stations may be some mm off
END_SHARE = 0.95  # of a tube's length: near its ends cones begin


class _Tubes(NamedTuple):
    """Axes of tubes: point and direction, two unit vectors across, and the arrays of :class:`Members`."""

    axis: Floats  # (m, 6)
    side: Floats
    other: Floats
    lengths: Floats
    radii: Floats
    bow: Floats


class _Chosen(NamedTuple):
    """Number (m,) of points of each tube, and their places and stations (m, most)."""

    number: Ints
    places: Ints
    stations: Labels


@njit(cache=True, nogil=True)
def choose(gathered, lines, tubes, chosen, first, last):  # type: ignore[no-untyped-def]
    """Choose by their hashes the points that lie on each tube's surface, in the order of their places."""
    places, stations = gathered.places, gathered.stations
    most = chosen.places.shape[1]
    for j in range(first, last):
        line = lines[j]
        count = gathered.counts[line]
        on, hashes = np.empty(count, np.int64), np.empty(count, np.uint64)
        # Hashes are uniform below the share that was gathered: a low part of them is enough, where points are many.
        part = np.uint64(min(gathered.shares[line] * PLENTY * most / max(count, 1), 1.0) * WHOLE)
        n = 0
        for i in range(line * gathered.room, line * gathered.room + count):
            if stations[i] < 0:
                continue
            h = hash_of(places[i], gathered.middles[line])
            if h < part and _is_on(places[i], gathered.middles[line], tubes, j):
                on[n], hashes[n] = i, h
                n += 1
        limit = np.uint64(0xFFFFFFFFFFFFFFFF)
        if n > most:
            limit = np.sort(hashes[:n])[most]
        rows = np.empty(min(n, most), np.int64)
        k = 0
        for i in range(n):
            if (n <= most or hashes[i] < limit) and k < most:
                rows[k] = on[i]
                k += 1
        key = np.empty(k, np.int64)
        for i in range(k):
            key[i] = places[rows[i]]
        order = np.argsort(key)
        for i in range(k):
            chosen.places[j, i], chosen.stations[j, i] = key[order[i]], stations[rows[order[i]]]
        chosen.number[j] = k


@njit(cache=True, nogil=True)
def _is_on(place, middle, tubes, j):  # type: ignore[no-untyped-def]
    """Whether a point lies within NEAR_MM of the surface of tube ``j``, off its ends."""
    axis, side, other, lengths, radii, bow = tubes
    mask = (1 << FIELD) - 1
    x = ((place >> (2 * FIELD)) - HALF + middle[0]) / STEPS_PER_MM - axis[j, 0]
    y = (((place >> FIELD) & mask) - HALF + middle[1]) / STEPS_PER_MM - axis[j, 1]
    z = ((place & mask) - HALF + middle[2]) / STEPS_PER_MM - axis[j, 2]
    t = 2.0 * (x * axis[j, 3] + y * axis[j, 4] + z * axis[j, 5]) / lengths[j]
    if abs(t) > END_SHARE:
        return False
    arch = 1.0 - t * t
    a = x * side[j, 0] + y * side[j, 1] + z * side[j, 2] - arch * bow[j, 0]
    b = x * other[j, 0] + y * other[j, 1] + z * other[j, 2] - arch * bow[j, 1]
    return abs(np.sqrt(a * a + b * b) - radii[j]) <= NEAR_MM


def tube_points(gathered: Gathered, lines: Ints, members: Members, most: int = MOST, threads: int = 0) -> TubePoints:
    """Take up to ``most`` points per member from those gathered near its line, ``lines`` (m,).

    The choice of points and their order depend on their coordinates alone.
    """
    m = len(lines)
    tubes = _Tubes(
        axis=np.hstack([members.points, members.directions]),
        side=members.side,
        other=np.ascontiguousarray(members.other),
        lengths=members.lengths,
        radii=members.radii,
        bow=members.bow,
    )
    chosen = _Chosen(np.zeros(m, np.int64), np.empty((m, most), np.int64), np.empty((m, most), np.int32))
    over_ranges(partial(choose, gathered, lines, tubes, chosen), m, threads)
    used = np.arange(most) < chosen.number[:, None]
    places, owner = chosen.places[used], np.repeat(lines, chosen.number)
    mask = (1 << FIELD) - 1
    steps = np.stack([places >> (2 * FIELD), (places >> FIELD) & mask, places & mask], axis=1) - HALF
    points = (steps + gathered.middles[owner]) / STEPS_PER_MM
    return TubePoints(points, chosen.stations[used], np.concatenate([[0], np.cumsum(chosen.number)]))
