"""Method ``default``: how the scanned surface has moved from the design's, at points of the design's surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from processor.adjustment import distance_summary, scanner_class_errors, view_error_from_opposite_sides
from processor.adjustment.body_motions import distance_derivative, variances
from processor.adjustment.distance_summary import Summary
from processor.deviation import large_cloud, mean_uncertainty, result_fields, stable_fit, surface_movement
from processor.deviation.cloud import ScanCloud
from processor.deviation.local_translation import Movement
from processor.deviation.params import Params
from processor.deviation.placement import Placement, place
from processor.deviation.result import CorePoints, ErrorSource, Result
from processor.deviation.stable_fit import Fits
from processor.deviation.station_offsets import CELL_DIAMETERS
from processor.deviation.surface_movement import Cloud
from processor.geometry import m3c2, mesh_distance, rigid
from processor.geometry.m3c2 import Distances
from processor.geometry.mesh_distance import CurvedFacets, MeshSurface, Samples
from processor.geometry.thinning import thinned
from processor.model import Floats, Reason, Scene, Status, reason
from processor.registration import surface_registration
from processor.registration.surface_registration import NEAR_MM, Placed, Registration

MOST_CORE = 150_000  # work: of a larger design core points are farther apart
POINTS_A_CORE = 40.0  # scanned points about a core point, fewer on narrow surfaces
CORE_SHARE = 0.5  # spacing of core points, in projection diameters
REACH_MM = 200.0  # points farther from the design's surface are not of the structure
DEPTH_SHARE, DEPTH_TIMES, LEAST_DEPTH_MM = 0.98, 2.5, 20.0  # chosen: no cylinder ends within the movement
DEPTH_POINTS = 100_000  # work: the share of a quantile of 98 % is known to 0.05 % (sqrt(0.98 * 0.02 / n))
FIT_POINTS, FIT_ROUNDS = 300_000, 2  # work: two rounds that place the scan; the result is measured with all its points
UNCERTAIN = 0.5  # of a point's standard deviation: a registration no better than the mean of four points
HALF = 0.5  # of the steel: the least that a stable fit is to rest on
FARTHEST_FRAME_MM = 6.0  # three standard deviations of 2 mm, of clouds that were registered on a site


@dataclass(frozen=True)
class Measured:
    """Core points with their movements, at a diameter and a spacing of core points and a depth to either side, mm.

    ``shared`` (k,) is the standard deviation of what the points of one station have in common; ``views`` is that of
    views which are not named. ``on_surface`` is the share of the scan's points that are within the depth.
    """

    core: Samples
    moved: Movement
    shared: Floats
    views: float
    diameter: float
    spacing: float
    depth: float
    on_surface: float


def measure(scene: Scene, scan: ScanCloud, vertices: Floats, origin: Floats, params: Params) -> Result:
    """Deviations of a scan from a design with vertices (v, 3) less ``origin`` (3,)."""
    assert scene.structure is not None
    surface = mesh_distance.of_design(vertices, scene.structure.faces)
    curved = mesh_distance.of_surface(surface)
    given = rigid.transform(np.eye(3), scan.origin - origin)
    placement = place(scan, surface, given, params.register)
    scan, placed = placement.scan, placement.placed
    if placed.registration is not Registration.AS_GIVEN:
        placed = replace(placed, T=_fitted_pose(scan, curved, placed, params))
    measured = _measured(scan, curved, placed.T, params)
    rigid_fits = _fits(measured, params)
    if placed.registration is not Registration.AS_GIVEN and rigid_fits.determined:
        measured, rigid_fits, placed = _corrected(measured, rigid_fits, placed, params)
    registered = registration_error(measured, rigid_fits, placed, params)
    result = _result(scan, placed, measured, registered, rigid_fits, origin, params)
    return _doubted(result, placement)


def _doubted(result: Result, placement: Placement) -> Result:
    """Put first why a result is not sure.

    Either the scan does not lie at the design, or scans were left out, or single points scatter as they do at a wrong
    pose, or the registration is less certain than scanners and single points are.
    """
    status, error = result.status, result.registration_error
    given = result.registration is Registration.AS_GIVEN
    if not placement.lies and placement.placed.registration is Registration.COARSE:
        first, status = reason("deviation.not-at-design"), Status.FAILED
    elif placement.left_out:
        names, points = ", ".join(name for name, _ in placement.left_out), sum(count for _, count in placement.left_out)
        first = reason("deviation.scans-elsewhere", scans=names, points=points, read=result.points_read)
        status = Status.WEAK if status is Status.OK else status
    elif result.registration is Registration.COARSE and result.sigma >= surface_registration.most_scatter(
        result.on_surface_share
    ):
        first, status = reason("deviation.no-fit", sigma=result.sigma), Status.WEAK if status is Status.OK else status
    elif status is Status.OK and error > max(UNCERTAIN * result.sigma, scanner_class_errors.SHIFT_SD_MM) and not given:
        first, status = reason("deviation.registration-uncertain", sd=error, sigma=result.sigma), Status.WEAK
    else:
        return result
    return replace(result, status=status, reasons=(first, *result.reasons))


def _measured(scan: ScanCloud, curved: CurvedFacets, T: Floats, params: Params, most: int = 0) -> Measured:
    """Measure movements of a scan placed by T (4, 4); of ``most`` points of it, if that is not 0."""
    step = max(1, -(-len(scan.points) // most)) if most else 1
    few = _cloud(scan, T, step, with_removed=not most)
    surface = curved.surface
    spacing = scan.spacing_mm * np.sqrt(step) if most else scan.resolved_mm
    diameter = params.projection_diameter_mm or m3c2.rounded(m3c2.diameter_for(POINTS_A_CORE, spacing))
    area = mesh_distance.area(surface.vertices, surface.faces)
    core_spacing = params.core_spacing_mm or max(CORE_SHARE * diameter, float(np.sqrt(area / MOST_CORE)))
    core = mesh_distance.sampled(surface.vertices, surface.faces, core_spacing)
    depth = params.max_depth_mm or _depth(few.points, surface)
    clouds = [few] if most or scan.large is None else large_cloud.Placed(scan.large, T)
    scanners = None if scan.scanners is None else rigid.apply(T, scan.scanners)
    moved, share, shared = surface_movement.movement(clouds, scanners, core, curved, diameter, depth)
    views = 0.0
    if scan.unnamed_views:
        # Each scanned point counts at ``overlap`` core points.
        variance = stable_fit.overlap(diameter, core_spacing) * moved.sd**2 / np.maximum(moved.count, 1)
        side = CELL_DIAMETERS * diameter
        views = view_error_from_opposite_sides.view_sd(core.points, core.normals, moved.along, variance, side)
    return Measured(
        core=core, moved=moved, shared=np.hypot(shared, views), views=views, diameter=diameter, spacing=core_spacing,
        depth=depth, on_surface=share,
    )  # fmt: skip


def _cloud(scan: ScanCloud, T: Floats, step: int, with_removed: bool) -> Cloud:
    """Return every k-th point of a scan placed by T (4, 4), and what was removed as outliers, or not."""
    points = np.concatenate([scan.points, scan.removed]) if with_removed else scan.points[::step]
    view = scan.view if with_removed else scan.view[: len(scan.points) : step]
    return Cloud(rigid.apply(T, points), np.arange(len(points)) >= len(scan.points), view)


def _fits(measured: Measured, params: Params) -> Fits:
    m = measured
    return stable_fit.fits(m.core, m.moved, m.diameter, m.spacing, params.seed, m.views)


def _fitted_pose(scan: ScanCloud, curved: CurvedFacets, placed: Placed, params: Params) -> Floats:
    """Return the pose (4, 4) of the fit that is wanted; that of the registration where the fit is not determined."""
    T = placed.T
    for _ in range(FIT_ROUNDS):
        found = _fits(_measured(scan, curved, T, params, FIT_POINTS), params)
        if not found.determined:
            return placed.T
        T = rigid.invert(found.of(params.fit).motion) @ T
    return T


def _corrected(measured: Measured, fits: Fits, placed: Placed, params: Params) -> tuple[Measured, Fits, Placed]:
    """Move a scan by what is left of the fit that is wanted, which was found with fewer points."""
    motion = fits.of(params.fit).motion
    left, back = _displaced(measured.core, motion), rigid.invert(motion)
    best, stable = (replace(fit, motion=back @ fit.motion) for fit in (fits.best, fits.stable))
    return (
        replace(measured, moved=replace(measured.moved, along=measured.moved.along - left)),
        replace(fits, best=best, stable=stable),
        replace(placed, T=back @ placed.T),
    )


class RegistrationError(NamedTuple):
    """What the pose adds to LOD95: one standard deviation ``sd`` (mm) along the normals, and the ``source`` of it.

    ``offset`` (k,) is by how much the pose given displaces each core point along its normal, relative to the steel that
    stands still; 0 where the scan was registered, or where the error of its frame was stated.
    """

    sd: float
    source: ErrorSource
    offset: Floats

    @property
    def total(self) -> float:
        """Rms of both over the core points, mm."""
        return float(np.sqrt(self.sd**2 + np.mean(self.offset**2))) if len(self.offset) else self.sd


def registration_error(measured: Measured, fits: Fits, placed: Placed, params: Params) -> RegistrationError:
    """Return the error of the pose.

    Nothing tells an error of the frame as given from a movement of the whole structure. Unless the error is stated,
    the motion of the steel that stands still is therefore taken as an error of the pose; where less than half of the
    steel agrees with that motion, it does so only if a registration may be that far off.
    """
    core, covariance = measured.core, placed.covariance
    known, none = np.isfinite(measured.moved.along), np.zeros(len(measured.core.points))
    if np.isfinite(params.registration_error_mm):
        return RegistrationError(params.registration_error_mm, ErrorSource.GIVEN, none)
    given = placed.registration is Registration.AS_GIVEN
    fit = fits.of(params.fit)
    if np.isfinite(fit.error_mm):
        sd, motion = fit.error_mm, fit.motion
    elif np.isfinite(covariance).all() and known.any():
        # Rms over the core points of the standard deviation along their normals
        J = distance_derivative(core.points[known], core.normals[known])
        sd = float(np.sqrt(np.mean(variances(J, covariance))))
        motion = placed.T @ rigid.invert(placed.T_best_fit)
    else:
        return RegistrationError(0.0, ErrorSource.UNKNOWN, none)
    if not given or not np.isfinite(motion).all():
        return RegistrationError(sd, ErrorSource.COVARIANCE, none)
    offset = np.where(known, _displaced(core, motion), 0.0)
    stands_still = fit.share >= HALF or np.sqrt(np.mean(offset**2)) <= FARTHEST_FRAME_MM
    return RegistrationError(sd, ErrorSource.STILL if stands_still else ErrorSource.COVARIANCE, offset * stands_still)


def _displaced(core: Samples, motion: Floats) -> Floats:
    """Return by how much a motion (4, 4) displaces core points along their normals (k,)."""
    left: Floats = np.einsum("ni,ni->n", rigid.apply(motion, core.points) - core.points, core.normals)
    return left


def distances(measured: Measured, registered: RegistrationError) -> Distances:
    """Distances at core points with LOD95."""
    moved = measured.moved
    number = np.maximum(moved.count, 1)
    random = np.sqrt(measured.shared**2 + moved.sd**2 / number) + registered.sd
    return Distances(
        distance=moved.along,
        lod95=m3c2.Z95 * random + np.abs(registered.offset),
        n1=moved.count,
        n2=moved.count,
        std1=measured.shared * np.sqrt(number),
        std2=moved.sd,
    )


def _depth(points: Floats, surface: MeshSurface) -> float:
    """Return how far from the design's surface points (n, 3) are compared with it."""
    face, distance, beyond = surface.distances(thinned(points, DEPTH_POINTS), REACH_MM)
    known = np.abs(distance[mesh_distance.on_face(face, beyond)])
    if not len(known):
        return LEAST_DEPTH_MM
    return float(np.clip(m3c2.rounded(DEPTH_TIMES * float(np.quantile(known, DEPTH_SHARE))), LEAST_DEPTH_MM, REACH_MM))


