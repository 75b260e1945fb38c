"""Spheres searched for in a whole cloud, without a design and without members, and fitted robustly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from processor.adjustment import residual_correlation, scanner_class_errors
from processor.adjustment.processing import point_processing
from processor.distinct_rows import distinct_points
from processor.geometry import coincident_points
from processor.geometry.sphere import Sphere, algebraic, lengths, sphere_cells
from processor.geometry.sphere_fit import LEAST_SCALE, RobustFit, bound, robust_fit
from processor.model import NORMAL_95, Floats, Reason, Status, Tolerance, reason
from processor.robust_statistics import TUKEY, biweight
from processor.scene_cloud import MergedCloud
from processor.space_frame.params import NAN, Params
from processor.space_frame.result import Flag, Result
from processor.space_frame.spheres import sphere_detection
from processor.space_frame.spheres.assessment import DOWN, LARGEST_SCALE, Row, as_result, assessed, generator, missing

COARSE_MM = 1.0  # rounding to it adds noise of 0.3 mm, as much as that of a good scanner
LEAST_ONE_SIDED = 0.2  # length of the mean of normals; 0.5 of half a sphere, 0 of one seen from all around
FAR_RADII = 1e4  # of a scanner that is not known: rays are parallel to 1e-4 rad
GRAZING_COS = 1e-3  # least cosine to the side that a sphere was seen from: its inverse must be finite
STEEP_COS = 0.5  # of the incidence of a ray
MOST_CELLS = 60  # of a sphere, else half as many: enough for correlations, and the time goes with the cube
FIRST_SCALE = 2.0  # of the second fit, in scales of the first: ranges scatter more than distances
LARGEST_CELL = 0.1  # of the radius: rms by stated sd 1.1 at 0.08 of it, 1.5 at 0.11, caps of 30 %, noise of 2 mm
THINNED = 2.0  # standard deviations: 1.7 measured of caps of 15 %, noise of 2 mm, cells of 8 mm
CHANCE = 3.29  # standard deviations: 0.1 % of right radii are farther from a measured one


def search(cloud: MergedCloud, params: Params) -> Result:
    """Search a cloud for spheres that stand out of it by themselves."""
    return _measured(detected(cloud, params), cloud, params)


def detected(cloud: MergedCloud, params: Params) -> list[sphere_detection.Ball]:
    """Return the spheres that stand out of a cloud."""
    # fixed: the result must not depend on the seed
    fixed = generator(replace(params, seed=0), "search")
    least, held = fewest_points(params), _held(params)
    return sphere_detection.find_balls(cloud.points, fixed, params.max_balls, least, held, cloud.scanner)


def fewest_points(params: Params) -> int:
    """Return the fewest points on a sphere."""
    return max(params.min_points, sphere_detection.LEAST_POINTS)


def no_ball(cloud: MergedCloud, params: Params) -> Reason:
    """Return why there is no sphere in a cloud."""
    count, least = len(cloud.points), fewest_points(params)
    if count < least:
        return reason("spheres.too-few-for-ball", points=count, least=least)
    if (step := coincident_points.rounding_of(cloud.points)) >= COARSE_MM:
        return reason("spheres.coordinates-rounded", step=step)
    return reason("spheres.no-ball", points=count)


def _measured(found: list[sphere_detection.Ball], cloud: MergedCloud, params: Params) -> Result:
    """Return the result of spheres found in a cloud, fitted by the method."""
    if not found:
        return Result(Status.FAILED, params.method, (no_ball(cloud, params),))
    rows = [fitted(id_, candidate, cloud, params) for id_, candidate in enumerate(found)]
    messages = [reason("spheres.searched")]
    if params.method == "least-squares":
        messages.append(reason("spheres.algebraic-fit"))
    elif cloud.scanner is None:
        messages.append(reason("spheres.robust-distances"))
    else:
        messages.append(reason("spheres.robust-ranges"))
    if params.method != "least-squares":
        messages += by_class()
    radius = _held(params)
    if radius is not None:
        messages.append(reason("spheres.radius-held", radius=radius))
    complete = len(found) < params.max_balls
    if not complete:
        messages.append(reason("spheres.most-balls", balls=len(found)))
    result = as_result(rows, cloud.origin, params, tuple(messages), complete)
    return _with_bounds(result, rows) if params.method == "ray" else result


def by_class() -> tuple[Reason, ...]:
    """Return what is assumed of a scanner whose class is not stated."""
    if scanner_class_errors.stated():
        return ()
    assumed = scanner_class_errors.known()
    return (reason("spheres.instrument-assumed", view=assumed.view_mm, incidence=assumed.incidence_mm),)


def _held(params: Params) -> float | None:
    return None if np.isnan(params.radius_mm) else params.radius_mm


def fitted(id_: int, candidate: sphere_detection.Ball, cloud: MergedCloud, params: Params) -> Row:
    """Return a sphere of a cloud with its covariance, flag and reasons."""
    on = cloud.points[candidate.fit.inliers]
    sphere: Sphere | None = candidate.fit.sphere
    if params.method == "least-squares":
        sphere = algebraic(on)
    if sphere is None:
        return missing(id_, NAN, len(on), reason("spheres.no-sphere"))
    off = on - candidate.fit.sphere.centre
    distance = lengths(off)
    trace = point_processing.recognised(on, (off / distance[:, None], distance - candidate.fit.sphere.radius))
    doubts: list[Reason] = []
    remarks = trace.reasons("points")
    wrong = trace.unbounded or trace.cell > LARGEST_CELL * candidate.fit.sphere.radius
    if params.method != "least-squares":
        widened = _widened(cloud, candidate.fit, _held(params) is not None)
        if widened is None:
            doubts.append(reason("spheres.unknown-side") if cloud.scanner is None else reason("spheres.at-limb"))
        else:
            # Cells that hold one point give far points the weight of many near ones.
            times = THINNED**2 if trace.cell > 0.0 else 1.0
            fitted = candidate.fit.sphere.covariance
            sphere = replace(widened, covariance=fitted + times * (widened.covariance - fitted))
        if _held(params) is not None:
            moved, other_radius, doubted = _by_free_radius(cloud, candidate.fit)
            sphere = sphere.widened_by(moved)
            remarks, wrong = (*remarks, *other_radius), wrong or doubted
    row = assessed(id_, NAN, sphere, on, candidate.inlier_share, params, Tolerance())
    # NaN, if the noise is unknown, stays NaN.
    times = candidate.fit.scale / np.maximum(
        sphere_detection.flat_noise(cloud.points, sphere.radius), LEAST_SCALE * sphere.radius
    )
    if times > LARGEST_SCALE:
        doubts.append(reason("spheres.rough", times=float(times)))
    if doubts or wrong:
        row = replace(row, flag=Flag.LOW_CONFIDENCE)
    row = replace(row, reasons=(*row.reasons, *doubts, *remarks))
    if params.method == "least-squares":
        return row
    free = 4 if _held(params) is None else 3
    shared, stations = _by_neighbours_and_views(cloud, candidate.fit, free)
    return replace(
        row,
        sphere=replace(sphere, covariance=sphere.covariance + shared),
        stations=stations,
        bound=bound(candidate.fit, free),
        formal=candidate.fit.sphere.covariance,
    )


def _widened(cloud: MergedCloud, fit: RobustFit, radius_held: bool) -> Sphere | None:
    """Return the sphere of a fit with what beams at the limb add to its covariance, of which it takes only a part.

    They also return from beside it and make it larger. So the sphere is fitted again, and what it moves by is one
    standard deviation. Of orthogonal distances the second fit is one of ranges as seen from far away, from the side
    that its points are on: rays that miss the sphere are left out. Of ranges it is without rays that meet it at more
    than 60 degrees, where a footprint is over twice as long as wide. None where that fit does not converge.
    """
    ball = fit.sphere
    off = cloud.points - ball.centre
    distance = lengths(off)
    near = distance < sphere_detection.NEAR * ball.radius
    if cloud.scanner is None:
        side = np.mean(off[fit.inliers] / distance[fit.inliers, None], axis=0)
        if np.linalg.norm(side) < LEAST_ONE_SIDED:
            return ball
        near &= off @ side > 0.0
        far = FAR_RADII * ball.radius / np.linalg.norm(side) * side
        seen_from: Floats = np.broadcast_to(far, (int(near.sum()), 3))
    else:
        seen_from = cloud.scanner - ball.centre
        across = lengths(np.cross(off, seen_from)) / np.maximum(lengths(off - seen_from), 1e-300)
        near &= across < np.sqrt(1.0 - STEEP_COS**2) * ball.radius
        seen_from = seen_from[near]
    start = replace(ball, centre=np.zeros(3))
    again = robust_fit(off[near], start, FIRST_SCALE * fit.scale, ball.radius if radius_held else None, seen_from)
    if again is None or not again.converged:
        return None
    # From the side of the points the noise is the same; fewer rays move the sphere by chance as well.
    by_chance = None if cloud.scanner is None else again.sphere.covariance
    return ball.widened_by(start.moved_to(again.sphere), by_chance)


def _by_neighbours_and_views(cloud: MergedCloud, fit: RobustFit, free: int) -> tuple[Floats, int]:
    """Return what a fit's covariance (4, 4) lacks: errors that neighbouring points share, and those of their views.

    The second is the number of views, 0 where it is not known.
    Where the scanner is not known a sphere that is seen from one side was seen by one view from there. Of one that was
    seen from all around nothing is known of the views: what they have in common is as likely along each axis.
    """
    on, added = fit.inliers, np.zeros((4, 4))
    J, away = fit.derivatives[on, :free], cloud.points[on] - fit.sphere.centre
    normals = away / lengths(away)[:, None]
    weights = biweight(fit.residuals[on] / (TUKEY * fit.scale))
    cells = sphere_cells(away, np.zeros(3))
    if len(np.unique(cells)) > MOST_CELLS:
        cells //= 2
    added[:free, :free] = residual_correlation.added_covariance(J, fit.residuals[on], weights, normals, cells)
    if cloud.scanner is None:
        side = normals.mean(axis=0)
        if np.linalg.norm(side) < LEAST_ONE_SIDED:
            added[:free, :free] += scanner_class_errors.known().view_mm ** 2 * np.eye(free)
            return added, 0
        cosines = np.maximum(normals @ side / np.linalg.norm(side), GRAZING_COS)
        errors = scanner_class_errors.view_errors(np.zeros(len(J)), cosines, np.zeros(len(J), np.int64))
        errors, stations = errors * cosines[:, None], 0  # along the normals
    else:
        seen_from = cloud.scanner[on]
        one = (seen_from == seen_from[0]).all()  # without the sort that several need
        view = np.zeros(len(J), np.int64) if one else distinct_points(seen_from)[1]
        stations = int(view.max()) + 1
        ranges = lengths(cloud.points[on] - seen_from)
        errors = scanner_class_errors.view_errors(ranges, 1.0 / fit.derivatives[on, 3], view)
    moved = np.linalg.solve(J.T @ J, J.T @ errors)
    added[:free, :free] += moved @ moved.T
    return added, stations


def _by_free_radius(cloud: MergedCloud, fit: RobustFit) -> tuple[Floats, tuple[Reason, ...], bool]:
    """Return how far points move the centre of a fit with a held radius, (4,), the remark on it, and whether to doubt.

    A radius that is wrong by a little fits as well, with its centre elsewhere. So the radius is also estimated. The
    square of the difference of the centres, less its mean by chance, is a variance of the held one. By less than what
    all points of a view have in common, a right radius may differ, too.
    """
    ball, nowhere = fit.sphere, np.zeros(4)
    off = cloud.points - ball.centre
    near = lengths(off) < sphere_detection.NEAR * ball.radius
    seen_from = None if cloud.scanner is None else cloud.scanner[near] - ball.centre
    crop, start = MergedCloud(off[near], cloud.origin + ball.centre, seen_from), replace(ball, centre=np.zeros(3))
    free = robust_fit(crop.points, start, FIRST_SCALE * fit.scale, None, seen_from)
    free_sphere = _widened(crop, free, radius_held=False) if free is not None and free.converged else None
    if free_sphere is None:
        return nowhere, (), False
    moved, sd = start.moved_to(free_sphere), float(np.sqrt(free_sphere.covariance[3, 3]))
    away = abs(float(moved[3]))
    if not away > sd:  # also where the points do not determine the radius: NaN
        return nowhere, (), False
    centre = np.sqrt(1.0 - (sd / away) ** 2) * np.append(moved[:3], 0.0)
    shift, measured = float(np.linalg.norm(moved[:3])), free_sphere.radius
    by_view = scanner_class_errors.known().view_mm
    remark = reason("spheres.other-radius", radius=measured, ci95=NORMAL_95 * sd, held=ball.radius, shift=shift)
    return centre, (remark,) if away > CHANCE * sd else (), away > CHANCE * float(np.hypot(sd, by_view))


def _with_bounds(result: Result, rows: list[Row]) -> Result:
    """Add the Cramér-Rao bounds of each sphere, and the efficiencies."""
    balls, bounds = result.balls, np.array([row.bound for row in rows])
    formal = np.array([row.formal for row in rows])
    variance, least = (np.einsum("kii->ki", C) for C in (formal, bounds))
    lowest, least_lowest = (np.sqrt(np.einsum("i,kij,j->k", DOWN, C, DOWN)) for C in (formal, bounds))
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.sqrt(least[:, :3].sum(axis=1) / variance[:, :3].sum(axis=1))
        efficiency = np.stack([centre, np.sqrt(least[:, 3] / variance[:, 3]), least_lowest / lowest], axis=1)
    balls = replace(
        balls,
        sizes=np.full(len(rows), NAN),
        axes=np.zeros(len(rows), np.int64),
        stations=np.array([row.stations for row in rows], np.int64),
        bound_sd=np.column_stack([np.sqrt(least), least_lowest]),
        efficiency=efficiency,
    )
    return replace(result, balls=balls)
