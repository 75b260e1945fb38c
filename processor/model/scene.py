"""The scene: scans, and what they were meant to be. All that a step may read."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from processor import large_arrays
from processor.model.columns import Columns
from processor.model.fields import (
    BOUND,
    DEVIATION,
    FARTHEST_MM,
    GRID_CELLS_PER_POINT,
    GRID_NUMBER,
    LARGEST_GRID,
    LARGEST_MM,
    LONG,
    MOST_MEMBERS,
    MOST_NODES,
    MOST_PARTS,
    NAMES,
    PLACE,
    SAMPLED_POINTS,
    SHARE,
    SIZE,
    SMALLEST_MM,
    TUBE_PER_BALL,
    WIDEST_MM,
    Bools,
    Checked,
    Codes,
    Fault,
    Floats,
    Ints,
    Labels,
    Meaning,
    Reason,
    Rows,
    Word,
    column,
    described,
    names,
    newer,
    optional,
    reason,
    reasons,
    words,
)
from processor.model.instruments import Instrument

# --- Vocabularies and constants


NORMAL_95 = 1.959963984540054  # standard deviations of a normal value that hold it in 95 % of cases
KEY_POINTS = ("P1", "P2", "P3", "P4", "P5", "P6", "P7", "P8")
ENDS = ("start", "end")
KINDS = ("arch-bridge", "space-frame", "structure")


class Status(Word):
    """How far a result can be relied on: of a step, or of one of its components or scans."""

    OK = "ok"
    PARTIAL = "partial"  # of a step: some of its parts have no result
    AMBIGUOUS = "ambiguous"  # another solution fits about as well
    WEAK = "weak"  # the data do not determine it well
    FAILED = "failed"


class Verdict(Word):
    """The outcome of a comparison with limits, at 95 % confidence."""

    PASS = "pass"
    FAIL = "fail"
    INDETERMINATE = "indeterminate"
    NONE = "none"  # nothing is limited


WORST_FIRST = (Verdict.FAIL, Verdict.INDETERMINATE, Verdict.PASS)


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the worst of verdicts: fail, then indeterminate, then pass; none of none."""
    known = set(verdicts)
    return next((verdict for verdict in WORST_FIRST if verdict in known), Verdict.NONE)


# --- the scene: all that a step may read --------------------------------------------------------------------------


@dataclass(frozen=True)
class Scan(Checked):
    """One scan, or one merged cloud.

    The scan's frame is the one its file uses, in mm. ``points`` are relative to ``origin``: the coordinate in the
    scan's frame is ``origin + points``, so a georeferenced cloud keeps its precision.
    """

    name: str
    points: Floats = column("n", 3, means=PLACE)
    origin: Floats = dataclasses.field(
        default_factory=lambda: np.zeros(3), metadata={"shape": (3,), "dtype": np.float64, "means": PLACE}
    )
    intensity: Floats = column("n")
    # row of Scene.stations a point was seen from, -1 = unknown
    point_station: Labels = column("n", dtype=np.int32, means=Meaning(rows_of="/stations.ids", lowest_row=-1))
    # of the scanner's grid: of one height; -1 = not on a grid
    grid_row: Labels = column("n", dtype=np.int32, means=GRID_NUMBER)
    grid_column: Labels = column("n", dtype=np.int32, means=GRID_NUMBER)  # of one direction about the scanner's axis
    component: str = ""  # arch bridge: the part this is a scan of
    station: str = ""
    position: Floats = optional(3, means=PLACE)  # of the scanner, in the scan's frame
    T_project_scan: Floats = optional(
        4, 4, means=PLACE
    )  # absent: the scan is in the project's frame already, or its pose is unknown
    # range noise, one standard deviation; NaN = unknown
    sigma_mm: float = described(float("nan"), means=Meaning(least=0.0, most=1_000.0))
    colour: Codes = column("n", 3, dtype=np.uint8, newer=True)  # red, green, blue

    @property
    def pose(self) -> Floats:
        """T_project_scan (4, 4); the identity for a scan without a pose."""
        return self.T_project_scan if self.T_project_scan.size else np.eye(4)

    def contradictions(self) -> Iterable[Fault]:
        """Yield that a few points claim a grid that fills the memory, noise of no scanner, and a scanner far away."""
        if 0.0 < self.sigma_mm < SMALLEST_MM:
            text = f": expected 0, or {SMALLEST_MM:g} mm or more, found {self.sigma_mm:.3g}"
            yield Fault(("sigma_mm",), text)
        if self.position.size and len(self.points):
            yield from _far(("position",), "", self.position - self.origin, self)
        if len(self.grid_row) and len(self.grid_column):
            rows, columns = (int(large_arrays.extremes(n)[1]) + 1 for n in (self.grid_row, self.grid_column))
            most = LARGEST_GRID + GRID_CELLS_PER_POINT * len(self.grid_row)
            if rows * columns > most:
                text = f": expected a grid of at most {most} cells for its points, found {rows} x {columns}"
                yield Fault(("grid_row",), text)


