"""Text: a line per point, in metres to 0.1 micrometre; a line of names if there are columns besides the coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from processor.writers.cloud import GRID, METRES, Cloud

COORDINATE, REAL, INTEGER = "%.7f", "%.6g", "%d"


def write(path: Path, cloud: Cloud) -> int:
    """Write a cloud with its columns, but for the scanner's grid; return the number of points."""
    kept = [name for name in cloud.fields if name not in GRID]
    forms = [COORDINATE] * 3 + [REAL if np.dtype(cloud.fields[name]).kind == "f" else INTEGER for name in kept]
    count = 0
    with path.open("w", encoding="ascii", newline="\n") as file:
        if kept:
            file.write(" ".join(["x", "y", "z", *kept]) + "\n")
        for block in cloud.blocks():
            points = (block.points + cloud.origin) * METRES
            np.savetxt(file, np.column_stack([points, *(block.fields[name] for name in kept)]), fmt=forms)
            count += len(points)
    return count
