"""Thresholds of the garbage collection in the processes of the commands."""

import gc

THRESHOLDS = (50_000, 20, 100)  # chosen: Python's own are 700, 10, 10


def collect_rarely() -> None:
    """Look for reference cycles less often than Python does by itself.

    Compiling kernels makes millions of small objects that stay: searched as often as usual, they take a third of the
    time of the first run after an install. Arrays are in no cycles; they are freed when the last reference goes.
    """
    gc.set_threshold(*THRESHOLDS)