@dataclass(frozen=True)
class Stations(Columns, Checked):
    """Scanner positions in the project's frame, and the poses of the scanners where they are known."""

    ids: tuple[str, ...] = names("k", means=NAMES)
    positions: Floats = column("k", 3, means=PLACE)
    T_project_station: Floats = column("k", 4, 4, means=PLACE)


@dataclass(frozen=True)
class DesignPart(Checked):
    """The nominal geometry of one component, in the bridge's frame (mm)."""

    name: str
    vertices: Floats = column("v", 3, means=PLACE)
    faces: Ints = column("f", 3, dtype=np.int64, means=Meaning(rows_of="vertices"))
    # From the start to the end of the component; left = +Y; empty = none.
    bottom_edge_left: Floats = column(
        "l", 3, means=PLACE
    )  # from the start to the end of the component; left = +Y; () = none
    bottom_edge_right: Floats = column("r", 3, means=PLACE)
    # of vertices and faces: mesh, or curves: the outer box between joints and bottom edges alone
    source: str = described("mesh", means=Meaning(words=("mesh", "curves")))


@dataclass(frozen=True)
class ArchDesign(Checked):
    """A bridge, or another assembly, of components in assembly order. Bridge frame: X along the span, Z up, mm.

    ``joint_points`` are P1..P8 of each joint: the outer corners bottom-left, bottom-right, top-right, top-left
    (left = +Y), then the middles of the outer bottom, right, top and left edges. Bottom and left are as seen from the
    left part towards the right one. The joints may form any graph.
    """

    parts: tuple[DesignPart, ...] = ()  # in assembly order
    joint_names: tuple[str, ...] = names("j", means=NAMES)
    joint_left: tuple[str, ...] = names("j", means=Meaning(among="parts.name", unlike="joint_right"))
    joint_right: tuple[str, ...] = names("j", means=Meaning(among="parts.name"))
    joint_points: Floats = column("j", 8, 3, means=PLACE)

    def contradictions(self) -> Iterable[Fault]:
        """Yield parts of one name, too many parts, and a bridge larger than any."""
        yield from _many("parts", len(self.parts), MOST_PARTS)
        yield from _many("joint_points", len(self.joint_points), 2 * MOST_PARTS)
        yield from _repeated("parts", tuple(part.name for part in self.parts))
        corners = [part.vertices.min(axis=0) for part in self.parts if len(part.vertices)]
        corners += [part.vertices.max(axis=0) for part in self.parts if len(part.vertices)]
        yield from _wide("joint_points", np.concatenate([np.reshape(corners, (-1, 3)), *self.joint_points]))

    @property
    def joined(self) -> Ints:
        """Rows (j, 2) of the left and the right part of each joint. Raises ValueError for an unknown name."""
        row = [part.name for part in self.parts].index
        pairs = zip(self.joint_left, self.joint_right, strict=True)
        return np.array([(row(left), row(right)) for left, right in pairs], np.int64).reshape(-1, 2)

    @property
    def in_row(self) -> bool:
        """Whether the parts form one row: each is joined to the next one, and there is no other joint."""
        count = np.arange(len(self.parts) - 1)
        return bool(np.array_equal(self.joined, np.stack([count, count + 1], axis=1)))


DESIGN_FRAMES = ("project", "own")  # of a frame's nodes: the project's, which the scans are in, or another one


