"""The result of step ``spheres``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from processor.limits.judging import JudgedLimits
from processor.model import (
    AMOUNT,
    COORDINATE,
    COUNT,
    COVARIANCE,
    END,
    NAMES,
    POSE,
    RADIUS,
    SHARE,
    Checked,
    Floats,
    Ints,
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
    worst,
)

BOUNDED = ("x", "y", "z", "radius", "lowest")  # columns of ``bound_sd``
EFFICIENT = ("centre", "radius", "lowest")  # columns of ``efficiency``
DISPLACEMENT = ("dx", "dy", "dz")
NAN = float("nan")


class Flag(Word):
    """Whether a sphere's numbers can be relied on."""

    OK = "ok"
    LOW_CONFIDENCE = "low-confidence"
    WRONG_SIZE = "wrong-size"
    NOT_FOUND = "not-found"


LOCATED_FLAGS = (Flag.OK, Flag.LOW_CONFIDENCE, Flag.WRONG_SIZE)  # of spheres that have a place


class Evidence(Word):
    """What a sphere's centre is estimated from."""

    BALL = "ball"  # points on the sphere
    FUSED = "fused"  # points on the sphere and the axes of members
    AXES = "axes"  # axes of members alone


class MovementGauge(Word):
    """The datum that movements of nodes are relative to."""

    DESIGN = "design-coordinates"  # differences of coordinates
    BEST_FIT = "best-fit"  # of all nodes: what moved as a whole is not in them

    @classmethod
    def _missing_(cls, value: object) -> MovementGauge | None:
        """Return the gauge by its word in files of before version 2.4 of results."""
        return {"design frame": cls.DESIGN, "best fit": cls.BEST_FIT}.get(str(value))


class GaugeBasis(Word):
    """Why movements are relative to their datum."""

    STATED = "stated"  # by design_frame of the project
    CONTROL = "control"  # control points, and the nodes are at the design's places in their frame
    STATIONS = "stations"  # positions or poses of the scans, and the nodes are at the design's places in their frame
    AGREEMENT = "agreement"  # the nodes are at the design's places in the scans' coordinates; nothing states the frame
    PATTERN = "pattern"  # the pattern of the nodes alone relates scan and design


class StationMotion(Word):
    """A motion of a station in the project's frame."""

    TURN_X = "turn about x"
    TURN_Y = "turn about y"
    TURN_Z = "turn about z"
    SHIFT_X = "shift along x"
    SHIFT_Y = "shift along y"
    SHIFT_Z = "shift along z"


def _of_gauge(gauge: MovementGauge, key: str, means: Meaning, **shown: Any) -> Any:
    """Declare a column (k, 3) of movements by a gauge, mm."""
    where = "design_movement" if gauge is MovementGauge.DESIGN else "best_fit_movement"
    return column("k", 3, json=f"movements.{gauge}.{key}", where=where, unit="mm", newer=True, means=means, **shown)


