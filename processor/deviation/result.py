"""The result of step ``deviation``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from processor.geometry.m3c2 import Distances
from processor.limits.judging import JudgedLimits
from processor.model import (
    AMOUNT,
    COORDINATE,
    COUNT,
    COVARIANCE,
    DIRECTION,
    PLACE,
    POSE,
    RATIO,
    SHARE,
    Checked,
    Floats,
    Ints,
    Labels,
    Meaning,
    Reason,
    Rows,
    Status,
    Verdict,
    Word,
    column,
    described,
    names,
    newer,
    optional,
    reasons,
    words,
)
from processor.registration.surface_registration import Registration

NAN = float("nan")


class ErrorSource(Word):
    """Where the registration error within LOD95 is from."""

    UNKNOWN = "not known: the scan does not determine the best fit"
    COVARIANCE = "covariance of the fit, mean over the core points"
    STILL = "difference of the pose given from what stands still, rms over the core points"
    GIVEN = "given"
    CLONE = "a clone of the scan"


@dataclass(frozen=True)
class CorePoints(Rows):
    """Core points of the design's surface, design frame less the result's origin, and M3C2 at each; NaN = no value.

    A distance outward is positive. By method ``default``, ``n1`` is the number of the surface's places that points
    were compared with, and ``std1`` / sqrt(``n1``) the standard deviation of what stations have in common.
    """

    points: Floats = column("k", 3, unit="mm", means=COORDINATE)
    normals: Floats = column("k", 3, means=DIRECTION)
    distance: Floats = column("k", unit="mm", means=COORDINATE)
    lod95: Floats = column("k", unit="mm", means=AMOUNT)
    n1: Ints = column("k", dtype=np.int64, means=COUNT)
    n2: Ints = column("k", dtype=np.int64, means=COUNT)
    std1: Floats = column("k", unit="mm", means=AMOUNT)
    std2: Floats = column("k", unit="mm", means=AMOUNT)
    body: Labels = column(
        "k", dtype=np.int32, newer=True, means=Meaning(rows_of="/result.bodies", lowest_row=-1)
    )  # row of the result's bodies, -1 = of none

    @property
    def distances(self) -> Distances:
        """The columns of M3C2."""
        return Distances(**{one.name: getattr(self, one.name) for one in dataclasses.fields(Distances)})


@dataclass(frozen=True)
class PartFits(Rows):
    """The parts of a bridge, each at the best fit to its own design; poses are of the part's first scan.

    The core points of the result are those of the parts one after the other, ``core_points`` of each.
    """

    name: tuple[str, ...] = names("p")
    status: tuple[Status, ...] = words("p", Status)
    reasons: tuple[tuple[Reason, ...], ...] = reasons("p")
    registration: tuple[Registration, ...] = words("p", Registration)
    T_design_scan: Floats = column("p", 4, 4, means=POSE)
    covariance: Floats = column("p", 6, 6, means=COVARIANCE)
    registration_error: Floats = column("p", unit="mm", means=AMOUNT)
    core_points: Ints = column("p", dtype=np.int64, means=COUNT)
    core_points_measured: Ints = column("p", dtype=np.int64, means=COUNT)
    mean: Floats = column("p", unit="mm", means=COORDINATE)
    sd: Floats = column("p", unit="mm", means=AMOUNT)
    min: Floats = column("p", unit="mm", means=COORDINATE)
    max: Floats = column("p", unit="mm", means=COORDINATE)
    lod95_median: Floats = column("p", unit="mm", means=AMOUNT)


@dataclass(frozen=True)
class Result(Checked):
    """Deviations of a scanned surface from its design.

    ``T_design_scan`` maps the frame of the scans as merged. ``T_best_fit`` is that of a best fit to all that was
    measured, ``T_stable_fit`` that of a fit to the largest part of it that agrees with one rigid motion to within
    ``stable_fit_limit``, applied or not, with the areas that they rest on. ``covariance`` (design frame, rotation about
    its origin and translation) is that of the fit wanted, for a pose as given with its difference from that fit. The
    statistics are of the core points that have a level of detection.
    """

    status: Status = described(words=Status)
    method: str = described()
    reasons: tuple[Reason, ...] = reasons()
    T_design_scan: Floats = optional(4, 4, means=POSE)
    registration: Registration = described(Registration.AS_GIVEN, words=Registration, heading="registration")
    registration_error: float = described(NAN, unit="mm", heading="registration error, one sd", means=AMOUNT)
    registration_error_from: ErrorSource = described(ErrorSource.UNKNOWN, words=ErrorSource, heading="from")
    covariance: Floats = optional(6, 6, means=COVARIANCE)
    ambiguity: float = described(NAN, unit="times", heading="ambiguity: error of the next best attitude", means=RATIO)
    T_best_fit: Floats = optional(4, 4, json="best_fit.T_design_scan", means=POSE)
    best_fit_shift: Floats = optional(
        3, json="best_fit.shift", unit="mm", means=COORDINATE
    )  # of the scan's middle, from T_design_scan
    best_fit_turn: float = described(NAN, json="best_fit.turn", unit="rad", means=AMOUNT)
    best_fit_area: float = described(
        NAN, json="best_fit.area", unit="m2", heading="best fit: area it rests on", means=AMOUNT
    )
    T_stable_fit: Floats = optional(4, 4, json="stable_fit.T_design_scan", means=POSE)
    stable_fit_shift: Floats = optional(3, json="stable_fit.shift", unit="mm", means=COORDINATE)
    stable_fit_turn: float = described(NAN, json="stable_fit.turn", unit="rad", means=AMOUNT)
    stable_fit_area: float = described(
        NAN, json="stable_fit.area", unit="m2", heading="stable fit: area it rests on", means=AMOUNT
    )
    stable_fit_share: float = described(
        NAN, json="stable_fit.area_share", percent=True, heading="stable fit: share of the area measured", means=SHARE
    )
    stable_fit_limit: float = described(
        NAN, json="stable_fit.limit", unit="mm", heading="stable fit: agreement within", means=AMOUNT
    )
    core_points: int = described(0, heading="core points", means=COUNT)
    core_points_measured: int = described(0, heading="core points measured", means=COUNT)
    significant_share: float = described(NAN, percent=True, heading="beyond LOD95", means=SHARE)
    significant_share_ci95: Floats = optional(2, percent=True, heading="beyond LOD95, 95 % interval", means=SHARE)
    within_10mm_share: float = described(NAN, percent=True, heading="within 10 mm", means=SHARE)
    mean: float = described(NAN, unit="mm", heading="mean", means=COORDINATE)
    mean_ci95: Floats = optional(2, unit="mm", heading="mean, 95 % interval", means=COORDINATE)
    median: float = described(NAN, unit="mm", heading="median", means=COORDINATE)
    sd: float = described(NAN, unit="mm", heading="standard deviation", means=AMOUNT)
    min: float = described(NAN, unit="mm", heading="least", means=COORDINATE)
    min_ci95: Floats = optional(2, unit="mm", heading="least, 95 % interval", means=COORDINATE)
    max: float = described(NAN, unit="mm", heading="greatest", means=COORDINATE)
    max_ci95: Floats = optional(2, unit="mm", heading="greatest, 95 % interval", means=COORDINATE)
    lod95_median: float = described(NAN, unit="mm", heading="LOD95, median", means=AMOUNT)
    points_read: int = described(0, json="points.read", heading="points read", means=COUNT)
    points_kept: int = described(0, json="points.kept", heading="points kept by the outlier removal", means=COUNT)
    on_surface_share: float = described(
        NAN, json="points.on_surface", percent=True, heading="points on the surface", means=SHARE
    )
    spacing: float = described(NAN, unit="mm", heading="spacing of the scan", means=AMOUNT)
    sigma: float = described(NAN, unit="mm", heading="sd of a point from the surface", means=AMOUNT)
    normal_diameter: float = described(NAN, unit="mm", heading="normal diameter", means=AMOUNT)
    projection_diameter: float = described(NAN, unit="mm", heading="projection diameter", means=AMOUNT)
    max_depth: float = described(NAN, unit="mm", heading="depth to either side", means=AMOUNT)
    origin: Floats = dataclasses.field(
        default_factory=lambda: np.zeros(3), metadata={"shape": (3,), "dtype": np.float64, "json": "", "means": PLACE}
    )
    core: CorePoints = dataclasses.field(default_factory=CorePoints, metadata={"json": ""})
    limits: JudgedLimits | None = newer()
    parts: PartFits | None = newer()  # of a bridge; then the fields of one registration are empty
    bodies: tuple[str, ...] = names("b", json="", newer=True)  # of the design, by name

    @property
    def overall(self) -> Verdict:
        """The worst verdict on the deviations of components; none without a limit."""
        return Verdict.NONE if self.limits is None else self.limits.overall
