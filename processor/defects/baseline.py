"""Method ``paper``: the chain of paper 004 as far as its one page tells, as a baseline.

Density clustering removes noise, histograms of point features pair places of the scan and the design, sample consensus
with Huber's error of the distances gives a first pose, iterative closest point the last; what is farther from the
design than a threshold is a defect, and its shape a curve integrated from the slopes of sub-regions. The page gives no
numbers for any of it, and no classes: those here follow from the cloud's spacing, and every defect is ``unknown``. A
point is held against the nearest face, so that in a plate a depth beyond half its thickness is one from its back.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from processor.defects import pictures
from processor.defects.params import Paper, Params
from processor.defects.pictures import MOST_PLACES
from processor.defects.result import Result
from processor.defects.surface_charts import of_mesh
from processor.geometry import icp, merging, mesh_distance, pfh, rigid
from processor.geometry.neighbors import surface_spacing, voxel_means
from processor.model import NORMAL_95, Floats, Ints, Scene

VOXEL_SPACINGS = 1.5
RADIUS_VOXELS = 2.5  # of a neighbourhood that density is told by
FEATURE_VOXELS = 3.6
CANDIDATES = 5  # places of the design with the nearest histograms, of which one is drawn
ROBUST_TIMES = 4.0  # standard deviations of all distances, beyond which a point belongs to a defect
DEFECT_POINTS = 8
HUBER_VOXELS = 2.0
ICP_VOXELS = (20.0, 5.0)
NOISE = -1


def defects(scene: Scene, params: Params, earlier: dict[str, Any]) -> Result:
    """Find the defects of a structure as in paper 004."""
    paper = params.paper
    assert scene.structure is not None
    vertices, origin = merging.local_design(scene.structure)
    cloud = merging.merged(merging.stitched(scene, earlier.get("stitch")), with_scanner=False)
    local = cloud.points + (cloud.origin - origin)
    size, points = _thinned(local, paper)
    radius = paper.cluster_radius_mm or RADIUS_VOXELS * size
    label = density_clusters(points, radius, paper.cluster_points)
    counts = np.bincount(label[label >= 0], minlength=1)
    kept = (label >= 0) & (counts[np.maximum(label, 0)] >= paper.smallest_cluster_share * counts.max())
    points = points[kept]
    if len(points) < paper.feature_points:
        return Result("failed", params.method, "too few points are left after the removal of noise")
    design = mesh_distance.sampled(vertices, scene.structure.faces, size)
    rng = np.random.default_rng([params.seed, 4])
    start = _first_pose(points, design.points, design.normals, size, paper, rng)
    T, rms = start, np.inf
    tree_share = 0.0
    for gate in ICP_VOXELS:
        found = icp.point_to_point(points, design.points, T, max_distance_mm=gate * size, max_iterations=40)
        if np.isfinite(found.rms):
            T, rms, tree_share = found.T_target_source, found.rms, found.paired_share
    if not np.isfinite(rms):
        return Result("failed", params.method, "the scan could not be laid on the design")
    surface = of_mesh(vertices, scene.structure.faces, 1000.0)
    placed = rigid.apply(T, points)
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, params.reach_mm)
    facet, distance = mesh_distance.nearest_visible(grid, placed, np.zeros((1, 3)), np.full(len(placed), -1, np.int64))
    on = facet >= 0
    placed, facet, distance = placed[on], facet[on], distance[on]
    sigma = 1.4826 * float(np.median(np.abs(distance - np.median(distance)))) if len(distance) else 0.0
    threshold = paper.defect_mm or max(ROBUST_TIMES * sigma, 1e-6)
    beyond = np.abs(distance) > threshold
    own = np.full(len(placed), NOISE, np.int64)
    own[beyond] = density_clusters(placed[beyond], 1.5 * radius, DEFECT_POINTS)
    said = (
        f"{len(points)} points {size:.1f} mm apart after density clustering; "
        f"rms {rms:.2f} mm of {tree_share:.0%} paired; "
        f"a defect is what is farther than {threshold:.2f} mm from the design; the page names no classes"
    )
    return _result(
        params, said, placed, distance, surface.normals[facet], surface.component_of[facet], own, origin,
        rigid.transform(np.eye(3), origin) @ T @ rigid.transform(np.eye(3), -origin), size, (len(cloud.points), sigma),
        threshold,
    )  # fmt: skip


def density_clusters(points: Floats, radius: float, least: int) -> Ints:
    """Label (n,) of each of points (n, 3), -1 for noise: DBSCAN, the point itself counted (Ester et al. 1996).

    A point that belongs to no core but is near some goes to the nearest; clusters are numbered by their first point.
    """
    found = np.full(len(points), NOISE, np.int64)
    if not len(points):
        return found
    tree = cKDTree(points)
    pairs = tree.query_pairs(radius, output_type="ndarray")
    degree = 1 + np.bincount(pairs.ravel(), minlength=len(points))
    core = degree >= least
    links = pairs[core[pairs].all(axis=1)]
    graph = coo_array((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), (len(points),) * 2)
    group = connected_components(graph, directed=False)[1]
    if not core.any():
        return found
    _, first, inverse = np.unique(group[core], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    found[core] = rank[inverse.reshape(-1)]
    rest = np.flatnonzero(~core)
    near, index = cKDTree(points[core]).query(points[rest], distance_upper_bound=radius)
    reached = np.isfinite(near)
    found[rest[reached]] = found[core][index[reached]]
    return found


def huber(length: Floats, limit: float) -> float:
    """Sum of Huber's function of distances (n,): half their square, linear beyond ``limit`` (paper 004 eq. 5)."""
    return float(np.where(length <= limit, 0.5 * length**2, 0.5 * limit * (2.0 * length - limit)).sum())


