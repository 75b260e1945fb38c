"""Line features of a part as the source paper extracts them: joint edges by reduced boxes, bottom edges by slices.

Source: paper 000, sections 2.3 (reduced boxes, table 1) and 2.4 (slices). Written out as published, with its known
limits: the boxes find the inner edge of a plate, "nearest to P" favours points inward of the edge, and both need a
good attitude.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import principal, rigid
from processor.geometry.neighbors import without_outliers
from processor.geometry.polyline import Line, crossing, fit_line, ransac_line
from processor.model import Floats

EDGES = ("bottom", "right", "top", "left")


@dataclass(frozen=True)
class BoxParams:
    """Parameters of the reduced boxes (mm); the paper's values where it gives them."""

    joint_zone_mm: float = 500.0  # what is cut off the part for its joint end
    edge_box_mm: float = 42.0  # L_edge: 1.5 times the plates' thickness
    box_count: int = 10  # boxes an edge
    box_range: float = 0.4  # k1, k2 run from -range to +range
    search_offset_mm: float = 200.0  # of P beyond the end
    line_threshold_mm: float = 5.0  # of the RANSAC line
    line_probability: float = 0.99
    line_iterations: int = 500
    distance_threshold: float = 1.0  # d_t in spacings
    denoise_neighbours: int = 20
    denoise_ratio: float = 3.0


@dataclass(frozen=True)
class SliceParams:
    """Parameters of the slices; the paper's values where it gives them."""

    thickness: float = 0.5  # of a slice, in spacings
    check_thickness: float = 4.0  # the same for the edges that the linear error is taken from
    search_offset_mm: float = 200.0  # of the lines l1, l2 beyond the part's box
    filter_radius: float = 4.0  # of the radius filter, in spacings or slices, whichever is longer
    filter_neighbours: int = 3
    direction_radius: float = 20.0  # neighbourhood of the direction filter, likewise
    direction_limit_deg: float = 30.0  # from the part's main direction


@dataclass(frozen=True)
class JointEdges:
    """One end of a part in its scan's frame: the points on its four edges and P1..P8 (8, 3)."""

    points: Floats
    key_points: Floats


def joint_frame(design_points: Floats) -> Floats:
    """T_bridge_joint (4, 4) of a joint from its P1..P8: origin in the middle, x along the bridge, y left, z up."""
    p1, p2, p3, p4 = design_points[:4]
    y = (p1 - p2) + (p4 - p3)
    z = (p4 - p1) + (p3 - p2)
    x = np.cross(y, z)
    x /= np.linalg.norm(x)
    z = np.cross(x, y)
    z /= np.linalg.norm(z)
    return rigid.transform(np.stack([x, np.cross(z, x), z], axis=1), design_points[:4].mean(axis=0))


def cut_joint_end(points: Floats, T_joint_scan: Floats, outward: float, size: Floats, params: BoxParams) -> Floats:
    """Cut the joint's zone off a part: its points (k, 3) in the joint's frame, without outliers.

    ``outward`` is +1 where the part ends at the joint and -1 where it starts; ``size`` (2,) is the section's width
    and height. The end itself is found in the scan, since principal axes do not place it well.
    """
    local = rigid.apply(T_joint_scan, points)
    reach = 2.0 * params.joint_zone_mm
    local = local[(np.abs(local[:, 0]) <= reach + params.joint_zone_mm) & (np.abs(local[:, 1:]) <= size).all(axis=1)]
    if len(local) < 100:
        return local
    # The last points along the axis, a few apart as outliers, are the end.
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
        if edge in ("top", "left"):
            strip = cut[:, across] > high[across] - params.edge_box_mm
        else:
            strip = cut[:, across] < low[across] + params.edge_box_mm
        found = []
        for k1, k2 in pairwise(k):
            q = cut[:, along] - middle[along]
            inside = np.flatnonzero(strip & (q > k1 * extent[along]) & (q < k2 * extent[along]))
            if len(inside) == 0:
                return None
            found.append(cut[inside[np.argmin(to_P[inside])]])
        line = ransac_line(
            np.array(found), params.line_threshold_mm, params.line_probability, params.line_iterations, rng
        )
        if line is None:
            return None
        lines.append(line)
    edges = [cut[line.distances(cut) < params.distance_threshold * spacing_mm] for line in lines]
    if min(len(edge) for edge in edges) < 2:
        return None
    bottom, right, top, left = (fit_line(edge) for edge in edges)
    corners = [crossing(bottom, left), crossing(bottom, right), crossing(top, right), crossing(top, left)]
    middles = [0.5 * (corners[i] + corners[j]) for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
    return JointEdges(np.vstack(edges), np.array(corners + middles))


def slice_edges(
    points: Floats, T_bridge_scan: Floats, spacing_mm: float, thickness: float, params: SliceParams
) -> tuple[Floats, Floats]:
    """Bottom edges, left (k, 3) and right (m, 3), of a part in its scan's frame (paper 000, section 2.4, figure 9).

    The part is levelled by its principal axes, X along it and Z up as ``T_bridge_scan`` has them. In each slice and
    half the point nearest to l1 or l2 is taken; lone points and points that run across the part are filtered out.
    ``thickness`` is that of a slice in spacings: the thicker, the more points to choose from, the nearer to the edge.
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
        sides.append(points[picked[_runs_along(level[picked], radius, reach, params)]])
    return sides[0], sides[1]


def _runs_along(level: Floats, radius_mm: float, reach_mm: float, params: SliceParams) -> np.ndarray:
    """Mark points (n,) with neighbours enough whose local direction is near the part's (its X axis)."""
    tree = cKDTree(level)
    counts = tree.query_ball_point(level, radius_mm, return_length=True) - 1
    keep = counts >= params.filter_neighbours
    limit = np.cos(np.radians(params.direction_limit_deg))
    near = cKDTree(level[keep]) if keep.any() else tree
    kept = level[keep]
    for i, point in zip(np.flatnonzero(keep), kept, strict=True):
        neighbours = kept[near.query_ball_point(point, reach_mm)]
        local = neighbours - neighbours.mean(axis=0)
        keep[i] = abs(np.linalg.eigh(local.T @ local)[1][0, 2]) >= limit
    return np.asarray(keep, bool)
