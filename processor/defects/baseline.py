"""Method ``paper``: the procedure of paper 004, as far as its one available page describes it, as a baseline.

Density clustering removes noise. Histograms of point features pair places of the scan and the design. Sample consensus
with Huber's error of the distances gives a first pose, iterative closest point the last. Points farther from the design
than a threshold are defects, with a curve integrated from the slopes of sub-regions. The page gives no numbers for any
of these steps, and no classes: the numbers here follow from the cloud's spacing, and every defect is ``unknown``. A
point is compared with the nearest face, so a depth beyond half a plate's thickness is taken from the plate's back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from processor import diagnostics, scene_cloud
from processor.defects import defect_grids
from processor.defects.defect_grids import MOST_PLACES
from processor.defects.params import Paper, Params
from processor.defects.result import DefectClass, Result, SurfacePlaces
from processor.defects.surface_charts import of_mesh
from processor.defects.to_result import table
from processor.distinct_rows import components, distinct
from processor.geometry import mesh_distance, rigid
from processor.geometry.nearest_neighbours import surface_spacing
from processor.geometry.thinning import voxel_means
from processor.model import NORMAL_95, Bools, Floats, Ints, Scene, Status, StructureDesign, reason
from processor.registration import icp, pfh
from processor.robust_statistics import robust_sd_about_median

VOXEL_SPACINGS = 1.5  # chosen: two or three points a voxel
RADIUS_VOXELS = 2.5  # radius of the neighbourhood that density is counted in
FEATURE_VOXELS = 3.6  # chosen: some 40 voxels of the surface are in a histogram
CANDIDATES = 5  # places of the design with the nearest histograms, of which one is drawn
ROBUST_TIMES = 4.0  # standard deviations of all distances, beyond which a point belongs to a defect
DEFECT_POINTS = 8  # chosen: points within the radius that make a cluster; fewer are noise
DEFECT_RADII = 1.5  # radius of a defect's density clusters, by that of the noise removal
HUBER_VOXELS = 2.0  # chosen: farther pairs count linearly
ICP_VOXELS = (20.0, 5.0)  # chosen: largest distance of pairs, at first for a poor pose, then for one within some voxels
ICP_ITERATIONS = 40  # work: at most, of each
LENGTH_VOXELS = 10.0  # largest difference of the sides of two triangles of a sample
NOISE = -1


@dataclass(frozen=True)
class Deviations:
    """Points (n, 3) near the design, local frame, with distance (n,), face normal and component, and cluster label."""

    points: Floats
    distance: Floats
    normal: Floats
    component: Ints
    names: tuple[str, ...]  # of the components
    label: Ints  # NOISE: of no defect
    sigma: float  # robust standard deviation of the distances, mm
    threshold: float  # mm


def defects(scene: Scene, params: Params, earlier: dict[str, Any]) -> Result:
    """Find the defects of a structure as in paper 004."""
    paper = params.paper
    assert scene.structure is not None
    vertices, origin = scene_cloud.local_design(scene.structure)
    cloud = scene_cloud.merged(scene_cloud.stitched(scene, earlier.get("stitch")), with_scanner=False)
    size, points = _thinned(cloud.points + (cloud.origin - origin), paper)
    radius = paper.cluster_radius_mm or RADIUS_VOXELS * size
    label = density_clusters(points, radius, paper.cluster_points)
    counts = np.bincount(label[label >= 0], minlength=1)
    clustered = (label >= 0) & (counts[np.maximum(label, 0)] >= paper.smallest_cluster_share * counts.max())
    _say_clusters(points, clustered, len(counts), radius, origin)
    points = points[clustered]
    if len(points) < paper.feature_points:
        return Result(status=Status.FAILED, method=params.method, reasons=(reason("defects.paper-too-few-points"),))
    design = mesh_distance.sampled(vertices, scene.structure.faces, size)
    rng = np.random.default_rng([params.seed, 4])
    T = _first_pose(points, design.points, design.normals, size, paper, rng)
    rms, paired_share = np.inf, 0.0
    for gate in ICP_VOXELS:
        fit = icp.point_to_point(points, design.points, T, max_distance_mm=gate * size, max_iterations=ICP_ITERATIONS)
        with diagnostics.at(f"pairs within {gate * size:.1f} mm"):
            diagnostics.note(
                "iterative closest point", rounds=fit.iterations, rms_mm=fit.rms, paired_share=fit.paired_share
            )
        if np.isfinite(fit.rms):
            T, rms, paired_share = fit.T_target_source, fit.rms, fit.paired_share
    if not np.isfinite(rms):
        return Result(status=Status.FAILED, method=params.method, reasons=(reason("defects.paper-not-placed"),))
    with diagnostics.placed(rigid.transform(np.eye(3), origin), "design"):
        deviations = _deviations(rigid.apply(T, points), vertices, scene.structure, radius, params)
    rows = sorted(_rows(deviations, size, paper), key=lambda row: -abs(row["volume_mm3"]))
    order = np.array([row.pop("label") for row in rows], np.int64)
    row_of = np.append(np.argsort(order), NOISE).astype(np.int32)  # by label; the last: of no defect
    shown = slice(None, None, -(-len(deviations.points) // MOST_PLACES) or 1)
    return Result(
        status=Status.OK,
        method=params.method,
        reasons=(
            reason("defects.paper-clusters", points=len(points), spacing=size),
            reason("defects.paper-fit", rms=rms, share=100.0 * paired_share),
            reason("defects.paper-threshold", threshold=deviations.threshold),
        ),
        T_design_project=rigid.transform(np.eye(3), origin) @ T @ rigid.transform(np.eye(3), -origin),
        cell=size,
        noise=deviations.sigma,
        lod95=deviations.threshold,
        examined_mm2=len(deviations.points) * size**2,
        points=len(cloud.points),
        points_used=len(deviations.points),
        defects=table(rows, origin),
        surface=SurfacePlaces(
            points=deviations.points[shown] + origin,
            deviation=deviations.distance[shown].astype(np.float32),
            defect=row_of[deviations.label[shown]],
        ),
    )


def _say_clusters(points: Floats, clustered: Bools, clusters: int, radius: float, origin: Floats) -> None:
    diagnostics.note(
        "density clusters", radius_mm=radius, points=len(points), clusters=clusters, kept=int(clustered.sum())
    )
    with diagnostics.placed(rigid.transform(np.eye(3), origin), "project"):
        diagnostics.keep("density clusters", points[clustered])
        diagnostics.keep("noise", points[~clustered])


def _deviations(points: Floats, vertices: Floats, design: StructureDesign, radius: float, params: Params) -> Deviations:
    """Measure distances of points (n, 3), and cluster those beyond the threshold."""
    surface = of_mesh(vertices, design.faces, 1000.0, design.bodies)
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, params.reach_mm)
    facet, distance = mesh_distance.nearest_visible(grid, points, np.zeros((1, 3)), np.full(len(points), -1, np.int64))
    near = facet >= 0
    points, facet, distance = points[near], facet[near], distance[near]
    sigma = robust_sd_about_median(distance)
    threshold = params.paper.defect_mm or max(ROBUST_TIMES * sigma, 1e-6)
    beyond = np.abs(distance) > threshold
    label = np.full(len(points), NOISE, np.int64)
    label[beyond] = density_clusters(points[beyond], DEFECT_RADII * radius, DEFECT_POINTS)
    diagnostics.note(
        "defect points", threshold_mm=threshold, beyond=int(beyond.sum()), clusters=int(label.max(initial=NOISE)) + 1
    )
    diagnostics.keep("defect points", lambda: points[label >= 0])
    return Deviations(
        points=points,
        distance=distance,
        normal=surface.normals[facet],
        component=surface.component_of[facet],
        names=surface.names,
        label=label,
        sigma=sigma,
        threshold=threshold,
    )


def _rows(deviations: Deviations, size: float, paper: Paper) -> Iterator[dict[str, Any]]:
    """Yield the values of each defect, and its label, for points of spacing ``size`` in mm."""
    for label in range(int(deviations.label.max(initial=NOISE)) + 1):
        inside = deviations.label == label
        points, distance = deviations.points[inside], deviations.distance[inside]
        middle = points.mean(axis=0)
        outward = deviations.normal[inside].mean(axis=0)
        outward = outward / max(float(np.linalg.norm(outward)), 1e-12)
        flat = (points - middle) - np.outer((points - middle) @ outward, outward)
        _, axes = np.linalg.eigh(flat.T @ flat)
        along, across = flat @ axes[:, 2], flat @ axes[:, 1]
        area = len(points) * size**2
        deepest = float(distance[np.argmax(np.abs(distance))])
        strips = min(paper.strips, max(2, len(points) // 4))
        yield {
            "label": label,
            "defect_class": DefectClass.UNKNOWN,
            "confidence": 0.0,
            "otherwise": DefectClass.DENT if distance.mean() < 0.0 else DefectClass.BULGE,
            "component": deviations.names[int(np.bincount(deviations.component[inside]).argmax())],
            "centre": middle,
            "axes": np.stack([axes[:, 2], np.cross(outward, axes[:, 2]), outward]),
            "extent": [np.ptp(along) + size, np.ptp(across) + size],
            "area_mm2": area,
            "depth_max": -deepest,
            "depth_ci95": NORMAL_95 * deviations.sigma,
            "depth_mean": -distance.mean(),
            "volume_mm3": -distance.mean() * area,
            "volume_ci95": np.nan,
            "edge_distance": np.nan,
            "curvature_per_m": np.nan,
            "lod95": deviations.threshold,
            "z": abs(deepest) / max(deviations.sigma, 1e-12),
            "chance": np.nan,
            "reasons": (),
            "deflection": defect_grids.by_slopes(along, distance, strips),
        }


def density_clusters(points: Floats, radius: float, least: int) -> Ints:
    """Label (n,) of each of points (n, 3), -1 for noise: DBSCAN, the point itself counted (Ester et al. 1996).

    A border point goes to the nearest core point; clusters are numbered by their first core point.
    """
    label = np.full(len(points), NOISE, np.int64)
    if not len(points):
        return label
    tree = cKDTree(points)
    pairs = tree.query_pairs(radius, output_type="ndarray")
    degree = 1 + np.bincount(pairs.ravel(), minlength=len(points))
    core = degree >= least
    links = pairs[core[pairs].all(axis=1)]
    if not core.any():
        return label
    # Components are numbered by their first nodes, so those of core points by their first core points.
    label[core] = distinct(components(len(points), *links.T)[core, None]).number
    rest = np.flatnonzero(~core)
    near, index = cKDTree(points[core]).query(points[rest], distance_upper_bound=radius)
    reached = np.isfinite(near)
    label[rest[reached]] = label[core][index[reached]]
    return label


def huber(length: Floats, limit: float) -> float:
    """Sum of Huber's function of distances (n,): half their square, linear beyond ``limit`` (paper 004 eq. 5)."""
    return float(np.where(length <= limit, 0.5 * length**2, 0.5 * limit * (2.0 * length - limit)).sum())


