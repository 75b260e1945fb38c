"""The result of step ``preassemble``."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor.model import (
    AMOUNT,
    COORDINATE,
    COVARIANCE,
    ENDS,
    KEY_POINTS,
    NUMBER,
    POSE,
    Checked,
    Floats,
    Labels,
    Meaning,
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
    worst,
)
from processor.preassembly.chain.joint_measures import Measures
from processor.preassembly.parts.systematic_errors import BudgetSource
from processor.preassembly.verdicts.joints import Conformity
from processor.preassembly.verdicts.trim_and_build_up import Proposal

NAN = float("nan")
MEAN_MAX = ("mean", "max")


class Gauge(Word):
    """What fixes the assembled chain in the bridge's frame."""

    UNKNOWN = ""
    ALL = "all joints and the design's curve at once"
    PRINCIPAL_AXES = "Foot 1 at its principal-axes attitude, its joint corners on the design's"
    LINES = "Foot 1 aligned to the design's lines"


class EdgeSide(Word):
    """A bottom edge of the bridge."""

    LEFT = "left"
    RIGHT = "right"


@dataclass(frozen=True)
class AtJoints(Rows):
    """The key points P1..P8 of one component at each of its joints, in the frame of its scan."""

    joint: tuple[str, ...] = names("e")
    key_points_scan: Floats = column("e", 8, 3, axes=(KEY_POINTS,), unit="mm", means=COORDINATE)
    key_points_sd: Floats = column("e", 8, 3, axes=(KEY_POINTS,), unit="mm", means=AMOUNT)


@dataclass(frozen=True)
class ScanPoses(Rows):
    """The scans that were used of one component, each with its pose as assembled."""

    name: tuple[str, ...] = names("s")
    T_bridge_scan: Floats = column("s", 4, 4, means=POSE)


@dataclass(frozen=True)
class Components(Rows):
    """The components in assembly order. Axis of length 2: start and end of a component. NaN = not known.

    ``scans`` names those used; poses and key points P1..P8 are in the frame of the first. The paper's methods state no
    covariance. A component that is left or right part of several joints has no start and end; then ``at_joints`` has
    the key points of all components by joint. Where several scans of a component were used, ``scan_poses`` has the pose
    of each scan of every component.
    """

    name: tuple[str, ...] = names("c")
    status: tuple[Status, ...] = words("c", Status)
    reasons: tuple[tuple[Reason, ...], ...] = reasons("c")
    scans: tuple[str, ...] = names("c")
    T_bridge_scan: Floats = column("c", 4, 4, means=POSE)
    covariance: Floats = column("c", 6, 6, means=COVARIANCE)
    key_points_scan: Floats = column("c", 2, 8, 3, axes=(ENDS, KEY_POINTS), means=COORDINATE)
    key_points_sd: Floats = column("c", 2, 8, 3, axes=(ENDS, KEY_POINTS), means=AMOUNT)
    at_joints: tuple[AtJoints, ...] = dataclasses.field(
        default=(), metadata={"json": "joints", "by": "joint", "newer": True}
    )
    scan_poses: tuple[ScanPoses, ...] = dataclasses.field(
        default=(), metadata={"json": "scan_poses", "by": "name", "newer": True}
    )

    def poses_of_scans(self, row: int) -> dict[str, Floats]:
        """Return T_bridge_scan (4, 4) of each scan of a component by name; empty for one that has no pose."""
        if not np.isfinite(self.T_bridge_scan[row]).all():
            return {}
        if self.scan_poses:
            poses = self.scan_poses[row]
            return dict(zip(poses.name, poses.T_bridge_scan, strict=True))
        return {self.scans[row]: self.T_bridge_scan[row]}


@dataclass(frozen=True)
class Joints(Rows):
    """The joints: gaps are right part minus left part at the assembled pose, bridge axes, mm."""

    name: tuple[str, ...] = names("j")
    left: tuple[str, ...] = names("j")
    right: tuple[str, ...] = names("j")
    gaps: Floats = column("j", 8, 3, json="points.*.gap", keys=KEY_POINTS, unit="mm", means=COORDINATE)
    gap_ci95: Floats = column("j", 8, 3, json="points.*.ci95", keys=KEY_POINTS, unit="mm", means=AMOUNT)
    verdict: tuple[Verdict, ...] = words("j", Verdict)