@dataclass(frozen=True)
class FrameDesign(Checked):
    """A space frame: nodes and the members between them, mm.

    ``coordinates`` is one of DESIGN_FRAMES where the project states it. ``labels`` are the ids as the design has them,
    where these are no whole numbers; then ``ids`` are 1, 2, ... in its order, and nothing outside shows them.
    """

    ids: Ints = column("k", dtype=np.int64, means=NAMES)
    centres: Floats = column("k", 3, means=PLACE)
    radii: Floats = column("k", means=SIZE)
    # ids of the two nodes
    member_a: Ints = column("m", dtype=np.int64, means=Meaning(among="ids", unlike="member_b"))
    member_b: Ints = column("m", dtype=np.int64, means=Meaning(among="ids"))
    tube_diameters: Floats = column("m", means=SIZE)
    # 0 = none, else the place in SUPPORTS, from 1
    supports: Codes = column("k", dtype=np.uint8, newer=True, means=Meaning(most=2))
    deflections: Floats = column(
        "k", newer=True, means=Meaning(least=-LARGEST_MM, most=LARGEST_MM)
    )  # computed, downward; NaN = not stated
    coordinates: str | None = newer(means=Meaning(words=DESIGN_FRAMES))
    labels: tuple[str, ...] = names("k", newer=True, means=NAMES)

    @property
    def names(self) -> list[int | str]:
        """The ids of the nodes, as the design has them."""
        return list(self.labels) or self.ids.tolist()

    @property
    def name_of(self) -> dict[int, int | str]:
        """The name of each node, by its number in ``ids``."""
        return dict(zip(self.ids.tolist(), self.names, strict=True))

    def contradictions(self) -> Iterable[Fault]:
        """Yield a frame larger than any, a second member of two nodes, and a tube far wider than its ball."""
        yield from _many("ids", len(self.ids), MOST_NODES)
        yield from _many("member_a", len(self.member_a), MOST_MEMBERS)
        yield from _wide("centres", self.centres)
        ends = np.sort(np.column_stack([self.member_a, self.member_b]), axis=1)
        second = np.ones(len(ends), bool)
        second[np.unique(ends, axis=0, return_index=True)[1]] = False
        if second.any():
            row = int(second.argmax())
            a, b = ends[row].tolist()
            yield Fault(("member_b",), f", row {row}: expected one member of two nodes, found a second of {a} and {b}")
        order = np.argsort(self.ids)
        balls = 2.0 * self.radii[order[np.searchsorted(self.ids, ends, sorter=order)]]
        wide = (self.tube_diameters[:, None] > TUBE_PER_BALL * balls).any(axis=1)
        if wide.any():
            row = int(wide.argmax())
            tube, ball = self.tube_diameters[row], balls[row].min()
            most = f"{TUBE_PER_BALL:g} times the diameter of its ball, {ball:.6g} mm"
            text = f"expected a tube of at most {most}, found {tube:.6g} mm"
            yield Fault(("tube_diameters",), f", row {row}: {text}; give diameters of tubes and radii of balls")


SUPPORTS = ("perimeter", "multi-point")  # of a node: of a frame supported along its edges, or at single points


@dataclass(frozen=True)
class DesignBodies(Checked):
    """The bodies of a structure's mesh by their names in the CAD file: the row (f,) of ``names`` of each facet.

    No two names are equal. ``shared`` of the bodies had a name that others have, ``unnamed`` had none: the design's
    reader numbered them.
    """

    names: tuple[str, ...] = names("b", means=NAMES)
    of_facet: Ints = column("f", dtype=np.int64, means=Meaning(rows_of="names"))
    shared: int = described(0, means=Meaning(least=0))
    unnamed: int = described(0, means=Meaning(least=0))


@dataclass(frozen=True)
class DesignFaults(Checked):
    """What was wrong with a structure's mesh: facets that were ``turned`` outward, and open edges of so many parts.

    ``repeated`` facets were left out, None for none: others have their corners, in the same order or in the other one.
    """

    turned: int = described(0, means=Meaning(least=0))
    open_edges: int = described(0, means=Meaning(least=0))
    open_parts: int = described(0, means=Meaning(least=0))
    repeated: int | None = described(None, newer=True, hashed=True, means=Meaning(least=0))


