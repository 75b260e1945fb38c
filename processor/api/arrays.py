"""Functions on arrays: the sphere of a target, the pose of a scan in its design, M3C2 between two clouds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from processor.deviation import measure as deviation_measure
from processor.geometry import m3c2 as m3c2_distances
from processor.geometry import mesh_distance, normal_orientation, rigid
from processor.geometry.m3c2 import Distances
from processor.geometry.mesh_distance import MeshSurface
from processor.model import Floats, Reason, Status
from processor.registration import surface_registration
from processor.scene_cloud import MergedCloud
from processor.space_frame.params import Params
from processor.space_frame.result import Flag
from processor.space_frame.spheres import search_without_design

LEAST_EXTENT_MM = 2.0  # nothing that is scanned is smaller: the coordinates are in metres
LEAST_POINTS = 10
LEAST_SCAN_POINTS = 100
MOST_RATIO = 30.0  # of the extents of a scan and its design; beyond it the units differ
FACING_MARGIN = 0.1  # difference of shares of points that face the scanner between two poses


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
    """M3C2 at core points: ``core`` and ``normals`` (k, 3) beside the columns of :class:`Distances`."""

    core: Floats
    normals: Floats


@dataclass(frozen=True)
class Pose:
    """Pose of a scan in its design.

    ``T_design_scan`` (4, 4) maps the scan's coordinates to the design's, mm. ``covariance`` (6, 6): rotation about the
    design's axes in rad, translation in mm, for a small motion applied on the left; NaN where the points do not
    determine the pose. ``status``: ok; ambiguous = another pose fits about as well, ``rival`` (4, 4); weak = the points
    do not determine every motion; failed = most points are not at the design. ``rival`` is None without another pose.
    """

    T_design_scan: Floats
    covariance: Floats
    status: Status
    rival: Floats | None


def fit_sphere(points: npt.ArrayLike, radius: float | None = None, scanner: npt.ArrayLike | None = None) -> SphereFit:
    """Fit a sphere to the points of one target, some of which may lie on other things.

    A robust search finds the sphere; Gauss-Newton with Tukey's biweight then fits it. The residual is the orthogonal
    distance, or with ``scanner`` the difference of ranges along the ray, which has no bias where a sphere is partly
    seen. The covariance is that of an M-estimator (Huber and Ronchetti 2009, "Robust Statistics", 2nd ed.,
    Wiley, eq. 6.6).

    Parameters
    ----------
    points : (n, 3), mm; 10 or more.
    radius : known radius in mm, held; None = estimated.
    scanner : (3,) position of the scanner, or (n, 3) that of each point, in the points' frame; None = unknown.

    Returns
    -------
    The sphere, with a status; a failed fit is a result, not an error.

    Raises
    ------
    ValueError : wrong shape, NaN, too few points, or coordinates that seem to be in metres.
    """
    cloud = _points(points, "points", LEAST_POINTS)
    if radius is not None and (isinstance(radius, str) or not 0.0 < radius < np.inf):
        raise ValueError(f"radius: expected a positive length in mm, got {radius!r}")
    origin = cloud.mean(axis=0)
    seen_from = None
    if scanner is not None:
        seen_from = _positions(scanner, "scanner", cloud.shape) - origin
    params = Params(radius_mm=float("nan") if radius is None else float(radius), max_balls=1)
    measured = search_without_design.search(MergedCloud(cloud - origin, origin, seen_from), params)
    balls = measured.balls
    if not len(balls):
        return SphereFit(
            centre=np.full(3, np.nan),
            radius=float("nan"),
            covariance=np.full((4, 4), np.nan),
            status=Status.FAILED,
            reasons=measured.reasons,
            points=0,
            rms=float("nan"),
        )
    return SphereFit(
        centre=balls.centres[0],
        radius=float(balls.radii[0]),
        covariance=balls.covariance[0],
        status=Status.OK if balls.flag[0] is Flag.OK else Status.WEAK,
        reasons=balls.reasons[0],
        points=int(balls.points[0]),
        rms=float(balls.rms[0]),
    )


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
        one is taken in which more of the surface faces the scanner. None = unknown.

    Returns
    -------
    The pose, with its covariance and status.

    Raises
    ------
    ValueError : wrong shapes, NaN, too few points, faces that name no vertex, points and mesh in different units.
    """
    cloud, corners = _points(points, "points", LEAST_SCAN_POINTS), _points(vertices, "vertices", 3)
    triangles = np.asarray(faces)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise ValueError(f"faces: expected an array (f, 3) of whole numbers, got {triangles.dtype} {triangles.shape}")
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(corners):
        raise ValueError(f"faces: expected numbers of vertices from 0 to {len(corners) - 1}")
    ratio = float(np.ptp(cloud, axis=0).max() / np.ptp(corners, axis=0).max())
    if not 1.0 / MOST_RATIO < ratio < MOST_RATIO:
        raise ValueError(f"points: {ratio:.3g} times as large as the mesh; expected both in mm")
    scan_origin, origin = cloud.mean(axis=0), corners.mean(axis=0)
    local = cloud - scan_origin
    surface = mesh_distance.of_design(corners - origin, triangles.astype(np.int64))
    given = rigid.transform(np.eye(3), scan_origin - origin)
    placed = surface_registration.place(local, surface, given, "auto")
    rival = placed.T_rival if placed.ambiguous else None
    if rival is not None and scanners is not None:
        seen_from = _positions(scanners, "scanners", cloud.shape) - scan_origin
        shares = [_facing_share(local, seen_from, surface, T) for T in (placed.T, rival)]
        if shares[1] > shares[0] + FACING_MARGIN:
            placed = surface_registration.place(local, surface, rival, "fine")
        rival = None if abs(shares[1] - shares[0]) > FACING_MARGIN else rival
    determined = bool(np.isfinite(placed.T_best_fit).all())
    T = placed.T_best_fit if determined else placed.T
    near, _ = surface.tree.query(rigid.apply(T, local), distance_upper_bound=surface_registration.NEAR_MM, workers=-1)
    if np.isfinite(near).mean() < surface_registration.NEAR_SHARE:
        status = Status.FAILED
    elif rival is not None:
        status = Status.AMBIGUOUS
    else:
        status = Status.WEAK if placed.weak or not determined else Status.OK
    return Pose(
        T_design_scan=deviation_measure.global_pose(T, scan_origin, origin),
        covariance=rigid.about_origin(placed.covariance, origin),
        status=status,
        rival=None if rival is None else deviation_measure.global_pose(rival, scan_origin, origin),
    )


