"""Functions on arrays: the sphere of a target, the pose of a scan in its design, M3C2 between two clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from processor import scene_cloud, unit_ratio
from processor.adjustment import scanner_class_errors
from processor.api.argument_checks import (
    MOST_RATIO,
    extent_of,
    faces_of,
    length_of,
    normals_of,
    points_of,
    positions_of,
)
from processor.deviation import measure as deviation_measure
from processor.geometry import coincident_points, mesh_distance, normal_orientation, rigid
from processor.geometry import m3c2 as m3c2_distances
from processor.geometry.m3c2 import Distances
from processor.geometry.mesh_distance import MeshSurface
from processor.geometry.thread_ranges import one_blas_thread
from processor.model import Bools, Floats, Instrument, Reason, Status, instruments, reason
from processor.model.inputs import Place
from processor.registration import surface_registration
from processor.registration.surface_registration import Placed
from processor.scan_folder.text_files import read_toml
from processor.scene_cloud import MergedCloud
from processor.space_frame.design import unit_mistakes
from processor.space_frame.params import NAN, Params
from processor.space_frame.result import Flag
from processor.space_frame.spheres import search_without_design
from processor.space_frame.spheres.assessment import Row, missing
from processor.targets import sphere_of_crop

LEAST_POINTS = 10  # of a sphere: four determine it, and six are left to show whether it is one
LEAST_SCAN_POINTS = 100  # of a scan or cloud: the least that a registration uses
LEAST_RADIUS_MM = 1.0  # no target is smaller: the radius is in metres
MOST_RADIUS_SHARE = 5.0  # of the span of the points; a cap of a larger sphere cannot be told from a plane
LEAST_RANGE_MM = 100.0  # median distance of the points; no scanner measures nearer than that
LEAST_ANGLE = 1e-4  # rad, of the whole cloud seen from the scanner; no beam is as narrow
AWAY_COS, MOST_AWAY = -0.1, 0.05  # of the normals to the rays; share of a sphere's points that face away
ON_SPHERE = 3.0  # rms residuals
MOST_LENGTH_RATIO = 300.0  # of two lengths of M3C2; beyond it their units differ
CORE_FACTOR = 1000.0  # of metres and mm
CORE_COVERS, BESIDE = 0.5, 0.05  # shares of the reference's extent: least extent of core points, and room beside
UNITS_MM = (10.0, 25.4)  # cm and inches; larger ones are beyond MOST_RATIO
UNIT_TOLERANCE = 0.3  # of a ratio of sizes along the axes: a scan is turned, and covers about its design
LIKE_SIZE = 3.0  # ratio of sizes up to which nothing is stated


@dataclass(frozen=True)
class SphereFit:
    """A sphere in the points' frame: ``centre`` (3,) and ``radius`` in mm, ``covariance`` (4, 4) of x, y, z, radius.

    ``status``: ok; weak = found, but the ``reasons`` limit its use; failed = no sphere, and all numbers are NaN.
    ``points`` is the number of points that the fit uses, ``rms`` that of their residuals.
    """

    centre: Floats
    radius: float
    covariance: Floats
    status: Status
    reasons: tuple[Reason, ...]
    points: int
    rms: float


@dataclass(frozen=True)
class CorePoints(Distances):
    """M3C2 at core points: ``core`` and ``normals`` (k, 3) beside the columns of :class:`Distances`.

    ``reasons`` state which clouds have coincident points, which count once.
    """

    core: Floats
    normals: Floats
    reasons: tuple[Reason, ...] = ()


@dataclass(frozen=True)
class Pose:
    """Pose of a scan in its design.

    ``T_design_scan`` (4, 4) maps the scan's coordinates to the design's, mm. ``covariance`` (6, 6): rotation about the
    design's axes in rad, translation in mm, for a small motion applied on the left; NaN where the points do not
    determine the pose. ``status``: ok; ambiguous = another pose fits about as well, ``rival`` (4, 4); weak = the points
    do not determine every motion, or many are not at the design; failed = most are not. ``rival`` is None without
    another pose.
    ``reasons`` state why the status is not ok, and where the sizes of scan and mesh suggest different units.
    """

    T_design_scan: Floats
    covariance: Floats
    status: Status
    rival: Floats | None
    reasons: tuple[Reason, ...] = ()


@one_blas_thread()
def fit_sphere(
    points: npt.ArrayLike,
    radius: float | None = None,
    scanner: npt.ArrayLike | None = None,
    instrument: str | Path = "",
) -> SphereFit:
    """Fit a sphere to the points of one target, some of which may lie on other things.

    Spheres through four points, drawn from all, propose the sphere; where it is a small share of the points, patches
    of every size do. Gauss-Newton with Tukey's biweight then fits it. The residual is the orthogonal distance, or with
    ``scanner`` the difference of ranges along the ray, which has no bias where a sphere is partly seen. The covariance
    is that of an M-estimator (Huber and Ronchetti 2009, "Robust Statistics", 2nd ed., Wiley, eq. 6.6), with what
    beams at the limb add, by a second fit (by the other residual, or without the rays near the limb), with what
    neighbouring points share, and by the class of the scanner what its ranges have in common, and bias by incidence.

    Parameters
    ----------
    points : (n, 3), mm; 10 or more, of which fewer than 40 give a failed fit.
    radius : known radius in mm, held; None = estimated. Where the points have another one the covariance of the centre
        holds its effect; the status is weak if scanners do not explain it.
    scanner : (3,) position of the scanner, or (n, 3) that of each point, in the points' frame; None = unknown.
    instrument : "phase" (one sd 0.5 mm of range a view and 0.3 mm of bias at 60 degrees of incidence), "pulse" (0.6,
        0.36) or "long-range" (2.5, 1.5); the path of a scanner.toml; "" = as of phase.

    Returns
    -------
    The sphere, with a status; a failed fit is a result, not an error.

    Raises
    ------
    ValueError : wrong shape, NaN, too few points, points that coincide, coordinates in metres, a radius that the cloud
        cannot hold, a scanner that cannot have measured the points, no class. InputError: an unusable scanner.toml.
    """
    every = points_of(points, "points", LEAST_POINTS)
    cloud, used, coincident = _once(every, "points")
    held = None if radius is None else _radius(radius, extent_of(cloud))
    origin = cloud.mean(axis=0)
    seen_from = None
    if scanner is not None:
        seen_from = positions_of(scanner, "scanner", every.shape)[used] - origin
        _check_scanner(cloud - origin, seen_from)
    params = Params(radius_mm=float("nan") if held is None else held, max_balls=1)
    with scanner_class_errors.used(_instrument(instrument)):
        row = _measured(MergedCloud(cloud - origin, origin, seen_from), params, held)
        assumed = search_without_design.by_class()
    if row.sphere is None:
        return _no_sphere((*row.reasons, *coincident), held)
    fitted = SphereFit(
        centre=row.sphere.centre + origin,
        radius=row.sphere.radius,
        covariance=row.sphere.covariance,
        status=Status.OK if row.flag is Flag.OK else Status.WEAK,
        reasons=(*row.reasons, *assumed, *coincident),
        points=row.points,
        rms=row.rms,
    )
    if seen_from is not None and fitted.status is Status.OK:
        _check_faces(cloud - fitted.centre, seen_from + origin - fitted.centre, fitted)
    return fitted


def _instrument(name: str | Path) -> Sequence[Instrument]:
    if str(name) in instruments.class_names():
        return (instruments.of_class(str(name)),)
    if str(name).lower().endswith(".toml"):
        return (instruments.from_file(read_toml(Path(name)), Place(str(name))),)
    if str(name):
        raise ValueError(f"instrument: {instruments.unknown(str(name))}")
    return ()


def _no_sphere(reasons: tuple[Reason, ...], held: float | None) -> SphereFit:
    doubt = None if held is None else unit_mistakes.implausible(held)
    nowhere, unknown = np.full(3, np.nan), np.full((4, 4), np.nan)
    reasons = (*reasons, *(() if doubt is None else (doubt,)))
    return SphereFit(nowhere, float("nan"), unknown, Status.FAILED, reasons, points=0, rms=float("nan"))


def _once(points: Floats, name: str) -> tuple[Floats, Bools | slice, tuple[Reason, ...]]:
    """Return the points (m, 3) that count once, which of those given (n, 3) they are, and how many were left out."""
    used = coincident_points.used_once(points)
    if used is None:
        return points, slice(None), ()
    left_out = len(used) - int(np.count_nonzero(used))
    return points[used], used, (scene_cloud.coincident(left_out, len(used), name),)


def _measured(cloud: MergedCloud, params: Params, held: float | None) -> Row:
    """Return the sphere that fills most of a cloud, else the one that is found in it, else one that is only likely.

    That may be another body, or be moved by what touches it.
    """
    found = sphere_of_crop.find(cloud.points, search_without_design.fewest_points(params), held, cloud.scanner)
    if found is None or not found.certain:
        balls = search_without_design.detected(cloud, params)
        if balls:
            return search_without_design.fitted(0, balls[0], cloud, params)
        if found is None:
            return missing(0, NAN, 0, search_without_design.no_ball(cloud, params))
    row = search_without_design.fitted(0, found, cloud, params)
    if found.certain:
        return row
    return replace(row, flag=Flag.LOW_CONFIDENCE, reasons=(*row.reasons, reason("spheres.not-only-sphere")))


def _radius(radius: Any, extent: float) -> float:
    """Return a radius in mm. Raises ValueError where points that span ``extent`` mm cannot be of such a sphere."""
    length = length_of(radius, "radius")
    if length < LEAST_RADIUS_MM:
        raise ValueError(
            f"radius: expected the radius of a target in mm, got {length:g}; it seems to be in metres: multiply by 1000"
        )
    if length > MOST_RADIUS_SHARE * extent:
        raise ValueError(
            f"radius: expected at most {MOST_RADIUS_SHARE:g} times the span of the points, {extent:.4g} mm, got"
            f" {length:g}; radius and points are expected in mm"
        )
    return length


def _check_scanner(points: Floats, scanner: Floats) -> None:
    """Raise ValueError for positions (n, 3) from where no scanner can have measured the points (n, 3)."""
    distance, extent = float(np.median(np.linalg.norm(points - scanner, axis=1))), extent_of(points)
    if distance < LEAST_RANGE_MM:
        raise ValueError(
            f"scanner: expected a position in mm in the points' frame, got one {distance:.4g} mm from the points"
            " (median); no scanner measures that near: is it in metres?"
        )
    if extent < LEAST_ANGLE * distance:
        raise ValueError(
            f"scanner: expected a position in mm in the points' frame, got one {distance:.4g} mm from the points, which"
            f" span {extent:.4g} mm; no scanner distinguishes points so close together from there: is it in metres?"
        )


def _check_faces(points: Floats, scanner: Floats, sphere: SphereFit) -> None:
    """Raise ValueError where many points on a sphere about (0, 0, 0) face away from the positions (n, 3) given."""
    height = np.linalg.norm(points, axis=1)
    # Of what touches the sphere more is seen, as it lies farther out.
    on = (height < sphere.radius + sphere.rms) & (height > sphere.radius - ON_SPHERE * sphere.rms)
    normal, sight = points[on] / height[on, None], (scanner - points)[on]
    cosine = np.einsum("ni,ni->n", normal, sight) / np.linalg.norm(sight, axis=1)
    limb = AWAY_COS - ON_SPHERE * sphere.rms / sphere.radius  # noise takes points at the limb beyond it
    away = float((cosine < limb).mean()) if on.any() else 0.0
    if away > MOST_AWAY:
        raise ValueError(
            f"scanner: expected the position in mm in the points' frame from where they were measured, but"
            f" {100.0 * away:.0f} % of the points on the sphere face away from the one given; of several stations give"
            " (n, 3), the position of each point"
        )


@one_blas_thread()
def register(
    points: npt.ArrayLike, vertices: npt.ArrayLike, faces: npt.ArrayLike, scanners: npt.ArrayLike | None = None
) -> Pose:
    """Register a scan to the mesh of its design, from any pose.

    A scan that lies at the design is fitted from there; else principal axes give the coarse pose in every attitude that
    they allow (paper 002, section 2.3). The best is refined by robust point-to-surface least squares.

    Parameters
    ----------
    points : (n, 3), mm, of a scan; 100 or more.
    vertices, faces : (v, 3) in mm and (f, 3), a triangle mesh whose normals point outward.
    scanners : (3,) or (n, 3), from where each point was measured, in the points' frame. Of two poses that fit alike the
        one is taken in which the surface faces the scanner. None = unknown.

    Returns
    -------
    The pose, with its covariance and status.

    Raises
    ------
    ValueError : wrong shapes, NaN, too few points, faces that name no vertex or have no area, points and mesh in
        different units.
    """
    every, corners = points_of(points, "points", LEAST_SCAN_POINTS), points_of(vertices, "vertices", 3)
    cloud, used, coincident = _once(every, "points")
    triangles = faces_of(faces, corners, mesh_distance.LEAST_AREA)
    ratio = extent_of(cloud) / extent_of(corners[np.unique(triangles)])
    if not 1.0 / MOST_RATIO < ratio < MOST_RATIO:
        raise ValueError(f"points: {ratio:.3g} times as large as the mesh; expected both in mm")
    scan_origin, origin = cloud.mean(axis=0), corners.mean(axis=0)
    local = cloud - scan_origin
    seen_from = None if scanners is None else positions_of(scanners, "scanners", every.shape)[used] - scan_origin
    surface = mesh_distance.of_design(corners - origin, triangles)
    given = rigid.transform(np.eye(3), scan_origin - origin)
    placed = surface_registration.place(local, surface, given, "auto", seen_from)
    determined = bool(np.isfinite(placed.T_best_fit).all())
    T = placed.T_best_fit if determined else placed.T
    body = local if placed.of_body is None else local[placed.of_body]
    status, reasons = _assessed(body, surface, T, placed)
    if status is not Status.OK and not 1.0 / LIKE_SIZE < ratio < LIKE_SIZE:
        reasons = (*reasons, _sizes(ratio))
    return Pose(
        T_design_scan=deviation_measure.global_pose(T, scan_origin, origin),
        covariance=rigid.about_origin(placed.covariance, origin),
        status=status,
        rival=deviation_measure.global_pose(placed.T_rival, scan_origin, origin) if placed.ambiguous else None,
        reasons=(*reasons, *coincident),
    )


def _assessed(points: Floats, surface: MeshSurface, T: Floats, placed: Placed) -> tuple[Status, tuple[Reason, ...]]:
    """Return the status of points (n, 3), without ground and walls, placed by T (4, 4), and why it is not ok."""
    share = surface_registration.near_share(points, surface, T)
    if share < surface_registration.NEAR_SHARE:
        near_mm = surface_registration.NEAR_MM
        return Status.FAILED, (reason("register.not-at-mesh", share=100.0 * share, near_mm=near_mm),)
    reasons = []
    if share < 1.0 - surface_registration.CLUTTER_SHARE:
        elsewhere = 100.0 * (1.0 - share)
        reasons.append(reason("register.points-elsewhere", share=elsewhere, near_mm=surface_registration.NEAR_MM))
    if placed.ambiguous:
        reasons.append(reason("register.ambiguous"))
    if not np.isfinite(placed.T_best_fit).all():
        reasons.append(reason("register.undetermined"))
    elif placed.weak:
        reasons.append(reason("deviation.weak", motions=placed.weak))
    status = Status.AMBIGUOUS if placed.ambiguous else Status.WEAK if reasons else Status.OK
    return status, tuple(reasons)


def _sizes(ratio: float) -> Reason:
    """Return the reason of a scan ``ratio`` times as large as its mesh, with the unit that would explain it."""
    unit_mm = unit_ratio.nearest_factor(max(ratio, 1.0 / ratio), UNITS_MM, UNIT_TOLERANCE)
    if unit_mm is None:
        return reason("register.sizes-differ", ratio=ratio)
    return reason("register.unit-mistake", ratio=ratio, unit_mm=unit_mm)


@one_blas_thread()
def m3c2(
    reference: npt.ArrayLike,
    compared: npt.ArrayLike,
    core: npt.ArrayLike | None = None,
    *,
    normal_diameter: float,
    projection_diameter: float,
    max_depth: float,
    registration_error: float = 0.0,
    normals: npt.ArrayLike | None = None,
) -> CorePoints:
    """Measure distances between two clouds along local normals, each with its level of detection.

    Lague, Brodu and Leroux (2013), cited in full in :mod:`processor.geometry.m3c2`; LOD95 as in paper 002, eq. 10.

    Parameters
    ----------
    reference, compared : (n, 3) and (m, 3), in one unit, mm as a rule.
    core : (k, 3), where distances are measured; None = at every point of the reference.
    normal_diameter : of the sphere that a normal is fitted in.
    projection_diameter : of the cylinder whose points are averaged.
    max_depth : of the cylinder, to either side of the core point.
    registration_error : one standard deviation, as a length, in LOD95.
    normals : (k, 3) unit normals at the core points; None = fitted to the reference. Fitted normals are turned towards
        +z; those of upright surfaces as :mod:`processor.geometry.normal_orientation` states.

    Returns
    -------
    ``distance`` (k,), compared minus reference along the normal, NaN without points; ``lod95`` (k,), NaN with fewer
    than four points of either cloud; ``significant`` (k,), ``n1``, ``n2``, ``std1``, ``std2``, ``core``, ``normals``.

    Raises
    ------
    ValueError : wrong shapes, NaN, no points, lengths that are not positive or wider than the reference, normals that
        are not of length 1, clouds of different units, and no core point with points of both clouds within reach.
    """
    first, second = points_of(reference, "reference", 1, in_mm=False), points_of(compared, "compared", 1, in_mm=False)
    places = first if core is None else points_of(core, "core", 1, in_mm=False)
    normal_diameter, projection_diameter, max_depth = _lengths(
        {"normal_diameter": normal_diameter, "projection_diameter": projection_diameter, "max_depth": max_depth}
    )
    error = length_of(registration_error, "registration_error", zero=True, unit="")
    given = None if normals is None else normals_of(normals, places.shape)
    _check_units(first, second, places, projection_diameter)
    first, _, of_first = _once(first, "reference")
    second, _, of_second = _once(second, "compared")
    origin = first.mean(axis=0)
    directions = _fitted_normals(first - origin, places - origin, normal_diameter) if given is None else given
    measured = m3c2_distances.distances(
        m3c2_distances.grid(first - origin, projection_diameter),
        m3c2_distances.grid(second - origin, projection_diameter),
        places - origin,
        directions,
        projection_diameter_mm=projection_diameter,
        max_depth_mm=max_depth,
        registration_error_mm=error,
    )
    _check_reach(measured)
    return CorePoints(**vars(measured), core=places, normals=directions, reasons=(*of_first, *of_second))


def _lengths(given: dict[str, Any]) -> list[float]:
    """Return the lengths. Raises ValueError where one must be in another unit; a depth may be as great as one likes."""
    lengths = {name: length_of(value, name, unit=" in the unit of the coordinates") for name, value in given.items()}
    for name, other in (
        ("max_depth", "projection_diameter"),
        ("projection_diameter", "normal_diameter"),
        ("normal_diameter", "projection_diameter"),
    ):
        if lengths[name] * MOST_LENGTH_RATIO < lengths[other]:
            raise ValueError(
                f"{name}: {lengths[name]:g} is less than 1/{MOST_LENGTH_RATIO:g} of {other}, {lengths[other]:g};"
                " expected lengths of one unit"
            )
    return list(lengths.values())


def _fitted_normals(reference: Floats, core: Floats, normal_diameter: float) -> Floats:
    """Fit normals (k, 3) at core points (k, 3). Raises ValueError where there is none."""
    fitted = m3c2_distances.normals(m3c2_distances.grid(reference, normal_diameter), core, normal_diameter)
    if not np.isfinite(fitted.normals).any():
        raise ValueError(
            f"normal_diameter: within {normal_diameter:g} no core point has enough points of the reference; expected"
            " core points on the reference, and lengths and coordinates in one unit"
        )
    return normal_orientation.turned(fitted, core, normal_diameter, None).normals


def _check_reach(measured: Distances) -> None:
    """Raise ValueError where no core point has points of both clouds."""
    if not ((measured.n1 > 0) & (measured.n2 > 0)).any():
        raise ValueError(
            f"core: none of the {len(measured.n1)} core points has points of both clouds within reach (the reference at"
            f" {np.count_nonzero(measured.n1)}, compared at {np.count_nonzero(measured.n2)}); expected clouds of one"
            " place, in one frame, and lengths and coordinates in one unit"
        )


def _check_units(reference: Floats, compared: Floats, core: Floats, projection_diameter: float) -> None:
    """Raise ValueError where sizes show that clouds, core points or lengths are in different units."""
    extent, other, of_core = extent_of(reference), extent_of(compared), extent_of(core)
    if projection_diameter > extent > 0.0:
        raise ValueError(
            f"projection_diameter: {projection_diameter:g} is wider than the reference, which spans {extent:g};"
            " expected lengths and coordinates in one unit"
        )
    if extent > 0.0 and other > 0.0 and not 1.0 / MOST_RATIO < other / extent < MOST_RATIO:
        raise ValueError(
            f"compared: spans {other:.4g}, the reference {extent:.4g}; expected clouds of one unit and about one size:"
            " cut the larger to where the other is"
        )
    lower, upper = reference.min(axis=0) - BESIDE * extent, reference.max(axis=0) + BESIDE * extent
    for factor in (CORE_FACTOR, 1.0 / CORE_FACTOR):
        inside = (factor * core >= lower) & (factor * core <= upper)
        if of_core > 0.0 and inside.all() and CORE_COVERS * extent < factor * of_core:
            raise ValueError(
                f"core: spans {of_core:.4g}, the reference {extent:.4g}; core points times {factor:g} lie all over it:"
                " expected coordinates of one unit"
            )
