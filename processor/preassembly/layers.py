"""A plate has two sides: which points about an outer face are of that face, and how thick the plate is.

Where the design has inner walls, points on them are told apart by the face they lie on. Without, they lie about the
outer face like everything else, a plate's thickness inside of it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from processor.model import Floats

Bools = npt.NDArray[np.bool_]

BIN_MM = 3.0
REACH_MM = 60.0  # inward and outward
LAYER_MM = 9.0  # about the middle of a layer; plates are thicker than this
CLEAR_SHARE = 0.35  # of the most crowded bin: a layer, and no strays
SECOND_SHARE = 0.05  # of the points further in: less is strays
FEWEST = 40
THINNEST_MM = 6.0
RING_SHARE = 0.95  # of a ring's points lie within this share of its plate's thickness


def outer(out: Floats) -> Bools:
    """Mark the points (n,) of the outermost layer by how far out they lie; all of them where there is but one."""
    everything = np.ones(len(out), bool)
    near = np.abs(out) < REACH_MM
    if not near.any():
        return everything
    edges = np.arange(-REACH_MM, REACH_MM + 0.5 * BIN_MM, BIN_MM)
    count = np.histogram(out[near], edges)[0]
    centre = edges[np.flatnonzero(count >= CLEAR_SHARE * count.max())[-1]] + 0.5 * BIN_MM
    for _ in range(8):
        centre = float(np.median(out[np.abs(out - centre) < LAYER_MM]))
    inside = near & (out < centre - LAYER_MM)
    if inside.sum() < SECOND_SHARE * near.sum():
        return everything
    found: Bools = np.abs(out - centre) < LAYER_MM
    return found


def plate_mm(x: Floats, e: Floats, sigma_mm: float, taken_mm: float) -> float:
    """Thickness of the plate at an open end: ``taken_mm`` unless the points say clearly otherwise.

    ``x`` (n,) is outward from the end, ``e`` inward from the outer face, of points clear of the section's corners. The
    inner wall says it; where it is not seen, the ring's own width does.
    """
    reach = 4.0 * sigma_mm + 2.0
    inner = e[(x < -reach) & (x > -REACH_MM) & (e > max(THINNEST_MM, reach)) & (e < REACH_MM)]
    if len(inner) >= FEWEST:
        inner = inner[outer(-inner)]
        found = float(np.median(inner))
        if np.median(np.abs(inner - found)) > 2.0 * sigma_mm + 1.0:  # clutter
            return taken_mm
    else:
        ring = e[(np.abs(x) < reach) & (e > reach) & (e < REACH_MM)]
        if len(ring) < FEWEST:
            return taken_mm
        found = float(np.quantile(ring, RING_SHARE))
        found = reach + (found - reach) / RING_SHARE
    return found if abs(found - taken_mm) > 2.0 * sigma_mm + 1.0 else taken_mm
