"""Limits of the address space of this process, beyond what it has now; none where the system does not tell its size."""

from __future__ import annotations

import mmap
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def limit(more: int) -> None:
    """Let this process have ``more`` bytes beyond those that it has; a hard limit stays."""
    has = _size()
    if has is not None:
        _set(has + more)


def extend(more: int) -> None:
    """Raise the limit, if there is one, by ``more`` bytes."""
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    if soft != resource.RLIM_INFINITY:
        _set(soft + more)


@contextmanager
def limited(more: int) -> Iterator[None]:
    """Limit this process as :func:`limit` does, for some time; a limit that is lower stays."""
    has = _size()
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    if has is None or (soft != resource.RLIM_INFINITY and soft < has + more):
        yield
        return
    try:
        _set(has + more)
        yield
    finally:
        _set(soft)


def room() -> float:
    """Return the bytes that this process may still have; infinite without a limit."""
    soft, has = resource.getrlimit(resource.RLIMIT_AS)[0], _size()
    return float("inf") if soft == resource.RLIM_INFINITY or has is None else float(soft - has)


def _size() -> int | None:
    """Return the bytes of address space of this process."""
    pages = Path("/proc/self/statm")
    return int(pages.read_text().split()[0]) * mmap.PAGESIZE if pages.exists() else None


def _set(wanted: int) -> None:
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    unlimited = hard == resource.RLIM_INFINITY
    soft = wanted if unlimited or (wanted != resource.RLIM_INFINITY and wanted < hard) else hard
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
