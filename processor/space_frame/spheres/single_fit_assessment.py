"""Assessment of spheres that were fitted one by one: flag and reasons of each, and the step's result of all."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np

from processor.geometry.sphere import Sphere, visible_fraction
from processor.model import NORMAL_95, Floats, Reason, Status, Tolerance, Verdict, reason
from processor.space_frame.design import unit_mistakes
from processor.space_frame.params import NAN, Params
from processor.space_frame.result import Balls, Evidence, Flag, Result
from processor.space_frame.spheres.assessment import beyond, blank_tolerance

LEAST_VISIBLE = 0.05  # share of the sphere
LEAST_INLIERS = 0.3  # share of the crop
LARGEST_SD = 0.05  # of the radius, in radii
LARGEST_RMS = 0.1  # of the residuals, in radii
PAPER_RADIUS_ERROR_MM = 3.0  # paper 001, table 2: RANSAC keeps radii within 0-3 mm


@dataclass(frozen=True)
class Row:
    """One row of the result, less the cloud's origin; without a sphere it was not found; ``reasons`` state why."""

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
    formal: Floats = field(default_factory=lambda: np.full((4, 4), NAN))  # covariance by the points alone


def generator(params: Params, purpose: str) -> np.random.Generator:
    """Return the random generator of a purpose, by the seed."""
    return np.random.default_rng([params.seed, zlib.crc32(purpose.encode())])


def missing(id_: int, nominal: float, points: int, cause: Reason) -> Row:
    """Return the row of a sphere that was not found."""
    return Row(id=id_, nominal=nominal, sphere=None, points=points, reasons=(cause,))


def assessed(
    id_: int, nominal: float, sphere: Sphere, points: Floats, share: float, params: Params, limits: Tolerance
) -> Row:
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
    return Row(
        id=id_,
        nominal=nominal,
        sphere=sphere,
        points=len(points),
        visible=visible,
        rms=rms,
        flag=flag,
        reasons=tuple(doubts),
    )


def as_result(
    rows: list[Row], origin: Floats, params: Params, reasons: tuple[Reason, ...], complete: bool = True
) -> Result:
    """Return the result of rows, with the cloud's origin put back."""
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
