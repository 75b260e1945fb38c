"""What carries a part from below while it is scanned, as its scan shows it: trestles, blocks, stacks of timber.

A support reaches from the floor to the underside of the part. Only what is below the part is looked at, so that what
stands beside it counts nowhere. Where the space beneath the part is not seen to be free between supports one may be
hidden there, and where something leads upward from the part it may hang: then the supports are unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from processor.geometry import mesh_distance, rigid
from processor.large_arrays import blocks
from processor.model import Bools, DesignPart, Floats, Ints
from processor.preassembly.parts.bending import Beam

CELL_MM = 50.0  # along and across the part, half the width of a narrow beam
SAMPLE_MM = 20.0  # between samples of the design: six or more in a cell
CLEAR_MM = 15.0  # below the underside from which a point is not the part's: bows and sags are below 10 mm
# Below the underside up to which something touches it: shims, and shadows under the edges of flanges
CONTACT_MM = 60.0
BESIDE_MM = 300.0  # beyond the part's sides up to which legs of trestles spread
STEP_MM, FILLED = 100.0, 0.6  # of the height below the underside that a support fills, of which some may be hidden
FLOOR_MM, FLOOR_CELLS = 60.0, 200  # thickness of the floor's points; half a square metre of it is seen
NEAR_MM = 300.0  # chosen: below the underside up to which what stands there may touch it in a shadow
BEAM_MM = 80.0  # half the width of a support of which one side alone is seen
ONE_MM = 300.0  # between points of one support: both sides of a beam, or its legs
WIDEST_MM = 600.0  # of a support, beyond which it is no place but a bed
FEWEST = 5  # points of a cell that touch the underside: single ones are mixed pixels
FREE = 0.2  # of the cells across, of which floor or underside is seen where nothing carries the part
HIDDEN_MM = 400.0  # of the length that is not seen to be free, beyond which a support may be hidden there
HANGS_MM = 1_000.0  # above the part, up to which a sling is followed
SUPPORTS = 4  # more, and what carries is not known
OVER = 1.0 / np.sqrt(12.0)  # standard deviation of a place that is anywhere on a support, by its width


class Seen(NamedTuple):
    """Places (k,) of supports along a part's axis, from the origin of its beam, and their standard deviations."""

    places: Floats
    sd: Floats


class _Under(NamedTuple):
    """The design in n cells along: heights of its underside and top, and its sides across; NaN beside it."""

    low: Floats
    high: Floats
    left: Floats
    right: Floats


def find(scans: Sequence[tuple[Floats, float, Floats]], up: Floats, beam: Beam, part: DesignPart) -> Seen | None:
    """Find the supports of a part in its scans; None where they are not surely seen.

    ``scans`` are poses T_design_scan (4, 4), factors and points (n, 3) that these shrink; ``up`` (3,) is vertical in
    the design's frame.
    """
    along = beam.axes[0] - (beam.axes[0] @ up) * up
    axes = np.stack([along / np.linalg.norm(along), np.cross(up, along / np.linalg.norm(along)), up])
    start = float((part.vertices - beam.origin).dot(axes[0]).min())
    origin = beam.origin + start * axes[0]
    under = _underside((mesh_distance.sampled(part.vertices, part.faces, SAMPLE_MM).points - origin) @ axes.T)
    near = np.concatenate([_about(scan, origin, axes, under) for scan in scans])
    cell = (near[:, 0] / CELL_MM).astype(np.int64)
    below = near[:, 2] - under.low[cell]
    across = np.maximum(under.left[cell] - near[:, 1], near[:, 1] - under.right[cell])  # negative between the sides
    floor = _floor(near[below < -CONTACT_MM])
    if floor is None or _hangs(near[(across < 0.0)], under, cell[across < 0.0]):
        return None
    on_floor = np.abs(near[:, 2] - floor) < FLOOR_MM
    touching = (below > -CONTACT_MM) & (below < -CLEAR_MM) & (across < 0.0) & ~on_floor
    body = (below < -CLEAR_MM) & ~on_floor & (near[:, 2] > floor) & (across < BESIDE_MM)
    found, taken = list[tuple[float, float]](), np.zeros(len(under.low), bool)
    for first, last in _groups(near[touching, 0]):
        rows = body & (np.abs(near[:, 0] - 0.5 * (first + last)) < 0.5 * (last - first) + ONE_MM)
        middle = min(int(0.5 * (first + last) / CELL_MM), len(under.low) - 1)
        height = max(float(under.low[middle]) - floor, 1.0)  # of a part that lies on the floor there is none
        steps = max(int(height / STEP_MM), 1)
        filled = np.unique(((near[rows, 2] - floor) / height * steps).astype(np.int64).clip(0, steps - 1))
        if len(filled) >= FILLED * steps:
            found.append((first, last))
            taken[int(max(first - ONE_MM, 0.0) / CELL_MM) : int((last + ONE_MM) / CELL_MM) + 1] = True
    # The sides of the part's webs end at the underside, too: only the middle of it shows that it is free.
    inner = 0.1 * (under.right - under.left)[cell]
    free = (across < 0.0) & on_floor | (np.abs(below) < CLEAR_MM) & (across < -inner)
    # What ends a little lower may touch the underside where no scanner looks
    near_by = _groups(near[body & (across < 0.0) & (below > -NEAR_MM), 0])
    unclear = any(not taken[int(0.5 * (first + last) / CELL_MM)] for first, last in near_by)
    wide = any(last - first > WIDEST_MM for first, last in found)
    if wide or unclear or not 2 <= len(found) <= SUPPORTS or _hidden(near[free], cell[free], under, taken):
        return None
    # Chainages along the part's own axis, at the underside of an inclined one
    ends = np.array(found)
    at = origin + 0.5 * ends.sum(axis=1)[:, None] * axes[0]
    at += under.low[(0.5 * ends.sum(axis=1) / CELL_MM).astype(np.int64).clip(0, len(under.low) - 1), None] * up
    width = np.ptp(ends, axis=1)
    return Seen((at - beam.origin) @ beam.axes[0], np.where(width < BEAM_MM, BEAM_MM, OVER * width))