@dataclass(frozen=True)
class MeanMax(Checked):
    """Mean and largest error, mm, with half-widths that cover both with 95 % or more, where a method states them."""

    mean: float = described(NAN, unit="mm", means=AMOUNT)
    max: float = described(NAN, unit="mm", means=AMOUNT)
    ci95: Floats = optional(2, json="*_ci95", keys=MEAN_MAX, unit="mm", means=AMOUNT)


@dataclass(frozen=True)
class Deviations(Checked):
    """Distances of the bottom edges from the design's, at the chainages of the linear error, mm."""

    error: MeanMax = dataclasses.field(default_factory=MeanMax, metadata={"json": "."})
    deviation: Floats = column("s", unit="mm", means=COORDINATE)
    ci95: Floats = column("b", unit="mm", means=AMOUNT)  # half-width that holds 95 % or more; of some methods empty


@dataclass(frozen=True)
class Linear(Checked):
    """Linear error as assembled, and with Foot 1 best-fit to the design.

    ``chainage`` is the arc length from the start of the design's bottom edge.
    """

    gauge: Gauge = described(Gauge.UNKNOWN, words=Gauge)
    chainage: Floats = column("s", json="stations", unit="mm", means=COORDINATE)
    edge: tuple[EdgeSide, ...] = words("s", EdgeSide)
    assembled: Deviations = dataclasses.field(default_factory=Deviations, metadata={"json": "."})
    best_fit: Deviations = dataclasses.field(default_factory=Deviations, metadata={"json": "foot1_best_fit"})


@dataclass(frozen=True)
class TradeOff(Rows):
    """Errors over the weight lambda of the design's curve, mm."""

    weight: Floats = column("t", json="lambda", means=AMOUNT)
    splicing_mean: Floats = column("t", unit="mm", means=AMOUNT)
    splicing_max: Floats = column("t", unit="mm", means=AMOUNT)
    linear_mean: Floats = column("t", unit="mm", means=AMOUNT)
    linear_max: Floats = column("t", unit="mm", means=AMOUNT)

    @property
    def figures(self) -> Floats:
        """All four errors (t, 4)."""
        return np.column_stack([self.splicing_mean, self.splicing_max, self.linear_mean, self.linear_max])


@dataclass(frozen=True)
class JudgedJoints(Rows):
    """Each joint: its measures, the comparison with the limits, and the proposal."""

    name: tuple[str, ...] = names("j")
    measures: tuple[Measures, ...] = described((), json=".")
    conformity: tuple[Conformity, ...] = described((), json=".")
    proposal: tuple[Proposal, ...] = described(())


@dataclass(frozen=True)
class Rivals(Rows):
    """The other pose of each ambiguous component."""

    component: tuple[str, ...] = names("r")
    T_rival_scan: Floats = column("r", 4, 4, means=POSE)


@dataclass(frozen=True)
class Residuals(Rows):
    """Places on all components, bridge frame, and distances from the design there, medians of nearby points, mm."""

    points: Floats = column("p", 3, unit="mm", means=COORDINATE)
    distance: Floats = column("p", unit="mm", means=COORDINATE)
    component: Labels = column(
        "p", dtype=np.int32, means=Meaning(rows_of="/result.components.name", lowest_row=-1)
    )  # row of the components


@dataclass(frozen=True)
class Loops(Rows):
    """Closure of closed loops of parts by their joints alone.

    ``joint`` was left open. The closure is the motion of its right part against its left one in the joint's axes: along
    them in mm, about them in mrad. ``joints`` are the others of the loop.
    """

    joint: tuple[str, ...] = names("l")
    joints: tuple[tuple[str, ...], ...] = name_lists("l")
    closure: Floats = column("l", 2, 3, json="closure.*", keys=("mm", "mrad"), means=NUMBER)
    closure_ci95: Floats = column("l", 2, 3, json="closure.ci95_*", keys=("mm", "mrad"), means=AMOUNT)


@dataclass(frozen=True)
class PartShape(Checked):
    """The ends and bottom edges of one component as measured, for steps that judge it by itself; NaN = not known.

    Bridge frame, at the pose of the component's registration and the reference temperature, mm. Axis of length 2: start
    and end of the component. ``covariance`` (48, 48) is of the ends' coordinates, point by point. Departures (k, 2) of
    the edges are to the left and up, with a ``covariance`` (k, k) of each. ``outer`` is by what the end that no joint
    measures departs outward along the component, at the middle of its bottom.
    """

    name: str = described("")
    ends: Floats = column(2, 8, 3, means=COORDINATE)
    ends_covariance: Floats = column(48, 48, means=COVARIANCE)
    edge: tuple[EdgeSide, ...] = words("k", EdgeSide)
    chainage: Floats = column("k", means=COORDINATE)  # from the component's start
    departure: Floats = column("k", 2, means=COORDINATE)
    departure_covariance: Floats = column(2, "k", "k", means=COVARIANCE)
    outer: float = described(NAN, means=COORDINATE)
    outer_variance: float = described(NAN, means=AMOUNT)