@dataclass(frozen=True)
class Balls(Rows):
    """The spheres in the input's own frame (its offset added), mm. NaN = no value.

    Only method ``ray`` fills the columns from ``sizes`` on. ``bound_sd`` are the Cramér-Rao bounds of x, y, z, radius
    and lowest point, ``efficiency`` is bound over standard deviation, as by the points alone, of centre, radius and
    lowest point. Movements are in the design's frame; ``verdict`` compares them with the limit; the risks are
    the probabilities that it is wrong to accept and to reject.
    """

    ids: Ints = column("k", dtype=np.int64, json="id", means=NAMES)
    labels: tuple[str, ...] = names("k", json="id", newer=True)  # ids that are no whole numbers
    centres: Floats = column("k", 3, json="centre", unit="mm", means=COORDINATE)
    radii: Floats = column("k", json="radius", unit="mm", means=RADIUS)
    lowest: Floats = column("k", 3, unit="mm", means=COORDINATE)
    lowest_sd: Floats = column("k", unit="mm", means=AMOUNT)  # of the lowest point's z
    covariance: Floats = column("k", 4, 4, unit="mm2", means=COVARIANCE)  # of centre x, y, z and radius
    points: Ints = column("k", dtype=np.int64, means=COUNT)  # used by the estimate
    visible_fraction: Floats = column("k", means=SHARE)  # of the sphere's surface that has points
    rms: Floats = column("k", unit="mm", means=AMOUNT)  # of the residuals of those points
    nominal_radii: Floats = column("k", json="nominal_radius", unit="mm", means=RADIUS)  # from the design, NaN without
    evidence: tuple[Evidence, ...] = words("k", Evidence)
    flag: tuple[Flag, ...] = words("k", Flag)
    reasons: tuple[tuple[Reason, ...], ...] = reasons("k")  # for the flag and the evidence
    sizes: Floats = column("k", json="size", unit="mm", means=RADIUS)  # radii of the catalogue
    axes: Ints = column("k", dtype=np.int64, means=COUNT)  # number of members that meet at the node
    stations: Ints = column("k", dtype=np.int64, means=COUNT)  # number that saw the ball
    bound_sd: Floats = column("k", 5, json="bound_sd.*", keys=BOUNDED, unit="mm", means=AMOUNT)
    efficiency: Floats = column("k", 3, json="efficiency.*", keys=EFFICIENT, means=AMOUNT)
    movement: Floats = column(
        "k",
        3,
        json=("movement.vector", "movement.*"),
        keys=DISPLACEMENT,
        where="movement",
        unit="mm",
        means=COORDINATE,
    )
    movement_ci95: Floats = column("k", 3, json="movement.ci95", where="movement", unit="mm", means=AMOUNT)
    movement_covariance: Floats = column("k", 3, 3, json="", means=COVARIANCE)
    movement_size: Floats = column("k", json="movement.size", where="movement", unit="mm", means=AMOUNT)
    movement_size_ci95: Floats = column("k", json="movement.size_ci95", where="movement", unit="mm", means=AMOUNT)
    verdict: tuple[Verdict, ...] = words("k", Verdict, json="movement.verdict", where="movement")
    risk_accept: Floats = column("k", json="movement.risk_accept", where="movement", newer=True, means=SHARE)
    risk_reject: Floats = column("k", json="movement.risk_reject", where="movement", newer=True, means=SHARE)
    movement_gauge: tuple[MovementGauge, ...] = words(
        "k", MovementGauge, json="movement.gauge", where="movement", newer=True
    )
    # By each gauge; one of the two is ``movement``.
    design_movement: Floats = _of_gauge(MovementGauge.DESIGN, "*", COORDINATE, keys=DISPLACEMENT)
    design_ci95: Floats = _of_gauge(MovementGauge.DESIGN, "ci95", AMOUNT)
    best_fit_movement: Floats = _of_gauge(MovementGauge.BEST_FIT, "*", COORDINATE, keys=DISPLACEMENT)
    best_fit_ci95: Floats = _of_gauge(MovementGauge.BEST_FIT, "ci95", AMOUNT)

    @property
    def names(self) -> list[int | str]:
        """The ids, as the design has them."""
        return list(self.labels) or self.ids.tolist()

    @property
    def placed(self) -> npt.NDArray[np.bool_]:
        """Whether each sphere (k,) has a centre."""
        return np.asarray(np.isfinite(self.centres).all(axis=1))

    def flagged(self, flag: Flag) -> npt.NDArray[np.bool_]:
        """Whether each sphere (k,) has this flag."""
        return np.array([item is flag for item in self.flag], bool)


@dataclass(frozen=True)
class Tubes(Rows):
    """Members as tubes from ``start`` to ``end`` of their axes, mm, between spheres of ids ``a`` and ``b``.

    Half-widths of 95 % intervals are of the radius, of the axis across at both ends, along x, y and z, and of the bow.
    """

    a: Ints = column("m", dtype=np.int64, means=END)  # -1 = none
    b: Ints = column("m", dtype=np.int64, means=END)
    label_a: tuple[str, ...] = names("m", json="a", newer=True)  # ids that are no whole numbers; "" = none
    label_b: tuple[str, ...] = names("m", json="b", newer=True)
    start: Floats = column("m", 3, unit="mm", means=COORDINATE)
    end: Floats = column("m", 3, unit="mm", means=COORDINATE)
    radii: Floats = column("m", json="radius", unit="mm", means=RADIUS)
    bow: Floats = column("m", unit="mm", means=AMOUNT)  # largest distance of the axis from a straight line
    radius_ci95: Floats = column("m", unit="mm", means=AMOUNT)
    start_ci95: Floats = column("m", 3, unit="mm", means=AMOUNT)
    end_ci95: Floats = column("m", 3, unit="mm", means=AMOUNT)
    bow_ci95: Floats = column("m", unit="mm", newer=True, means=AMOUNT)

    @property
    def ends(self) -> list[tuple[int | str, int | str]]:
        """The ids of the spheres at both ends of each tube, as the design has them; "" = none."""
        if len(self.label_a):
            return list(zip(self.label_a, self.label_b, strict=True))
        a, b = (["" if id_ < 0 else id_ for id_ in ids.tolist()] for ids in (self.a, self.b))
        return list(zip(a, b, strict=True))


