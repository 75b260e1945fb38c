"""Progress of stages on standard error: a line that is refreshed on a terminal, one every half minute in a file."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from processor.plain_text import printable

Item = TypeVar("Item")
PATIENCE_S = 2.0  # a shorter stage needs no line
REFRESH_S = 0.25  # as often as a moving number can be read
FIRST_LINE_S, LINE_S = 10.0, 30.0  # off a terminal: a log is read afterwards, or by somebody who waits
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
_in_lines = False


@contextmanager
def in_lines(wanted: bool = True) -> Iterator[None]:
    """Print lines about long stages where standard error is no terminal, as long as the context lasts."""
    global _in_lines
    before, _in_lines = _in_lines, wanted
    try:
        yield
    finally:
        _in_lines = before


@contextmanager
def stage(title: str) -> Iterator[None]:
    """Show a title with the time elapsed while the block runs, and the progress of :func:`tracked` within it."""
    terminal = sys.stderr.isatty()
    if not (terminal or _in_lines):
        yield
        return
    # A title may hold the name of a file, which a terminal must not obey.
    ended, current = threading.Event(), _Stage(printable(title))
    display = threading.Thread(target=_show if terminal else _print_lines, args=(current, ended), daemon=True)
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


def _print_lines(current: _Stage, ended: threading.Event) -> None:
    started, wait = time.monotonic(), FIRST_LINE_S
    while not ended.wait(wait):
        of = f", {current.done} of {current.total}" if current.total else ""
        print(f"{current.title}: {time.monotonic() - started:.0f} s{of}", file=sys.stderr, flush=True)
        wait = LINE_S
