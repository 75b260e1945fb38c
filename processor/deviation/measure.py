"""Method ``default``: how the scanned surface has moved from the design's, at points of the design's surface.

M3C2 with the design's surface itself in place of a cloud of it: each scanned point is compared with the facet below it,
so that the curvature of a tube does not count as roughness, and the two sides of a plate are kept separate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.deviation import local_translation, to_result
from processor.deviation.cloud import ScanCloud
from processor.deviation.local_translation import Movement
from processor.deviation.params import Params
from processor.deviation.result import ErrorSource, Result
from processor.geometry import m3c2, mesh_distance, rigid, surface_registration
from processor.geometry.m3c2 import Distances
from processor.geometry.mesh_distance import CurvedFacets, MeshSurface, Samples
from processor.geometry.surface_registration import NEAR_MM, Placed, Registration
from processor.model import Floats, Ints, Reason, Scene, Status, reason

MOST_CORE = 150_000
POINTS_A_CORE = 40.0  # scanned points about a core point, fewer on narrow surfaces
CORE_SHARE = 0.5  # spacing of core points, in projection diameters
REACH_MM = 200.0  # points farther from the design's surface are not of the structure
DEPTH_SHARE, DEPTH_TIMES, LEAST_DEPTH_MM = 0.98, 2.5, 20.0
LEAST_COS = 0.5  # between the normals at a core point and below a scanned point
NEAR_CORE = 4  # nearest core points whose movement a scanned point may take
BACK_COS = -0.2  # a facet that faces away from the scanner by more is not visible
BACK_TRIES = 8  # nearest samples among which a visible facet is searched


@dataclass(frozen=True)
class OnSurface:
    """Points of a scan on the design: foot (n, 3), signed distance (n,) and facet (n,); mm, outward > 0."""

    feet: Floats
    distance: Floats
    facet: Ints


def measure(scene: Scene, scan: ScanCloud, vertices: Floats, origin: Floats, params: Params) -> Result:
    """Deviations of a scan from a design with vertices (v, 3) less ``origin`` (3,)."""
    assert scene.structure is not None
    surface = mesh_distance.of_design(vertices, scene.structure.faces)
    curved = mesh_distance.of_surface(surface)
    given = rigid.transform(np.eye(3), scan.origin - origin)
    placed = surface_registration.place(scan.points, surface, given, params.register, scan.scanner)
    diameter = params.projection_diameter_mm or m3c2.rounded(m3c2.diameter_for(POINTS_A_CORE, scan.spacing_mm))
    area = mesh_distance.area(vertices, surface.faces)
    core_spacing = params.core_spacing_mm or max(CORE_SHARE * diameter, float(np.sqrt(area / MOST_CORE)))
    core = mesh_distance.sampled(vertices, surface.faces, core_spacing)
    seen = on_surface(scan, curved, placed.T)
    depth = params.max_depth_mm or _depth(seen.distance)
    near = np.abs(seen.distance) <= depth
    moved = movement(core, curved, seen, near, diameter)
    measured, error, source = distances(core, moved, placed, params.registration_error_mm)
    return _result(scan, placed, core, measured, origin, params, (diameter, depth, error, source, float(near.mean())))


def on_surface(scan: ScanCloud, curved: CurvedFacets, T: Floats, reach_mm: float = REACH_MM) -> OnSurface:
    """Compare a scan's points, placed by T (4, 4), with a design; those off its faces have distance NaN, facet -1.

    If the position that a point was seen from is known, it is compared with a facet visible from there.
    """
    surface = curved.surface
    points = rigid.apply(T, scan.points)
    face, distance, beyond = surface.distances(points, reach_mm)
    if scan.scanner is not None:
        sight = rigid.apply(T, scan.scanner) - points
        sight /= np.maximum(np.linalg.norm(sight, axis=1), 1e-9)[:, None]
        away = np.flatnonzero((face >= 0) & (np.einsum("ni,ni->n", surface.normals[face], sight) < BACK_COS))
        if len(away):
            other = _facing(points[away], sight[away], surface, reach_mm)
            face[away], distance[away], beyond[away] = surface.distances(points[away], reach_mm, other)
    used = mesh_distance.on_face(face, beyond)
    face, distance = np.where(used, face, -1), np.where(used, distance, np.nan)
    feet = points - distance[:, None] * surface.normals[face]
    return OnSurface(feet, distance - curved.heights(feet, face), face)


def _facing(points: Floats, sight: Floats, surface: MeshSurface, reach: float) -> Ints:
    """Return the facet (n,) of the nearest sample that faces along ``sight`` (n, 3); -1 if none of the nearest does."""
    k = min(BACK_TRIES, len(surface.sample_face))
    near, index = surface.tree.query(points, k=np.arange(1, k + 1), distance_upper_bound=reach, workers=-1)
    facet = surface.sample_face[np.minimum(index, len(surface.sample_face) - 1)]
    facing = np.isfinite(near) & (np.einsum("nki,ni->nk", surface.normals[facet], sight) >= BACK_COS)
    first = np.argmax(facing, axis=1)
    rows = np.arange(len(points))
    nearest: Ints = np.where(facing[rows, first], facet[rows, first], -1)
    return nearest


def movement(
    core: Samples, curved: CurvedFacets, seen: OnSurface, used: npt.NDArray[np.bool_], diameter_mm: float
) -> Movement:
    """Fit movements at core points to the scan's points in use (n,).

    The second of two fits compares each point with the facet below its place before the movement, so that a tube that
    moved sideways does not appear smaller.
    """
    surface = curved.surface
    rows = np.flatnonzero(used)
    feet, distance, facet = seen.feet[rows], seen.distance[rows], seen.facet[rows]
    first = _fitted(core, surface, feet, distance, facet, diameter_mm)
    known = np.flatnonzero(np.isfinite(first.along))
    if not len(known):
        return first
    near, index = cKDTree(core.points[known]).query(feet, k=np.arange(1, NEAR_CORE + 1), workers=-1)
    at = known[np.minimum(index, len(known) - 1)]
    alike = np.einsum("nki,ni->nk", core.normals[at], surface.normals[facet]) >= LEAST_COS
    alike &= near <= 0.5 * diameter_mm
    nearest = at[np.arange(len(at)), np.argmax(alike, axis=1)]
    vector = np.where(alike.any(axis=1)[:, None], first.vector[nearest], 0.0)
    height = distance + curved.heights(feet, facet)
    before = feet + height[:, None] * surface.normals[facet] - vector
    facet, left, beyond = surface.distances(before, REACH_MM, facet)
    on = mesh_distance.on_face(facet, beyond)
    before, facet, left, vector = before[on], facet[on], left[on], vector[on]
    normals = surface.normals[facet]
    # The residual after the first movement, and the first movement itself along the facet's normal.
    feet = before - left[:, None] * normals
    distance = left - curved.heights(feet, facet) + np.einsum("ni,ni->n", normals, vector)
    return _fitted(core, surface, feet, distance, facet, diameter_mm)


def _fitted(
    core: Samples, surface: MeshSurface, feet: Floats, distance: Floats, facet: Ints, diameter_mm: float
) -> Movement:
    grid = m3c2.grid(feet, diameter_mm)
    return local_translation.movement(
        grid, distance[grid.order], surface.normals[facet[grid.order]], core.points, core.normals,
        diameter_mm=diameter_mm, least_cos=LEAST_COS,
    )  # fmt: skip


def distances(
    core: Samples, moved: Movement, placed: Placed, stated_error_mm: float
) -> tuple[Distances, float, ErrorSource]:
    """Distances at core points with LOD95, the registration error in it (one sd, mm), and its source."""
    known = np.isfinite(moved.along)
    if np.isfinite(stated_error_mm):
        error, source = stated_error_mm, ErrorSource.GIVEN
    elif np.isfinite(placed.covariance).all() and known.any():
        error = surface_registration.error_along(placed.covariance, core.points[known], core.normals[known])
        source = ErrorSource.COVARIANCE
    else:
        error, source = 0.0, ErrorSource.UNKNOWN
    lod95 = m3c2.Z95 * (moved.sd / np.sqrt(np.maximum(moved.count, 1)) + error)
    measured = Distances(
        distance=moved.along, lod95=lod95, n1=moved.count, n2=moved.count, std1=np.zeros(len(lod95)), std2=moved.sd
    )
    return measured, error, source


def _depth(distance: Floats) -> float:
    known = np.abs(distance[np.isfinite(distance)])
    if not len(known):
        return LEAST_DEPTH_MM
    return float(np.clip(m3c2.rounded(DEPTH_TIMES * float(np.quantile(known, DEPTH_SHARE))), LEAST_DEPTH_MM, REACH_MM))


def _result(
    scan: ScanCloud,
    placed: Placed,
    core: Samples,
    measured: Distances,
    origin: Floats,
    params: Params,
    used: tuple[float, float, float, ErrorSource, float],
) -> Result:
    diameter, depth, error, source, share = used
    total = m3c2.summary(measured, core.points, core.normals, diameter, m3c2.PAPER_POINTS_A_CYLINDER)
    points = to_result.core_points(core.points, core.normals, measured)
    status, reasons = _status(placed, total, params)
    if scan.unposed > 1:
        reasons.append(reason("deviation.unposed-scans", scans=scan.unposed))
    known = measured.std2[np.isfinite(measured.lod95)]
    return Result(
        status=status,
        method=params.method,
        reasons=tuple(reasons),
        T_design_scan=global_pose(placed.T, scan.origin, origin),
        registration=placed.registration,
        registration_error=error,
        registration_error_from=source,
        T_best_fit=global_pose(placed.T_best_fit, scan.origin, origin),
        covariance=rigid.about_origin(placed.covariance, origin),
        best_fit_shift=placed.shift,
        best_fit_turn=placed.turn,
        ambiguity=placed.ambiguity,
        spacing=scan.spacing_mm,
        sigma=float(np.median(known)) if len(known) else float("nan"),
        points_read=scan.read,
        points_kept=scan.kept,
        on_surface_share=share,
        projection_diameter=diameter,
        max_depth=depth,
        origin=origin,
        core=points,
        **to_result.statistics(points, total),
    )


def _status(placed: Placed, total: m3c2.Summary, params: Params) -> tuple[Status, list[Reason]]:
    """Return the status, and its reasons: how the scan was registered."""
    if total.core_points == total.without_lod:
        share = 100.0 * placed.near_share
        return Status.FAILED, [reason("deviation.no-core-point", share=share, near_mm=NEAR_MM)]
    reasons: list[Reason] = []
    status = Status.OK
    if placed.registration is Registration.AS_GIVEN:
        if params.register == "none":
            reasons.append(reason("deviation.as-requested"))
        else:
            reasons.append(reason("deviation.as-given", share=100.0 * placed.near_share))
        if np.isfinite(placed.turn):
            x, y, z = placed.shift.tolist()
            reasons.append(reason("deviation.best-fit-would-move", x=x, y=y, z=z, turn_mrad=1000.0 * placed.turn))
    else:
        reasons.append(reason("deviation.best-fit"))
        if not np.isfinite(placed.T_best_fit).all():
            status = Status.WEAK
            reasons.append(reason("deviation.coarse-only"))
    if placed.ambiguous:
        status = Status.AMBIGUOUS
        reasons.append(reason("deviation.ambiguous", ratio=placed.ambiguity))
    if placed.weak and placed.registration is not Registration.AS_GIVEN and status is Status.OK:
        status = Status.WEAK
        reasons.append(reason("deviation.weak", motions=placed.weak))
    return status, reasons


def global_pose(T: Floats, scan_origin: Floats, design_origin: Floats) -> Floats:
    """Pose of local frames as one of frames whose origins are put back."""
    shift: Floats = T[:3, 3] + design_origin - T[:3, :3] @ scan_origin
    return rigid.transform(T[:3, :3], shift)