@dataclass(frozen=True)
class StructureDesign(Checked):
    """One mesh of a whole structure, in the design's frame (mm); ``bodies`` are None where the mesh has no names.

    ``faults`` are None where none were found, or the mesh is not from a file.
    """

    name: str
    vertices: Floats = column("v", 3, means=PLACE)
    faces: Ints = column("f", 3, dtype=np.int64, means=Meaning(rows_of="vertices"))
    bodies: DesignBodies | None = newer()
    faults: DesignFaults | None = newer()

    def contradictions(self) -> Iterable[Fault]:
        """Yield a structure larger than any, and that bodies are not given for each facet."""
        yield from _wide("vertices", self.vertices)
        given = len(self.faces) if self.bodies is None else len(self.bodies.of_facet)
        if given != len(self.faces):
            text = f": expected a row for each of {len(self.faces)} faces, found {given}"
            yield Fault(("bodies", "of_facet"), text)


# What each step compares with limits, as ``Limit.measure`` names it; of single parts, "part " and a quantity.
MEASURES: Mapping[str, tuple[str, ...]] = {
    "preassemble": (
        "misalignment", "groove_gap", "eccentricity", "span", "unit_length", "inner_arc", "lateral_axis", "elevation",
    ),
    "spheres": (
        "node_place", "ball_size", "support_centre", "support_height", "adjacent_support_height",
        "multi_point_support_height", "deflection", "ceiling",
    ),
    "stitch": ("closure", "control_point", "scan_position"),
    "deviation": ("deviation", "deviation_share"),
    "defects": ("defect_depth", "defect_area"),
    "inspect": (
        "part length", "part width", "part height", "part diagonal", "part diagonal-difference", "part twist",
        "part sweep", "part camber", "part flatness", "part squareness", "part thickness", "part hole-position",
        "part hole-pitch", "part pass-through", "part hole-diameter", "part diameter", "part bow", "part angle",
        "part alignment",
    ),
}  # fmt: skip
LIMITED_SIZES = ("length", "height", "width", "thickness", "diameter", "spacing", "depth")


@dataclass(frozen=True)
class Limit(Checked):
    """One row of a standard: what it limits, from ``low`` to ``high`` (NaN = no bound), and where that stands.

    ``low_ratio`` and ``high_ratio`` are multiples of the size named by ``of``; by ``rule`` the smaller of number and
    multiple counts, or their sum. The row is for sizes above ``above_mm`` up to ``up_to_mm``. ``measure`` is what is
    compared with it, one of MEASURES or nothing. ``component`` is a pattern of the names of those that a project gives
    it for, None of all.
    """

    key: str
    what: str = dataclasses.field(metadata={"means": LONG})
    unit: str = "mm"
    low: float = described(float("nan"), means=BOUND)
    high: float = described(float("nan"), means=BOUND)
    low_ratio: float = described(float("nan"), means=BOUND)
    high_ratio: float = described(float("nan"), means=BOUND)
    of: str = described("", means=Meaning(words=("", *LIMITED_SIZES)))
    rule: str = described("", means=Meaning(words=("", "smaller", "sum")))
    above_mm: float = described(float("nan"), means=Meaning(least=0.0))
    up_to_mm: float = described(float("nan"), means=Meaning(least=0.0))
    measure: str = described("", means=Meaning(words=("", *(name for step in MEASURES.values() for name in step))))
    clause: str = described("", means=LONG)
    verified: bool = False  # the number was compared with the published text
    source: str = described("", means=LONG)
    component: str | None = newer()

    def contradictions(self) -> Iterable[Fault]:
        """Yield a lower bound above the upper one."""
        for low, high in (("low", "high"), ("low_ratio", "high_ratio"), ("above_mm", "up_to_mm")):
            if getattr(self, low) > getattr(self, high):
                text = f": expected at most {high}, {getattr(self, high):g}, found {getattr(self, low):g}"
                yield Fault((low,), text)


class DecisionRule(Word):
    """How a value with its uncertainty is judged by a limit, see :mod:`processor.limits.judging`."""

    SIMPLE = "simple"
    GUARDED = "guarded"
    RISK = "risk"


LARGEST_RISK = 0.05  # of a wrong decision, where a project states none: 95 % as of all intervals