def _thinned(points: Floats, paper: Paper) -> tuple[float, Floats]:
    """Thin to voxel means, in voxels as large as keep to the most points allowed."""
    size = paper.voxel_mm or max(VOXEL_SPACINGS * surface_spacing(points), 1.0)
    while True:
        found = voxel_means(points, size)
        if len(found) <= paper.points or paper.voxel_mm:
            return size, found[:: max(1, -(-len(found) // paper.points))]
        size *= max(1.1, float(np.sqrt(len(found) / paper.points)))


def _histograms(points: Floats, normals: Floats, keys: Ints, radius: float) -> Floats:
    """PFH (k, 125) of some of points (n, 3), from their neighbourhoods in all of them."""
    tree = cKDTree(points)
    found = np.zeros((len(keys), 125))
    for row, key in enumerate(keys.tolist()):
        own = np.array(sorted(tree.query_ball_point(points[key], radius)))
        if len(own) >= 3:
            found[row] = _one(points[own], normals[own])
    return found


def _one(points: Floats, normals: Floats) -> Floats:
    first, second = np.triu_indices(len(points), 1)
    features = pfh.pair_features(points, normals, first, second)
    features = features[np.isfinite(features).all(axis=1)]
    cell = np.clip(np.floor((features - [-1.0, -1.0, -np.pi]) / [2.0, 2.0, 2.0 * np.pi] * 5).astype(np.int64), 0, 4)
    found: Floats = np.bincount(cell @ [1, 5, 25], minlength=125) / max(len(features), 1)
    return found


def _normals(points: Floats) -> Floats:
    """Return unit normals (n, 3) by the nearest dozen; a sign that features do not depend on is left as it falls."""
    near = cKDTree(points).query(points, k=min(12, len(points)))[1]
    local = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))
    normal = axes[:, :, 0]
    outward = np.einsum("ni,ni->n", normal, points - points.mean(axis=0))
    found: Floats = np.where(outward[:, None] < 0.0, -normal, normal)
    return found


def _first_pose(
    points: Floats, design: Floats, design_normals: Floats, size: float, paper: Paper, rng: np.random.Generator
) -> Floats:
    """Return the pose (4, 4) of least Huber error among those of three pairs of like places, and the one as given."""
    radius = FEATURE_VOXELS * size
    source = np.sort(rng.choice(len(points), min(paper.feature_points, len(points)), replace=False))
    target = np.sort(rng.choice(len(design), min(paper.feature_points, len(design)), replace=False))
    of_source = _histograms(points, _normals(points), source, radius)
    of_target = _histograms(design, design_normals, target, radius)
    like = cKDTree(of_target).query(of_source, k=min(CANDIDATES, len(target)))[1].reshape(len(source), -1)
    tree, limit = cKDTree(design), paper.huber_mm or HUBER_VOXELS * size
    keys = points[source]

    def error(T: Floats) -> float:
        return huber(tree.query(rigid.apply(T, keys))[0], limit)

    best = np.eye(4)
    least = error(best)
    for _ in range(paper.trials):
        rows = rng.choice(len(source), 3, replace=False)
        pick = like[rows, rng.integers(like.shape[1], size=3)]
        a, b = keys[rows], design[target[pick]]
        sides = np.linalg.norm(a - np.roll(a, 1, axis=0), axis=1) - np.linalg.norm(b - np.roll(b, 1, axis=0), axis=1)
        if np.abs(sides).max() > 10.0 * size:
            continue
        T = rigid.fit(a, b)
        own = error(T)
        if own < least:
            best, least = T, own
    return best


def _result(
    params: Params, said: str, placed: Floats, distance: Floats, normals: Floats, component: Ints, own: Ints,
    origin: Floats, T: Floats, size: float, cloud: tuple[int, float], threshold: float,
) -> Result:  # fmt: skip
    rows: list[dict[str, Any]] = []
    curves: list[tuple[Floats, Floats]] = []
    for k in range(int(own.max(initial=NOISE)) + 1):
        inside = own == k
        at, d = placed[inside], distance[inside]
        middle = at.mean(axis=0)
        out = normals[inside].mean(axis=0)
        out = out / max(float(np.linalg.norm(out)), 1e-12)
        flat = (at - middle) - np.outer((at - middle) @ out, out)
        _, axes = np.linalg.eigh(flat.T @ flat)
        along, across = flat @ axes[:, 2], flat @ axes[:, 1]
        area = len(at) * size**2
        top = int(np.argmax(np.abs(d)))
        rows.append({
            "classes": "unknown", "second": "dent" if d.mean() < 0.0 else "bulge", "confidence": 0.0,
            "components": f"component-{int(np.bincount(component[inside]).argmax()) + 1}", "centres": middle + origin,
            "axes": np.stack([axes[:, 2], np.cross(out, axes[:, 2]), out]),
            "extent": [np.ptp(along) + size, np.ptp(across) + size], "area_mm2": area, "depth_max": -d[top],
            "depth_ci95": NORMAL_95 * cloud[1], "depth_mean": -d.mean(), "volume_mm3": -d.mean() * area,
            "volume_ci95": np.nan, "edge_mm": np.nan, "curvature_per_m": np.nan, "lod95": threshold,
            "z": abs(d[top]) / max(cloud[1], 1e-12), "chance": np.nan, "remarks": "",
        })  # fmt: skip
        curves.append(pictures.by_slopes(along, d, min(params.paper.strips, max(2, len(at) // 4))))
    order = sorted(range(len(rows)), key=lambda k: -abs(rows[k]["volume_mm3"]))
    row_of = np.append(np.argsort(order), NOISE).astype(np.int32)  # the last: what belongs to none
    shown = slice(None, None, -(-len(placed) // MOST_PLACES) or 1)
    rows, curves = [rows[k] for k in order], [curves[k] for k in order]
    columns: dict[str, Any] = {key: [row[key] for row in rows] for key in (rows[0] if rows else ())}
    return Result(
        "ok", params.method, said, T_design_project=T, registration_error_mm=np.nan, cell_mm=size, noise_mm=cloud[1],
        lod95_mm=threshold, examined_mm2=len(placed) * size**2, points=cloud[0], used=len(placed),
        ids=np.arange(len(rows)), **columns,
        curve_defect=np.concatenate([[], *(np.full(len(c[0]), k) for k, c in enumerate(curves))]),
        curve_at_mm=np.concatenate([[], *(c[0] for c in curves)]),
        curve_mm=np.concatenate([[], *(c[1] for c in curves)]),
        curve_ci95=np.full(sum(len(c[0]) for c in curves), np.nan),
        surface_at=placed[shown] + origin, surface_mm=distance[shown].astype(np.float32),
        surface_defect=row_of[own[shown]],
    )  # fmt: skip
