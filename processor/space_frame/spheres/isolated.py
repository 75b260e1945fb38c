"""Spheres one at a time: the source paper's two estimators at a design's nodes, and spheres without members.

With a design every sphere is fitted to its crop by algebraic least squares, or by RANSAC with adaptive N (paper 001).
These are baselines: sleeves inside the crop bias both, and their covariances are formal. Without a design and members
spheres are searched for in the whole cloud and fitted robustly.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace

import numpy as np

from processor.geometry.merging import MergedCloud
from processor.geometry.neighbors import nearest_crops
from processor.geometry.sphere import Bools, Sphere, algebraic, bound, ransac, visible_fraction
from processor.model import NORMAL_95, Floats, FrameDesign, Ints, Reason, Status, Tolerance, Verdict, reason
from processor.space_frame.design import unit_mistakes
from processor.space_frame.params import NAN, Params
from processor.space_frame.result import Balls, Evidence, Flag, Result
from processor.space_frame.spheres import sphere_search
from processor.space_frame.spheres.quality import LARGEST_SCALE, beyond, blank_tolerance

LEAST_VISIBLE = 0.05  # share of the sphere
LEAST_INLIERS = 0.3  # share of the crop
LARGEST_SD = 0.05  # of the radius, in radii
LARGEST_RMS = 0.1  # of the residuals, in radii
PAPER_RADIUS_ERROR_MM = 3.0  # paper 001, table 2: RANSAC keeps radii within 0-3 mm


@dataclass(frozen=True)
class _Row:
    """One row of the result, less the cloud's origin; without a sphere it was not found, for the ``reasons``."""

    id: int
    nominal: float
    sphere: Sphere | None
    points: int = 0
    visible: float = 0.0
    rms: float = NAN
    flag: Flag = Flag.NOT_FOUND
    reasons: tuple[Reason, ...] = ()
    stations: int = 0  # number that saw it; 0 = unknown
    bound: Floats = field(default_factory=lambda: np.full((4, 4), NAN))  # Cramér-Rao, of x, y, z, radius


def _generator(params: Params, purpose: str) -> np.random.Generator:
    return np.random.default_rng([params.seed, zlib.crc32(purpose.encode())])


# --- with a design -------------------------------------------------------------------------------------------------


def fit_nodes(cloud: MergedCloud, design: FrameDesign, params: Params, limits: Tolerance) -> Result:
    """Fit a sphere to the crop about every node of a design in the cloud's frame, by one of the paper's methods."""
    nodes = design.centres - cloud.origin
    crops = nearest_crops(cloud.points, nodes, design.radii + params.crop_margin_mm)
    rows = [
        _fit_node(int(design.ids[i]), nodes[i], float(design.radii[i]), cloud.points[crop], params, limits)
        for i, crop in enumerate(crops)
    ]
    return _result(rows, cloud.origin, params, (reason("spheres.formal-covariances"),))


def fit_points(
    points: list[Floats],
    nodes: Floats,
    ids: Ints,
    nominal: Floats,
    origin: Floats,
    params: Params,
    limits: Tolerance,
    reasons: tuple[Reason, ...],
) -> Result:
    """Fit a sphere to each set of points (n, 3), given less nodes (k, 3), by one of the paper's methods."""
    rows = [
        _fit_node(id_, node, size, crop + node, params, limits)
        for id_, node, size, crop in zip(ids.tolist(), nodes, nominal.tolist(), points, strict=True)
    ]
    return _result(rows, origin, params, reasons)


