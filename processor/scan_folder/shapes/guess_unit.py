"""The unit of a design whose files state none, from scans that have one, or from what sizes are usual."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.model import Reason, reason
from processor.scan_folder.shapes.surface_files import Surface
from processor.scan_folder.units import MM_PER_UNIT, radius

UNITS = ("mm", "m", "inch", "cm", "ft")
SURE, TOLERANCE = 0.05, 0.25  # relative difference of a scan's size from its design's: in one unit, and in no other
SIZES_M = (3.0, 300.0)  # of most structures
USUAL = ("mm", "m")  # what CAD writes
# A unit, "" if none is likelier than the others, and the doubt about it; () where it is sure
DesignUnit = tuple[str, tuple[Reason, ...]]


def guess(surfaces: Sequence[Surface], scans: Sequence[tuple[float, str]], given: str, as_whole: bool) -> DesignUnit:
    """Return the unit ``given`` or that of the files, else guess it from each part, or from the whole if ``as_whole``.

    ``scans`` are the radius of each scan and the unit that its format states, "" for none.
    """
    if given or all(surface.unit for surface in surfaces):
        return given or "mm", ()
    whole = np.concatenate([surface.vertices for surface in surfaces])
    sizes = np.array([radius(whole)] if as_whole else [radius(surface.vertices) for surface in surfaces])
    stated = [size * MM_PER_UNIT[unit] for size, unit in scans if unit and size > 0.0]
    if stated:
        misfit = {
            unit: max(float(np.abs(np.log(size / (sizes * MM_PER_UNIT[unit]))).min()) for size in stated)
            for unit in UNITS
        }
        best, second = sorted(UNITS, key=misfit.__getitem__)[:2]
        if misfit[best] <= np.log1p(SURE) and misfit[second] > np.log1p(TOLERANCE):
            return best, ()
    extent = float(np.ptp(whole, axis=0).max())
    possible = [u for u in UNITS if SIZES_M[0] <= extent * MM_PER_UNIT[u] / 1000.0 <= SIZES_M[1]]
    likely = [u for u in possible if u in USUAL]
    if not likely:
        why = reason("init.extent-of-no-unit", extent=extent)
        if possible:
            either: str | Reason = possible[0]
            for other in possible[1:]:
                either = reason("init.or", first=either, second=other)
            why = reason("init.extent-of-several-units", extent=extent, units=either)
        return "", (reason("init.design-unit-unclear", reason=why),)
    unit = "mm" if "mm" in likely else likely[0]
    units: str | Reason = unit
    for other in (u for u in possible if u != unit):
        units = reason("init.and-in", first=units, second=other)
    why = reason("init.extent-in-units", extent=extent, units=units)
    return unit, (reason("init.design-unit-taken", unit=unit, reason=why),)
