"""What is being done, on a terminal: a line on standard error for whatever lasts over two seconds, silent otherwise."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

Item = TypeVar("Item")
PATIENCE_S = 2.0
REFRESH_S = 0.25
COUNTED = "{desc}: {n_fmt} of {total_fmt} |{bar}| {elapsed}, {remaining} left"
UNCOUNTED = "{desc}: {elapsed}"


@dataclass
class _Stage:
    what: str
    done: int = 0
    total: int = 0


_stages: list[_Stage] = []


@contextmanager
def stage(what: str) -> Iterator[None]:
    """Show ``what`` with the time it takes while the block lasts, and how far :func:`tracked` within it has come."""
    if not sys.stderr.isatty():
        yield
        return
    ended, now = threading.Event(), _Stage(what)
    shower = threading.Thread(target=_show, args=(now, ended), daemon=True)
    _stages.append(now)
    shower.start()
    try:
        yield
    finally:
        ended.set()
        shower.join()
        _stages.remove(now)


def tracked(items: Sequence[Item]) -> Iterator[Item]:
    """Yield items, counted in the line of the stage that this is part of."""
    now = _stages[-1] if _stages else _Stage("")
    now.done, now.total = 0, len(items)
    for item in items:
        yield item
        now.done += 1
    now.total = 0


def _show(now: _Stage, ended: threading.Event) -> None:
    if ended.wait(PATIENCE_S):
        return
    from tqdm import tqdm

    with tqdm(desc=now.what, leave=False, file=sys.stderr, bar_format=UNCOUNTED) as bar:
        while not ended.wait(REFRESH_S):
            if bar.total != now.total:
                bar.reset(now.total)
                bar.bar_format = COUNTED if now.total else UNCOUNTED
            bar.n = now.done
            bar.refresh()