@dataclass(frozen=True)
class Tolerance(Checked):
    """The limits that results are compared with: those of a standard, of the project, or both (the project's win).

    ``rule`` and ``risk`` are None where the project states none: see :attr:`decision` and :attr:`largest_risk`.
    """

    standard: str = ""
    edition: str = described("", means=LONG)
    limits: tuple[Limit, ...] = ()
    # between two ends as assembled, by the design; their gap is compared with it
    root_gap_mm: float = described(0.0, means=PLACE)
    rule: str | None = newer(means=Meaning(words=tuple(DecisionRule)))
    risk: float | None = newer(means=SHARE)

    @property
    def decision(self) -> DecisionRule:
        """The decision rule: guarded unless stated."""
        return DecisionRule.GUARDED if self.rule is None else DecisionRule(self.rule)

    @property
    def largest_risk(self) -> float:
        """The largest probability of a wrong decision, of rule ``risk``."""
        return LARGEST_RISK if self.risk is None else self.risk


@dataclass(frozen=True)
class Control(Checked):
    """Control points: targets whose coordinates are known, and where the scans have them; mm.

    ``positions`` are in the project's frame, that of the design. ``seen`` (m, 3) is where target ``point`` (m,), a row
    of ``ids``, was measured in scan ``scan`` (m,), a row of Scene.scans, in that scan's own frame. Of a cloud of
    several stations ``station`` (m,), a row of Scene.stations, says which one saw it; -1 = the scan's own.
    """

    ids: tuple[str, ...] = names("k", means=NAMES)
    positions: Floats = column("k", 3, means=PLACE)
    sd: Floats = column("k", means=SIZE)  # of each coordinate of a position
    point: Ints = column("m", dtype=np.int64, means=Meaning(rows_of="ids"))
    scan: Ints = column("m", dtype=np.int64, means=Meaning(rows_of="/scans"))
    station: Ints = column("m", dtype=np.int64, means=Meaning(rows_of="/stations.ids", lowest_row=-1))
    seen: Floats = column("m", 3, means=PLACE)
    seen_sd: Floats = column("m", means=DEVIATION)  # of each coordinate as seen


class TargetKind(Word):
    """What a target is."""

    CHECKERBOARD = "checkerboard"
    SPHERE = "sphere"


@dataclass(frozen=True)
class TargetSearch(Checked):
    """Targets that scans are searched for, mm: NaN = not for this kind.

    ``checkerboard_mm`` is the side of a square of two by two fields, two of them dark, across from one another.
    """

    checkerboard_mm: float = described(float("nan"), means=Meaning(above=0.0, most=LARGEST_MM))
    sphere_radius_mm: float = described(float("nan"), means=Meaning(above=0.0, most=LARGEST_MM))


@dataclass(frozen=True)
class Targets(Rows):
    """Targets as found in scans: ``places`` (t, 3) in the frame of scan ``scan`` (t,), a row of Scene.scans; mm.

    ``name`` is that of the control point, "" where none is there. ``sd`` is of each coordinate, with the error that all
    ranges of a view share by the class of scanners, along the direction where it is largest; ``station`` as in
    :class:`Control`. ``fit`` is the share of the intensities' variance that the pattern explains; NaN for spheres.
    """

    name: tuple[str, ...] = names("t")
    kind: tuple[TargetKind, ...] = words("t", TargetKind)
    scan: Ints = column("t", dtype=np.int64, means=Meaning(rows_of="/scans"))
    station: Ints = column("t", dtype=np.int64, means=Meaning(rows_of="/stations.ids", lowest_row=-1))
    places: Floats = column("t", 3, means=PLACE)
    sd: Floats = column("t", means=DEVIATION)
    points: Ints = column("t", dtype=np.int64, means=Meaning(least=0))
    fit: Floats = column("t", means=Meaning(most=1.0))


@dataclass(frozen=True)
class Picks(Checked):
    """Common points that were picked in two scans each, in these scans' frames (mm)."""

    scan_a: tuple[str, ...] = names("q", means=Meaning(among="/scans.name", unlike="scan_b"))
    scan_b: tuple[str, ...] = names("q", means=Meaning(among="/scans.name"))
    points: tuple[str, ...] = names("q")
    in_a: Floats = column("q", 3, means=PLACE)
    in_b: Floats = column("q", 3, means=PLACE)