def _facing_share(points: Floats, scanners: Floats, surface: MeshSurface, T: Floats) -> float:
    """Share of points (n, 3), placed by T (4, 4), whose facet faces the scanner, of those that lie on a facet."""
    placed = rigid.apply(T, points)
    facet, _, _ = surface.distances(placed, surface_registration.NEAR_MM)
    on = facet >= 0
    sight = rigid.apply(T, scanners)[on] - placed[on]
    facing = np.einsum("ni,ni->n", surface.normals[facet[on]], sight) > 0.0
    return float(facing.mean()) if on.any() else 0.0


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
    ValueError : wrong shapes, NaN, no points, lengths that are not positive or wider than the reference.
    """
    first, second = (_points(reference, "reference", 1, in_mm=False), _points(compared, "compared", 1, in_mm=False))
    places = first if core is None else _points(core, "core", 1, in_mm=False)
    _check_lengths(first, normal_diameter, projection_diameter, max_depth, registration_error)
    origin = first.mean(axis=0)
    local = places - origin
    grid = m3c2_distances.grid(first - origin, projection_diameter)
    if normals is None:
        fitted = m3c2_distances.normals(m3c2_distances.grid(first - origin, normal_diameter), local, normal_diameter)
        directions = normal_orientation.turned(fitted, local, normal_diameter, None).normals
    else:
        directions = _finite(normals, "normals")
        if directions.shape != places.shape:
            raise ValueError(
                f"normals: expected shape {places.shape}, one normal per core point; got {directions.shape}"
            )
    measured = m3c2_distances.distances(
        grid,
        m3c2_distances.grid(second - origin, projection_diameter),
        local,
        directions,
        projection_diameter_mm=projection_diameter,
        max_depth_mm=max_depth,
        registration_error_mm=registration_error,
    )
    return CorePoints(**vars(measured), core=places, normals=directions)


def _check_lengths(
    reference: Floats,
    normal_diameter: float,
    projection_diameter: float,
    max_depth: float,
    registration_error: float,
) -> None:
    if not 0.0 <= registration_error < np.inf:
        raise ValueError(f"registration_error: expected 0 or a positive length, got {registration_error}")
    for name, value in (
        ("normal_diameter", normal_diameter),
        ("projection_diameter", projection_diameter),
        ("max_depth", max_depth),
    ):
        if not 0.0 < value < np.inf:
            raise ValueError(f"{name}: expected a positive length, got {value}")
    extent = float(np.ptp(reference, axis=0).max())
    if projection_diameter > extent > 0.0:
        raise ValueError(
            f"projection_diameter: {projection_diameter:g} is wider than the reference, which spans {extent:g};"
            " expected lengths and coordinates in one unit"
        )


def _points(values: npt.ArrayLike, name: str, least: int, in_mm: bool = True) -> Floats:
    """Check an array of points, and with ``in_mm`` that they are not in metres."""
    points = _finite(values, name)
    if points.ndim != 2 or points.shape[1] != 3:
        unit = " in mm" if in_mm else ""
        raise ValueError(f"{name}: expected an array (n, 3) of coordinates{unit}, got shape {points.shape}")
    if len(points) < least:
        raise ValueError(f"{name}: expected {least} points or more, got {len(points)}")
    extent = float(np.ptp(points, axis=0).max())
    if in_mm and len(points) > 1 and extent < LEAST_EXTENT_MM:
        raise ValueError(
            f"{name}: span {extent:.4g}; expected coordinates in mm, these seem to be in metres: multiply them by 1000"
        )
    return points


def _positions(values: npt.ArrayLike, name: str, shape: tuple[int, ...]) -> Floats:
    """Return the scanner's position for each point: (3,) for all, or one of ``shape`` (n, 3)."""
    positions = _finite(values, name)
    if positions.shape not in ((3,), shape):
        raise ValueError(f"{name}: expected shape (3,) or {shape}, got {positions.shape}")
    return np.broadcast_to(positions, shape)


def _finite(values: Any, name: str) -> Floats:
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected numbers, got {type(values).__name__}") from None
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise ValueError(f"{name}: expected finite numbers, got {bad} of {array.size} that are NaN or infinite")
    return array
