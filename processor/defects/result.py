"""The result of step ``defects``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.limits.judging import JudgedLimits
from processor.model import (
    AMOUNT,
    COORDINATE,
    COUNT,
    COVARIANCE,
    DIRECTION,
    NAMES,
    NUMBER,
    OPEN,
    POSE,
    RATIO,
    SHARE,
    Checked,
    Codes,
    Floats,
    Ints,
    Labels,
    Meaning,
    Reason,
    Rows,
    Shorts,
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

NAN = float("nan")
DOUBTFUL = 0.01  # false alarms as strong on 100 m2, above which a defect is doubtful


class DefectClass(Word):
    """What a defect is."""

    DENT = "dent"
    BULGE = "bulge"
    BEND = "bend"
    TWIST = "twist"
    WAVINESS = "waviness"
    EDGE_LOSS = "edge-loss"
    MISSING_PART = "missing-part"
    PIT = "pit"
    CRACK = "crack"
    STEP = "step"
    MISALIGNMENT = "misalignment"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Curve(Checked):
    """A deflection curve, mm: distance along the component, displacement outward, half-width of its 95 % interval."""

    along: Floats = column("c", optional=True, means=COORDINATE)
    displacement: Floats = column("c", optional=True, means=COORDINATE)
    ci95: Floats = column("c", optional=True, means=AMOUNT)


@dataclass(frozen=True)
class Picture(Checked):
    """Deviations about a defect on a grid along the defect's face.

    ``low`` (2,) is the corner of the first cell relative to the defect's centre. ``deviation`` is outward positive,
    NaN without points; ``part`` is 1 where the cell belongs to the defect. Both are empty where no cell can be shown.
    """

    low: Floats = dataclasses.field(
        default_factory=lambda: np.zeros(2),
        metadata={"shape": (2,), "dtype": np.float64, "unit": "mm", "means": COORDINATE},
    )
    cell: float = described(NAN, unit="mm", means=AMOUNT)
    deviation: Shorts = column("u", "v", dtype=np.float32, unit="mm", means=COORDINATE)
    part: Codes = column("u", "v", dtype=np.uint8, means=Meaning(most=1.0))


@dataclass(frozen=True)
class Windows(Rows):
    """Sizes of search window: the least mean depth that is found, and how much window means scatter beyond noise."""

    side: Floats = column("s", unit="mm", means=AMOUNT)
    depth: Floats = column("s", unit="mm", means=AMOUNT)
    noise_inflation: Floats = column("s", means=AMOUNT)


@dataclass(frozen=True)
class SurfacePlaces(Rows):
    """Places spread over the scanned surface, few enough to be drawn, and all places of small defects."""

    points: Floats = column("t", 3, unit="mm", means=COORDINATE)
    deviation: Shorts = column("t", dtype=np.float32, unit="mm", means=COORDINATE)  # outward positive
    defect: Labels = column(
        "t", dtype=np.int32, means=Meaning(rows_of="/result.defects.id", lowest_row=-1)
    )  # row of the defect, -1 = none


@dataclass(frozen=True)
class Defects(Rows):
    """Defects in the design's frame; a depth inward is positive.

    ``otherwise`` is the second most probable class. ``axes`` are unit directions of the largest extent, of the extent
    across and outward; ``extent`` holds the full lengths along the first two. ``chance`` is the expected number of
    false alarms as strong on 100 m2.
    """

    id: Ints = column("k", dtype=np.int64, means=NAMES)
    defect_class: tuple[DefectClass, ...] = words("k", DefectClass, json="class")
    confidence: Floats = column("k", means=SHARE)
    otherwise: tuple[DefectClass, ...] = words("k", DefectClass)
    component: tuple[str, ...] = names("k")
    centre: Floats = column("k", 3, unit="mm", means=COORDINATE)
    area_mm2: Floats = column("k", means=AMOUNT)
    depth_max: Floats = column("k", unit="mm", means=COORDINATE)
    depth_ci95: Floats = column("k", unit="mm", means=RATIO)
    depth_mean: Floats = column("k", unit="mm", means=COORDINATE)
    volume_mm3: Floats = column("k", means=NUMBER)
    volume_ci95: Floats = column("k", unit="mm3", means=RATIO)
    axes: Floats = column("k", 3, 3, means=DIRECTION)
    extent: Floats = column("k", 2, unit="mm", means=AMOUNT)
    edge_distance: Floats = column("k", unit="mm", means=COORDINATE)  # from the centre to the border of the face
    curvature_per_m: Floats = column(
        "k", means=NUMBER
    )  # largest principal curvature of the deviation at the deepest place
    lod95: Floats = column("k", unit="mm", means=AMOUNT)  # of a mean over the defect
    z: Floats = column("k", means=OPEN)  # deviation by its standard deviation
    chance: Floats = column("k", json="by_chance_on_100_m2", means=RATIO)
    doubtful: npt.NDArray[np.bool_] = column(
        "k", dtype=np.bool_
    )  # chance above DOUBTFUL, an ambiguous pose, or hidden beside
    reasons: tuple[tuple[Reason, ...], ...] = reasons("k")
    deflection: tuple[Curve, ...] = ()  # empty curves where a defect has none

    @property
    def depth_is_bound(self) -> npt.NDArray[np.bool_]:
        """Return which depths (k,) are lower bounds."""
        return np.array([any(reason.code == "defects.depth-bound" for reason in row) for row in self.reasons], np.bool_)


@dataclass(frozen=True)
class PartPoses(Rows):
    """The parts of a bridge, each at the best fit to its own design; poses are of the bridge's frame as registered."""

    name: tuple[str, ...] = names("p")
    status: tuple[Status, ...] = words("p", Status)
    reasons: tuple[tuple[Reason, ...], ...] = reasons("p")
    T_design_project: Floats = column("p", 4, 4, means=POSE)
    covariance: Floats = column("p", 6, 6, means=COVARIANCE)
    noise: Floats = column("p", unit="mm", means=AMOUNT)
    lod95: Floats = column("p", unit="mm", means=AMOUNT)
    examined_mm2: Floats = column("p", means=AMOUNT)
    expected_mm2: Floats = column("p", means=AMOUNT)
    defects: Ints = column("p", dtype=np.int64, means=COUNT)