def _thinned(points: Floats, paper: Paper) -> tuple[float, Floats]:
    """Return the voxel size in mm and the voxel means; voxels grow until no more points are left than allowed."""
    size = paper.voxel_mm or max(VOXEL_SPACINGS * surface_spacing(points), 1.0)
    while True:
        means = voxel_means(points, size)
        if len(means) <= paper.points or paper.voxel_mm:
            return size, means[:: max(1, -(-len(means) // paper.points))]
        size *= max(1.1, float(np.sqrt(len(means) / paper.points)))


def _normals(points: Floats) -> Floats:
    """Return unit normals (n, 3) by the nearest 12 points, away from the centroid; features ignore the sign."""
    near = cKDTree(points).query(points, k=min(12, len(points)))[1]
    local = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))
    normal = axes[:, :, 0]
    outward = np.einsum("ni,ni->n", normal, points - points.mean(axis=0))
    oriented: Floats = np.where(outward[:, None] < 0.0, -normal, normal)
    return oriented


def _first_pose(
    points: Floats, design: Floats, design_normals: Floats, size: float, paper: Paper, rng: np.random.Generator
) -> Floats:
    """Return the pose (4, 4) of least Huber error among poses by three pairs of similar places and the identity."""
    radius = FEATURE_VOXELS * size
    source = np.sort(rng.choice(len(points), min(paper.feature_points, len(points)), replace=False))
    target = np.sort(rng.choice(len(design), min(paper.feature_points, len(design)), replace=False))
    of_source = pfh.histograms(points, _normals(points), radius, rows=source)
    of_target = pfh.histograms(design, design_normals, radius, rows=target)
    similar = cKDTree(of_target).query(of_source, k=min(CANDIDATES, len(target)))[1].reshape(len(source), -1)
    tree, limit = cKDTree(design), paper.huber_mm or HUBER_VOXELS * size
    keys = points[source]

    def error(T: Floats) -> float:
        return huber(tree.query(rigid.apply(T, keys))[0], limit)

    best = np.eye(4)
    least = error(best)
    tried = 0
    for _ in range(paper.trials):
        rows = rng.choice(len(source), 3, replace=False)
        pick = similar[rows, rng.integers(similar.shape[1], size=3)]
        a, b = keys[rows], design[target[pick]]
        sides = np.linalg.norm(a - np.roll(a, 1, axis=0), axis=1) - np.linalg.norm(b - np.roll(b, 1, axis=0), axis=1)
        if np.abs(sides).max() > LENGTH_VOXELS * size:
            continue
        T = rigid.fit(a, b)
        tried += 1
        candidate = error(T)
        if candidate < least:
            best, least = T, candidate
    diagnostics.note("descriptors", source=len(source), target=len(target), radius_mm=radius)
    diagnostics.note("sample consensus", trials=paper.trials, fitted=tried, huber_mm2=least, huber_limit_mm=limit)
    return best