def _fit_node(id_: int, node: Floats, nominal: float, crop: Floats, params: Params, limits: Tolerance) -> _Row:
    if len(crop) < 4:
        return _missing(id_, nominal, len(crop), reason("spheres.few-crop-points", points=len(crop)))
    on: Bools = np.ones(len(crop), bool)
    sphere: Sphere | None
    if params.method == "least-squares":
        sphere = algebraic(crop - node)
    else:
        rng = _generator(params, f"ransac {id_}")
        consensus = ransac(crop - node, rng, params.tau_mm, params.probability, params.max_iterations)
        sphere = None if consensus is None else consensus.sphere
        on = on if consensus is None else consensus.inliers
    if sphere is None:
        return _missing(id_, nominal, len(crop), reason("spheres.no-sphere"))
    reach = nominal + params.crop_margin_mm
    away = float(np.linalg.norm(sphere.centre))
    if away > reach or sphere.radius > 2.0 * reach:
        cause = reason("spheres.fit-left-crop", distance=away, radius=sphere.radius)
        return _missing(id_, nominal, int(on.sum()), cause)
    share = float(on.mean()) if params.method == "ransac" else 1.0
    placed = Sphere(sphere.centre + node, sphere.radius, sphere.covariance)
    return _assessed(id_, nominal, placed, crop[on], share, params, limits)


def _missing(id_: int, nominal: float, points: int, cause: Reason) -> _Row:
    return _Row(id=id_, nominal=nominal, sphere=None, points=points, reasons=(cause,))


def _assessed(
    id_: int, nominal: float, sphere: Sphere, points: Floats, share: float, params: Params, limits: Tolerance
) -> _Row:
    """Return a fitted sphere with its flag and every reason for it."""
    visible = visible_fraction(points, sphere.centre)
    rms = float(np.sqrt(np.mean(sphere.residuals(points) ** 2)))
    sd = float(np.sqrt(sphere.covariance[3, 3]))
    implausible = unit_mistakes.implausible(sphere.radius)
    doubts = []
    if len(points) < params.min_points:
        doubts.append(reason("spheres.few-points", points=len(points), least=params.min_points))
    if visible < LEAST_VISIBLE:
        doubts.append(reason("spheres.little-visible", share=visible))
    if share < LEAST_INLIERS:
        doubts.append(reason("spheres.few-inliers", share=share))
    if not sd <= LARGEST_SD * sphere.radius:
        doubts.append(reason("spheres.uncertain-radius", sd=sd))
    if implausible is not None:
        doubts.append(implausible)
    if rms > LARGEST_RMS * sphere.radius:
        doubts.append(reason("spheres.large-residuals", rms=rms))
    flag = Flag.LOW_CONFIDENCE if doubts else Flag.OK
    error = sphere.radius - nominal
    below, above = blank_tolerance(nominal, limits)
    if not doubts and not np.isnan(nominal) and not -below <= error <= above:
        # The interval is formal: a size is wrong only beyond the errors that the method is known to have.
        margin = max(NORMAL_95 * sd, PAPER_RADIUS_ERROR_MM)
        wrong = beyond(sphere.radius, nominal, margin, limits)
        if params.method == "ransac" and wrong is not None:
            flag, doubts = Flag.WRONG_SIZE, [wrong]
        elif params.method == "least-squares":
            flag, doubts = Flag.LOW_CONFIDENCE, [reason("spheres.size-or-sleeves", error=error)]
    return _Row(
        id=id_,
        nominal=nominal,
        sphere=sphere,
        points=len(points),
        visible=visible,
        rms=rms,
        flag=flag,
        reasons=tuple(doubts),
    )


# --- without a design ----------------------------------------------------------------------------------------------


def search(cloud: MergedCloud, params: Params) -> Result:
    """Search a cloud for spheres that stand out of it by themselves."""
    radius = None if np.isnan(params.radius_mm) else params.radius_mm
    least = max(params.min_points, sphere_search.LEAST_POINTS)
    # fixed: the result must not depend on the seed
    fixed = _generator(replace(params, seed=0), "search")
    candidates = sphere_search.find_balls(cloud.points, fixed, params.max_balls, least, radius, cloud.scanner)
    if not candidates:
        return Result(Status.FAILED, params.method, (reason("spheres.no-ball", points=len(cloud.points)),))
    rows = [_searched(id_, candidate, cloud, params) for id_, candidate in enumerate(candidates)]
    messages = [reason("spheres.searched")]
    if params.method == "least-squares":
        messages.append(reason("spheres.algebraic-fit"))
    elif cloud.scanner is None:
        messages.append(reason("spheres.robust-distances"))
    else:
        messages.append(reason("spheres.robust-ranges"))
    if radius is not None:
        messages.append(reason("spheres.radius-held", radius=radius))
    complete = len(candidates) < params.max_balls
    if not complete:
        messages.append(reason("spheres.most-balls", balls=len(candidates)))
    result = _result(rows, cloud.origin, params, tuple(messages), complete)
    return _with_bounds(result, rows) if params.method == "ray" else result


