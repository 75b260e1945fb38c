"""The two sides of a plate: which points near an outer face belong to it, and how thick the plate is.

Where the design has inner walls, points on them are assigned to them by the nearest facet. Without inner walls their
points are found near the outer face, a plate's thickness inside it.
"""

from __future__ import annotations

import numpy as np

from processor.model import Bools, Floats, Ints

BIN_MM = 3.0  # chosen: wider than noise scatters, narrower than half a plate
REACH_MM = 60.0  # inward and outward
LAYER_MM = 9.0  # half the width of a layer; plates are thicker
CLEAR_SHARE = 0.35  # of the fullest bin: fewer points are outliers and no layer
SECOND_SHARE = 0.05  # of all points, inside the outermost layer: fewer are outliers
FEWEST = 40  # points of a layer or ring: fewer outliers together do not look like one
FEWEST_OF_CELL = 12  # points of a cell of a layer: its plane has three unknowns
FEWEST_BESIDE = 10  # points of the end face on one side of a layer, which show that the plate is there
CLIMBS = 2  # a plate has two sides
ONE_LAYER_SHARE = 0.7  # of the points above a layer that must lie on one surface, to be a layer themselves
THINNEST_MM = 6.0  # chosen: plates of sections are thicker; a step of less is the noise of one side
FEW, STARTS = 500, (0.1, 0.5, 0.9)  # points by which two sides are looked for, and quantiles of heights to begin at
RING_SHARE = 0.95  # quantile of a ring's points that is taken for this share of the thickness


def outer_layer(out: Floats) -> Bools:
    """Mark the points of the outermost layer by their heights (n,) outward; all points where there is one layer."""
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
    layer: Bools = np.abs(out - centre) < LAYER_MM
    return layer


def outer_surface(out: Floats, basis: Floats, cell: Ints) -> Bools:
    """Mark the points of the outermost layer where it is not level: a surface in a ``basis`` (n, k).

    The outermost layer is found in every ``cell`` (n,), and the surface fitted to these layers in the L1 norm.
    """
    level = _through_cells(out, basis, cell)
    if level is None:
        return outer_layer(out)
    for _ in range(CLIMBS):
        # Where few points are on the outer side, most cells find the inner side: look for a layer above.
        above = np.flatnonzero((out - level > LAYER_MM) & (out - level < REACH_MM))
        if len(above) < max(SECOND_SHARE * len(out), FEWEST):
            break
        coefficients = _least_absolute(basis[above], out[above])
        if np.mean(np.abs(out[above] - basis[above] @ coefficients) < LAYER_MM) < ONE_LAYER_SHARE:
            break
        level = basis @ coefficients
    layer: Bools = np.abs(out - level) < LAYER_MM
    return layer


def inner_of_two(out: Floats, basis: Floats, thickness_mm: float) -> Bools:
    """Mark points that are on the inner side of a plate ``thickness_mm`` thick, where ``out`` (n,) holds both sides.

    Where the outer side was seen near the end alone and the inner one beyond, a bent surface may run from one to the
    other. Two surfaces of one shape in ``basis`` (n, k), a thickness apart, are taken if they halve what one leaves.
    """
    none = np.zeros(len(out), bool)
    if len(out) < 2 * FEWEST_OF_CELL or thickness_mm < THINNEST_MM:
        return none
    few = np.linspace(0, len(out) - 1, min(len(out), FEW)).astype(np.int64)
    points, terms = out[few], basis[few]
    spread = 0.5 * _spread(points - terms @ _least_absolute(terms, points))
    best: Floats | None = None
    for start in np.quantile(points, STARTS):
        level = np.full(len(few), start)
        for _ in range(3):
            raised = points + thickness_mm * (points - level < -0.5 * thickness_mm)
            coefficients = _least_absolute(terms, raised)
            level = terms @ coefficients
        left = _spread(raised - level)
        if left < spread:
            best, spread = coefficients, left
    if best is None:
        return none
    inner: Bools = out - basis @ best < -0.5 * thickness_mm
    return inner if min(inner.sum(), (~inner).sum()) >= FEWEST_OF_CELL else none


