"""Balls of a space frame, or of a cloud without a design.

With a design every ball is fitted to its crop, by the source paper's two methods (paper 001): algebraic least squares,
or RANSAC with adaptive N. They are baselines: sleeves inside the crop bias both, and their covariances are formal.
Without a design the balls are searched for in the whole cloud and fitted robustly.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from processor.geometry.crops import nearest_crops
from processor.geometry.merging import MergedCloud, merged
from processor.geometry.sphere import Mask, Sphere, algebraic, visible_fraction
from processor.geometry.sphere_ransac import ransac
from processor.geometry.sphere_search import LEAST_POINTS, Found, find_balls
from processor.model import (
    Checked,
    Floats,
    FrameDesign,
    Ints,
    Metric,
    Scene,
    Tolerance,
    Truth,
    UsageError,
    column,
    names,
)
from processor.preassembly import tolerance

NEEDS: tuple[str, ...] = ()
KIND = "space-frame"
METHODS = ("ransac", "least-squares")  # the first is the default

NAN = float("nan")
LEAST_VISIBLE = 0.05  # share of the sphere
LEAST_INLIERS = 0.3  # share of the crop
LARGEST_SD = 0.05  # of the radius, in radii
LARGEST_RMS = 0.1  # of the residuals, in radii
WRONG_MM = 10.0  # a centre farther off than this is another thing
PAPER_RADIUS_ERROR_MM = 3.0  # paper 001, table 2: RANSAC keeps radii within 0-3 mm


@dataclass(frozen=True)
class Params:
    """Parameters (lengths in mm)."""

    method: str = METHODS[0]
    seed: int = 0
    crop_margin_mm: float = 20.0  # beyond the nominal radius, about the nominal centre
    tau_mm: float = 4.0  # ransac: distance from the surface within which a point consents; two sd of a 2 mm scanner
    probability: float = 0.99  # ransac: that one minimal set was free of outliers
    max_iterations: int = 10_000  # ransac: minimal sets at most
    min_points: int = 20  # fewer: low confidence; without a design: no ball, and 40 is the least
    radius_mm: float = NAN  # without a design: the known radius, held; NaN = estimated
    max_balls: int = 10  # without a design: to search for, one after another


@dataclass(frozen=True)
class Result(Checked):
    """The balls, a row each, in the input's own frame (its offset put back), mm. NaN = no answer."""

    status: str  # ok | partial | failed
    method: str
    message: str = ""
    ids: Ints = column("k", dtype=np.int64)
    centres: Floats = column("k", 3)
    radii: Floats = column("k")
    lowest: Floats = column("k", 3)
    covariance: Floats = column("k", 4, 4)  # of centre x, y, z and radius
    lowest_sd: Floats = column("k")  # of the lowest point's z
    points: Ints = column("k", dtype=np.int64)  # that the estimate rests on
    visible_fraction: Floats = column("k")  # of the sphere's surface that has points
    rms: Floats = column("k")  # of the residuals of those points
    nominal_radii: Floats = column("k")  # from the design, NaN without
    evidence: tuple[str, ...] = names("k")  # ball | fused | axes
    flag: tuple[str, ...] = names("k")  # ok | low-confidence | wrong-size | not-found
    reason: tuple[str, ...] = names("k")  # why the flag is not ok


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


def run(scene: Scene, params: Params) -> Result:
    """Find the balls of a scene: one per node of its design, or those that stand out of the cloud.

    ``status``: ok = an answer for every ball, partial = for some or ``max_balls`` reached, failed = for none; the flag
    of each ball says what its answer is worth. Raises UsageError for parameters that make no sense.
    """
    _checked(params, scene.frame is not None)
    if scene.frame is None:
        return _search(merged(scene, with_scanner=True), params)
    return _fit_nodes(merged(scene, with_scanner=False), scene.frame, params, tolerance.default_for(scene.tolerance))


def _checked(params: Params, has_design: bool) -> None:
    if params.method not in METHODS:
        raise UsageError(f"spheres: unknown method {params.method!r}; it has {', '.join(METHODS)}")
    for name, sound in (
        ("crop_margin_mm", params.crop_margin_mm > 0.0),
        ("tau_mm", params.tau_mm > 0.0),
        ("probability", 0.0 < params.probability < 1.0),
        ("max_iterations", params.max_iterations >= 1),
        ("min_points", params.min_points >= 1),
        ("max_balls", params.max_balls >= 1),
        ("seed", params.seed >= 0),
        ("radius_mm", np.isnan(params.radius_mm) or 0.0 < params.radius_mm < np.inf),
    ):
        if not sound:
            raise UsageError(f"spheres: {name} = {getattr(params, name)} makes no sense")
    if not np.isnan(params.radius_mm) and (has_design or params.method == "least-squares"):
        raise UsageError(
            "spheres: radius_mm holds the radius of a ball searched for without a design, by method ransac; "
            "with a design, and by least-squares, the radius is free: take radius_mm out"
        )


def _generator(params: Params, purpose: str) -> np.random.Generator:
    return np.random.default_rng([params.seed, zlib.crc32(purpose.encode())])


# --- with a design -------------------------------------------------------------------------------------------------


