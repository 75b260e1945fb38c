"""Line features of a part by the source paper: joint edges by reduced boxes, bottom edges by slices.

Source: paper 000, sections 2.3 (reduced boxes, table 1) and 2.4 (slices). Implemented as published, with its known
limits: the boxes find the inner edge of a plate, "nearest to P" favours points inward of the edge, and both need a
good attitude.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from processor import diagnostics
from processor.geometry import rigid
from processor.geometry.lines_and_polylines import Line, crossing, fit_line, ransac_line
from processor.geometry.nearest_neighbours import without_outliers
from processor.model import Floats
from processor.preassembly.params import BoxParams, SliceParams
from processor.registration import principal

EDGES = ("bottom", "right", "top", "left")
EDGE_BOX = 1.5  # L_edge in thicknesses (paper 000, section 2.3)
OUTER_SIDE_MM, THICKEST_MM = 6.0, 120.0  # depths of an inner side
REFITS = 5  # each takes five sixths of the error of the line before
LEAST_INNER = 50  # points of an inner side


@dataclass(frozen=True)
class JointEdges:
    """One end of a part in its scan's frame: the points on its four edges, P1..P8 (8, 3), and corner points (4, 3).

    The corner points are the scanned ones nearest to P1..P4, where the edges' lines cross.
    """

    points: Floats
    key_points: Floats
    corners: Floats

    def moved(self, T: Floats) -> JointEdges:
        """Return the edges in another frame."""
        return JointEdges(rigid.apply(T, self.points), rigid.apply(T, self.key_points), rigid.apply(T, self.corners))


def cut_joint_end(points: Floats, T_joint_scan: Floats, outward: float, size: Floats, params: BoxParams) -> Floats:
    """Cut out a part's points (k, 3) in a joint's zone, in the joint's frame, without outliers.

    ``outward`` is +1 where the part ends at the joint and -1 where it starts; ``size`` (2,) is the section's width
    and height. The end itself is found in the scan, since principal axes do not place it accurately.
    """
    local = rigid.apply(T_joint_scan, points)
    reach = params.end_search_mm + params.joint_zone_mm
    local = local[(np.abs(local[:, 0]) <= reach) & (np.abs(local[:, 1:]) <= size).all(axis=1)]
    if len(local) < 100:
        return local
    # The last points along the axis are the end, but for a few outliers.
    end = np.quantile(outward * local[:, 0], 1.0 - min(0.5, 50.0 / len(local)))
    local = local[outward * local[:, 0] >= end - params.joint_zone_mm]
    return without_outliers(local, params.denoise_neighbours, params.denoise_ratio)


def reduced_boxes(
    cut: Floats, outward: float, spacing_mm: float, params: BoxParams, rng: np.random.Generator
) -> JointEdges | None:
    """Edges of a joint end from its cut zone (k, 3) in the joint's frame (paper 000, table 1, figures 6 to 8).

    None when a box is empty or a line cannot be fitted. Everything returned is in the joint's frame.
    """
    if len(cut) < 4 * params.box_count:
        return None
    low, high = cut.min(axis=0), cut.max(axis=0)
    middle, extent = 0.5 * (low + high), high - low
    P = np.array([high[0] if outward > 0 else low[0], middle[1], middle[2]])
    P[0] += outward * params.search_offset_mm
    to_P = np.linalg.norm(cut - P, axis=1)
    k = np.linspace(-params.box_range, params.box_range, params.box_count + 1)
    lines: list[Line] = []
    for edge in EDGES:
        across, along = (2, 1) if edge in ("top", "bottom") else (1, 2)
        depth = high[across] - cut[:, across] if edge in ("top", "left") else cut[:, across] - low[across]
        q = cut[:, along] - middle[along]
        reach = edge_box(depth[np.abs(q) < params.box_range * extent[along]], params)
        strip = depth < reach
        nearest = []
        for k1, k2 in pairwise(k):
            inside = np.flatnonzero(strip & (q > k1 * extent[along]) & (q < k2 * extent[along]))
            if len(inside) == 0:
                return None
            nearest.append(cut[inside[np.argmin(to_P[inside])]])
        with diagnostics.at(edge):
            diagnostics.note("strip", L_edge_mm=reach, points=int(strip.sum()))
            diagnostics.keep("strip", lambda strip=strip: cut[strip])  # type: ignore[misc]
            diagnostics.keep("nearest points", np.array(nearest))
            line = ransac_line(
                np.array(nearest),
                params.line_threshold * spacing_mm,
                params.line_probability,
                params.line_iterations,
                rng,
            )
        if line is None:
            return None
        lines.append(line)
    d_t = params.distance_threshold * spacing_mm
    edges = [_on_line(cut, line, d_t) for line in lines]
    for edge, points in zip(EDGES, edges, strict=True):
        with diagnostics.at(edge):
            diagnostics.note("edge points", points=len(points), distance_threshold_mm=d_t)
            diagnostics.keep("edge points", points)
    if min(len(edge) for edge in edges) < 2:
        return None
    bottom, right, top, left = (fit_line(edge) for edge in edges)
    corners = [crossing(bottom, left), crossing(bottom, right), crossing(top, right), crossing(top, left)]
    middles = [0.5 * (corners[i] + corners[j]) for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
    key_points = np.array(corners + middles)
    at_corners = cut[cKDTree(cut).query(np.nan_to_num(key_points[:4]))[1]]
    return JointEdges(np.vstack(edges), key_points, at_corners)


def _on_line(cut: Floats, line: Line, d_t: float) -> Floats:
    """Points (k, 3) of a cut end within ``d_t`` of a line, which is fitted to them again and again.

    The first line is that of ten points, as far from the edge as points are apart. The band about it holds points of
    the end and of the inner side; fitted again, it settles 0.3 ``d_t`` inward of the edge in both.
    """
    points = cut[line.distances(cut) < d_t]
    for _ in range(REFITS):
        if len(points) < 2:
            break
        points = cut[fit_line(points).distances(cut) < d_t]
    return points


def edge_box(depth: Floats, params: BoxParams) -> float:
    """L_edge: 1.5 times the thickness of a plate, from the depths (n,) of points below its outer side.

    Points of the inner side are many more than those of the plate's end, so that the median depth of all that are not
    on the outer side is the thickness.
    """
    if params.edge_box_mm > 0.0:
        return params.edge_box_mm
    below = depth[(depth > OUTER_SIDE_MM) & (depth < THICKEST_MM)]
    return EDGE_BOX * (float(np.median(below)) if len(below) >= LEAST_INNER else params.plate_mm)


def slice_edges(
    points: Floats, T_bridge_scan: Floats, spacing_mm: float, thickness: float, params: SliceParams
) -> tuple[Floats, Floats]:
    """Bottom edges, left (k, 3) and right (m, 3), of a part in its scan's frame (paper 000, section 2.4, figure 9).

    The part is levelled by its principal axes, X along it and Z up as in ``T_bridge_scan``. In each slice and half the
    point nearest to l1 or l2 is taken; isolated points and lines of points across the part are filtered out.
    ``thickness`` is that of a slice in spacings: thicker slices have more points and reach nearer to the edge.
    """
    axes = principal.of_points(points).axes
    up = T_bridge_scan[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    forward = T_bridge_scan[:3, :3].T @ np.array([1.0, 0.0, 0.0])
    x = axes[:, 0] * np.sign(axes[:, 0] @ forward)
    z = max((axes[:, 1], axes[:, 2]), key=lambda axis: abs(axis @ up))
    z = z * np.sign(z @ up)
    R = np.stack([x, np.cross(z, x), z])
    level = points @ R.T
    low, high = level.min(axis=0), level.max(axis=0)
    middle = 0.5 * (low[1] + high[1])
    in_slice = np.floor((level[:, 0] - low[0]) / (thickness * spacing_mm)).astype(np.int64)
    sides = []
    for left in (True, False):
        side = np.flatnonzero((level[:, 1] >= middle) == left)
        l_y = high[1] + params.search_offset_mm if left else low[1] - params.search_offset_mm
        l_z = low[2] - params.search_offset_mm
        distance = np.hypot(level[side, 1] - l_y, level[side, 2] - l_z)
        nearest = np.full(in_slice.max() + 1, np.inf)
        np.minimum.at(nearest, in_slice[side], distance)
        picked = side[distance == nearest[in_slice[side]]]
        radius, reach = (k * max(1.0, thickness) * spacing_mm for k in (params.filter_radius, params.direction_radius))
        across = params.direction_offset * max(1.0, thickness) * spacing_mm
        kept = points[picked[_runs_along(level[picked], radius, reach, across, params)]]
        with diagnostics.at("left" if left else "right"):
            width = thickness * spacing_mm
            diagnostics.note("slices", thickness_mm=width, slices=len(nearest), picked=len(picked), kept=len(kept))
            diagnostics.keep("slices", kept)
        sides.append(kept)
    return sides[0], sides[1]


def _runs_along(level: Floats, radius_mm: float, reach_mm: float, across_mm: float, params: SliceParams) -> np.ndarray:
    """Mark points (n,) with enough neighbours and a local direction near the part's (its X axis), along which they lie.

    In the last slice of a part the nearest point may be one high up on the end: it is off the line of its neighbours.
    """
    tree = cKDTree(level)
    counts = tree.query_ball_point(level, radius_mm, return_length=True) - 1
    keep = counts >= params.filter_neighbours
    limit = np.cos(np.radians(params.direction_limit_deg))
    near = cKDTree(level[keep]) if keep.any() else tree
    filtered = level[keep]
    for i, point in zip(np.flatnonzero(keep), filtered, strict=True):
        neighbours = filtered[near.query_ball_point(point, reach_mm)]
        local = neighbours - np.median(neighbours, axis=0)
        direction = np.linalg.eigh(local.T @ local)[1][:, 2]
        off = np.cross(point - np.median(neighbours, axis=0), direction)
        keep[i] = abs(direction[0]) >= limit and float(np.linalg.norm(off)) <= across_mm
    return np.asarray(keep, bool)
