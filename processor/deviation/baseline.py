"""Method ``paper``: the source paper's chain (002), for comparison.

Outliers removed, the design as points at the scan's density, both down-sampled by density-adaptive voxels, principal
axes (rotations alone: four of the paper's eight cases are mirror images; each refined before they are compared),
iterative closest point, M3C2 between the two clouds with the paper's scales. The registration error is that of
registering a clone of the scan: repeatability alone.
"""

from __future__ import annotations

import numpy as np

from processor import diagnostics
from processor.adjustment import distance_summary
from processor.adjustment.point_groups import group_means
from processor.deviation import cloud, result_fields
from processor.deviation import measure as deviation_measure
from processor.deviation.cloud import ScanCloud
from processor.deviation.params import Paper, Params
from processor.deviation.result import CorePoints, ErrorSource, Result
from processor.geometry import m3c2, mesh_distance, rigid
from processor.geometry.thinning import thinned
from processor.geometry.thread_ranges import each
from processor.model import Floats, Ints, Scene, Status, StructureDesign, reason
from processor.registration import icp, principal
from processor.registration.surface_registration import Registration

MOST_ICP_POINTS = 60_000  # work: of point-to-point iterations along a whole structure
COARSE_POINTS, COARSE_ITERATIONS = 3_000, 30  # work: to choose between attitudes; the pose is refined after it
NAN = float("nan")


def measure(scene: Scene, scan: ScanCloud, vertices: Floats, origin: Floats, params: Params) -> Result:
    """Deviations of a scan from a design with vertices (v, 3) less ``origin`` (3,), as in the paper."""
    assert scene.structure is not None
    with diagnostics.placed(np.eye(4), "project"):
        return _measured(scene.structure, scan, vertices, origin, params)


def _measured(design_of: StructureDesign, scan: ScanCloud, vertices: Floats, origin: Floats, params: Params) -> Result:
    preset = params.paper
    design = mesh_distance.sampled(vertices, design_of.faces, scan.spacing_mm)
    group = voxels(design.points, preset)
    core = group_means(design.points, group)
    towards = group_means(design.normals, group)
    diagnostics.note("outliers", read=scan.read, kept=scan.kept)
    diagnostics.keep("outliers", scan.removed + scan.origin)
    _say_voxels("design voxels", design.points, core)
    T, error, ambiguity = _registered(scan, core, origin, params)
    grid = m3c2.grid(design.points, preset.projection_diameter_mm)
    normals = m3c2.oriented(m3c2.normals(grid, core, preset.normal_diameter_mm).normals, towards)
    compared = m3c2.grid(rigid.apply(T, scan.points), preset.projection_diameter_mm)
    distances = m3c2.distances(
        grid, compared, core, normals,
        projection_diameter_mm=preset.projection_diameter_mm, max_depth_mm=preset.max_depth_mm,
        registration_error_mm=error,
    )  # fmt: skip
    total = distance_summary.of_distances(
        distances, core, normals, preset.projection_diameter_mm, m3c2.PAPER_POINTS_A_CYLINDER
    )
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
    if ambiguity < principal.AMBIGUOUS:
        status = Status.AMBIGUOUS if status is Status.OK else status
        reasons.append(reason("deviation.paper-ambiguous", ratio=ambiguity))
    used = known if (known := distances.std2[np.isfinite(distances.lod95)]).size else np.array([NAN])
    points = CorePoints(points=core, normals=normals, **vars(distances))
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
    reduced = group_means(scan.points, voxels(scan.points, preset))
    _say_voxels("scan voxels", scan.points, reduced)
    diagnostics.keep("scan voxels", reduced + scan.origin)
    target, source = thinned(core, MOST_ICP_POINTS), thinned(reduced, MOST_ICP_POINTS)
    if params.register in ("none", "fine"):
        T, ambiguity = rigid.transform(np.eye(3), scan.origin - origin), NAN
    else:
        T, rms, ambiguity = coarse(source, target)
        diagnostics.note("principal axes", rms_mm=rms, rival_by_best=ambiguity)
    error = 0.0
    if params.register != "none":
        fine = icp.point_to_point(source, target, T)
        T = fine.T_target_source
        diagnostics.note("iterative closest point", rounds=fine.iterations, rms_mm=fine.rms)
        # What the same registration leaves between the points (n, 3) and a clone of them, rms in mm
        points = rigid.apply(T, source)
        error = icp.point_to_point(points, points, coarse(points, points)[0]).rms
        diagnostics.note("clone", rms_mm=error)
    if np.isfinite(params.registration_error_mm):
        error = params.registration_error_mm
    return T, error, ambiguity


def voxels(points: Floats, preset: Paper) -> Ints:
    """Return the voxel (n,) of each of points (n, 3) by the paper's density-adaptive down-sampling."""
    return cloud.adaptive_voxels(points, preset.voxel_mm, preset.voxel_points, preset.voxel_growth)


def _say_voxels(stage: str, points: Floats, means: Floats) -> None:
    diagnostics.note(stage, points=len(points), voxels=len(means), rate=len(means) / max(len(points), 1))


def coarse(source: Floats, target: Floats) -> tuple[Floats, float, float]:
    """Lay principal axes on each other: the pose with the least mean square distance (eq. 9) after a short ICP.

    Paper 002 compares the poses as the axes give them. Axes are a little off, by as much as the poses of a nearly
    symmetric structure differ. Returns T_target_source (4, 4), the rms in mm that it leaves, and the ratio of the rms
    of the next best pose to it, NaN without one.
    """
    few, from_axes, to_axes = thinned(source, COARSE_POINTS), principal.of_points(source), principal.of_points(target)

    def refined(turn: Floats) -> tuple[float, Floats]:
        R = to_axes.axes @ turn @ from_axes.axes.T
        start = rigid.transform(R, to_axes.centre - R @ from_axes.centre)
        T = icp.point_to_point(few, target, start, max_iterations=COARSE_ITERATIONS).T_target_source
        return icp.point_to_point(few, target, T, max_iterations=1).rms, T

    size = float(np.linalg.norm(np.ptp(target, axis=0)))
    fits = each(refined, principal.possible_turns(to_axes.variances, from_axes.variances))
    (rms, best), *others = sorted(fits, key=lambda fit: fit[0])
    rivals = (error for error, T in others if principal.differ(T, best, from_axes.centre, size))
    return best, rms, next(rivals, NAN) / max(rms, 1e-9)
