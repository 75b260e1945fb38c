"""Rows gathered by a key, and summed: compiled, for a million points at a time."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit

from processor.model import Floats, Ints

MIX = np.uint64(0x9E3779B97F4A7C15)  # keys that count up would fill a table in runs
EMPTY = np.iinfo(np.int64).min


@njit(cache=True, nogil=True)
def place(table, key, shift):  # type: ignore[no-untyped-def]
    """Return the slot of a key in a table, or the free one where it belongs."""
    last = len(table) - 1
    slot = np.int64((np.uint64(key) * MIX) >> np.uint64(shift))
    while table[slot] != EMPTY and table[slot] != key:
        slot = (slot + 1) & last
    return slot


@njit(cache=True, nogil=True)
def gather(keys, table, shift, number, distinct):  # type: ignore[no-untyped-def]
    """Give numbers to keys (n,) as they come: into ``number`` (n,) and ``distinct``; returns how many these are."""
    held = np.empty(len(table), np.int64)
    count = 0
    for i in range(len(keys)):
        slot = place(table, keys[i], shift)
        if table[slot] == EMPTY:
            table[slot] = keys[i]
            held[slot] = count
            distinct[count] = keys[i]
            count += 1
        number[i] = held[slot]
    return count


@njit(cache=True, nogil=True)
def renumber(number, rank, first):  # type: ignore[no-untyped-def]
    """Turn numbers (n,) into ranks, and note the first row of each."""
    first[:] = -1
    for i in range(len(number)):
        number[i] = rank[number[i]]
        if first[number[i]] < 0:
            first[number[i]] = i


@njit(cache=True, nogil=True)
def add_rows(values, group, out):  # type: ignore[no-untyped-def]
    """Add rows of values (n, k) to those of their groups."""
    for i in range(len(values)):
        for j in range(values.shape[1]):
            out[group[i], j] += values[i, j]


@njit(cache=True, nogil=True)
def add_points(points, group, out):  # type: ignore[no-untyped-def]
    """Add the ten sums of points (n, 3) to those (k, 10) of their groups; see octree.UPPER."""
    for i in range(len(points)):
        x, y, z, g = points[i, 0], points[i, 1], points[i, 2], group[i]
        out[g, 0] += x * x
        out[g, 1] += x * y
        out[g, 2] += x * z
        out[g, 3] += y * y
        out[g, 4] += y * z
        out[g, 5] += z * z
        out[g, 6] += x
        out[g, 7] += y
        out[g, 8] += z
        out[g, 9] += 1.0


def numbered(keys: Ints) -> tuple[Ints, Ints]:
    """Give numbers, ascending, to the distinct of keys (n,): the first row of each (k,), each row's number (n,)."""
    number, distinct = np.empty(len(keys), np.int64), np.empty(len(keys), np.int64)
    bits = max(1, int(2 * len(keys)).bit_length())
    table = np.full(1 << bits, EMPTY, np.int64)
    keys = np.ascontiguousarray(keys, np.int64)
    count = gather(keys, table, 64 - bits, number, distinct)
    order = np.argsort(distinct[:count])
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count)
    first = np.empty(count, np.int64)
    renumber(number, rank, first)
    return first, number


def distinct_count(keys: Ints) -> int:
    """Count the distinct of keys (n,)."""
    number, distinct = np.empty(len(keys), np.int64), np.empty(len(keys), np.int64)
    bits = max(1, int(2 * len(keys)).bit_length())
    return int(gather(np.ascontiguousarray(keys), np.full(1 << bits, EMPTY, np.int64), 64 - bits, number, distinct))


def summed(values: Floats, group: Ints, count: int) -> Floats:
    """Sum rows of values (n, k) by group: (count, k)."""
    out = np.zeros((count, values.shape[1]))
    add_rows(np.ascontiguousarray(values), np.ascontiguousarray(group), out)
    return out


def sums_of_points(points: Floats, group: Ints, count: int) -> Floats:
    """Sum points (n, 3) by group into ten numbers each: (count, 10); see octree.UPPER."""
    out = np.zeros((count, 10))
    add_points(np.ascontiguousarray(points), group, out)
    return out
