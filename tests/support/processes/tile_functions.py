"""Functions of tiles, which workers of a cluster import."""

import os
import time
from pathlib import Path

import numpy as np

from processor.model import InputError


def scaled(tile, factor):
    """The tile times a factor, whether both can be written to, and the process that did it."""
    return tile * factor, tile.flags.writeable and factor.flags.writeable, os.getpid()


def refused(tile):
    raise InputError(f"tile {int(tile[0])}: refused")


def without_memory(_):
    raise MemoryError


def ends_its_worker(tile, folder):
    """Note each attempt; the first at tile 2 ends its worker."""
    number = int(tile[0])
    note = Path(folder, f"{number}-{time.monotonic_ns()}")
    first = not list(Path(folder).glob(f"{number}-*"))
    note.touch()
    if number == 2 and first:
        os._exit(9)
    return np.sqrt(tile)