def _spread(residual: Floats) -> float:
    """Mean absolute residual, of which outliers are no large share."""
    return float(np.mean(np.minimum(np.abs(residual), LAYER_MM)))


def _through_cells(out: Floats, basis: Floats, cell: Ints) -> Floats | None:
    """Heights (n,) of the surface through the cells' outermost layers; None with too few cells."""
    cells, cell_of_point = np.unique(cell, return_inverse=True)
    places, centres = [], []
    for k in range(len(cells)):
        rows = np.flatnonzero(cell_of_point == k)
        if len(rows) >= FEWEST_OF_CELL:
            layer = rows[outer_layer(out[rows])]
            centres.append(float(np.median(out[layer])))
            places.append(basis[layer].mean(axis=0))
    if len(centres) < 2 * basis.shape[1]:
        return None
    level: Floats = basis @ _least_absolute(np.array(places), np.array(centres))
    return level


def _least_absolute(basis: Floats, value: Floats) -> Floats:
    """Coefficients (k,) with the least sum of absolute residuals of values (n,), by reweighted least squares."""
    weight = np.ones(len(value))
    coefficients = np.zeros(basis.shape[1])
    for _ in range(30):
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(basis * root[:, None], value * root, rcond=None)[0]
        coefficients = np.asarray(solution, np.float64)
        weight = 1.0 / np.maximum(np.abs(value - basis @ coefficients), 0.1)
    return coefficients


def plate_thickness(x: Floats, e: Floats, sigma_mm: float, design_mm: float) -> float:
    """Thickness in mm of the plate at an open end: ``design_mm`` unless the points clearly differ.

    ``x`` (n,) is outward from the end, ``e`` (n,) inward from the outer face, of points away from the section's
    corners. It is the distance of the inner wall or, without points on it, the width of the ring.
    """
    reach = _reach(sigma_mm)
    inner = e[(x < -reach) & (x > -REACH_MM) & (e > max(THINNEST_MM, reach)) & (e < REACH_MM)]
    if len(inner) >= FEWEST:
        inner = inner[outer_layer(-inner)]
        thickness = float(np.median(inner))
        if np.median(np.abs(inner - thickness)) > 2.0 * sigma_mm + 1.0:  # clutter
            return design_mm
        return thickness if abs(thickness - design_mm) > 2.0 * sigma_mm + 1.0 else design_mm
    return ring_width(x, e, sigma_mm, design_mm)


def ring_width(x: Floats, e: Floats, sigma_mm: float, design_mm: float) -> float:
    """Width in mm of the ring of the plate's end face: ``design_mm`` unless the points clearly differ.

    ``x`` (n,) is outward from the end, ``e`` (n,) the distance from one side of the plate towards the other.
    """
    reach = _reach(sigma_mm)
    ring = e[(np.abs(x) < reach) & (e > reach) & (e < REACH_MM)]
    if len(ring) < FEWEST:
        return design_mm
    width = reach + (float(np.quantile(ring, RING_SHARE)) - reach) / RING_SHARE
    return width if abs(width - design_mm) > 2.0 * sigma_mm + 1.0 else design_mm


def beside(x: Floats, e: Floats, sigma_mm: float) -> tuple[int, int]:
    """Count the points beside a layer near the end, on its outer and on its inner side; ``x``, ``e`` as above."""
    near = (np.abs(x) < REACH_MM) & (np.abs(e) > _reach(sigma_mm)) & (np.abs(e) < REACH_MM)
    return int((near & (e < 0.0)).sum()), int((near & (e > 0.0)).sum())


def _reach(sigma_mm: float) -> float:
    """Distance from a layer beyond which points are not of it."""
    return 4.0 * sigma_mm + 2.0
