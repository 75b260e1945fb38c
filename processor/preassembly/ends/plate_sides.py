"""A plate has two sides: which points about an outer face are of that face, and how thick the plate is.

Where the design has inner walls, points on them are told apart by the face they lie on. Without, they lie about the
outer face like everything else, a plate's thickness inside of it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from processor.model import Floats, Ints

Bools = npt.NDArray[np.bool_]

BIN_MM = 3.0
REACH_MM = 60.0  # inward and outward
LAYER_MM = 9.0  # about the middle of a layer; plates are thicker than this
CLEAR_SHARE = 0.35  # of the most crowded bin: a layer, and no strays
SECOND_SHARE = 0.05  # of the points further in: less is strays
FEWEST = 40
FEWEST_OF_CELL = 12
CLIMBS = 2  # a plate has two sides
ONE_LAYER_SHARE = 0.7  # of points above a layer: they are one, and no strays
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


def outer_surface(out: Floats, basis: Floats, cell: Ints) -> Bools:
    """Mark the points (n,) of the outermost layer where it is not level: a surface in a basis (n, k) over cells (n,).

    Each cell's own outermost layer is found first; the surface is the one with the least sum of distances from these.
    """
    level = _through_cells(out, basis, cell)
    if level is None:
        return outer(out)
    for _ in range(CLIMBS):
        # Where the outer side was seen in few places, most cells found the inner one.
        above = np.flatnonzero((out - level > LAYER_MM) & (out - level < REACH_MM))
        if len(above) < max(SECOND_SHARE * len(out), FEWEST):
            break
        coefficients = least_distances(basis[above], out[above])
        if np.mean(np.abs(out[above] - basis[above] @ coefficients) < LAYER_MM) < ONE_LAYER_SHARE:
            break
        level = basis @ coefficients
    found: Bools = np.abs(out - level) < LAYER_MM
    return found


def _through_cells(out: Floats, basis: Floats, cell: Ints) -> Floats | None:
    """Heights (n,) of the surface through the outermost layers of the cells; None where too few have any."""
    at, which = np.unique(cell, return_inverse=True)
    places, centres = [], []
    for one in range(len(at)):
        rows = np.flatnonzero(which == one)
        if len(rows) >= FEWEST_OF_CELL:
            kept = rows[outer(out[rows])]
            centres.append(float(np.median(out[kept])))
            places.append(basis[kept].mean(axis=0))
    if len(centres) < 2 * basis.shape[1]:
        return None
    found: Floats = basis @ least_distances(np.array(places), np.array(centres))
    return found


def least_distances(basis: Floats, value: Floats) -> Floats:
    """Coefficients (k,) with the least sum of absolute residuals of values (n,), by reweighting."""
    weight = np.ones(len(value))
    found = np.zeros(basis.shape[1])
    for _ in range(30):
        root = np.sqrt(weight)
        found = np.asarray(np.linalg.lstsq(basis * root[:, None], value * root, rcond=None)[0], np.float64)
        weight = 1.0 / np.maximum(np.abs(value - basis @ found), 0.1)
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
