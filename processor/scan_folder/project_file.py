"""project.toml and stations.json as declared: their keys, what the values must be, and what they mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from processor import record_checks
from processor.model import (
    DESIGN_FRAMES,
    KINDS,
    Floats,
    Instrument,
    Reason,
    Steel,
    TitleBlock,
    Tolerance,
    instruments,
    reason,
)  # fmt: skip
from processor.model.inputs import FLAG, Kind, Place, array, entry, hidden, number, table, tables, text
from processor.scan_folder.file_values import FILE, FILE_UNIT, UNIT
from processor.scan_folder.files import PROJECT
from processor.scan_folder.guess import Guess
from processor.scan_folder.text_files import read_toml
from processor.scan_folder.title_block import TITLE_BLOCK
from processor.scan_folder.tolerance import TOLERANCE
from processor.scan_folder.units import FileUnit

NAN = float("nan")
# Side of the square searched for over the diameter of a round target: the strip that tells whether a pattern goes on
# begins at 0.56 of a side from the centre, and is to lie off the circle: from 0.89 on; real ones are found to 1.0.
ROUND_SHARE = 0.9
MOST_BOXES = 100  # of [[clip]]: each is compared with every point


def _pose(value: Any, place: Place) -> Floats:
    pose: Floats = array(4, 4).convert(value, place)
    if not record_checks.are_poses(pose[None])[0]:
        raise place.refused("is not a rotation and a translation above a row of 0, 0, 0, 1; correct the matrix")
    return pose


# A matrix in homogeneous coordinates
POSE = Kind(array(4, 4).expected, _pose, array(4, 4).schema)


def _scanner(value: Any, place: Place) -> Instrument:
    if not isinstance(value, str) or not value:
        raise TypeError
    if value in instruments.class_names():
        return instruments.of_class(value)
    if not value.lower().endswith(".toml"):
        raise place.refused(instruments.unknown(value))
    path = FILE.convert(value, place)
    return instruments.from_file(read_toml(path), Place(str(path)))


# A class of scanners, or the file of an instrument
SCANNER = Kind("a class of scanners or a scanner.toml", _scanner, {"type": "string", "minLength": 1})


@dataclass(frozen=True)
class ScanEntry:
    """A table [[scan]], or a scan file without one."""

    file: Path = entry(FILE)
    # arch bridge: the component that was scanned; default: the file's name where it is a component's
    component: str = entry(text(), default="")
    station: str = entry(text(), default="")  # name of the scanner's station
    # 4 x 4 matrix, scanner to project: a rotation and a translation above a row of 0, 0, 0, 1; translation in the
    # scan's unit
    pose: Floats | None = entry(POSE, default=None)
    sigma_mm: float = entry(number(above=0), default=NAN)  # range noise, one standard deviation; default: not known
    position: Floats | None = entry(array(3), default=None)  # of the scanner, in the scan's own frame and unit
    # of the scan, whatever its file states: a unit, or m/us-ft with that of the heights
    units: FileUnit | None = entry(FILE_UNIT, default=None)
    # its instrument: phase, pulse, long-range, or a file, see docs/instruments.md; default: that of the project
    scanner: Instrument | None = entry(SCANNER, default=None)
    units_by: Reason = hidden(reason("units.by-scan", file=PROJECT))  # who gives them


@dataclass(frozen=True)
class ControlPoint:
    """A table [[control]]."""

    SCHEMA: ClassVar[Mapping[str, Any]] = {
        "anyOf": [{"required": ["position", "sd_mm"]}, {"required": ["scan", "seen"]}],
        "dependentRequired": {"position": ["sd_mm"], "scan": ["seen"], "seen": ["scan"]},
    }

    name: str = entry(text())
    position: Floats | None = entry(array(3), default=None)  # known coordinates, in the project's frame and units
    sd_mm: float = entry(number(above=0), default=NAN)  # standard deviation of each known coordinate
    scan: str = entry(text(), default="")  # scan or station that measured the target
    seen: Floats | None = entry(array(3), default=None)  # measured coordinates, in the scan's own frame and unit
    # standard deviation of each measured coordinate; 0: not known
    seen_sd_mm: float = entry(number(least=0), default=0.0)
    where: str = hidden("")

    def contradiction(self) -> str:
        """Return what is missing of a known place, or of one in a scan."""
        if self.position is not None and np.isnan(self.sd_mm):
            return "expected a number above 0 as 'sd_mm', found nothing"
        if bool(self.scan) != (self.seen is not None):
            missing = f"{array(3).expected} as 'seen'" if self.scan else "a text as 'scan'"
            return f"expected {missing}, found nothing"
        if self.position is None and self.seen is None:
            return "expected 'position' with 'sd_mm', or 'scan' with 'seen', found neither"
        return ""


@dataclass(frozen=True)
class ClipBox:
    """A table [[clip]]."""

    box: Floats = entry(array(2, 3))  # lower and upper corner, in the project's frame and units
    # true: only points in a box to keep stay; false: points in the box are left out; default: true
    keep: bool = entry(FLAG, default=True)
    scan: str = entry(text(), default="")  # name of the scan it is for; default: all
    where: str = hidden("")

    @property
    def low(self) -> Floats:
        """The lower corner (3,)."""
        low: Floats = self.box[0]
        return low

    @property
    def high(self) -> Floats:
        """The upper corner (3,)."""
        high: Floats = self.box[1]
        return high

    def contradiction(self) -> str:
        """Return why the box holds nothing."""
        if (self.low < self.high).all():
            return ""
        return (
            "expected 'box' = [[x0, y0, z0], [x1, y1, z1]] with x0 < x1, y0 < y1 and z0 < z1, "
            f"found {self.box.tolist()}; put the lower corner first"
        )


@dataclass(frozen=True)
class SupportEntry:
    """A table [[support]]: what a component of a bridge lay on when it was scanned."""

    SCHEMA: ClassVar[Mapping[str, Any]] = {"oneOf": [{"required": ["at"]}, {"required": ["chainage_mm"]}]}

    component: str = entry(text())
    at: Floats | None = entry(array(3), default=None)  # in the frame and unit of the component's first scan
    chainage_mm: float = entry(number(), default=NAN)  # from the component's start, along its bottom edge

    def contradiction(self) -> str:
        """Return that the place is given twice or not at all."""
        if (self.at is None) == np.isnan(self.chainage_mm):
            found = "neither" if self.at is None else "both"
            return f"expected 'at', a place, or 'chainage_mm', found {found}; give one of them"
        return ""


@dataclass(frozen=True)
class SteelEntry:
    """The table [steel]."""

    E_MPa: float = entry(number(above=0), default=Steel.E_MPa)  # modulus of elasticity
    density_kg_m3: float = entry(number(above=0), default=Steel.density_kg_m3)  # density


@dataclass(frozen=True)
class CeilingEntry:
    """The table [ceiling]."""

    SCHEMA: ClassVar[Mapping[str, Any]] = {"oneOf": [{"required": ["level"]}, {"required": ["surface"]}]}

    level: float = entry(number(), default=NAN)  # height of the ceiling, in the project's frame and units
    surface: Path | None = entry(FILE, default=None)  # mesh, STEP or IFC file in the project's frame
    # least height of balls and tubes above the ceiling; default: 0
    clearance_mm: float = entry(number(least=0), default=0.0)
    hanger_longest_mm: float = entry(number(above=0), default=NAN)  # greatest length of a hanger; default: any

    def contradiction(self) -> str:
        """Return what is given twice or not at all, and a hanger that is too short."""
        if np.isnan(self.level) == (self.surface is None):
            given = "neither" if self.surface is None else "level and surface"
            return f"expected 'level', a height, or 'surface', a mesh or CAD file, found {given}; give one of them"
        if self.hanger_longest_mm <= self.clearance_mm:
            return (
                "expected 'clearance_mm' of 0 or more and 'hanger_longest_mm' above it, found "
                f"{self.clearance_mm:g} and {self.hanger_longest_mm:g}; correct them"
            )
        return ""


@dataclass(frozen=True)
class Targets:
    """The table [targets]."""

    SCHEMA: ClassVar[Mapping[str, Any]] = {"minProperties": 1}

    checkerboard_mm: float = entry(number(above=0), default=NAN)  # side of the square of two by two fields
    # diameter of a round target of four sectors, two of them dark, instead of a square
    round_mm: float = entry(number(above=0), default=NAN)
    sphere_radius_mm: float = entry(number(above=0), default=NAN)

    def contradiction(self) -> str:
        """Return that nothing is to be searched for."""
        if not np.isnan([self.checkerboard_mm, self.round_mm]).any():
            return "expected 'checkerboard_mm' or 'round_mm', found both; search for one of them"
        if np.isnan([self.checkerboard_mm, self.round_mm, self.sphere_radius_mm]).all():
            return "expected 'checkerboard_mm', 'round_mm' or 'sphere_radius_mm', found none; give one"
        return ""

    @property
    def side_mm(self) -> float:
        """The side of the square that is searched for; of a round target one whose strips beside lie off the circle."""
        return ROUND_SHARE * self.round_mm if np.isnan(self.checkerboard_mm) else self.checkerboard_mm


CONTROL_POINTS = tables(ControlPoint)
CONTROL = Kind(
    "a text or a list",
    lambda value, place: (FILE if isinstance(value, str) else CONTROL_POINTS).convert(value, place),
    {"oneOf": [FILE.schema, CONTROL_POINTS.schema]},
)


@dataclass(frozen=True)
class Project:
    """project.toml of a scan folder."""

    name: str = entry(text(), default="")  # name of the project; default: the folder's name
    kind: str = entry(text(*KINDS), default="")  # default: by the design, else structure
    # of scans whose format states no unit, and of stations.json and control points
    units: str = entry(UNIT, default="")
    # design.json, a CSV table of balls, or the mesh, STEP or IFC file of a structure; default: design.json or
    # design.csv where it exists
    design: Path | None = entry(FILE, default=None)
    design_units: str = entry(UNIT, default="")  # of a design file that states no unit; default: units
    temperature_C: float = entry(number(), default=NAN)  # temperature of the steel during the scan; reference is 20
    # instrument of all scans: phase, pulse, long-range, or a file, as processor field-check writes it; default: as of
    # phase
    scanner: Instrument | None = entry(SCANNER, default=None)
    # scans to read; default: all scan files in the folder and in scans/
    scan: tuple[ScanEntry, ...] = entry(tables(ScanEntry), default=())
    # limits: those of a standard, of the project, or both; the project's win
    tolerance: Tolerance | None = entry(TOLERANCE, default=None)
    # control points as tables, or the name of a CSV file; default: control.csv where it exists
    control: tuple[ControlPoint, ...] | Path | None = entry(CONTROL, default=None)
    # title block of the report: these keys and further ones, in their order; empty texts are left out
    report: TitleBlock | None = entry(TITLE_BLOCK, default=None)
    clip: tuple[ClipBox, ...] = entry(tables(ClipBox), default=())  # boxes that the scans are cut by as they are read
    # of a bridge: what its components lay on when they were scanned, two or more each
    support: tuple[SupportEntry, ...] = entry(tables(SupportEntry), default=())
    steel: SteelEntry | None = entry(table(SteelEntry), default=None)  # of a bridge; default: structural steel
    # ceiling that hangs from a space frame: level or surface
    ceiling: CeilingEntry | None = entry(table(CeilingEntry), default=None)
    targets: Targets | None = entry(table(Targets), default=None)  # targets that the scans are searched for
    # of a space frame: the nodes of the design are in the project's frame, which the scans are in, or in a frame of
    # their own; default: by their coordinates
    design_frame: str = entry(text(*DESIGN_FRAMES), default="")

    where: str = hidden("")
    measured: tuple[ControlPoint, ...] = hidden(())  # of this file or of a table
    guessed: Guess | None = hidden(None)  # instead of a project.toml

    def contradiction(self) -> str:
        """Return that there are more boxes than can be compared with every point."""
        if len(self.clip) > MOST_BOXES:
            return f"expected at most {MOST_BOXES} of [[clip]], found {len(self.clip)}"
        return ""


@dataclass(frozen=True)
class Station:
    """A scanner of stations.json, by its name."""

    position: Floats = entry(array(3))  # in the project's frame and units


# A scanner in a list
ListedStation = make_dataclass("ListedStation", [("id", str, entry(text()))], bases=(Station,), frozen=True)
