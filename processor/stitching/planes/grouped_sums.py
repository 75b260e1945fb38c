"""Group rows by integer keys and sum them: compiled hash tables for millions of points."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from processor import large_arrays
from processor.geometry.point_grid import FREE, empty_table, slot_of
from processor.model import Bools, Floats, Ints


def numbered(keys: Ints) -> tuple[Ints, Ints]:
    """Assign numbers to the k distinct values of keys (n,) in ascending order.

    Returns the first row of each value (k,) and the number of each row (n,), as np.unique does.
    """
    number, distinct = np.empty(len(keys), np.int64), np.empty(len(keys), np.int64)
    keys = np.ascontiguousarray(keys, np.int64)
    count = gather(keys, *empty_table(len(keys)), number, distinct)
    order = np.argsort(distinct[:count])
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count)
    first = np.empty(count, np.int64)
    renumber(number, rank, first)
    return first, number


def distinct_count(keys: Ints) -> int:
    """Count the distinct values of keys (n,)."""
    number, distinct = np.empty(len(keys), np.int64), np.empty(len(keys), np.int64)
    return int(gather(np.ascontiguousarray(keys), *empty_table(len(keys)), number, distinct))


def summed(values: Floats, group: Ints, count: int) -> Floats:
    """Sum rows of values (n, k) by group (n,): (count, k)."""
    out = np.zeros((count, values.shape[1]))
    add_rows(np.ascontiguousarray(values), np.ascontiguousarray(group), out)
    return out


def sums_of_points(points: Floats, group: Ints, count: int, kept: Bools | None = None) -> Floats:
    """Sum the ten moments of points (n, 3) by group (n,), of those alone that are ``kept`` (n,), if that is given.

    Returns (count, 10), in the order of extraction.UPPER.
    """
    out = np.zeros((count, 10))
    for rows in large_arrays.blocks(len(points)):
        part, own = points[rows], group[rows]
        if kept is not None:
            part, own = part[kept[rows]], own[kept[rows]]
        add_points(np.ascontiguousarray(part), np.ascontiguousarray(own), out)
    return out


def number_of_rows(keys: Callable[[slice], Ints], count: int) -> tuple[Ints, Ints]:
    """Return the distinct ones (k,) of keys, ascending, and the number (count,) of each row.

    ``keys`` returns the keys of a slice of the rows.
    """
    parts, held = [np.empty(0, np.int64)], 0
    for rows in large_arrays.blocks(count):
        key = keys(rows)
        parts.append(key[numbered(key)[0]])
        held += len(parts[-1])
        if held > max(large_arrays.AT_ONCE, len(parts[0])):
            parts, held = [np.unique(np.concatenate(parts))], 0
    distinct = np.unique(np.concatenate(parts))
    number = large_arrays.allocate(count, dtype=np.int64)
    for rows in large_arrays.blocks(count):
        key = keys(rows)
        first, own = numbered(key)
        number[rows] = np.searchsorted(distinct, key[first])[own]
    return distinct, number


@njit(cache=True, nogil=True)
def gather(keys, table, number_of_slot, number, distinct):  # type: ignore[no-untyped-def]
    """Write numbers of keys (n,), by first appearance, and the ``distinct`` keys; returns how many these are."""
    count = 0
    for i in range(len(keys)):
        slot = slot_of(table, keys[i])
        if table[slot] == FREE:
            table[slot] = keys[i]
            number_of_slot[slot] = count
            distinct[count] = keys[i]
            count += 1
        number[i] = number_of_slot[slot]
    return count


@njit(cache=True, nogil=True)
def renumber(number, rank, first):  # type: ignore[no-untyped-def]
    """Replace numbers (n,) by their ranks, and write the first row of each rank."""
    first[:] = -1
    for i in range(len(number)):
        number[i] = rank[number[i]]
        if first[number[i]] < 0:
            first[number[i]] = i


@njit(cache=True, nogil=True)
def add_rows(values, group, out):  # type: ignore[no-untyped-def]
    """Add rows of values (n, k) to the rows of their groups in ``out``."""
    for i in range(len(values)):
        for j in range(values.shape[1]):
            out[group[i], j] += values[i, j]


@njit(cache=True, nogil=True)
def add_points(points, group, out):  # type: ignore[no-untyped-def]
    """Add the ten moments of points (n, 3) to the rows of their groups in ``out`` (k, 10)."""
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
