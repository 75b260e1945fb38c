"""Functions on arrays: the sphere of a target, the pose of a scan in its design, M3C2 between two clouds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from processor.geometry import m3c2 as m3c2_distances
from processor.geometry import normal_orientation
from processor.geometry.m3c2 import Distances
from processor.geometry.merging import MergedCloud
from processor.model import Floats, Reason, Status
from processor.space_frame.params import Params
from processor.space_frame.spheres import isolated

LEAST_EXTENT_MM = 2.0  # nothing that is scanned is smaller: the coordinates are in metres
LEAST_POINTS = 10


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


def fit_sphere(points: npt.ArrayLike, radius: float | None = None, scanner: npt.ArrayLike | None = None) -> SphereFit:
    """Fit a sphere to the points of one target, some of which may lie on other things.

    A robust search finds the sphere; Gauss-Newton with Tukey's biweight then fits it. The residual is the orthogonal
    distance, or with ``scanner`` the difference of ranges along the ray, which has no bias where a sphere is partly
    seen. The covariance is that of an M-estimator (Huber and Ronchetti 2009, eq. 6.6).

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
    if radius is not None and not 0.0 < radius < np.inf:
        raise ValueError(f"radius: expected a positive length in mm, got {radius}")
    origin = cloud.mean(axis=0)
    seen_from = None
    if scanner is not None:
        seen_from = np.broadcast_to(_finite(scanner, "scanner"), cloud.shape) - origin
    params = Params(radius_mm=float("nan") if radius is None else float(radius), max_balls=1)
    found = isolated.search(MergedCloud(cloud - origin, origin, seen_from), params)
    if not len(found.radii):
        return SphereFit(
            centre=np.full(3, np.nan),
            radius=float("nan"),
            covariance=np.full((4, 4), np.nan),
            status=Status.FAILED,
            reasons=(),
            points=0,
            rms=float("nan"),
        )
    return SphereFit(
        centre=found.centres[0],
        radius=float(found.radii[0]),
        covariance=found.covariance[0],
        status=Status.OK if found.flag[0] == "ok" else Status.WEAK,
        reasons=(),
        points=int(found.points[0]),
        rms=float(found.rms[0]),
    )


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

    Lague, Brodu and Leroux (2013); LOD95 as in paper 002, eq. 10.

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
    ValueError : wrong shapes, NaN, no points, diameters that are not positive or wider than the reference, which
        indicates another unit.
    """
    first, second = _points(reference, "reference", 1), _points(compared, "compared", 1)
    places = first if core is None else _points(core, "core", 1)
    _check_lengths(first, normal_diameter, projection_diameter, max_depth)
    origin = first.mean(axis=0)
    local = places - origin
    grid = m3c2_distances.grid(first - origin, projection_diameter)
    if normals is None:
        fitted = m3c2_distances.normals(m3c2_distances.grid(first - origin, normal_diameter), local, normal_diameter)
        directions = normal_orientation.turned(fitted, local, normal_diameter, None).normals
    else:
        directions = _finite(normals, "normals")
        if directions.shape != places.shape:
            raise ValueError(f"normals: expected shape {places.shape}, one normal a core point; got {directions.shape}")
    found = m3c2_distances.distances(
        grid,
        m3c2_distances.grid(second - origin, projection_diameter),
        local,
        directions,
        projection_diameter_mm=projection_diameter,
        max_depth_mm=max_depth,
        registration_error_mm=registration_error,
    )
    return CorePoints(**vars(found), core=places, normals=directions)


def _check_lengths(reference: Floats, normal_diameter: float, projection_diameter: float, max_depth: float) -> None:
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


def _points(values: npt.ArrayLike, name: str, least: int) -> Floats:
    """Check an array of points."""
    points = _finite(values, name)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected an array (n, 3) of coordinates in mm, got shape {points.shape}")
    if len(points) < least:
        raise ValueError(f"{name}: expected {least} points or more, got {len(points)}")
    extent = float(np.ptp(points, axis=0).max())
    if len(points) > 1 and extent < LEAST_EXTENT_MM:
        raise ValueError(
            f"{name}: span {extent:.4g}; expected coordinates in mm, these seem to be in metres: multiply them by 1000"
        )
    return points


def _finite(values: Any, name: str) -> Floats:
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected numbers, got {type(values).__name__}") from None
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise ValueError(f"{name}: expected finite numbers, got {bad} of {array.size} that are NaN or infinite")
    return array