def _result(
    scan: ScanCloud,
    placed: Placed,
    measured: Measured,
    registered: RegistrationError,
    fits: Fits,
    origin: Floats,
    params: Params,
) -> Result:
    core, distance = measured.core, distances(measured, registered)
    total = distance_summary.of_distances(
        distance, core.points, core.normals, measured.diameter, m3c2.PAPER_POINTS_A_CYLINDER
    )
    points = CorePoints(points=core.points, normals=core.normals, **vars(distance))
    if not fits.determined and placed.registration is Registration.AS_GIVEN:
        best = _shifted(scan, placed.T, placed.T_best_fit)
    else:
        best = _shifted(scan, placed.T, rigid.invert(fits.best.motion) @ placed.T)
    stable = _shifted(scan, placed.T, rigid.invert(fits.stable.motion) @ placed.T)
    status, reasons = _status(placed, fits, total, params, (best, stable))
    reasons += _of_pose(measured, registered, fits, params) if total.core_points > total.without_lod else ()
    reasons += _of_views(scan, placed, measured)
    if scan.unposed > 1:
        reasons.append(reason("deviation.unposed-scans", scans=scan.unposed))
    known = distance.std2[np.isfinite(distance.lod95)]
    area = 1e-6 * measured.spacing**2 * float(np.isfinite(measured.moved.along).sum())
    covariance, half = _uncertainty(scan, placed, measured, fits, registered, params)
    return Result(
        status=status,
        method=params.method,
        reasons=tuple(reasons),
        T_design_scan=global_pose(placed.T, scan.origin, origin),
        registration=placed.registration,
        registration_error=registered.total,
        registration_error_from=registered.source,
        covariance=rigid.about_origin(covariance, origin),
        T_best_fit=global_pose(best.T, scan.origin, origin),
        best_fit_shift=best.shift,
        best_fit_turn=best.turn,
        best_fit_area=area,
        T_stable_fit=global_pose(stable.T, scan.origin, origin),
        stable_fit_shift=stable.shift,
        stable_fit_turn=stable.turn,
        stable_fit_area=area * fits.stable.share,
        stable_fit_share=fits.stable.share,
        stable_fit_limit=fits.limit_mm,
        ambiguity=placed.ambiguity,
        spacing=scan.spacing_mm if scan.large is None else scan.large.spacing_mm,
        sigma=float(np.median(known)) if len(known) else float("nan"),
        points_read=scan.read,
        points_kept=scan.kept,
        on_surface_share=measured.on_surface,
        projection_diameter=measured.diameter,
        max_depth=measured.depth,
        origin=origin,
        core=points,
        mean_ci95=total.mean + half * np.array([-1.0, 1.0]),
        **result_fields.statistics(points, total),
    )


