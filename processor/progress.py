"""Progress on a terminal: a line on standard error for every stage that takes more than two seconds."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from processor.plain_text import printable

Item = TypeVar("Item")
PATIENCE_S = 2.0
REFRESH_S = 0.25
COUNTED = "{desc}: {n_fmt} of {total_fmt} |{bar}| {elapsed}, {remaining} left"
UNCOUNTED = "{desc}: {elapsed}"
IN_PARTS = "{desc}: {percentage:3.0f} % |{bar}| {elapsed}, {remaining} left"


@dataclass
class _Stage:
    title: str
    done: int = 0
    total: int = 0
    share: float = 0.0  # of the item after those done


_stages: list[_Stage] = []


@contextmanager
def stage(title: str) -> Iterator[None]:
    """Show a title with the time elapsed while the block runs, and the progress of :func:`tracked` within it."""
    if not sys.stderr.isatty():
        yield
        return
    # A title may hold the name of a file, which a terminal must not obey.
    ended, current = threading.Event(), _Stage(printable(title))
    display = threading.Thread(target=_show, args=(current, ended), daemon=True)
    _stages.append(current)
    display.start()
    try:
        yield
    finally:
        ended.set()
        display.join()
        _stages.remove(current)


def tracked(items: Sequence[Item]) -> Iterator[Item]:
    """Yield items and count them in the line of the current stage."""
    current = _stages[-1] if _stages else _Stage("")
    current.done, current.total = 0, len(items)
    for item in items:
        yield item
        current.done, current.share = current.done + 1, 0.0
    current.total = 0


def show_share(share: float) -> None:
    """Show how much of the current item of :func:`tracked` is done, from 0 to 1."""
    if _stages:
        _stages[-1].share = min(share, 1.0)


def _show(current: _Stage, ended: threading.Event) -> None:
    if ended.wait(PATIENCE_S):
        return
    from tqdm import tqdm

    with tqdm(desc=current.title, leave=False, file=sys.stderr, bar_format=UNCOUNTED) as bar:
        while not ended.wait(REFRESH_S):
            if bar.total != current.total:
                bar.reset(current.total)
            bar.bar_format = UNCOUNTED if not current.total else IN_PARTS if current.share else COUNTED
            bar.n = current.done + current.share if current.share else current.done
            bar.refresh()
