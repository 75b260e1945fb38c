"""The ends of members at nodes, and how far from their axes a ball's surface is hidden by sleeves and flats."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints
from processor.space_frame.members.records import Nodes, Tubes

# Of a hexagon's corner radius: the median distance from its axis of a point on it is 0.901, of a round sleeve 1.
MEDIAN_OF_CORNER = 0.901
SLEEVE_OF_TUBE = 0.70  # corner radius of a sleeve whose points are too few, as a share of its tube's radius
SLEEVE_MM = 25.0  # where the tube's radius is not known either
FLAT_MM = 1.0  # a flat is milled so much wider than its sleeve
AXIS_MM = 1.5  # what the axis may be off at the node
LEAST_POINTS = 8
CLASS_MM = 4.0  # tubes within this are of one class, and have sleeves alike


@dataclass(frozen=True)
class Ends:
    """Members at nodes: those of node i in rows ``start[i]`` to ``start[i + 1]``.

    ``points`` (m, 3) on the axis less the node's position, ``directions`` (m, 3) away from it, ``tube_radii`` (m,).
    """

    start: Ints
    points: Floats
    directions: Floats
    tube_radii: Floats


def ends(nodes: Nodes, tubes: Tubes) -> Ends:
    """List the members' ends by node. The foot of the node on each axis stands for the axis."""
    node = np.concatenate([tubes.node_a, tubes.node_b])
    row = np.concatenate([np.arange(len(tubes.node_a))] * 2)
    sign = np.concatenate([np.ones(len(tubes.node_a)), -np.ones(len(tubes.node_b))])
    held = np.flatnonzero(node >= 0)
    order = held[np.argsort(node[held], kind="stable")]
    node, row, sign = node[order], row[order], sign[order]
    start = np.searchsorted(node, np.arange(nodes.count + 1)).astype(np.int64)
    direction = tubes.directions[row]
    to_axis = tubes.points[row] - nodes.positions[node]
    foot = to_axis - np.einsum("mi,mi->m", to_axis, direction)[:, None] * direction
    return Ends(start, foot, direction * sign[:, None], tubes.radii[row])


def first_guess(found: Ends) -> Floats:
    """Corner radii (m,) of sleeves by the size of the tubes alone, mm."""
    guess: Floats = np.where(np.isfinite(found.tube_radii), SLEEVE_OF_TUBE * found.tube_radii, SLEEVE_MM)
    return guess


def measured(found: Ends, start: Ints, points: Floats, centres: Floats, radii: Floats, threads: int = 0) -> Floats:
    """Corner radii (m,) of sleeves from the points just beyond the balls, mm.

    The larger of an end's own and the median of the ends with tubes alike: too much hidden costs a few points, too
    little costs the truth. The guess stays where there are no points.
    """
    guess = first_guess(found)
    # NaN tubes look as far as the widest plausible sleeve
    widest = np.where(np.isfinite(found.tube_radii), found.tube_radii + 6.0, 50.0)
    medians, counts = np.full(len(guess), np.nan), np.zeros(len(guess), np.int64)
    over_ranges(
        lambda a, b: _medians(
            a, b, start, points, found.start, found.points, found.directions, widest, centres, radii, medians, counts
        ),
        len(radii),
        threads,
    )
    own = np.where(counts >= LEAST_POINTS, medians / MEDIAN_OF_CORNER, np.nan)
    corner = guess.copy()
    classes = np.where(np.isfinite(found.tube_radii), np.rint(found.tube_radii / CLASS_MM), -1.0)
    for one in np.unique(classes):
        rows = classes == one
        seen = own[rows & np.isfinite(own)]
        if len(seen) >= 3:
            corner[rows] = np.median(seen)
    larger = np.isfinite(own) & (own > corner) & (counts >= 2 * LEAST_POINTS)
    result: Floats = np.where(larger, own, corner)
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _medians(begin, end, start, points, end_start, foot, directions, widest, centres, radii, found, counts):  # type: ignore[no-untyped-def]
    """Fill median distance from the axis and number of points 4 to 25 mm beyond each end's ball."""
    for k in range(begin, end):
        if np.isnan(radii[k]):
            continue
        off = np.empty(start[k + 1] - start[k])
        for m in range(end_start[k], end_start[k + 1]):
            near, far = radii[k] + 4.0, radii[k] + 25.0
            kept = 0
            for i in range(start[k], start[k + 1]):
                x, y, z = points[i, 0], points[i, 1], points[i, 2]
                dx, dy, dz = directions[m, 0], directions[m, 1], directions[m, 2]
                out = (x - centres[k, 0]) * dx + (y - centres[k, 1]) * dy + (z - centres[k, 2]) * dz
                if out < near or out > far:
                    continue
                x, y, z = x - foot[m, 0], y - foot[m, 1], z - foot[m, 2]
                along = x * dx + y * dy + z * dz
                d2 = x * x + y * y + z * z - along * along
                if d2 <= widest[m] * widest[m]:
                    off[kept] = np.sqrt(max(d2, 0.0))
                    kept += 1
            counts[m] = kept
            if kept > 0:
                found[m] = np.median(off[:kept])