def _searched(id_: int, candidate: sphere_search.Ball, cloud: MergedCloud, params: Params) -> _Row:
    on = cloud.points[candidate.fit.inliers]
    sphere: Sphere | None = candidate.fit.sphere
    if params.method == "least-squares":
        sphere = algebraic(on)
    if sphere is None:
        return _missing(id_, NAN, len(on), reason("spheres.no-sphere"))
    row = _assessed(id_, NAN, sphere, on, candidate.inlier_share, params, Tolerance())
    times = candidate.fit.scale / sphere_search.flat_noise(cloud.points, sphere.radius)
    if times > LARGEST_SCALE:
        row = replace(row, flag=Flag.LOW_CONFIDENCE, reasons=(*row.reasons, reason("spheres.rough", times=times)))
    if params.method == "least-squares":
        return row
    seen_from = None if cloud.scanner is None else cloud.scanner[candidate.fit.inliers]
    stations = 0 if seen_from is None else len(np.unique(seen_from, axis=0))
    least = bound(cloud.points, candidate.fit, not np.isnan(params.radius_mm), cloud.scanner)
    return replace(row, stations=stations, bound=least)


def _result(
    rows: list[_Row], origin: Floats, params: Params, reasons: tuple[Reason, ...], complete: bool = True
) -> Result:
    nowhere = Sphere(np.full(3, NAN), NAN, np.full((4, 4), NAN))
    spheres = [nowhere if row.sphere is None else row.sphere for row in rows]
    centres = np.array([sphere.centre + origin for sphere in spheres]).reshape(-1, 3)
    radii = np.array([sphere.radius for sphere in spheres])
    fitted = sum(row.sphere is not None for row in rows)
    balls = Balls(
        ids=np.array([row.id for row in rows], np.int64),
        centres=centres,
        radii=radii,
        lowest=centres - radii[:, None] * np.array([0.0, 0.0, 1.0]),
        covariance=np.array([sphere.covariance for sphere in spheres]),
        lowest_sd=np.array([sphere.lowest_sd for sphere in spheres]),
        points=np.array([row.points for row in rows], np.int64),
        visible_fraction=np.array([row.visible for row in rows]),
        rms=np.array([row.rms for row in rows]),
        nominal_radii=np.array([row.nominal for row in rows]),
        evidence=(Evidence.BALL,) * len(rows),
        flag=tuple(row.flag for row in rows),
        reasons=tuple(row.reasons for row in rows),
        verdict=(Verdict.NONE,) * len(rows),
    )
    status = Status.FAILED if fitted == 0 else Status.OK if complete and fitted == len(rows) else Status.PARTIAL
    return Result(status=status, method=params.method, reasons=reasons, balls=balls)


def _with_bounds(result: Result, rows: list[_Row]) -> Result:
    """Add the Cramér-Rao bounds of each sphere, and the efficiencies."""
    balls, bounds = result.balls, np.array([row.bound for row in rows])
    down = np.array([0.0, 0.0, 1.0, -1.0])
    variance, least = (np.einsum("kii->ki", C) for C in (balls.covariance, bounds))
    least_lowest = np.sqrt(np.einsum("i,kij,j->k", down, bounds, down))
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.sqrt(least[:, :3].sum(axis=1) / variance[:, :3].sum(axis=1))
        efficiency = np.stack([centre, np.sqrt(least[:, 3] / variance[:, 3]), least_lowest / balls.lowest_sd], axis=1)
    balls = replace(
        balls,
        sizes=np.full(len(rows), NAN),
        axes=np.zeros(len(rows), np.int64),
        stations=np.array([row.stations for row in rows], np.int64),
        bound_sd=np.column_stack([np.sqrt(least), least_lowest]),
        efficiency=efficiency,
    )
    return replace(result, balls=balls)