def _uncertainty(
    scan: ScanCloud, placed: Placed, measured: Measured, fits: Fits, registered: RegistrationError, params: Params
) -> tuple[Floats, float]:
    """Return the covariance (6, 6) of the pose, and half the 95 % interval of the mean, with what scans share."""
    core, offset = measured.core, registered.offset
    covariance = fits.of(params.fit).covariance if fits.determined else placed.covariance
    common = scanner_class_errors.pose_covariance(core.points)
    if placed.registration is not Registration.AS_GIVEN:
        covariance = covariance + common
        common = covariance if np.isfinite(covariance).all() else common
    elif offset.any():
        T = fits.of(params.fit).motion if fits.determined else placed.T @ rigid.invert(placed.T_best_fit)
        off = np.concatenate([rigid.vector_from_rotation(T[:3, :3]), T[:3, 3]])
        covariance = covariance + np.outer(off, off)
    overlap = stable_fit.overlap(measured.diameter, measured.spacing)
    sd = mean_uncertainty.mean_sd(scan, placed.T, core, measured.moved, common, overlap)
    known = np.isfinite(measured.moved.along)
    return covariance, m3c2.Z95 * sd + abs(float(offset[known].mean()) if known.any() else 0.0)


def _of_pose(measured: Measured, registered: RegistrationError, fits: Fits, params: Params) -> Iterator[Reason]:
    """Yield what the steel that stands still says of a pose that was given, and how the result depends on it."""
    if registered.source is ErrorSource.STILL:
        without = distances(measured, registered._replace(offset=0.0 * registered.offset))
        known = np.isfinite(without.lod95)
        left = (without.distance - registered.offset)[known]
        yield reason(
            "deviation.pose-error",
            rms=float(np.sqrt(np.mean(registered.offset[known] ** 2))),
            share=100.0 * float(np.mean(np.abs(left) > without.lod95[known])),
            least=float(left.min()),
            greatest=float(left.max()),
        )
    elif registered.source is ErrorSource.GIVEN and fits.determined:
        known = np.isfinite(measured.moved.along)
        fit = fits.of(params.fit)
        rms = float(np.sqrt(np.mean(_displaced(measured.core, fit.motion)[known] ** 2)))
        allowed = np.linalg.norm([registered.sd, fit.error_mm, scanner_class_errors.SHIFT_SD_MM])
        if rms > m3c2.Z95 * allowed:
            yield reason("deviation.frame-error-exceeded", rms=rms, sd=registered.sd)