@dataclass(frozen=True)
class Clips(Columns, Checked):
    """Boxes that the scans were cut by as they were read: corners in the project's frame, mm, and the points in each.

    ``keep`` marks boxes whose points are the ones kept, the others are left out. ``scan`` is the one meant, "" all.
    """

    scan: tuple[str, ...] = names("c")
    low: Floats = column("c", 3, means=PLACE)
    high: Floats = column("c", 3, means=PLACE)
    keep: Bools = column("c", dtype=np.bool_, means=Meaning())
    inside: Ints = column("c", dtype=np.int64, means=Meaning(least=0))
    read: int = described(0, means=Meaning(least=0))  # points of all scans
    kept: int = described(0, means=Meaning(least=0))


@dataclass(frozen=True)
class Ceiling(Checked):
    """A ceiling that hangs from a space frame, in the project's frame, mm: a ``level``, or a surface of triangles.

    Nothing is to be nearer above it than ``clearance_mm``, no hanger longer than ``longest_mm`` (NaN = any length).
    """

    level: float = described(float("nan"), means=Meaning(least=-LARGEST_MM, most=LARGEST_MM))
    vertices: Floats = column("v", 3, means=PLACE)
    faces: Ints = column("f", 3, dtype=np.int64, means=Meaning(rows_of="vertices"))
    clearance_mm: float = described(0.0, means=Meaning(finite=True, least=0.0, most=LARGEST_MM))
    longest_mm: float = described(float("nan"), means=Meaning(above=0.0, most=LARGEST_MM))

    def contradictions(self) -> Iterable[Fault]:
        """Yield that there is neither a level nor a surface, or both."""
        if bool(np.isnan(self.level)) == (not len(self.faces)):
            yield Fault(("level",), ": expected a level or faces, found neither or both")


@dataclass(frozen=True)
class TitleBlock(Checked):
    """What the project writes on its report: names and texts in their order, and a logo (bytes of a PNG or JPEG)."""

    keys: tuple[str, ...] = names("k")
    values: tuple[str, ...] = names("k")
    logo: Codes = column("bytes", dtype=np.uint8, means=Meaning())


@dataclass(frozen=True)
class PartSupports(Columns, Checked):
    """What parts of a bridge lay on when they were scanned, a row a support, by its part's name.

    ``places`` (k, 3) are in the frame of the part's first scan, mm; ``chainages`` (k,) are from the part's start, mm.
    Each row has one of them, the other is NaN.
    """

    component: tuple[str, ...] = names("k")
    places: Floats = column("k", 3, means=Meaning(least=-LARGEST_MM, most=LARGEST_MM))
    chainages: Floats = column("k", means=Meaning(least=-LARGEST_MM, most=LARGEST_MM))


@dataclass(frozen=True)
class Steel(Checked):
    """The material of the parts: modulus of elasticity and density (EN 1993-1-1, 3.2.6; EN 1991-1-1, table A.4)."""

    E_MPa: float = described(210_000.0, means=Meaning(finite=True, above=0.0))
    density_kg_m3: float = described(7_850.0, means=Meaning(finite=True, above=0.0))


def _units_as_stated(text: str) -> tuple[Reason, ...]:
    """Return the source of a unit that a scene file of before version 1.5 states as a text."""
    return (reason("units.as-stated", text=text),) if text else ()


