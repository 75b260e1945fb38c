"""Compiled selection: the least of many values are put before the others without a sort."""
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
