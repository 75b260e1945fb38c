"""Compiled kernels over ranges of items on several threads.

The result of an item does not depend on other items, so that neither the number of threads nor the ranges matter.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import TypeVar

import scipy.linalg  # noqa: F401 - only a BLAS that is loaded already is limited
from threadpoolctl import ThreadpoolController

A = TypeVar("A")
B = TypeVar("B")
PIECES = 32  # ranges; more than threads, since they do not all take the same time


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="kernels")


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()  # looks through all that is loaded, which takes as long as a fit


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep linear algebra to one thread: the last digits of its sums depend on the number of threads.

    Two threads also take longer for the small matrices here.
    """
    with _libraries().limit(limits=1, user_api="blas"):
        yield


def usable() -> int:
    """Return the number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(function: Callable[[A], B], items: Iterable[A]) -> list[B]:
    """Call a function that releases the interpreter lock for each item, on threads; return results in order."""
    with ThreadPoolExecutor(usable()) as pool:
        return list(pool.map(function, items))


def over_ranges(kernel: Callable[[int, int], object], count: int, threads: int = 0, least: int = 1) -> None:
    """Call ``kernel(first, last)`` for ranges that cover 0 to ``count``; 0 threads = all usable ones.

    A range has ``least`` items or more, except where ``count`` is smaller.
    """
    threads = threads or usable()
    pieces = max(1, min(PIECES, count // max(least, 1)))
    bounds = [count * i // pieces for i in range(pieces + 1)]
    if threads == 1 or pieces == 1:
        kernel(0, count)
        return
    for done in [_pool(threads).submit(kernel, a, b) for a, b in pairwise(bounds)]:
        done.result()
