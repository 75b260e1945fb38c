"""The source paper's two estimators on the points that method ``ray`` used, for comparison.

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


def fit_same_points(
    source: Source,
    nodes: Nodes,
    members: Members,
    spheres: Spheres,
    ids: Ints,
    params: Params,
    limits: Tolerance,
) -> Result:
    """Fit the spheres (k,) of method ``ray`` by one of the paper's methods to the same points of a source."""
    seen = spheres.radii[spheres.points > 0]
    largest = float(seen.max()) if len(seen) else 0.0
    off = np.linalg.norm(spheres.centres - nodes.positions, axis=1)[spheres.points > 0].max(initial=0.0)
    crops = gather(source, nodes.positions, largest + float(off) + SLEEVES_MM)
    points = points_of_spheres(crops, nodes, members, spheres)
    return isolated.fit_points(points, nodes.positions, ids, spheres.nominal, source.origin, params, limits, (SAME,))


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
