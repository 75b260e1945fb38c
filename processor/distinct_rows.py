"""Distinct rows: cells that points lie in, pairs of numbers, points; in a fraction of the time of np.unique.

And the rows of each label, and the connected components of what is linked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Floats, Ints

DENSE = 8  # times the rows: numbers of this range are counted, others are sorted


@dataclass(frozen=True)
class Distinct:
    """Rows (k, m), sorted from the first column on; where each comes ``first`` (k,), and how often: ``count`` (k,).

    ``number`` (n,) is that of each of the rows given.
    """

    rows: Ints
    first: Ints
    number: Ints
    count: Ints


def distinct(rows: Ints) -> Distinct:
    """Find the distinct ones of rows (n, m)."""
    if not len(rows):
        none = np.empty(0, np.int64)
        return Distinct(rows, none, none, none)
    low, high = rows.min(axis=0), rows.max(axis=0)
    key, span = np.zeros(len(rows), np.int64), 1
    for column, least, most in zip(rows.T, low.tolist(), high.tolist(), strict=True):
        span *= most - least + 1
        if span >= 2**62:  # a key for each row would not fit
            _, first, number, count = np.unique(
                rows, axis=0, return_index=True, return_inverse=True, return_counts=True
            )
            return Distinct(rows[first], first, number.reshape(-1), count)
        key = key * (most - least + 1) + (column - least)
    if span > DENSE * len(rows):
        _, first, number, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
        return Distinct(rows[first], first, number, count)
    every = np.bincount(key, minlength=span)
    there = every > 0
    number = (np.cumsum(there) - 1)[key]
    count = every[there]
    first = np.empty(len(count), np.int64)
    first[number[::-1]] = np.arange(len(rows) - 1, -1, -1)
    return Distinct(rows[first], first, number, count)


def distinct_points(points: Floats) -> tuple[Floats, Ints]:
    """Return the distinct ones of points (n, m), sorted from the first column on, and the number (n,) of each given."""
    order = np.lexsort(points.T[::-1])
    ordered = points[order]
    begins = np.ones(len(points), bool)
    begins[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    number = np.empty(len(points), np.int64)
    number[order] = np.cumsum(begins) - 1
    return ordered[begins], number


def rows_by_label(label: Ints) -> list[Ints]:
    """Return the rows (m,) of each label of labels (n,), the least label first."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(order) else []


def components(count: int, a: Ints, b: Ints) -> Ints:
    """Return the component (count,) of each node of a graph with links a, b (k,), numbered by their first nodes."""
    from scipy.sparse import coo_array, csgraph

    links = coo_array((np.ones(len(a), np.int8), (a, b)), (count, count))
    label: Ints = csgraph.connected_components(links, directed=False)[1].astype(np.int64)
    return label