def _of_views(scan: ScanCloud, placed: Placed, measured: Measured) -> Iterator[Reason]:
    """Yield what is taken of the errors that all views have in common, where these placed the scan."""
    if placed.registration is not Registration.AS_GIVEN:
        sizes = {"shift": scanner_class_errors.SHIFT_SD_MM, "offset": scanner_class_errors.known().offset_mm}
        if scan.unnamed_views:
            yield reason("deviation.views-by-class", **sizes)
        else:
            yield reason("deviation.stations-by-class", **sizes)
    if measured.views > 0.0:
        yield reason("deviation.views-differ", sd=measured.views)


class _Shifted(NamedTuple):
    """A pose T (4, 4), and by what it moves (3,) and turns the scan's middle relative to the pose that is used."""

    T: Floats
    shift: Floats
    turn: float

    @property
    def values(self) -> dict[str, float]:
        """The numbers of a reason."""
        x, y, z = self.shift.tolist()
        return {"x": x, "y": y, "z": z, "turn_mrad": 1000.0 * self.turn}


def _shifted(scan: ScanCloud, used: Floats, T: Floats) -> _Shifted:
    between = T @ rigid.invert(used)
    middle = rigid.apply(used, scan.points.mean(axis=0))
    return _Shifted(T, rigid.apply(between, middle) - middle, rigid.rotation_angle(between[:3, :3]))


