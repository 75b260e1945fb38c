"""Compiled selection and sorting: the least of many values before the others; rows of few points by coordinates."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from processor.inner_kernels import inner


@inner
def least_first(values, count, k):  # type: ignore[no-untyped-def]
    """Reorder the first ``count`` values: number ``k`` is the one of their sorted order, none before it is greater.

    Hoare's selection; none may be NaN. np.partition and np.median take a second to compile.
    """
    low, high = 0, count - 1
    while low < high:
        one, two, three = values[low], values[(low + high) // 2], values[high]
        pivot = max(min(one, two), min(max(one, two), three))
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break


@inner
def median(values, count):  # type: ignore[no-untyped-def]
    """Return the median of the first ``count`` values, one or more, whose order is changed; none may be NaN."""
    middle = count // 2
    least_first(values, count, middle)
    if count % 2:
        return values[middle]
    below = values[0]
    for k in range(1, middle):
        below = max(below, values[k])
    return (below + values[middle]) / 2.0


@inner
def _is_after(points, one, other):  # type: ignore[no-untyped-def]
    """Whether one row comes after another by x, y, z and its number."""
    for i in range(3):
        if points[one, i] != points[other, i]:
            return points[one, i] > points[other, i]
    return one > other


@inner
def sort_rows(points, rows, first, last):  # type: ignore[no-untyped-def]
    """Sort ``rows`` of points (n, 3) from ``first`` to ``last`` - 1 by x, y, z and row (Shell's sort: for few)."""
    gap = (last - first) // 2
    while gap > 0:
        for i in range(first + gap, last):
            row, j = rows[i], i
            while j >= first + gap and _is_after(points, rows[j - gap], row):
                rows[j] = rows[j - gap]
                j -= gap
            rows[j] = row
        gap //= 2