def _underside(samples: Floats) -> _Under:
    """Return the underside of a design by samples (m, 3) along, across and up."""
    cell = (samples[:, 0] / CELL_MM).astype(np.int64).clip(0)
    found = []
    for values, extreme in ((samples[:, 2], np.minimum), (samples[:, 2], np.maximum),
                            (samples[:, 1], np.minimum), (samples[:, 1], np.maximum)):  # fmt: skip
        of_cell = np.full(cell.max() + 1, np.inf if extreme is np.minimum else -np.inf)
        extreme.at(of_cell, cell, values)
        known = np.isfinite(of_cell)
        found.append(np.interp(np.arange(len(of_cell)), np.flatnonzero(known), of_cell[known]))
    found[0] = minimum_filter(found[0], 3)  # few samples are in the cells at its ends
    return _Under(*found)


def _about(scan: tuple[Floats, float, Floats], origin: Floats, axes: Floats, under: _Under) -> Floats:
    """Return the points (k, 3) of a scan, along, across and up, that lie about a part, below it or above it."""
    found = []
    left, right, high = under.left.min() - 5.0 * BESIDE_MM, under.right.max() + 5.0 * BESIDE_MM, under.high.max()
    T, shrink, points = scan
    for rows in blocks(len(points)):
        placed = (rigid.apply(T, shrink * points[rows]) - origin) @ axes.T
        inside = (placed[:, 0] >= 0.0) & (placed[:, 0] < CELL_MM * len(under.low))
        found.append(placed[inside & (placed[:, 1] > left) & (placed[:, 1] < right) & (placed[:, 2] < high + HANGS_MM)])
    return np.concatenate(found)


def _floor(below: Floats) -> float | None:
    """Return the height of the floor among points (n, 3) below a part; None where none is seen."""
    if not len(below):
        return None
    cells = np.unique(np.floor(below / [CELL_MM, CELL_MM, FLOOR_MM / 3.0]).astype(np.int64), axis=0)
    heights, count = np.unique(cells[:, 2], return_counts=True)
    floor = (heights[np.argmax(count)] + 0.5) * FLOOR_MM / 3.0
    return float(floor) if count.max() >= FLOOR_CELLS else None


def _hangs(points: Floats, under: _Under, cell: Ints) -> bool:
    """Whether points (n, 3) between a part's sides lead upward from it."""
    steps = ((points[:, 2] - under.high[cell]) / STEP_MM).astype(np.int64)
    count = int(HANGS_MM / STEP_MM)
    return bool((np.bincount(steps[(steps > 0) & (steps < count)], minlength=count)[1:] >= FEWEST).all())


def _groups(values: Floats) -> list[tuple[float, float]]:
    """Return the first and last of places (n,) along of each group of cells that have them."""
    cell = (values / CELL_MM).astype(np.int64)
    kept = np.sort(values[np.bincount(cell)[cell] >= FEWEST]) if len(values) else values
    groups = np.split(kept, np.flatnonzero(np.diff(kept) > ONE_MM) + 1)
    return [(float(group[0]), float(group[-1])) for group in groups if len(group)]


def _hidden(points: Floats, cell: Ints, under: _Under, taken: Bools) -> bool:
    """Whether a support may be hidden between those known, at cells ``taken``; points (n, 3) show that it is free."""
    across = np.floor(points[:, 1] / CELL_MM).astype(np.int64)
    seen = np.bincount(np.unique(np.column_stack([cell, across]), axis=0)[:, 0], minlength=len(taken))
    blind = (seen < FREE * (under.right - under.left) / CELL_MM) & ~taken
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[False], blind, [False]]).astype(np.int64))))[::2]
    return bool(CELL_MM * runs.max(initial=0) > HIDDEN_MM)
