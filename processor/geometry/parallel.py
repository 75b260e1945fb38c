"""Compiled kernels over ranges of items on a few threads.

Every item's answer is its own, so that neither the number of threads nor the ranges show in any result.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")
PIECES = 32  # ranges, more than threads: they do not all take the same time


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="kernels")


def usable() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(function: Callable[[A], B], items: Iterable[A]) -> list[B]:
    """Call a function that lets other threads run for each of the items; the answers in the items' order."""
    with ThreadPoolExecutor(usable()) as pool:
        return list(pool.map(function, items))


def over_ranges(kernel: Callable[[int, int], object], count: int, threads: int = 0, least: int = 1) -> None:
    """Call ``kernel(first, last)`` for ranges that cover 0 to ``count``; 0 threads = as many as are usable.

    ``least`` items make a range, where there are so many.
    """
    threads = threads or usable()
    pieces = max(1, min(PIECES, count // max(least, 1)))
    bounds = [count * i // pieces for i in range(pieces + 1)]
    if threads == 1 or pieces == 1:
        kernel(0, count)
        return
    for done in [_pool(threads).submit(kernel, a, b) for a, b in pairwise(bounds)]:
        done.result()


# --- Compiled kernels over ranges of items on a few threads; see :mod:`processor.geometry.parallel`.


__all__ = ["over_ranges", "usable"]
