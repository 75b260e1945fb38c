"""Tiles of one scene: a function is called for each, in this process or on the workers of a cluster.

A tile's result depends on the tile alone, and results come in the order of the tiles. What is computed from them is
therefore the same wherever they were computed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from processor.model import Ints

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, eq=False)
class Shared(Generic[S]):
    """What many tiles need, e.g. a design's surface: a worker gets it once."""

    value: S


class Workers(Protocol):
    """Computes tiles elsewhere."""

    def results(self, function: Callable[..., R], tiles: Iterable[Any], shared: Sequence[Shared[Any]]) -> Iterator[R]:
        """Yield ``function(tile, *values of shared)`` for each tile, in order."""


_workers: ContextVar[Workers | None] = ContextVar("workers", default=None)


@contextmanager
def on(workers: Workers) -> Iterator[None]:
    """Compute tiles by ``workers``, as long as the context lasts."""
    before = _workers.set(workers)
    try:
        yield
    finally:
        _workers.reset(before)


def mapped(function: Callable[..., R], tiles: Iterable[Any], *shared: Shared[Any]) -> Iterator[R]:
    """Yield ``function(tile, *values of shared)`` for each tile, in order.

    The function is one of a module, and takes arrays and records of arrays. The single tile of a sequence is computed
    in this process.
    """
    workers = _workers.get()
    if workers is None or (isinstance(tiles, Sequence) and len(tiles) < 2):
        for tile in tiles:
            yield function(tile, *(one.value for one in shared))
    else:
        yield from workers.results(function, tiles, shared)


def grouped(counts: Ints, most: int) -> Ints:
    """Return the group (b,) of each of bins in a row, such that the ``counts`` (b,) of a group are ``most`` in sum.

    A bin that has more is a group by itself.
    """
    group, number, total = np.empty(len(counts), np.int64), 0, 0
    for row, count in enumerate(counts.tolist()):
        if total and total + count > most:
            number, total = number + 1, 0
        group[row], total = number, total + count
    return group


def ranges(count: int, size: int) -> list[slice]:
    """Return slices of ``size`` rows, the last of fewer, up to ``count``."""
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]
