"""Method ``paper``: the source paper's chain (002), for comparison.

Outliers removed, the design as points at the scan's density, both down-sampled by density-adaptive voxels, principal
axes (rotations alone: four of the paper's eight cases are mirror images; each refined before they are compared),
iterative closest point, M3C2 between the two clouds with the paper's scales. The registration error is that of
registering a clone of the scan: repeatability alone.
"""

from __future__ import annotations

import numpy as np

from processor.adjustment.groups import group_means
from processor.deviation import cloud, result_fields
from processor.deviation import measure as deviation_measure
from processor.deviation.cloud import ScanCloud
from processor.deviation.params import Params
from processor.deviation.result import ErrorSource, Result
from processor.geometry import icp, m3c2, mesh_distance, principal, rigid
from processor.geometry.neighbors import thinned
from processor.geometry.principal import AMBIGUOUS, CoarsePose
from processor.geometry.surface_registration import Registration
from processor.model import Floats, Scene, Status, reason

MOST_ICP_POINTS = 60_000
COARSE_POINTS, COARSE_ITERATIONS = 3_000, 30
NAN = float("nan")


def measure(scene: Scene, scan: ScanCloud, vertices: Floats, origin: Floats, params: Params) -> Result:
    """Deviations of a scan from a design with vertices (v, 3) less ``origin`` (3,), as in the paper."""
    assert scene.structure is not None
    preset = params.paper
    design = mesh_distance.sampled(vertices, scene.structure.faces, scan.spacing_mm)
    group = cloud.adaptive_voxels(design.points, preset.voxel_mm, preset.voxel_points)
    core = group_means(design.points, group)
    towards = group_means(design.normals, group)
    T, error, ambiguity = _registered(scan, core, origin, params)
    grid = m3c2.grid(design.points, preset.projection_diameter_mm)
    normals = m3c2.oriented(m3c2.normals(grid, core, preset.normal_diameter_mm).normals, towards)
    compared = m3c2.grid(rigid.apply(T, scan.points), preset.projection_diameter_mm)
    distances = m3c2.distances(
        grid, compared, core, normals,
        projection_diameter_mm=preset.projection_diameter_mm, max_depth_mm=preset.max_depth_mm,
        registration_error_mm=error,
    )  # fmt: skip
    total = m3c2.summary(distances, core, normals, preset.projection_diameter_mm, m3c2.PAPER_POINTS_A_CYLINDER)
    status = Status.OK if total.core_points > total.without_lod else Status.FAILED
    reasons = [
        reason(
            "deviation.paper-scales",
            without=total.without_lod,
            core_points=total.core_points,
            few=total.few_points,
            least=m3c2.PAPER_POINTS_A_CYLINDER,
        )
    ]
    if ambiguity < AMBIGUOUS:
        status = Status.AMBIGUOUS if status is Status.OK else status
        reasons.append(reason("deviation.paper-ambiguous", ratio=ambiguity))
    used = known if (known := distances.std2[np.isfinite(distances.lod95)]).size else np.array([NAN])
    points = result_fields.core_points(core, normals, distances)
    how = {"none": Registration.AS_GIVEN, "fine": Registration.FINE}.get(params.register, Registration.COARSE)
    return Result(
        status=status,
        method=params.method,
        reasons=tuple(reasons),
        T_design_scan=deviation_measure.global_pose(T, scan.origin, origin),
        registration=how,
        registration_error=error,
        registration_error_from=ErrorSource.GIVEN if np.isfinite(params.registration_error_mm) else ErrorSource.CLONE,
        ambiguity=ambiguity,
        spacing=scan.spacing_mm,
        sigma=float(np.median(used)),
        points_read=scan.read,
        points_kept=scan.kept,
        normal_diameter=preset.normal_diameter_mm,
        projection_diameter=preset.projection_diameter_mm,
        max_depth=preset.max_depth_mm,
        origin=origin,
        core=points,
        **result_fields.statistics(points, total),
    )


def _registered(scan: ScanCloud, core: Floats, origin: Floats, params: Params) -> tuple[Floats, float, float]:
    """Pose T (4, 4) of the scan in the design's local frame, registration error in mm, and ambiguity."""
    preset = params.paper
    reduced = group_means(scan.points, cloud.adaptive_voxels(scan.points, preset.voxel_mm, preset.voxel_points))
    target, source = thinned(core, MOST_ICP_POINTS), thinned(reduced, MOST_ICP_POINTS)
    if params.register in ("none", "fine"):
        T, ambiguity = rigid.transform(np.eye(3), scan.origin - origin), NAN
    else:
        pose = coarse(source, target)
        T, ambiguity = pose.T_target_source, pose.ambiguity
    error = 0.0
    if params.register != "none":
        T = icp.point_to_point(source, target, T).T_target_source
        error = clone_error(rigid.apply(T, source))
    if np.isfinite(params.registration_error_mm):
        error = params.registration_error_mm
    return T, error, ambiguity


def coarse(source: Floats, target: Floats) -> CoarsePose:
    """Lay principal axes on each other: the pose with the least mean square distance (eq. 9) after a short ICP."""
    few = thinned(source, COARSE_POINTS)

    def refined(start: Floats) -> tuple[float, Floats]:
        T = icp.point_to_point(few, target, start, max_iterations=COARSE_ITERATIONS).T_target_source
        return icp.point_to_point(few, target, T, max_iterations=1).rms, T

    size = float(np.linalg.norm(np.ptp(target, axis=0)))
    return principal.coarse(principal.of_points(source), principal.of_points(target), size, refined)


def clone_error(points: Floats) -> float:
    """Rms in mm that the same registration leaves between points (n, 3) and a clone of them."""
    return icp.point_to_point(points, points, coarse(points, points).T_target_source).rms