def _status(
    placed: Placed, fits: Fits, total: Summary, params: Params, moves: tuple[_Shifted, _Shifted]
) -> tuple[Status, list[Reason]]:
    """Return the status, and its reasons: how the scan was registered."""
    if total.core_points == total.without_lod:
        share = 100.0 * placed.near_share
        return Status.FAILED, [reason("deviation.no-core-point", share=share, near_mm=NEAR_MM)]
    reasons: list[Reason] = []
    status = Status.OK
    best, stable = moves
    share = 100.0 * fits.stable.share
    if placed.registration is Registration.AS_GIVEN:
        if params.register == "none":
            reasons.append(reason("deviation.as-requested"))
        else:
            reasons.append(reason("deviation.as-given", share=100.0 * placed.near_share))
        if np.isfinite(best.turn):
            reasons.append(reason("deviation.best-fit-would-move", **best.values))
        if fits.determined:
            reasons.append(reason("deviation.stable-fit-would-move", share=share, **stable.values))
    elif not fits.determined:
        reasons.append(reason("deviation.best-fit"))
        if not np.isfinite(placed.T_best_fit).all():
            status = Status.WEAK
            reasons.append(reason("deviation.coarse-only"))
    elif params.fit == "stable":
        reasons.append(reason("deviation.stable-fit", share=share, **best.values))
    else:
        reasons.append(reason("deviation.best-fit"))
        reasons.append(reason("deviation.stable-fit-would-move", share=share, **stable.values))
    if placed.registration is not Registration.AS_GIVEN and fits.stable.share < HALF:
        status = Status.WEAK
        reasons.insert(0, reason("deviation.no-stable-half", share=share, limit_mm=fits.limit_mm))
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