def _fit_nodes(cloud: MergedCloud, design: FrameDesign, params: Params, limits: Tolerance) -> Result:
    nodes = design.centres - cloud.origin
    crops = nearest_crops(cloud.points, nodes, design.radii + params.crop_margin_mm)
    balls = [
        _fit_node(int(design.ids[i]), nodes[i], float(design.radii[i]), cloud.points[rows], params, limits)
        for i, rows in enumerate(crops)
    ]
    return _result(balls, cloud.origin, params, "covariances are formal: bias by sleeves and mixed pixels is left out")


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
    doubts = [
        text
        for doubtful, text in (
            (len(points) < params.min_points, f"{len(points)} points, fewer than {params.min_points}"),
            (visible < LEAST_VISIBLE, f"{visible:.0%} of the surface seen"),
            (share < LEAST_INLIERS, f"{share:.0%} of the points around lie on it"),
            (not sd <= LARGEST_SD * sphere.radius, f"ill-conditioned: sd of the radius {sd:.1f} mm"),
            (rms > LARGEST_RMS * sphere.radius, f"not round: residuals of {rms:.1f} mm rms"),
        )
        if doubtful
    ]
    flag = "low-confidence" if doubts else "ok"
    error = sphere.radius - nominal
    below, above = _blank_tolerance(nominal, limits)
    if not doubts and not np.isnan(nominal) and not -below <= error <= above:
        # The interval is formal; what the method is known to reach decides whether it may call a size wrong.
        margin = max(1.96 * sd, PAPER_RADIUS_ERROR_MM)
        if params.method == "ransac" and not -below - margin <= error <= above + margin:
            flag = "wrong-size"
            doubts = [
                f"radius {error:+.1f} mm from nominal, beyond the blank's +{above:g}/-{below:g} by {margin:.1f} mm"
            ]
        elif params.method == "least-squares":
            flag = "low-confidence"
            doubts = [f"radius {error:+.1f} mm from nominal: this method cannot tell a wrong size from sleeves"]
    return _Ball(id_, nominal, sphere, len(points), visible, rms, flag, "; ".join(doubts))


def _blank_tolerance(radius: float, limits: Tolerance) -> tuple[float, float]:
    """How much smaller and larger in mm a ball's radius may be: half of the limits on the blank's diameter.

    Limits that do not speak of balls leave them to those of the default standard.
    """
    for one in (limits, tolerance.load(tolerance.DEFAULT)):
        for limit in one.limits:
            if limit.key.startswith("ball_blank_diameter_") and tolerance.applies(limit, 2.0 * radius):
                low, high = tolerance.bounds(limit, {"diameter": 2.0 * radius})
                return -0.5 * low, 0.5 * high
    return NAN, NAN


# --- without a design ----------------------------------------------------------------------------------------------


def _search(cloud: MergedCloud, params: Params) -> Result:
    held = None if np.isnan(params.radius_mm) else params.radius_mm
    least = max(params.min_points, LEAST_POINTS)
    found = find_balls(cloud.points, _generator(params, "search"), params.max_balls, least, held, cloud.scanner)
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
    return _result(balls, cloud.origin, params, "; ".join(said), complete=len(found) < params.max_balls)


def _searched(id_: int, found: Found, cloud: MergedCloud, params: Params) -> _Ball:
    on = cloud.points[found.fit.inliers]
    sphere: Sphere | None = found.fit.sphere
    if params.method == "least-squares":
        sphere = algebraic(on)
    if sphere is None:
        return _Ball(id_, NAN, None, len(on), reason="the points determine no sphere")
    return _judged(id_, NAN, sphere, on, found.inlier_share, params, Tolerance())


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


# --- evaluation ----------------------------------------------------------------------------------------------------


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Hold balls against the truth, by id with a design and by the nearest centre without.

    Limits: RANSAC's radius errors of 0-3 mm in the paper, held against their median; and no ball that is wrong but
    called ok. All else informs.
    """
    if truth.frame is None:
        return []
    true = truth.frame
    got = np.flatnonzero(np.isfinite(result.radii))
    if scene.frame is not None:
        row_of = {int(id_): row for row, id_ in enumerate(true.ids)}
        pairs = [(row, row_of[int(result.ids[row])]) for row in got.tolist() if int(result.ids[row]) in row_of]
    else:
        distance = np.linalg.norm(result.centres[got, None] - true.centres[None], axis=2)
        pairs = [(row, int(distance[i].argmin())) for i, row in enumerate(got.tolist()) if len(true.ids)]
    rows, matches = np.array(pairs, np.int64).reshape(-1, 2).T
    radius = np.abs(result.radii[rows] - true.radii[matches])
    centre = np.linalg.norm(result.centres[rows] - true.centres[matches], axis=1)
    lowest = np.abs(result.lowest[rows, 2] - true.lowest[matches, 2])
    within = radius <= 1.96 * np.sqrt(result.covariance[rows, 3, 3])
    wrong = (centre > WRONG_MM) & np.array([result.flag[row] == "ok" for row in rows], bool)
    limit = PAPER_RADIUS_ERROR_MM if result.method == "ransac" and scene.frame is not None else NAN
    metrics = [
        Metric(
            "spheres", f"{name}, {which}", value, limit if (name, which) == ("radius error", "median") else NAN, "mm"
        )
        for name, errors in (("radius error", radius), ("centre error", centre), ("lowest point error", lowest))
        for which, value in _summary(errors)
    ]
    return [
        *metrics,
        Metric("spheres", "balls not found", float(len(true.ids) - len(set(matches.tolist()))), NAN, ""),
        Metric("spheres", f"balls called ok, centre over {WRONG_MM:g} mm off", float(wrong.sum()), 0.0, ""),
        Metric("spheres", "radii within their 95 % interval", float(within.mean()) if len(within) else NAN, NAN, ""),
    ]


def _summary(errors: Floats) -> list[tuple[str, float]]:
    if len(errors) == 0:
        return [("median", NAN), ("95th percentile", NAN), ("max", NAN)]
    median, high = np.percentile(errors, [50.0, 95.0])
    return [("median", float(median)), ("95th percentile", float(high)), ("max", float(errors.max()))]
