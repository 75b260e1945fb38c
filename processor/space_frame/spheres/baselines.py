"""The source paper's two estimators, algebraic least squares and RANSAC: at a design's nodes, or beside method ``ray``.

They are baselines: sleeves inside a crop bias both, and their covariances are formal. Beside ``ray`` they get raw crops
about its nodes, or the points that it used.

A raw crop holds the sleeves and tubes at a ball, as those that the paper cuts out by hand: RANSAC is then far better
than least squares. On the points of ``ray``, cleaned of them, least squares is a little better: it uses all of them.
Source: paper 001 (Huang et al. 2019), equations 12-15 and section 2.2.
"""

from __future__ import annotations

import numpy as np

from processor import diagnostics
from processor.geometry import rigid
from processor.geometry.nearest_neighbours import nearest_crops
from processor.geometry.sphere import Sphere, algebraic, ransac
from processor.model import Bools, Floats, FrameDesign, Ints, Reason, Tolerance, reason
from processor.scene_cloud import MergedCloud
from processor.space_frame.members.records import Members, Nodes
from processor.space_frame.params import Params
from processor.space_frame.points.source import Source
from processor.space_frame.points.sphere_crops import Crops, gather
from processor.space_frame.result import Result
from processor.space_frame.spheres import sleeve_radii
from processor.space_frame.spheres.alternating_fit import RayFitParams
from processor.space_frame.spheres.assessment import Row, as_result, assessed, generator, missing
from processor.space_frame.spheres.ball_fit import VISIBLE, SphereMask, select
from processor.space_frame.spheres.records import Spheres

MARGIN_MM = 8.0  # on both sides of a sphere's surface: about what the ray fit uses with 2 mm of noise
SLEEVES_MM = 26.0  # beyond a sphere: sleeves are measured there
SAME = reason("spheres.points-of-ray")
RAW = reason("spheres.raw-crops")


def fit_nodes(cloud: MergedCloud, design: FrameDesign, params: Params, limits: Tolerance) -> Result:
    """Fit a sphere to the crop about every node of a design in the cloud's frame, by one of the paper's methods."""
    nodes = design.centres - cloud.origin
    crops = nearest_crops(cloud.points, nodes, design.radii + params.crop_margin_mm)
    with diagnostics.placed(rigid.transform(np.eye(3), cloud.origin), "project"):
        rows = [
            _fit_node(int(design.ids[i]), nodes[i], float(design.radii[i]), cloud.points[crop], params, limits)
            for i, crop in enumerate(crops)
        ]
    return as_result(rows, cloud.origin, params, (reason("spheres.formal-covariances"),))


def fit_points(
    points: list[Floats],
    nodes: Floats,
    ids: Ints,
    nominal: Floats,
    origin: Floats,
    params: Params,
    limits: Tolerance,
    reasons: tuple[Reason, ...],
) -> Result:
    """Fit a sphere to each set of points (n, 3), given less nodes (k, 3), by one of the paper's methods."""
    rows = [
        _fit_node(id_, node, size, crop + node, params, limits)
        for id_, node, size, crop in zip(ids.tolist(), nodes, nominal.tolist(), points, strict=True)
    ]
    return as_result(rows, origin, params, reasons)


def _fit_node(id_: int, node: Floats, nominal: float, crop: Floats, params: Params, limits: Tolerance) -> Row:
    if len(crop) < 4:
        return missing(id_, nominal, len(crop), reason("spheres.few-crop-points", points=len(crop)))
    on: Bools = np.ones(len(crop), bool)
    sphere: Sphere | None
    if params.method == "least-squares":
        sphere = algebraic(crop - node)
    else:
        rng = generator(params, f"ransac {id_}")
        consensus = ransac(crop - node, rng, params.tau_mm, params.probability, params.max_iterations)
        sphere = None if consensus is None else consensus.sphere
        if consensus is not None:
            on = consensus.inliers
            with diagnostics.at(f"ball {id_}"):
                diagnostics.note("consensus", trials=consensus.trials, points=len(on), inliers_share=float(on.mean()))
                diagnostics.keep("consensus", crop[on])
    if sphere is None:
        return missing(id_, nominal, len(crop), reason("spheres.no-sphere"))
    reach = nominal + params.crop_margin_mm
    away = float(np.linalg.norm(sphere.centre))
    if away > reach or sphere.radius > 2.0 * reach:
        cause = reason("spheres.fit-left-crop", distance=away, radius=sphere.radius)
        return missing(id_, nominal, int(on.sum()), cause)
    share = float(on.mean()) if params.method == "ransac" else 1.0
    placed = Sphere(sphere.centre + node, sphere.radius, sphere.covariance)
    return assessed(id_, nominal, placed, crop[on], share, params, limits)


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
        return fit_points(raw, nodes.positions, ids, spheres.nominal, source.origin, params, limits, (RAW,))
    seen = spheres.radii[spheres.points > 0]
    largest = float(seen.max()) if len(seen) else 0.0
    off = np.linalg.norm(spheres.centres - nodes.positions, axis=1)[spheres.points > 0].max(initial=0.0)
    crops = gather(source, nodes.positions, largest + float(off) + SLEEVES_MM)
    points = points_of_spheres(crops, nodes, members, spheres)
    return fit_points(points, nodes.positions, ids, spheres.nominal, source.origin, params, limits, (SAME,))


def raw_crops(source: Source, nodes: Nodes, spheres: Spheres, margin_mm: float) -> list[Floats]:
    """All points (n, 3) about each node, relative to it, to ``margin_mm`` beyond the radius of its sphere."""
    sizes = np.where(np.isfinite(spheres.nominal), spheres.nominal, spheres.radii)
    reach = np.nan_to_num(sizes, nan=0.0) + margin_mm
    crops = gather(source, nodes.positions, float(reach.max(initial=margin_mm)))
    every = [crops.points[crops.start[i] : crops.start[i + 1]] for i in range(nodes.count)]
    return [points[np.linalg.norm(points, axis=1) <= reach[i]] for i, points in enumerate(every)]


def points_of_spheres(crops: Crops, nodes: Nodes, members: Members, spheres: Spheres) -> list[Floats]:
    """Points (n, 3) of each sphere, relative to its node: within ``MARGIN_MM`` of it, off sleeves and process hole."""
    ends = sleeve_radii.member_ends(nodes, members)
    states = np.column_stack([spheres.centres - nodes.positions, spheres.radii])
    radii = sleeve_radii.estimated(ends, crops.start, crops.points, states)
    keep_off = radii + sleeve_radii.FLAT_MM + sleeve_radii.AXIS_MM
    every = [np.empty((0, 3))] * nodes.count
    for i in np.flatnonzero((spheres.points > 0) & np.isfinite(spheres.radii)).tolist():
        points = crops.points[crops.start[i] : crops.start[i + 1]]
        rows = slice(ends.start[i], ends.start[i + 1])
        mask = SphereMask(ends.points[rows], ends.directions[rows], keep_off[rows], RayFitParams().process_hole_mm, 0.0)
        surface = np.zeros(len(points), np.uint8)
        select(points, np.zeros_like(points), mask, states[i], MARGIN_MM, surface)
        every[i] = points[surface == VISIBLE]
    return every
