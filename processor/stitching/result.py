"""The result of step ``stitch``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from processor.limits.judging import JudgedLimits
from processor.model import (
    AMOUNT,
    COORDINATE,
    COUNT,
    COVARIANCE,
    POSE,
    RATIO,
    SCALED_POSE,
    SHARE,
    Bools,
    Checked,
    Floats,
    Ints,
    Reason,
    Rows,
    Status,
    Verdict,
    Word,
    column,
    described,
    name_lists,
    names,
    newer,
    optional,
    reasons,
    words,
)

NAN = float("nan")


class ProjectFrame(Word):
    """The frame that the poses of all scans lead to."""

    PRCS = "PRCS"  # that of the reference scan
    GLCS = "GLCS"  # that of the control points, or the one that the given pose of the reference scan leads to


@dataclass(frozen=True)
class Scans(Rows):
    """The scans with their poses in the project's frame, mm; NaN without a pose.

    Covariances: order (rotation about x, y, z of the project's frame in rad; translation in mm), left perturbation
    T = exp(xi) T_project_scan. They are relative to the reference scan, unless control points fix the frame.

    With ``[stitch] scale = "free"`` a pose holds the scale of its scan: T_project_scan = [s R, t]. The covariance is
    then that of the rotation about the scan's ``position`` and of this position, transformed to the project's origin.
    It does not contain the scale: an error of the scale (``scale_sd``) moves a point in proportion to its distance from
    the position.
    """

    name: tuple[str, ...] = names("k")
    status: tuple[Status, ...] = words("k", Status)
    reasons: tuple[tuple[Reason, ...], ...] = reasons("k")
    T_project_scan: Floats = column("k", 4, 4, means=SCALED_POSE)
    covariance: Floats = column("k", 6, 6, means=COVARIANCE)
    position: Floats = column(
        "k", 3, unit="mm", means=COORDINATE
    )  # of the scanner; if unknown, of the centroid of the points
    position_sd: Floats = column("k", 3, unit="mm", means=AMOUNT)
    rotation_sd: Floats = column("k", 3, unit="rad", means=AMOUNT)  # about the project's axes
    scale: Floats = column("k", means=AMOUNT)  # of T_project_scan; 1 unless it is free
    scale_sd: Floats = column("k", means=AMOUNT)
    rivalry: Floats = column("k", means=RATIO)  # score of the next best pose by that of the best one
    T_rival_scan: Floats = column("k", 4, 4, nullable=True, means=SCALED_POSE)
    from_frame: tuple[str, ...] = names("k", json="from")  # of T_project_scan
    to_frame: tuple[str, ...] = names("k", json="to")

    @property
    def placed(self) -> Bools:
        """Which scans (k,) have a pose."""
        return np.asarray(np.isfinite(self.T_project_scan).all(axis=(1, 2)))


@dataclass(frozen=True)
class Pairs(Rows):
    """Pairs of scans, each registered by itself; ``covariance`` is in the frame of a, ordered as in :class:`Scans`."""

    a: tuple[str, ...] = names("p")
    b: tuple[str, ...] = names("p")
    overlap: Floats = column("p", means=SHARE)  # share of the surface of both scans that the other one sees too
    residual: Floats = column("p", unit="mm", means=AMOUNT)  # rms
    used: Bools = column("p", dtype=np.bool_)
    reasons: tuple[tuple[Reason, ...], ...] = reasons("p")
    shared: Ints = column("p", dtype=np.int64, means=COUNT)  # planar pieces or picked points that both scans have
    T_a_b: Floats = column("p", 4, 4, means=SCALED_POSE)  # with ``scale`` where that is free
    covariance: Floats = column("p", 6, 6, means=COVARIANCE)
    scale: Floats = column(
        "p", means=AMOUNT
    )  # three-point: of b in a; with six parameters a diagnostic, which T_a_b does not hold
    scale_sd: Floats = column("p", means=AMOUNT)
    from_frame: tuple[str, ...] = names("p", json="from")  # of T_a_b
    to_frame: tuple[str, ...] = names("p", json="to")


@dataclass(frozen=True)
class Closures(Rows):
    """Misclosures of loops of pairs, by the pairs' own poses."""

    loop: tuple[tuple[str, ...], ...] = name_lists("l")  # names of the scans; the first again at the end
    mm: Floats = column("l", unit="mm", means=AMOUNT)
    mrad: Floats = column("l", unit="mrad", means=AMOUNT)
    ratio: Floats = column("l", means=AMOUNT)  # chi-square by the pairs' covariances over its 6 degrees of freedom


@dataclass(frozen=True)
class ControlSightings(Rows):
    """Sightings of control points after the adjustment, in the project's frame; NaN in scans without a pose."""

    point: tuple[str, ...] = names("c", json="name")
    scan: tuple[str, ...] = names("c")
    off: Floats = column("c", 3, unit="mm", means=COORDINATE)  # known less seen place
    sd: Floats = column(
        "c", 3, unit="mm", means=AMOUNT
    )  # of ``off``; of an unused sighting that of its prediction by the others
    share: Floats = column(
        "c", means=SHARE
    )  # of an error of the sighting that is visible in ``off``; the poses absorb the rest
    used: Bools = column("c", dtype=np.bool_)


@dataclass(frozen=True)
class ControlPoints(Checked):
    """How control points fix the frame of the scans."""

    holds: bool = False  # whether the project's frame is theirs; False: too few, it is the reference scan's
    redundancy: int = described(0, means=COUNT)  # degrees of freedom
    ratio: float = described(NAN, means=AMOUNT)  # chi-square of the misfits over the redundancy; expected: 1
    loosened: float = described(
        1.0, means=AMOUNT
    )  # factor that the standard deviations of control points were multiplied by
    sightings: ControlSightings = dataclasses.field(default_factory=ControlSightings)


@dataclass(frozen=True)
class Result(Checked):
    """All scans in one frame, the project's, as ``frame`` names it. NaN = no value."""

    status: Status = described(words=Status)
    method: str = described()
    reasons: tuple[Reason, ...] = reasons()
    reference: str = ""
    scans: Scans = dataclasses.field(default_factory=Scans)
    pairs: Pairs = dataclasses.field(default_factory=Pairs)
    closures: Closures = dataclasses.field(default_factory=Closures)
    noise_mm: float = described(NAN, means=AMOUNT)  # estimated standard deviation of single points along the ray
    patch_mm: float = described(NAN, means=AMOUNT)  # the same of the error that neighbouring points have in common
    ends_share: float = described(
        NAN, means=AMOUNT
    )  # the same of ends of faces, by the standard deviation of a single end
    frame: ProjectFrame = described(ProjectFrame.PRCS, words=ProjectFrame)
    T_GLCS_PRCS: Floats = optional(4, 4, means=POSE)
    control: ControlPoints | None = newer()
    limits: JudgedLimits | None = newer()

    @property
    def overall(self) -> Verdict:
        """The worst verdict on the network of scans; none without a limit."""
        return Verdict.NONE if self.limits is None else self.limits.overall

    @property
    def by_control(self) -> bool:
        """Whether control points fix the frame."""
        return self.control is not None and self.control.holds