@dataclass(frozen=True)
class Adjustment(Checked):
    """What the adjustment alone states.

    ``linear_offset`` is from the design's bottom edges to the left and up, as assembled.
    ``chain`` has the comparison of span and edges with the limits of the whole chain, ``unused_limits`` those that a
    project gives and nothing is compared with. ``closure`` is of the joints alone: along the bridge's axes (mm) and
    about them (mrad). ``budget_sd`` are standard deviations of an end of the longest part.
    """

    weight: float = described(NAN, json="lambda", means=AMOUNT)
    joints: JudgedJoints = dataclasses.field(default_factory=JudgedJoints, metadata={"json": "joint_measures"})
    chain: tuple[Conformity, ...] = described((), json="chain_limits")
    unused_limits: tuple[str, ...] = names("u", json="limits_not_held")
    unused_limits_what: tuple[str, ...] = names("u", json="")
    span_departure: float = described(NAN, json="span.departure", unit="mm", means=COORDINATE)
    span_ci95: float = described(NAN, json="span.ci95", unit="mm", means=AMOUNT)
    linear_offset: Floats = column("o", 2, json="linear_offset.left_up", unit="mm", means=COORDINATE)
    linear_offset_ci95: Floats = column("o", 2, json="linear_offset.ci95", unit="mm", means=AMOUNT)
    closure: Floats = optional(2, 3, json="closure.*", keys=("mm", "mrad"), means=NUMBER)
    closure_ci95: Floats = optional(2, 3, json="closure.ci95_*", keys=("mm", "mrad"), means=AMOUNT)
    rivals: Rivals = dataclasses.field(default_factory=Rivals, metadata={"json": "ambiguous", "by": "component"})
    limiting: tuple[Reason, ...] = reasons()
    advice: tuple[Reason, ...] = reasons()
    budget_sd: Floats = optional(
        len(BudgetSource), json="budget_sd.*", keys=tuple(BudgetSource), unit="mm", means=AMOUNT
    )
    residuals: Residuals = dataclasses.field(default_factory=Residuals, metadata={"json": ""})
    loops: Loops | None = newer()
    shapes: tuple[PartShape, ...] = described((), json="")


@dataclass(frozen=True)
class Result(Checked):
    """The assembled bridge; NaN = not known."""

    status: Status = described(words=Status)
    method: str = described()
    reasons: tuple[Reason, ...] = reasons()
    components: Components = dataclasses.field(default_factory=Components)
    joints: Joints = dataclasses.field(default_factory=Joints)
    splicing: MeanMax = dataclasses.field(default_factory=MeanMax, metadata={"json": "splicing_error"})
    linear: Linear = dataclasses.field(default_factory=Linear, metadata={"json": "linear_error"})
    trade_off: TradeOff = dataclasses.field(default_factory=TradeOff)
    adjustment: Adjustment | None = described(None, json=".")

    @property
    def overall(self) -> Verdict:
        """The worst verdict on the joints and on the limits of the whole chain."""
        chain = () if self.adjustment is None else self.adjustment.chain
        return worst([*self.joints.verdict, *(one.verdict for one in chain if len(one.limits))])

    @property
    def verified(self) -> bool:
        """Whether all limits that were used are checked against the standard's text, or given by the project."""
        if self.adjustment is None:
            return True
        compared = (*self.adjustment.joints.conformity, *self.adjustment.chain)
        return all(bool(one.limits.verified.all()) for one in compared)

    @property
    def errors(self) -> tuple[MeanMax, MeanMax, MeanMax]:
        """Splicing error, linear error as assembled and with Foot 1 best-fit to the design."""
        return self.splicing, self.linear.assembled.error, self.linear.best_fit.error

    @property
    def errors_ci95(self) -> Floats:
        """95 % half-widths (6,) of mean and largest of :attr:`errors`; (0,) of a method that states none."""
        return np.concatenate([error.ci95 for error in self.errors])


def overall_status(statuses: Sequence[Status]) -> Status:
    """Return the status of a step by those of its parts."""
    if all(status == Status.OK for status in statuses):
        return Status.OK
    return Status.FAILED if all(status == Status.FAILED for status in statuses) else Status.PARTIAL
