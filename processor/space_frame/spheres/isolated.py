"""Balls one at a time: the source paper's two estimators at a design's nodes, and balls that stand without members.

With a design every ball is fitted to its crop by algebraic least squares, or by RANSAC with adaptive N (paper 001).
They are baselines: sleeves inside the crop bias both, and their covariances are formal. Without a design and members
balls are searched for in the whole cloud and fitted robustly.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace

import numpy as np

from processor.geometry.merging import MergedCloud
from processor.geometry.neighbors import nearest_crops
from processor.geometry.sphere import Mask, Sphere, algebraic, bound, ransac, visible_fraction
from processor.geometry.sphere_search import LEAST_POINTS, Ball, find_balls
from processor.model import NORMAL_95, Floats, FrameDesign, Ints, Tolerance
from processor.space_frame.design import unit_mistakes
from processor.space_frame.params import NAN, Params
from processor.space_frame.result import Result
from processor.space_frame.spheres.quality import beyond, blank_tolerance

LEAST_VISIBLE = 0.05  # share of the sphere
LEAST_INLIERS = 0.3  # share of the crop
LARGEST_SD = 0.05  # of the radius, in radii
LARGEST_RMS = 0.1  # of the residuals, in radii
PAPER_RADIUS_ERROR_MM = 3.0  # paper 001, table 2: RANSAC keeps radii within 0-3 mm


@dataclass(frozen=True)
class _Ball:
    """One row of the Result, less the cloud's origin; no sphere = not found, and the reason says why."""

    id: int
    nominal: float
    sphere: Sphere | None
    points: int = 0
    visible: float = 0.0
    rms: float = NAN
    flag: str = "not-found"
    reason: str = ""
    stations: int = 0  # that saw it; 0 = unknown
    bound: Floats = field(default_factory=lambda: np.full((4, 4), NAN))  # Cramér-Rao, of x, y, z, radius


def _generator(params: Params, purpose: str) -> np.random.Generator:
    return np.random.default_rng([params.seed, zlib.crc32(purpose.encode())])


# --- with a design -------------------------------------------------------------------------------------------------


def fit_nodes(cloud: MergedCloud, design: FrameDesign, params: Params, limits: Tolerance) -> Result:
    """Fit a ball to the crop about every node of a design in the cloud's frame, by one of the paper's methods."""
    nodes = design.centres - cloud.origin
    crops = nearest_crops(cloud.points, nodes, design.radii + params.crop_margin_mm)
    balls = [
        _fit_node(int(design.ids[i]), nodes[i], float(design.radii[i]), cloud.points[rows], params, limits)
        for i, rows in enumerate(crops)
    ]
    return _result(balls, cloud.origin, params, "covariances are formal: bias by sleeves and mixed pixels is left out")


def fit_points(
    points: list[Floats],
    nodes: Floats,
    ids: Ints,
    nominal: Floats,
    origin: Floats,
    params: Params,
    limits: Tolerance,
    message: str,
) -> Result:
    """Fit a ball to each set of points (n, 3), given less nodes (k, 3), by one of the paper's methods."""
    balls = [
        _fit_node(id_, node, size, own + node, params, limits)
        for id_, node, size, own in zip(ids.tolist(), nodes, nominal.tolist(), points, strict=True)
    ]
    return _result(balls, origin, params, message)


def _fit_node(id_: int, node: Floats, nominal: float, crop: Floats, params: Params, limits: Tolerance) -> _Ball:
    if len(crop) < 4:
        return _Ball(id_, nominal, None, len(crop), reason=f"{len(crop)} points in the crop; a sphere needs 4")
    on: Mask = np.ones(len(crop), bool)
    sphere: Sphere | None
    if params.method == "least-squares":
        sphere = algebraic(crop - node)
    else:
        rng = _generator(params, f"ransac {id_}")
        consensus = ransac(crop - node, rng, params.tau_mm, params.probability, params.max_iterations)
        sphere = None if consensus is None else consensus.sphere
        on = on if consensus is None else consensus.inliers
    if sphere is None:
        return _Ball(id_, nominal, None, len(crop), reason="the points of the crop determine no sphere")
    reach = nominal + params.crop_margin_mm
    away = float(np.linalg.norm(sphere.centre))
    if away > reach or sphere.radius > 2.0 * reach:
        reason = f"the fit left the crop: centre {away:.0f} mm off, radius {sphere.radius:.0f} mm"
        return _Ball(id_, nominal, None, int(on.sum()), reason=reason)
    share = float(on.mean()) if params.method == "ransac" else 1.0
    placed = Sphere(sphere.centre + node, sphere.radius, sphere.covariance)
    return _judged(id_, nominal, placed, crop[on], share, params, limits)


def _judged(
    id_: int, nominal: float, sphere: Sphere, points: Floats, share: float, params: Params, limits: Tolerance
) -> _Ball:
    """Give a found ball its flag and every reason for it."""
    visible = visible_fraction(points, sphere.centre)
    rms = float(np.sqrt(np.mean(sphere.residuals(points) ** 2)))
    sd = float(np.sqrt(sphere.covariance[3, 3]))
    strange = unit_mistakes.implausible(sphere.radius)
    doubts = [
        text
        for doubtful, text in (
            (len(points) < params.min_points, f"{len(points)} points, fewer than {params.min_points}"),
            (visible < LEAST_VISIBLE, f"{visible:.0%} of the surface seen"),
            (share < LEAST_INLIERS, f"{share:.0%} of the points around lie on it"),
            (not sd <= LARGEST_SD * sphere.radius, f"ill-conditioned: sd of the radius {sd:.1f} mm"),
            (bool(strange), strange),
            (rms > LARGEST_RMS * sphere.radius, f"not round: residuals of {rms:.1f} mm rms"),
        )
        if doubtful
    ]
    flag = "low-confidence" if doubts else "ok"
    error = sphere.radius - nominal
    below, above = blank_tolerance(nominal, limits)
    if not doubts and not np.isnan(nominal) and not -below <= error <= above:
        # The interval is formal; what the method is known to reach decides whether it may call a size wrong.
        margin = max(NORMAL_95 * sd, PAPER_RADIUS_ERROR_MM)
        said = beyond(sphere.radius, nominal, margin, limits)
        if params.method == "ransac" and said:
            flag, doubts = "wrong-size", [said]
        elif params.method == "least-squares":
            flag = "low-confidence"
            doubts = [f"radius {error:+.1f} mm from nominal: this method cannot tell a wrong size from sleeves"]
    return _Ball(id_, nominal, sphere, len(points), visible, rms, flag, "; ".join(doubts))


