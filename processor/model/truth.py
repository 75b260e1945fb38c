"""The truth, which evaluation alone reads, the figures that are compared with it, and runs of steps."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor.model.fields import (
    AMOUNT,
    COORDINATE,
    COUNT,
    COVARIANCE,
    DIRECTION,
    LONG,
    NAMES,
    NUMBER,
    OPEN,
    POSE,
    RADIUS,
    Bools,
    Checked,
    Codes,
    Floats,
    Ints,
    Labels,
    Meaning,
    RecordError,
    Shorts,
    Word,
    column,
    described,
    names,
    newer,
    optional,
)
from processor.model.scene import Verdict

# --- the truth: evaluation alone reads it --------------------------------------------------------------------------


@dataclass(frozen=True)
class PointLabels(Checked):
    """What each point of a scan really is: ``part`` a row of ``part_names``, ``source`` a row of SOURCES.

    Scans by rays also name the surface, and give the range measured less the true one and the cosine of incidence.
    """

    scan: str
    part_names: tuple[str, ...] = ()
    part: Labels = column("n", dtype=np.int32, means=Meaning(least=-1))  # -1 = none
    source: Codes = column("n", dtype=np.uint8, means=Meaning(most=2.0))
    surface_names: tuple[str, ...] = ()
    surface: Labels = column("n", dtype=np.int32, means=Meaning(least=-1))  # -1 = none
    range_error_mm: Shorts = column("n", dtype=np.float32, means=COORDINATE)
    incidence_cos: Shorts = column("n", dtype=np.float32, means=NUMBER)
    defect: Labels = column(
        "n", dtype=np.int32, newer=True, means=Meaning(least=-1)
    )  # id of the defect that displaced the surface, -1 = none


SOURCES = ("surface", "mixed", "outlier")  # the footprint on one surface; on several, or past an edge; a stray return


@dataclass(frozen=True)
class ArchTruth(Checked):
    """The true pose and key points of each component. Axis of length 2: start, end; NaN where an end has none.

    ``edges_bridge`` are points from the start to the end along the bottom edges, left and right; NaN without any.
    A component that is left or right part of several joints has the key points of each in a row of ``branch_*``.
    """

    names: tuple[str, ...] = names("c")
    T_bridge_scan: Floats = column("c", 4, 4, means=POSE)
    key_points_scan: Floats = column("c", 2, 8, 3, means=COORDINATE)
    key_points_bridge: Floats = column("c", 2, 8, 3, means=COORDINATE)
    edges_bridge: Floats = column("c", 2, "e", 3, means=COORDINATE)
    branch_component: Ints = column("b", dtype=np.int64, newer=True, means=Meaning(rows_of="names"))  # row of names
    branch_joint: Ints = column("b", dtype=np.int64, newer=True, means=COUNT)  # row of the design's joints
    branch_scan: Floats = column("b", 8, 3, newer=True, means=COORDINATE)
    branch_bridge: Floats = column("b", 8, 3, newer=True, means=COORDINATE)


@dataclass(frozen=True)
class FrameTruth(Checked):
    """The true balls, in the frame of the scan: as built, not as designed.

    ``lowest`` is the lowest point of the sphere, its centre minus its radius: where a ball has its process hole, the
    hole cuts that point away.
    """

    ids: Ints = column("k", dtype=np.int64, means=NAMES)
    centres: Floats = column("k", 3, means=COORDINATE)
    radii: Floats = column("k", means=RADIUS)
    lowest: Floats = column("k", 3, means=COORDINATE)


@dataclass(frozen=True)
class StationTruth(Checked):
    """Where the scanners really stood, and the systematic errors each had; both axes of ``tilt`` in rad."""

    ids: tuple[str, ...] = names("k")
    T_project_station: Floats = column("k", 4, 4, means=POSE)
    zero_offset_mm: Floats = column("k", means=COORDINATE)
    scale_ppm: Floats = column("k", means=NUMBER)
    tilt: Floats = column("k", 2, means=NUMBER)


@dataclass(frozen=True)
class AsBuilt(Checked):
    """What was built or happened otherwise than designed: a row per number, e.g. ("bow, up", "rib1", 3.2, "mm")."""

    what: tuple[str, ...] = names("i")
    where: tuple[str, ...] = names("i")
    value: Floats = column("i", means=NUMBER)
    unit: tuple[str, ...] = names("i")


@dataclass(frozen=True)
class BodyTruth(Checked):
    """The bodies of a structure by name, how each moved as a whole, and the row (m,) of the body of each true point.

    ``shift`` is that of the middle of a body's box in the design, ``turn`` the rotation vector about it; NaN for a
    body that is missing. Bends and dents are none of either.
    """

    names: tuple[str, ...] = names("b")
    of_point: Labels = column("m", dtype=np.int32, means=Meaning(rows_of="names", lowest_row=-1))
    shift: Floats = column("b", 3, means=COORDINATE)  # mm
    turn: Floats = column("b", 3, means=NUMBER)  # rad

    @property
    def moved(self) -> Bools:
        """Whether each body (b,) moved as a whole."""
        known = np.isfinite(self.shift).all(axis=1)
        changed: Bools = known & ((self.shift != 0.0).any(axis=1) | (self.turn != 0.0).any(axis=1))
        return changed


@dataclass(frozen=True)
class StructureTruth(Checked):
    """Points of the design's surface with their outward normals, and where the structure really has them (mm).

    ``bodies`` are None where the structure is no model of named bodies.
    """

    points: Floats = column("m", 3, means=COORDINATE)
    normals: Floats = column("m", 3, means=DIRECTION)
    displacement: Floats = column("m", 3, means=COORDINATE)
    bodies: BodyTruth | None = newer()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.bodies is not None and len(self.bodies.of_point) != len(self.points):
            raise RecordError(
                f"StructureTruth.bodies: expected a row for each of {len(self.points)} points, "
                f"found {len(self.bodies.of_point)}"
            )


@dataclass(frozen=True)
class DefectTruth(Checked):
    """The defects of a structure, in the design's frame; a depth inward is positive."""

    ids: Ints = column("k", dtype=np.int64, means=NAMES)
    classes: tuple[str, ...] = names("k")
    components: tuple[str, ...] = names("k")
    centres: Floats = column("k", 3, means=COORDINATE)
    area_mm2: Floats = column("k", means=AMOUNT)
    depth_max_mm: Floats = column("k", means=COORDINATE)
    volume_mm3: Floats = column("k", means=NUMBER)


