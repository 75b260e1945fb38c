"""The parts of a bridge one by one: small ones on several threads, with the results of one thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import TypeVar

from processor import diagnostics, large_arrays
from processor.geometry.thread_ranges import usable
from processor.model import Scan
from processor.progress import tracked

T = TypeVar("T")
POINTS_BESIDE = 5_000_000  # of parts that are worked on beside each other: 1 GB


def each_part(function: Callable[[int], T], scans: Sequence[Sequence[Scan]]) -> list[T]:
    """Call a function of a part's number for each part; ``scans`` are those of each. Returns the results in order.

    Diagnostics are in the order of the parts, whichever is done first.
    """
    parts = range(len(scans))
    largest = max(sum(len(scan.points) for scan in of_part) for of_part in scans)
    threads = min(usable(), POINTS_BESIDE // max(largest, 1))
    if threads < 2:
        found = []
        for part in tracked(parts):
            found.append(function(part))
            large_arrays.release()  # the points of one part are in memory at a time
        return found

    def recorded(part: int) -> tuple[T, diagnostics.Notes]:
        with diagnostics.recording() as notes:
            return function(part), notes

    # Each part has a copy of the context, which knows whether clouds are kept: a context cannot be entered twice.
    contexts = [copy_context() for _ in parts]
    with ThreadPoolExecutor(threads) as pool:
        # After an error, or Ctrl-C, no further part is begun.
        results = pool.map(lambda context, part: context.run(recorded, part), contexts, parts)
        done = [found for _, found in zip(tracked(parts), results, strict=True)]
    for _, notes in done:
        diagnostics.replay(notes)
    return [result for result, _ in done]