@dataclass(frozen=True)
class Scene(Checked):
    """What was scanned, and what it was meant to be. Steps read this and nothing else."""

    name: str
    kind: str = dataclasses.field(metadata={"means": Meaning(words=KINDS)})
    scans: tuple[Scan, ...] = ()
    arch: ArchDesign | None = None
    frame: FrameDesign | None = None
    stations: Stations | None = None
    # of the steel while it was scanned
    temperature_C: float = described(float("nan"), means=Meaning(least=-100.0, most=500.0))
    units: str = "mm"  # of the input's coordinates, and why they were read so
    units_reason: tuple[Reason, ...] = reasons(of_text=_units_as_stated, hashed_as_text=True)
    structure: StructureDesign | None = None
    tolerance: Tolerance | None = None  # None: the input does not state it
    control: Control | None = newer()
    picks: Picks | None = newer()
    title_block: TitleBlock | None = newer(hashed=False)
    clips: Clips | None = newer()
    ceiling: Ceiling | None = newer()
    target_search: TargetSearch | None = newer()
    part_supports: PartSupports | None = newer()
    steel: Steel | None = newer()  # None: of structural steel
    targets: Targets | None = newer(hashed=False)  # those of Scene.control are hashed
    target_remarks: tuple[Reason, ...] = reasons(newer=True, hashed=False)  # on the search for targets
    # of the scanner, first those of single scans; () = not stated
    instruments: tuple[Instrument, ...] = described((), newer=True, hashed=True)
    # days of the scans by their files, YYYY-MM-DD, in order; no step reads them
    scanned: tuple[str, ...] = names("days", newer=True, hashed=False)

    def contradictions(self) -> Iterable[Fault]:
        """Yield scans of one name, scanners far away, and parts that the design does not have."""
        yield from _repeated("scans", tuple(scan.name for scan in self.scans))
        for scan in self.scans:
            for row, position in self._stations_of(scan):
                place = (position - scan.pose[:3, 3]) @ scan.pose[:3, :3] - scan.origin
                far = list(_far(("stations", "positions"), f", row {row}", place, scan))
                if far:  # one names the mistake: a wrong unit concerns every row
                    yield far[0]
                    break
        parts = {part.name for part in self.arch.parts} if self.arch else set()
        for i, scan in enumerate(self.scans):
            if parts and scan.component and scan.component not in parts:
                text = f": expected a part of the design, found {scan.component!r}"
                yield Fault(("scans", f"{i:04d}", "component"), text)
        named = () if self.part_supports is None else self.part_supports.component
        for row, name in enumerate(named):
            if name not in parts:
                yield Fault(
                    ("part_supports", "component"), f", row {row}: expected a part of the design, found {name!r}"
                )
            elif named.count(name) < 2:
                text = f", row {row}: expected two or more supports of {name!r}, found one"
                yield Fault(("part_supports", "component"), text)

    def _stations_of(self, scan: Scan) -> list[tuple[int, Floats]]:
        """Return the stations that a scan's points name, or all if it is the only scan: rows and positions (3,)."""
        if self.stations is None or not len(scan.points):
            return []
        positions = dict(enumerate(self.stations.positions))
        if len(scan.point_station):
            named = np.unique(_sample(scan.point_station)).tolist()
            return [(row, positions[row]) for row in named if row in positions]
        return list(positions.items()) if len(self.scans) == 1 else []


def _sample(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return rows[:: max(1, len(rows) // SAMPLED_POINTS)]


def _far(path: tuple[str, ...], row: str, position: Floats, scan: Scan) -> Iterator[Fault]:
    """Yield that a scanner's position, relative to the scan's origin, is far from all points of the scan."""
    away = float(np.linalg.norm(_sample(scan.points) - position, axis=1).min())
    if away > FARTHEST_MM:
        text = f"expected a scanner at most {FARTHEST_MM / 1e6:g} km from the points of scan {scan.name!r}"
        yield Fault(path, f"{row}: {text}, found {away / 1e6:.4g} km; is its unit that of the scans?")


def _wide(field: str, points: Floats) -> Iterator[Fault]:
    """Yield that points (n, 3) of a design extend farther than any structure."""
    if not len(points):
        return
    extent = float((points.max(axis=0) - points.min(axis=0)).max())
    if extent > WIDEST_MM:
        row = int(np.abs(points - np.median(points, axis=0)).max(axis=1).argmax())
        text = f"expected a design of at most {WIDEST_MM / 1e6:g} km across, found {extent / 1e6:.4g} km"
        yield Fault((field,), f", row {row}: {text}; correct the place or the unit")


def _many(field: str, count: int, most: int) -> Iterator[Fault]:
    if count > most:
        yield Fault((field,), f": expected at most {most}, found {count}")


def _repeated(field: str, names: tuple[str, ...]) -> Iterator[Fault]:
    for i, name in enumerate(names):
        if name in names[:i]:
            text = f": expected another name for each, found {name!r} a second time"
            yield Fault((field, f"{i:04d}", "name"), text)
            return