@dataclass(frozen=True)
class PoseTruth(Checked):
    """Where the design lies in a scene whose scans are in another frame than the design.

    ``covariance``, turn about the design frame's axes and shift: of the motion that errors of the scan's stations look
    like, which no method can distinguish from a movement of the whole.
    """

    T_design_project: Floats = column(4, 4, means=POSE)
    covariance: Floats = optional(6, 6, newer=True, means=COVARIANCE)


@dataclass(frozen=True)
class TargetTruth(Checked):
    """Targets as placed, in the project's frame: centres of patterns and of spheres."""

    ids: tuple[str, ...] = names("k")
    kinds: tuple[str, ...] = names("k")
    positions: Floats = column("k", 3, means=COORDINATE)


@dataclass(frozen=True)
class Truth(Checked):
    """What the generator knows and no step may see."""

    labels: tuple[PointLabels, ...] = ()
    arch: ArchTruth | None = None
    frame: FrameTruth | None = None
    spacing_mm: float = described(float("nan"), means=AMOUNT)
    sigma_mm: float = described(float("nan"), means=AMOUNT)
    structure: StructureTruth | None = None
    defects: DefectTruth | None = None
    stations: StationTruth | None = None
    as_built: AsBuilt | None = None
    pose: PoseTruth | None = newer()  # without it the scans are in the design's frame
    targets: TargetTruth | None = newer()


# --- checks ---------------------------------------------------------------------------------------------------------


class Statistic(Word):
    """What a metric takes of a quantity; the word is its part of the metric's name."""

    VALUE = "value"
    COUNT = "count"
    SHARE = "share"
    MEDIAN = "median"
    MEAN = "mean"
    RMS = "rms"
    P95 = "95th percentile"
    MAX = "max"
    BIAS = "bias"
    SD = "standard deviation"
    ERROR_95 = "95 % error"
    NUMBER = "number"  # of errors that the other statistics are made from
    EFFICIENCY = "efficiency"  # least possible standard deviation by the real one
    COVERAGE = "coverage"  # share of errors within their 95 % intervals
    PULL_RMS = "rms of error by standard deviation"


class Better(Word):
    """Which way a metric is better."""

    LOW = "low"
    HIGH = "high"
    ZERO = "zero"
    ONE = "one"
    NOMINAL_95 = "95"


BETTER = {
    Statistic.BIAS: Better.ZERO,
    Statistic.NUMBER: Better.HIGH,
    Statistic.EFFICIENCY: Better.HIGH,
    Statistic.COVERAGE: Better.NOMINAL_95,
    Statistic.PULL_RMS: Better.ONE,
}  # of all other statistics low, where the metric does not state otherwise
METRIC_NAMES = {
    Statistic.VALUE: "{quantity}",
    Statistic.COUNT: "{quantity}",
    Statistic.SHARE: "{quantity}",
    Statistic.COVERAGE: "{quantity} within their 95 % intervals",
}


@dataclass(frozen=True)
class Metric:
    """One figure compared with the truth. Without a limit (NaN) it informs and always passes.

    ``quantity`` is an English name, of which a catalogue has the translation; ``step`` is set by the report of all
    steps, and ``method``, of the step, where the run was made for comparison.
    """

    quantity: str
    value: float
    statistic: Statistic = Statistic.VALUE
    unit: str = ""
    limit: float = float("nan")
    better: Better | None = None  # None: as BETTER has it for the statistic
    step: str = ""
    method: str = ""

    def __post_init__(self) -> None:
        if self.better is None:
            object.__setattr__(self, "better", BETTER.get(self.statistic, Better.LOW))

    @property
    def name(self) -> str:
        """The name of the figure in files: quantity and statistic, after the method of a comparison."""
        name = METRIC_NAMES.get(self.statistic, "{quantity}, {statistic}")
        name = name.format(quantity=self.quantity, statistic=self.statistic)
        return f"{self.method}: {name}" if self.method else name

    @property
    def passed(self) -> bool:
        """Whether the value keeps within the limit; a value that is not a number never does."""
        return bool(np.isnan(self.limit) or self.value <= self.limit)


@dataclass(frozen=True)
class Diagnostics(Checked):
    """Numbers that the parts of a step found on the way, one a row; NaN where there is none.

    ``place`` is where, such as the end of a part; a unit stands at the end of a quantity, else it is a number or share.
    """

    stage: tuple[str, ...] = names("k")
    place: tuple[str, ...] = names("k", means=LONG)
    quantity: tuple[str, ...] = names("k")
    value: Floats = column("k", means=OPEN)


@dataclass(frozen=True)
class StepRun:
    """One step as it was run: the parameters as JSON text, the step's own Result record, and diagnostics, if any."""

    step: str
    method: str
    params: str = dataclasses.field(metadata={"means": LONG})
    result: Any
    diagnostics: Diagnostics | None = newer()

    @property
    def verdict(self) -> Verdict:
        """The worst verdict in the result; none where the step compares nothing with limits."""
        verdict: Verdict = getattr(self.result, "overall", Verdict.NONE)
        return verdict