# --- without a design ----------------------------------------------------------------------------------------------


def search(cloud: MergedCloud, params: Params) -> Result:
    """Search a cloud for balls that stand out of it by themselves."""
    held = None if np.isnan(params.radius_mm) else params.radius_mm
    least = max(params.min_points, LEAST_POINTS)
    # fixed: what is found must not depend on the seed
    fixed = _generator(replace(params, seed=0), "search")
    found = find_balls(cloud.points, fixed, params.max_balls, least, held, cloud.scanner)
    if not found:
        message = (
            f"no ball stands out of {len(cloud.points)} points; a whole frame needs a design (design.json) with this "
            "method: its balls are too small a share of the cloud to search for"
        )
        return Result("failed", params.method, message)
    balls = [_searched(id_, one, cloud, params) for id_, one in enumerate(found)]
    said = ["searched without a design"]
    if params.method == "least-squares":
        said.append("algebraic least squares on the points found to lie on each ball")
    elif cloud.scanner is None:
        said.append(
            "robust fit of orthogonal distances, for the scanner's position is unknown: range noise biases them"
        )
    else:
        said.append("robust fit of ranges from the known scanner positions")
    if held is not None:
        said.append(f"radius held at {held:g} mm, its covariance is 0")
    if len(found) == params.max_balls:
        said.append(f"stopped at {len(found)} balls (max_balls), there may be more: a whole frame needs a design")
    made = _result(balls, cloud.origin, params, "; ".join(said), complete=len(found) < params.max_balls)
    return _with_bounds(made, balls) if params.method == "ray" else made


def _searched(id_: int, found: Ball, cloud: MergedCloud, params: Params) -> _Ball:
    on = cloud.points[found.fit.inliers]
    sphere: Sphere | None = found.fit.sphere
    if params.method == "least-squares":
        sphere = algebraic(on)
    if sphere is None:
        return _Ball(id_, NAN, None, len(on), reason="the points determine no sphere")
    ball = _judged(id_, NAN, sphere, on, found.inlier_share, params, Tolerance())
    if params.method == "least-squares":
        return ball
    seen_from = None if cloud.scanner is None else cloud.scanner[found.fit.inliers]
    stations = 0 if seen_from is None else len(np.unique(seen_from, axis=0))
    least = bound(cloud.points, found.fit, not np.isnan(params.radius_mm), cloud.scanner)
    return replace(ball, stations=stations, bound=least)


def _result(balls: list[_Ball], origin: Floats, params: Params, message: str, complete: bool = True) -> Result:
    nowhere = Sphere(np.full(3, NAN), NAN, np.full((4, 4), NAN))
    spheres = [nowhere if ball.sphere is None else ball.sphere for ball in balls]
    centres = np.array([sphere.centre + origin for sphere in spheres]).reshape(-1, 3)
    radii = np.array([sphere.radius for sphere in spheres])
    found = sum(ball.sphere is not None for ball in balls)
    return Result(
        status="failed" if found == 0 else "ok" if complete and found == len(balls) else "partial",
        method=params.method,
        message=message,
        ids=np.array([ball.id for ball in balls], np.int64),
        centres=centres,
        radii=radii,
        lowest=centres - radii[:, None] * np.array([0.0, 0.0, 1.0]),
        covariance=np.array([sphere.covariance for sphere in spheres]),
        lowest_sd=np.array([sphere.lowest_sd for sphere in spheres]),
        points=np.array([ball.points for ball in balls], np.int64),
        visible_fraction=np.array([ball.visible for ball in balls]),
        rms=np.array([ball.rms for ball in balls]),
        nominal_radii=np.array([ball.nominal for ball in balls]),
        evidence=("ball",) * len(balls),
        flag=tuple(ball.flag for ball in balls),
        reason=tuple(ball.reason for ball in balls),
    )


def _with_bounds(found: Result, balls: list[_Ball]) -> Result:
    """Put beside each ball what any estimate from its points could reach at best."""
    bounds = np.array([ball.bound for ball in balls])
    down = np.array([0.0, 0.0, 1.0, -1.0])
    variance, least = (np.einsum("kii->ki", one) for one in (found.covariance, bounds))
    least_lowest = np.sqrt(np.einsum("i,kij,j->k", down, bounds, down))
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.sqrt(least[:, :3].sum(axis=1) / variance[:, :3].sum(axis=1))
        efficiency = np.stack([centre, np.sqrt(least[:, 3] / variance[:, 3]), least_lowest / found.lowest_sd], axis=1)
    return replace(
        found,
        sizes=np.full(len(balls), NAN),
        axes=np.zeros(len(balls), np.int64),
        stations=np.array([ball.stations for ball in balls], np.int64),
        bound_sd=np.column_stack([np.sqrt(least), least_lowest]),
        efficiency=efficiency,
    )