@dataclass(frozen=True)
class Result(Checked):
    """Defects of a structure.

    ``T_design_project`` maps the frame of the scans as merged, and was used for all places; ``covariance`` (turn about
    the design frame's axes, translation) is its own. ``registration_error``, ``noise`` of a point and
    ``lod95`` of a cell are medians over the surface. ``examined_mm2`` is the area searched for deviations,
    ``expected_mm2`` the area that scanners should have seen. ``points_used`` are within reach of the design.
    ``pictures`` are of the first defects, in order.
    """

    status: Status = described(words=Status)
    method: str = described()
    reasons: tuple[Reason, ...] = reasons()
    T_design_project: Floats = optional(4, 4, means=POSE)
    covariance: Floats = optional(6, 6, means=COVARIANCE)
    registration_error: float = described(NAN, unit="mm", means=AMOUNT)  # one standard deviation
    cell: float = described(NAN, unit="mm", means=AMOUNT)
    noise: float = described(NAN, unit="mm", means=AMOUNT)  # one standard deviation
    lod95: float = described(NAN, unit="mm", means=AMOUNT)
    examined_mm2: float = described(NAN, means=AMOUNT)
    expected_mm2: float = described(NAN, means=AMOUNT)
    points: int = described(0, means=COUNT)
    points_used: int = described(0, means=COUNT)
    least_depth: Windows = dataclasses.field(default_factory=Windows)
    defects: Defects = dataclasses.field(default_factory=Defects)
    pictures: tuple[Picture, ...] = described((), json="")
    surface: SurfacePlaces = dataclasses.field(default_factory=SurfacePlaces, metadata={"json": ""})
    limits: JudgedLimits | None = newer()
    parts: PartPoses | None = newer()  # of a bridge; then the fields of one pose are empty

    @property
    def overall(self) -> Verdict:
        """The worst verdict on the defects; none without a limit."""
        return Verdict.NONE if self.limits is None else self.limits.overall
