"""Tasks of processor beside peers, in turn in one process: outlier removal, and a part registered without a start.

Ratios are of processor seconds, of all threads together, the median of the rounds; compiled code is warm. M3C2 and the
fit of balls stand beside peers in tests/bench/m3c2.py and tests/bench/spheres/peers.py.
"""

from __future__ import annotations

import importlib.util
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from designgen import recipe_files
from designgen.scenes.make import make
from processor.api.arrays import register
from processor.clouds import cleaning
from processor.geometry import rigid
from processor.model import Floats
from processor.writers.cloud import BLOCK, Block, Cloud
from tests.bench import m3c2

PEERS = ("open3d", "scipy", "py4dgeo", "small_gicp", "pyransac3d")
ROUNDS = 3
POINTS, STRAY = 1_000_000, 0.01  # of the cloud whose outliers are removed; share of stray points
POSES = 5
PLACED_MM, PLACED_MRAD = 5.0, 2.0  # a pose within these is counted as found
VOXEL_MM = 60.0  # of Open3D's features: a tenth of the part's least width or so
SAMPLES = 100_000  # of the mesh, for Open3D


def there(name: str) -> bool:
    """Whether a package is installed."""
    return importlib.util.find_spec(name) is not None


def compared(quick: bool) -> dict[str, Any]:
    """All tasks: rows of name, seconds and ratio; and the peers that are not installed."""
    points = stray_cloud(POINTS // (10 if quick else 1))
    found: dict[str, Any] = {"outliers": beside(outlier_removal(points), 1 if quick else ROUNDS)}
    for row in found["outliers"]:
        row["agree"] = float((row["answer"] == found["outliers"][0]["answer"]).mean())
        row["points"] = len(points)
    found["registration"] = registration(1 if quick else POSES)
    for row in (*found["outliers"], *found["registration"]):
        row.pop("answer", None)
        print("  ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)
    return found | {"missing": [name for name in PEERS if not there(name)]}


def beside(tasks: dict[str, Callable[[], Any]], rounds: int) -> list[dict[str, Any]]:
    """Run every task once unmeasured, then all in turn; medians, and ratios to the first."""
    answers = {name: task() for name, task in tasks.items()}
    took: dict[str, list[tuple[float, float]]] = {name: [] for name in tasks}
    for _ in range(rounds):
        for name, task in tasks.items():
            started = time.process_time(), time.perf_counter()
            answers[name] = task()
            took[name].append((time.process_time() - started[0], time.perf_counter() - started[1]))
    first = next(iter(took))
    return [
        {
            "name": name,
            "cpu": statistics.median(one[0] for one in times),
            "wall": statistics.median(one[1] for one in times),
            "ratio": statistics.median(one[0] / ours[0] for one, ours in zip(times, took[first], strict=True)),
            "answer": answers[name],
        }
        for name, times in took.items()
    ]


def stray_cloud(count: int) -> Floats:
    """A wavy surface, and points anywhere about it."""
    points = m3c2.cloud(count, 0.0, 1)
    stray = np.random.default_rng(2).choice(count, int(STRAY * count), replace=False)
    points[stray, 2] += np.random.default_rng(3).uniform(-500.0, 500.0, len(stray))
    return points


def outlier_removal(points: Floats) -> dict[str, Callable[[], Any]]:
    """Outlier removal as processor exports, by SciPy's tree and by Open3D: marks (n,) of the points that stay."""
    near, ratio = cleaning.NEIGHBOURS, cleaning.RATIO

    def ours() -> Any:
        def blocks():
            for start in range(0, len(points), BLOCK):
                rows = np.arange(start, min(start + BLOCK, len(points)))
                yield Block(points[rows], {"row": rows.astype(np.int32)})

        cloud = Cloud("cloud", {"row": np.dtype(np.int32)}, blocks, count=len(points))
        kept = np.zeros(len(points), bool)
        with tempfile.TemporaryDirectory() as aside:
            for block in cleaning.cleaned(cloud, None, None, Path(aside))[0].blocks():
                kept[block.fields["row"]] = True
        return kept

    def tree() -> Any:
        found = cKDTree(points)
        mean = np.empty(len(points))
        mean[found.indices] = found.query(points[found.indices], k=near + 1, workers=-1)[0][:, 1:].mean(axis=1)
        return mean <= mean.mean() + ratio * mean.std()

    def open3d() -> Any:
        import open3d as o3d

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        kept = np.zeros(len(points), bool)
        kept[np.asarray(cloud.remove_statistical_outlier(near + 1, ratio)[1])] = True
        return kept

    tasks = {"processor, with slabs on disk": ours, "SciPy's tree, leaf order": tree}
    return tasks | ({"Open3D": open3d} if there("open3d") else {})


def part() -> tuple[Floats, Floats, Floats]:
    """Points of a scanned arch foot at its design, mm, and the design's vertices and faces."""
    scene, _ = make("arch-foot", recipe_files.overridden(recipe_files.load("arch-foot")[1], ["scan.step_mrad=2.0"]), 1)
    points = [rigid.apply(scan.T_project_scan, scan.points + scan.origin) for scan in scene.scans]
    return np.vstack(points), scene.structure.vertices, scene.structure.faces


def registration(poses: int) -> list[dict[str, Any]]:
    """A scanned part moved to random poses, registered to its mesh without a start; errors of the part's points."""
    points, vertices, faces = part()
    origin = points.mean(axis=0)
    tasks = {"processor.register": lambda cloud: register(cloud, vertices, faces).T_design_scan}
    if there("open3d"):
        tasks["Open3D: FPFH, RANSAC, ICP"] = lambda cloud: by_features(cloud, vertices, faces)
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in tasks}
    errors: dict[str, list[float]] = {name: [] for name in tasks}
    for seed in range(poses):
        turn = Rotation.random(random_state=seed).as_matrix()
        moved = (points - origin) @ turn.T + np.random.default_rng(seed).uniform(-5e3, 5e3, 3)
        for row in beside({name: partial(task, moved) for name, task in tasks.items()}, 1):
            rows[row["name"]].append(row)
            off = np.linalg.norm(rigid.apply(row["answer"], moved) - points, axis=1)
            errors[row["name"]].append(float(np.sqrt((off**2).mean())))
    return [
        {
            "name": name,
            "cpu": statistics.median(row["cpu"] for row in own),
            "wall": statistics.median(row["wall"] for row in own),
            "ratio": statistics.median(row["ratio"] for row in own),
            "poses": poses,
            "found": sum(error < PLACED_MM for error in errors[name]),
            "error": statistics.median(errors[name]),
            "points": len(points),
        }
        for name, own in rows.items()
    ]


def by_features(points: Floats, vertices: Floats, faces: Floats) -> Floats:
    """Open3D's pose by features of points, RANSAC over them, and point-to-plane ICP."""
    import open3d as o3d

    o3d.utility.random.seed(1)
    tools, estimators = o3d.pipelines.registration, o3d.geometry.KDTreeSearchParamHybrid
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices.copy()), o3d.utility.Vector3iVector(faces.copy())
    )
    mesh.compute_triangle_normals()
    clouds, features = [], []
    scanned = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    target = mesh.sample_points_uniformly(SAMPLES, use_triangle_normal=True)
    for cloud in (scanned, target):
        thin = cloud.voxel_down_sample(VOXEL_MM)
        thin.estimate_normals(estimators(2.0 * VOXEL_MM, 30))
        thin.orient_normals_consistent_tangent_plane(20)
        clouds.append(thin)
        features.append(tools.compute_fpfh_feature(thin, estimators(5.0 * VOXEL_MM, 100)))
    checks = [
        tools.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        tools.CorrespondenceCheckerBasedOnDistance(1.5 * VOXEL_MM),
    ]
    coarse = tools.registration_ransac_based_on_feature_matching(
        *clouds, *features, True, 1.5 * VOXEL_MM, tools.TransformationEstimationPointToPoint(False), 3, checks,
        tools.RANSACConvergenceCriteria(400_000, 0.999),
    )  # fmt: skip
    T = coarse.transformation
    for reach in (1.0 * VOXEL_MM, 0.25 * VOXEL_MM):
        T = tools.registration_icp(
            scanned, target, reach, T, tools.TransformationEstimationPointToPlane(),
            tools.ICPConvergenceCriteria(max_iteration=60),
        ).transformation  # fmt: skip
    return np.asarray(T)
