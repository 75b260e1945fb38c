"""The unit of a design whose files state none, from scans that have one, or from what sizes are usual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor.model import Floats
from processor.scan_folder.units import MM_PER_UNIT, radius

UNITS = ("mm", "m", "inch", "cm", "ft")
SURE, TOLERANCE = 0.05, 0.25  # relative difference of a scan's size from its design's: in one unit, and in no other
SIZES_M = (3.0, 300.0)  # of most structures
USUAL = ("mm", "m")  # what CAD writes


@dataclass(frozen=True)
class DesignUnit:
    """A unit of length, "" if none is likelier than the others, with the reason, and whether it is sure."""

    unit: str
    reason: str
    sure: bool


def guess(surfaces: Sequence[Floats], scans: Sequence[tuple[float, str]], as_whole: bool) -> DesignUnit:
    """Guess the unit of vertices (v, 3) of each part, or of the whole if ``as_whole``.

    ``scans`` are the radius of each scan and the unit that its format states, "" for none.
    """
    whole = np.concatenate(surfaces)
    sizes = np.array([radius(whole)] if as_whole else [radius(part) for part in surfaces])
    stated = [size * MM_PER_UNIT[unit] for size, unit in scans if unit and size > 0.0]
    if stated:
        misfit = {
            unit: max(float(np.abs(np.log(size / (sizes * MM_PER_UNIT[unit]))).min()) for size in stated)
            for unit in UNITS
        }
        best, second = sorted(UNITS, key=misfit.__getitem__)[:2]
        if misfit[best] <= np.log1p(SURE) and misfit[second] > np.log1p(TOLERANCE):
            return DesignUnit(best, "the scans, whose formats state a unit, are as large as the design in it", True)
    extent = float(np.ptp(whole, axis=0).max())
    possible = [u for u in UNITS if SIZES_M[0] <= extent * MM_PER_UNIT[u] / 1000.0 <= SIZES_M[1]]
    likely = [u for u in possible if u in USUAL]
    which = " or ".join(possible) if possible else "none of the usual units"
    if len(likely) != 1 and "mm" not in likely:
        return DesignUnit("", f"an extent of {extent:.4g} would be {which}", False)
    unit = "mm" if "mm" in likely else likely[0]
    others = "".join(f", and in {u}" for u in possible if u != unit)
    return DesignUnit(
        unit, f"no file states it; an extent of {extent:.4g} is that of a structure in {unit}{others}", False
    )