@dataclass(frozen=True)
class Hangers(Rows):
    """Vertical hangers from the lowest point ``top`` of each sphere down to ``bottom`` on the ceiling, mm.

    NaN where a sphere was not found or no ceiling is below it. Above the ceiling a length is positive. ``verdict``: of
    clearance and greatest length.
    """

    ids: Ints = column("k", dtype=np.int64, json="id", means=NAMES)
    labels: tuple[str, ...] = names("k", json="id", newer=True)  # ids that are no whole numbers
    top: Floats = column("k", 3, unit="mm", means=COORDINATE)
    bottom: Floats = column("k", 3, unit="mm", means=COORDINATE)
    length: Floats = column("k", unit="mm", means=COORDINATE)
    ci95: Floats = column("k", unit="mm", means=AMOUNT)
    verdict: tuple[Verdict, ...] = words("k", Verdict)

    @property
    def names(self) -> list[int | str]:
        """The ids of the spheres, as the design has them."""
        return list(self.labels) or self.ids.tolist()


@dataclass(frozen=True)
class StationCorrections(Rows):
    """Corrections of the stations: ``T`` (s, 4, 4) map places as registered to corrected places."""

    names: tuple[str, ...] = names("s", json="name")
    T: Floats = column("s", 4, 4, means=POSE)
    reasons: tuple[tuple[Reason, ...], ...] = reasons("s")


@dataclass(frozen=True)
class ControlDeviations(Rows):
    """Sightings of control points after the corrections of the stations."""

    points: tuple[str, ...] = names("c", json="name")
    scans: tuple[str, ...] = names("c", json="scan")
    off: Floats = column("c", 3, unit="mm", means=COORDINATE)  # known place minus sighting
    used: npt.NDArray[np.bool_] = column("c", dtype=np.bool_)  # False = left out: it contradicts the others


@dataclass(frozen=True)
class DesignPose(Checked):
    """Pose of the design, its covariance, and other poses ``rivals`` (r, 4, 4) that explain the nodes as well."""

    status: Status = described(words=Status)
    T_design_scan: Floats = column(4, 4, means=POSE)
    covariance: Floats = column(6, 6, means=COVARIANCE)
    rivals: Floats = column("r", 4, 4, means=POSE)


@dataclass(frozen=True)
class MovementReference(Checked):
    """What movements are relative to, and the limit of their size; NaN = none."""

    gauge: MovementGauge = described(words=MovementGauge)
    limit: float = described(NAN, json="movement_limit.mm", unit="mm", means=AMOUNT)
    limit_source: str = described("", json="movement_limit.source")  # name of the file or standard


@dataclass(frozen=True)
class Gauges(Checked):
    """Movements by both gauges, mm: which one is the answer, why, and how they differ.

    ``georeference_sd`` is that of a shift of all nodes in the design's coordinates along an axis, in the intervals of
    this gauge. ``difference`` (3,) is the mean of design coordinates minus best fit, ``largest_difference`` the largest
    at a node. A gauge without a mean has no movements: the scan is not in the design's coordinates.
    """

    gauge: MovementGauge = described(words=MovementGauge)
    basis: GaugeBasis = described(words=GaugeBasis)
    georeference_sd: float = described(NAN, unit="mm", means=AMOUNT)
    difference: Floats = optional(3, unit="mm", means=COORDINATE)
    largest_difference: float = described(NAN, unit="mm", means=AMOUNT)
    design_mean: Floats = optional(3, json=f"{MovementGauge.DESIGN}.mean", unit="mm", means=COORDINATE)
    design_largest: float = described(NAN, json=f"{MovementGauge.DESIGN}.largest", unit="mm", means=AMOUNT)
    best_fit_mean: Floats = optional(3, json=f"{MovementGauge.BEST_FIT}.mean", unit="mm", means=COORDINATE)
    best_fit_largest: float = described(NAN, json=f"{MovementGauge.BEST_FIT}.largest", unit="mm", means=AMOUNT)


@dataclass(frozen=True)
class Result(Checked):
    """The spheres of a scene; only method ``ray`` has tubes, stations and movements."""

    status: Status = described(words=Status)
    method: str = described()
    reasons: tuple[Reason, ...] = reasons()
    balls: Balls = dataclasses.field(default_factory=Balls)
    movement_reference: MovementReference | None = described(None, json=".")
    matching: DesignPose | None = None
    tubes: Tubes = dataclasses.field(default_factory=Tubes, metadata={"optional": True})
    stations: StationCorrections = dataclasses.field(default_factory=StationCorrections, metadata={"optional": True})
    datum: tuple[Reason, ...] = described((), reasons="", optional=True)  # what fixes all stations together
    control: ControlDeviations = dataclasses.field(default_factory=ControlDeviations, metadata={"optional": True})
    limits: JudgedLimits | None = newer()  # all but those of movements of nodes, which are in ``balls``
    hangers: Hangers | None = newer()
    gauges: Gauges | None = newer(json="movements")

    @property
    def has_bounds(self) -> bool:
        """Whether balls were found by method ``ray``, with the bounds of their estimates."""
        return len(self.balls.sizes) > 0

    @property
    def overall(self) -> Verdict:
        """The worst verdict on the nodes' movements, supports, deflections, hangers and tubes."""
        return worst((*self.balls.verdict, *(() if self.limits is None else self.limits.verdict)))
