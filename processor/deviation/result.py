"""The result of step ``deviation``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from processor.geometry.m3c2 import Distances
from processor.limits.judging import JudgedLimits
from processor.model import (
    Checked,
    Floats,
    Ints,
    Labels,
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
    GIVEN = "given"
    CLONE = "a clone of the scan"


@dataclass(frozen=True)
class CorePoints(Rows):
    """Core points of the design's surface, design frame less the result's origin, and M3C2 at each; NaN = no value.

    A distance outward is positive. By method ``default``, ``n1`` is the number of the surface's places that points
    were compared with, and ``std1`` / sqrt(``n1``) the standard deviation of what stations have in common.
    """

    points: Floats = column("k", 3, unit="mm")
    normals: Floats = column("k", 3)
    distance: Floats = column("k", unit="mm")
    lod95: Floats = column("k", unit="mm")
    n1: Ints = column("k", dtype=np.int64)
    n2: Ints = column("k", dtype=np.int64)
    std1: Floats = column("k", unit="mm")
    std2: Floats = column("k", unit="mm")
    body: Labels = column("k", dtype=np.int32, newer=True)  # row of the result's bodies, -1 = of none

    @property
    def distances(self) -> Distances:
        """The columns of M3C2."""
        return Distances(
            distance=self.distance, lod95=self.lod95, n1=self.n1, n2=self.n2, std1=self.std1, std2=self.std2
        )


@dataclass(frozen=True)
class PartFits(Rows):
    """The parts of a bridge, each at the best fit to its own design; poses are of the part's first scan.

    The core points of the result are those of the parts one after the other, ``core_points`` of each.
    """

    name: tuple[str, ...] = names("p")
    status: tuple[Status, ...] = words("p", Status)
    reasons: tuple[tuple[Reason, ...], ...] = reasons("p")
    registration: tuple[Registration, ...] = words("p", Registration)
    T_design_scan: Floats = column("p", 4, 4)
    covariance: Floats = column("p", 6, 6)
    registration_error: Floats = column("p", unit="mm")
    core_points: Ints = column("p", dtype=np.int64)
    core_points_measured: Ints = column("p", dtype=np.int64)
    mean: Floats = column("p", unit="mm")
    sd: Floats = column("p", unit="mm")
    min: Floats = column("p", unit="mm")
    max: Floats = column("p", unit="mm")
    lod95_median: Floats = column("p", unit="mm")


@dataclass(frozen=True)
class Result(Checked):
    """Deviations of a scanned surface from its design.

    ``T_design_scan`` maps the frame of the scans as merged. ``T_best_fit`` is that of a best fit to all that was
    measured, ``T_stable_fit`` that of a fit to the largest part of it that agrees with one rigid motion to within
    ``stable_fit_limit``, applied or not, with the areas that they rest on. ``covariance`` (design frame, rotation about
    its origin and translation) is that of the fit wanted. The statistics are of the core points that have a level of
    detection.
    """

    status: Status = described(words=Status)
    method: str = described()
    reasons: tuple[Reason, ...] = reasons()
    T_design_scan: Floats = optional(4, 4)
    registration: Registration = described(Registration.AS_GIVEN, words=Registration, heading="registration")
    registration_error: float = described(NAN, unit="mm", heading="registration error, one sd")
    registration_error_from: ErrorSource = described(ErrorSource.UNKNOWN, words=ErrorSource, heading="from")
    covariance: Floats = optional(6, 6)
    ambiguity: float = described(NAN, unit="times", heading="ambiguity: error of the next best attitude")
    T_best_fit: Floats = optional(4, 4, json="best_fit.T_design_scan")
    best_fit_shift: Floats = optional(3, json="best_fit.shift", unit="mm")  # of the scan's middle, from T_design_scan
    best_fit_turn: float = described(NAN, json="best_fit.turn", unit="rad")
    best_fit_area: float = described(NAN, json="best_fit.area", unit="m2", heading="best fit: area it rests on")
    T_stable_fit: Floats = optional(4, 4, json="stable_fit.T_design_scan")
    stable_fit_shift: Floats = optional(3, json="stable_fit.shift", unit="mm")
    stable_fit_turn: float = described(NAN, json="stable_fit.turn", unit="rad")
    stable_fit_area: float = described(NAN, json="stable_fit.area", unit="m2", heading="stable fit: area it rests on")
    stable_fit_share: float = described(
        NAN, json="stable_fit.area_share", percent=True, heading="stable fit: share of the area measured"
    )
    stable_fit_limit: float = described(NAN, json="stable_fit.limit", unit="mm", heading="stable fit: agreement within")
    core_points: int = described(0, heading="core points")
    core_points_measured: int = described(0, heading="core points measured")
    significant_share: float = described(NAN, percent=True, heading="beyond LOD95")
    significant_share_ci95: Floats = optional(2, percent=True, heading="beyond LOD95, 95 % interval")
    within_10mm_share: float = described(NAN, percent=True, heading="within 10 mm")
    mean: float = described(NAN, unit="mm", heading="mean")
    mean_ci95: Floats = optional(2, unit="mm", heading="mean, 95 % interval")
    median: float = described(NAN, unit="mm", heading="median")
    sd: float = described(NAN, unit="mm", heading="standard deviation")
    min: float = described(NAN, unit="mm", heading="least")
    min_ci95: Floats = optional(2, unit="mm", heading="least, 95 % interval")
    max: float = described(NAN, unit="mm", heading="greatest")
    max_ci95: Floats = optional(2, unit="mm", heading="greatest, 95 % interval")
    lod95_median: float = described(NAN, unit="mm", heading="LOD95, median")
    points_read: int = described(0, json="points.read", heading="points read")
    points_kept: int = described(0, json="points.kept", heading="points kept by the outlier removal")
    on_surface_share: float = described(NAN, json="points.on_surface", percent=True, heading="points on the surface")
    spacing: float = described(NAN, unit="mm", heading="spacing of the scan")
    sigma: float = described(NAN, unit="mm", heading="sd of a point from the surface")
    normal_diameter: float = described(NAN, unit="mm", heading="normal diameter")
    projection_diameter: float = described(NAN, unit="mm", heading="projection diameter")
    max_depth: float = described(NAN, unit="mm", heading="depth to either side")
    origin: Floats = dataclasses.field(
        default_factory=lambda: np.zeros(3), metadata={"shape": (3,), "dtype": np.float64, "json": ""}
    )
    core: CorePoints = dataclasses.field(default_factory=CorePoints, metadata={"json": ""})
    limits: JudgedLimits | None = newer()
    parts: PartFits | None = newer()  # of a bridge; then the fields of one registration are empty
    bodies: tuple[str, ...] = names("b", json="", newer=True)  # of the design, by name

    @property
    def overall(self) -> Verdict:
        """The worst verdict on the deviations of components; none without a limit."""
        return Verdict.NONE if self.limits is None else self.limits.overall
