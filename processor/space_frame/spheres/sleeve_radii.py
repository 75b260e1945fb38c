"""Member ends at nodes, and how far from their axes sleeves and flats hide a sphere's surface."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats, Ints
from processor.space_frame.members.records import Members, Nodes

# Of a hexagon's corner radius: the median distance from its axis of a point on it is 0.901, of a round sleeve 1.
MEDIAN_OF_CORNER = 0.901
SLEEVE_OF_TUBE = 0.70  # corner radius of a sleeve with too few points, as a share of its tube's radius
SLEEVE_MM = 25.0  # where the tube's radius is not known either
FLAT_MM = 1.0  # by which a milled flat is wider than its sleeve
AXIS_MM = 1.5  # allowance for the error of the axis at the node
LEAST_POINTS = 8  # a median of eight is within 0.5 of their scatter
RADIUS_BIN_MM = 4.0  # tubes whose radii round to the same multiple are taken to have equal sleeves


class MemberEnds(NamedTuple):
    """Member ends at nodes: those of node i in rows ``start[i]`` to ``start[i + 1]``."""

    start: Ints  # (k + 1,)
    points: Floats  # (m, 3) on the axis, relative to the node
    directions: Floats  # (m, 3) away from the node
    tube_radii: Floats  # (m,)


def member_ends(nodes: Nodes, members: Members) -> MemberEnds:
    """List the members' ends by node. The foot of the node on each axis stands for the axis."""
    node = np.concatenate([members.node_a, members.node_b])
    row = np.concatenate([np.arange(len(members.node_a))] * 2)
    sign = np.concatenate([np.ones(len(members.node_a)), -np.ones(len(members.node_b))])
    at_node = np.flatnonzero(node >= 0)
    order = at_node[np.argsort(node[at_node], kind="stable")]
    node, row, sign = node[order], row[order], sign[order]
    start = np.searchsorted(node, np.arange(nodes.count + 1)).astype(np.int64)
    direction = members.directions[row]
    to_axis = members.points[row] - nodes.positions[node]
    foot = to_axis - np.einsum("mi,mi->m", to_axis, direction)[:, None] * direction
    return MemberEnds(start, foot, direction * sign[:, None], members.radii[row])


def from_tubes(ends: MemberEnds) -> Floats:
    """Corner radii (m,) of sleeves from the radii of the tubes alone, mm."""
    radii = ends.tube_radii
    guess: Floats = np.where(np.isfinite(radii), SLEEVE_OF_TUBE * radii, SLEEVE_MM)
    return guess


def estimated(ends: MemberEnds, start: Ints, points: Floats, states: Floats, threads: int = 0) -> Floats:
    """Corner radii (m,) of sleeves from the points (n, 3) just beyond the spheres (k, 4), mm.

    The larger of an end's own radius and the median over ends of the same class is taken: masking too much loses a few
    points, masking too little biases the fit. The guess from the tube remains where there are no points.
    """
    radii = ends.tube_radii
    # without a tube's radius, as far as the widest plausible sleeve
    widest = np.where(np.isfinite(radii), radii + 6.0, 50.0)
    medians, counts = np.full(len(radii), np.nan), np.zeros(len(radii), np.int64)
    median_range = partial(_medians, start, points, ends, widest, states, medians, counts)
    over_ranges(median_range, len(states), threads)
    single = np.where(counts >= LEAST_POINTS, medians / MEDIAN_OF_CORNER, np.nan)
    corner = from_tubes(ends)
    classes = np.where(np.isfinite(radii), np.rint(radii / RADIUS_BIN_MM), -1.0)
    for number in np.unique(classes):
        rows = classes == number
        seen = single[rows & np.isfinite(single)]
        if len(seen) >= 3:
            corner[rows] = np.median(seen)
    larger = np.isfinite(single) & (single > corner) & (counts >= 2 * LEAST_POINTS)
    result: Floats = np.where(larger, single, corner)
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _medians(start, points, ends, widest, states, medians, counts, first, last):  # type: ignore[no-untyped-def]
    """Fill median distance from the axis and number of the points 4 to 25 mm beyond each end's sphere."""
    for k in range(first, last):
        radius = states[k, 3]
        if np.isnan(radius):
            continue
        off = np.empty(start[k + 1] - start[k])
        for m in range(ends.start[k], ends.start[k + 1]):
            near, far = radius + 4.0, radius + 25.0
            dx, dy, dz = ends.directions[m, 0], ends.directions[m, 1], ends.directions[m, 2]
            foot = ends.points[m]
            number = 0
            for i in range(start[k], start[k + 1]):
                x, y, z = points[i, 0], points[i, 1], points[i, 2]
                out = (x - states[k, 0]) * dx + (y - states[k, 1]) * dy + (z - states[k, 2]) * dz
                if out < near or out > far:
                    continue
                x, y, z = x - foot[0], y - foot[1], z - foot[2]
                along = x * dx + y * dy + z * dz
                d2 = x * x + y * y + z * z - along * along
                if d2 <= widest[m] * widest[m]:
                    off[number] = np.sqrt(max(d2, 0.0))
                    number += 1
            counts[m] = number
            if number > 0:
                medians[m] = np.median(off[:number])
