"""What happens after each piece of a file: memory is given back, and the share that is read is shown."""

from __future__ import annotations

from collections.abc import Callable

from processor import large_arrays, progress

BYTES_A_POINT = 32  # of the arrays of a scan

_show: Callable[[float], None] = progress.show_share


def read(points: int, done: int, total: int) -> None:
    """Note that a piece of ``points`` points was read: ``done`` of ``total`` points or bytes."""
    large_arrays.release_after(points * BYTES_A_POINT)
    _show(done / max(total, 1))


def show_with(show: Callable[[float], None]) -> None:
    """Replace what shows the share of a file that is read."""
    global _show
    _show = show
