"""The source paper's two estimators beside method ``ray``: on raw crops about its nodes, or on the points that it used.

A raw crop holds the sleeves and tubes at a ball, as those that the paper cuts out by hand: RANSAC is then far better
than least squares. On the points of ``ray``, cleaned of them, least squares is a little better: it uses all of them.
Source: paper 001 (Huang et al. 2019), equations 12-15 and section 2.2.
"""

from __future__ import annotations

import numpy as np

from processor.model import Floats, Ints, Tolerance, reason
from processor.space_frame.members.records import Members, Nodes
from processor.space_frame.params import Params
from processor.space_frame.points.source import Source
from processor.space_frame.points.sphere_crops import Crops, gather
from processor.space_frame.result import Result
from processor.space_frame.spheres import isolated, sleeves
from processor.space_frame.spheres.fit_all import RayFitParams
from processor.space_frame.spheres.gauss_newton import VISIBLE, SphereMask, select
from processor.space_frame.spheres.records import Spheres

MARGIN_MM = 8.0  # on both sides of a sphere's surface: about what the ray fit uses with 2 mm of noise
SLEEVES_MM = 26.0  # beyond a sphere: sleeves are measured there
SAME = reason("spheres.points-of-ray")
RAW = reason("spheres.raw-crops")


def fit_beside(
    source: Source,
    nodes: Nodes,
    members: Members,
    spheres: Spheres,
    ids: Ints,
    params: Params,
    limits: Tolerance,
) -> Result:
    """Fit the spheres (k,) of method ``ray`` by one of the paper's methods to raw crops, or to the same points."""
    if params.raw_crops:
        raw = raw_crops(source, nodes, spheres, params.crop_margin_mm)
        return isolated.fit_points(raw, nodes.positions, ids, spheres.nominal, source.origin, params, limits, (RAW,))
    seen = spheres.radii[spheres.points > 0]
    largest = float(seen.max()) if len(seen) else 0.0
    off = np.linalg.norm(spheres.centres - nodes.positions, axis=1)[spheres.points > 0].max(initial=0.0)
    crops = gather(source, nodes.positions, largest + float(off) + SLEEVES_MM)
    points = points_of_spheres(crops, nodes, members, spheres)
    return isolated.fit_points(points, nodes.positions, ids, spheres.nominal, source.origin, params, limits, (SAME,))


def raw_crops(source: Source, nodes: Nodes, spheres: Spheres, margin_mm: float) -> list[Floats]:
    """All points (n, 3) about each node, relative to it, to ``margin_mm`` beyond the radius of its sphere."""
    sizes = np.where(np.isfinite(spheres.nominal), spheres.nominal, spheres.radii)
    reach = np.nan_to_num(sizes, nan=0.0) + margin_mm
    crops = gather(source, nodes.positions, float(reach.max(initial=margin_mm)))
    every = [crops.points[crops.start[i] : crops.start[i + 1]] for i in range(nodes.count)]
    return [points[np.linalg.norm(points, axis=1) <= reach[i]] for i, points in enumerate(every)]


def points_of_spheres(crops: Crops, nodes: Nodes, members: Members, spheres: Spheres) -> list[Floats]:
    """Points (n, 3) of each sphere, relative to its node: within ``MARGIN_MM`` of it, off sleeves and process hole."""
    ends = sleeves.member_ends(nodes, members)
    states = np.column_stack([spheres.centres - nodes.positions, spheres.radii])
    sleeve_radii = sleeves.sleeve_radii(ends, crops.start, crops.points, states)
    keep_off = sleeve_radii + sleeves.FLAT_MM + sleeves.AXIS_MM
    every = [np.empty((0, 3))] * nodes.count
    for i in np.flatnonzero((spheres.points > 0) & np.isfinite(spheres.radii)).tolist():
        points = crops.points[crops.start[i] : crops.start[i + 1]]
        rows = slice(ends.start[i], ends.start[i + 1])
        mask = SphereMask(ends.points[rows], ends.directions[rows], keep_off[rows], RayFitParams().process_hole_mm, 0.0)
        surface = np.zeros(len(points), np.uint8)
        select(points, np.zeros_like(points), mask, states[i], MARGIN_MM, surface)
        every[i] = points[surface == VISIBLE]
    return every
