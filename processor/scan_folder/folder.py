"""A scan folder, or a single scan file, to a scene in mm."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from processor import readers
from processor.limits import standards
from processor.model import (
    KINDS,
    ArchDesign,
    Floats,
    FrameDesign,
    InputError,
    Scan,
    Scene,
    Stations,
    StructureDesign,
    Tolerance,
)
from processor.progress import tracked
from processor.readers import RawScan
from processor.readers.common import decoded, stem, text_of, used_up
from processor.scan_folder import cad, scanner_grid
from processor.scan_folder.checked_toml import Table, inside
from processor.scan_folder.control_points import CONTROL, Measured, control_points, read_control
from processor.scan_folder.design import read_design, read_json, read_surface
from processor.scan_folder.meshes import MESH_SUFFIXES
from processor.scan_folder.picks import PICKS, read_picks
from processor.scan_folder.units import MM_PER_UNIT, STRAY, check_extent, known_unit
from processor.store import store

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = "project.toml"
TRUTH = "truth.h5"
STATIONS = "stations.json"
DESIGNS = ("design.json", "design.csv")
NOT_SCANS = ("design.csv", PICKS, "deviation.csv", CONTROL)
KEYS = ("name", "kind", "units", "design", "design_units", "temperature_C", "scan", "tolerance", "control")
SCAN_KEYS = ("file", "component", "station", "pose", "sigma_mm", "position")
FEWEST_POINTS = 4
FLOAT_STEP_MM = 1.0

# How much larger than the design a scan comes out when a unit is mistaken for another one.
UNIT_SLIPS: tuple[float, ...] = (
    1000.0, 304.8, 100.0, 1 / 0.0254, 25.4, 10.0, 1 / 0.3048, 0.1, 1 / 25.4, 0.0254, 0.01, 1 / 304.8, 0.001,
)  # fmt: skip
FRAME_SLIPS: tuple[float, ...] = (1000.0, 304.8, 25.4, 1 / 304.8, 0.001)
CLEAREST_SLIPS: tuple[float, ...] = (1000.0, 304.8, 1 / 304.8, 0.001)
SLIP_TOLERANCE = 0.25


@dataclass(frozen=True)
class _Entry:
    """One [[scan]] of project.toml, or a file that was found."""

    path: Path
    component: str = ""
    station: str = ""
    pose: Floats | None = None
    position: Floats | None = None
    sigma_mm: float = float("nan")


@dataclass(frozen=True)
class _Project:
    name: str
    kind: str
    units: str
    design: Path | None
    design_units: str
    temperature_C: float
    entries: tuple[_Entry, ...]
    tolerance: Tolerance | None = None
    control: tuple[Measured, ...] = ()


def truth_file(path: Path) -> Path | None:
    """Return the file that a truth may be read from: the scene file itself, or FOLDER/truth.h5 where it is there."""
    if path.is_dir():
        return path / TRUTH if (path / TRUTH).is_file() else None
    return path if path.suffix.lower() == ".h5" else None


def read_input(path: Path, units: str | None = None) -> Scene:
    """Read a scan folder, a single scan file or a scene file.

    ``units`` are those of the scans' coordinates, whatever the format says. Without, the format's own unit counts,
    then the project file's, then metres; ``Scene.units_reason`` says which it was.

    Raises InputError for input that cannot be used, UsageError for an unknown unit.
    """
    asked = known_unit(units) if units else ""
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder")
    if path.is_dir() and not readers.is_closed(path):
        return _read_folder(path, asked)
    if path.suffix.lower() == ".h5":
        return store.read_scene(path)
    return _scene(_Project(stem(path), "", "", None, "", float("nan"), (_Entry(path),)), None, asked)


def _read_folder(folder: Path, asked: str) -> Scene:
    project = _read_project(folder)
    design: ArchDesign | FrameDesign | StructureDesign | None = None
    if project.design is not None:
        unit = project.design_units or project.units or asked or "m"
        surface = project.design.suffix.lower() in (*MESH_SUFFIXES, *cad.SUFFIXES)
        if surface and project.kind in ("", "structure"):
            design = StructureDesign(stem(project.design), *read_surface(project.design, unit))
        else:
            design = read_design(folder, project.design, project.design_units or asked or project.units or "m")
    scene = _scene(project, design, asked, _places(folder, project.units or asked or "m"))
    if scene.structure is not None and project.design is not None and project.design.suffix.lower() in MESH_SUFFIXES:
        said = PROJECT if project.design_units or project.units else "--units" if asked else "nothing, so metres"
        correct = f"say which it is by 'design_units' or 'units' in {PROJECT}"
        check_extent(f"{project.design}: the design", scene.structure.vertices, unit, f"said by {said}", correct)
    if not (folder / PICKS).exists():
        return scene
    # Picks are in their scans' own units; where formats differ in these, --units says what all are in.
    unit = scene.units if scene.units in MM_PER_UNIT else ""
    if not unit:
        raise InputError(f"{folder / PICKS}: the scans are in {scene.units}; say one unit for all by --units")
    inside(folder, PICKS, str(folder))
    picks = read_picks(folder / PICKS, scene.scans, unit)
    return dataclasses.replace(scene, picks=picks)


def _places(folder: Path, unit: str) -> Stations | None:
    """Read stations.json, where it is there: positions of scanners by name, in the project's frame."""
    path = folder / STATIONS
    if not path.exists():
        return None
    inside(folder, STATIONS, str(folder))
    table = read_json(path)
    names = list(table.values)
    places = [table.table(name) for name in names]
    for place in places:
        place.only(("position",))
    positions = np.array([place.array("position", 3) for place in places]).reshape(-1, 3)
    return Stations(tuple(names), positions * MM_PER_UNIT[unit])


def _read_project(folder: Path) -> _Project:
    path = folder / PROJECT
    table = Table(str(path), {})
    if path.exists():
        inside(folder, PROJECT, str(folder))
        try:
            table = Table.of(str(path), tomllib.loads(decoded(path.read_bytes())))
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise InputError(f"{path}: not readable TOML: {error}") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    table.only(KEYS)
    kind = table.text("kind", "")
    if kind and kind not in KINDS:
        raise InputError(f"{path}: unknown kind {kind!r}; expected one of {', '.join(KINDS)}")
    named = table.text("design", "") or next((name for name in DESIGNS if (folder / name).exists()), "")
    design = inside(folder, named, str(path)) if named else None
    entries = [_entry(folder, scan) for scan in table.tables("scan")]
    control, apart = read_control(folder, table)
    return _Project(
        table.text("name", text_of(folder.resolve().name)),
        kind,
        table.unit("units", ""),
        design,
        table.unit("design_units", ""),
        table.number("temperature_C", float("nan")),
        tuple(entries or [_Entry(found) for found in _found(folder, {design, apart})]),
        _tolerance(table),
        control,
    )


def _tolerance(project: Table) -> Tolerance | None:
    """Read [tolerance]: a standard, limits of the project's own, or both; None where there is nothing."""
    if not project.values.get("tolerance"):
        return None
    table = project.table("tolerance")
    standard = table.text("standard", "")
    try:
        base = standards.load(standard) if standard else Tolerance()
        choice = standards.choice(base)
    except InputError as error:
        raise InputError(f"{table.where}: {error}") from None
    table.only(("standard", "root_gap_mm", *choice))
    own = {}
    for key in table.values:
        if key in choice:
            given = table.array(key, 2) if standards.two_sided(choice[key]) else np.array([table.number(key)])
            if not (given[0] < given[-1] if len(given) == 2 else given[0] > 0.0):
                expected = "a number above 0" if len(given) == 1 else "two numbers, least and greatest"
                raise InputError(f"{table.where}: expected {expected} as {key!r}, found {given.tolist()}")
            own[key] = given
    return standards.with_own(base, own, PROJECT, table.number("root_gap_mm", 0.0))


def _entry(folder: Path, scan: Table) -> _Entry:
    scan.only(SCAN_KEYS)
    pose = scan.array("pose", 4, 4) if "pose" in scan.values else None
    if pose is not None and not (
        np.abs(pose[:3, :3].T @ pose[:3, :3] - np.eye(3)).max() < 1e-3
        and np.linalg.det(pose[:3, :3]) > 0
        and (pose[3] == [0, 0, 0, 1]).all()
    ):
        raise InputError(f"{scan.where}: 'pose' is not a rotation and a translation above a row of 0, 0, 0, 1")
    return _Entry(
        inside(folder, scan.text("file"), scan.where),
        scan.text("component", ""),
        scan.text("station", ""),
        pose,
        scan.array("position", 3) if "position" in scan.values else None,
        scan.number("sigma_mm", float("nan"), positive=True),
    )


def _found(folder: Path, others: Collection[Path | None]) -> list[Path]:
    """Find the scans of a folder: all files of their formats but those of a name, and ``others``."""
    found, closed = list[Path](), list[Path]()
    for place in (folder, folder / "scans"):
        for path in sorted(place.iterdir()) if place.is_dir() else []:
            scan = path.suffix.lower() in readers.SUFFIXES and path.name not in NOT_SCANS and path not in others
            if ((scan and path.is_file()) or readers.is_closed(path)) and not path.name.startswith("."):
                inside(folder, str(path.relative_to(folder)), str(folder))
                (closed if readers.is_closed(path) else found).append(path)
    # A scanner's own files often lie beside what was exported from them.
    exported = {path.stem for path in found}
    left = [path for path in closed if path.stem not in exported]
    if left and not found:
        readers.read(left[0])
    if left:
        raise InputError(
            f"{left[0]}: is in a closed format, and no other file here has its name; export it to E57 under that name, "
            f"or say in {PROJECT} by [[scan]] which files are to be read"
        )
    if not found:
        raise InputError(
            f"{folder}: expected scans ({', '.join(readers.SUFFIXES)}) in the folder or in scans/, "
            f"found none{_packed(folder)}"
        )
    return found


def _packed(folder: Path) -> str:
    packed = [path.name for path in sorted(folder.iterdir()) if path.suffix.lower() in readers.ARCHIVES]
    return f"; unpack {packed[0]} first" if packed else ""


def _scene(
    project: _Project,
    design: ArchDesign | FrameDesign | StructureDesign | None,
    asked: str,
    places: Stations | None = None,
) -> Scene:
    arch = design if isinstance(design, ArchDesign) else None
    frame = design if isinstance(design, FrameDesign) else None
    kind = "arch-bridge" if arch else "space-frame" if frame else project.kind or "structure"
    if project.kind and project.kind != kind:
        raise InputError(f"{project.design}: the design is of kind {kind}, but {PROJECT} says {project.kind}")
    parts = {part.name for part in arch.parts} if arch else set()
    scans: list[Scan] = []
    units: list[str] = []
    reasons: dict[str, str] = {}
    for entry in tracked(project.entries):
        if entry.component and parts and entry.component not in parts:
            raise InputError(
                f"{entry.path}: the design has no component {entry.component!r}; it has {', '.join(sorted(parts))}"
            )
        raws = readers.read(entry.path)
        if len(raws) > 1 and (entry.pose is not None or entry.position is not None):
            raise InputError(f"{entry.path}: holds {len(raws)} scans, so one 'pose' or 'position' does not fit them")
        several = len(raws) > 1
        for number in range(1, len(raws) + 1):
            raw = raws.pop(0)
            if several and any(raw.name == other.name for other in scans):  # scanners call each file's first S1
                raw = dataclasses.replace(raw, name=f"{stem(entry.path)}-{number}")
            unit, reason = _unit(raw, entry.path, project, asked)
            reasons.setdefault(unit, reason)
            scan = _scan(raw, entry, unit, parts, places)
            if any(scan.name == other.name for other in scans):
                raise InputError(f"{entry.path}: a second scan named {scan.name!r}; rename one of the files")
            _check_size(entry.path, scan, unit, reason, design)
            correct = f"say which it is by --units or in {PROJECT}"
            check_extent(f"{entry.path}: scan {scan.name!r}", scan.points, unit, reason, correct, STRAY)
            scans.append(scan)
            units.append(unit)
    where = places or _stations(scans)
    return Scene(
        project.name,
        kind,
        tuple(scans),
        arch,
        frame,
        where,
        project.temperature_C,
        ", ".join(reasons),
        "; ".join(dict.fromkeys(reasons.values())),
        design if isinstance(design, StructureDesign) else None,
        project.tolerance,
        control_points(project.control, scans, units, where, project.units or asked or "m"),
    )


def _unit(raw: RawScan, path: Path, project: _Project, asked: str) -> tuple[str, str]:
    if asked:
        return asked, "asked for by --units"
    if raw.unit:
        return known_unit(raw.unit), f"said by the {path.suffix.lower()[1:]} file or its format"
    if project.units:
        return project.units, f"said by {PROJECT}"
    return "m", "taken as metres, as scanners write: neither the format nor the project says"


def _scan(raw: RawScan, entry: _Entry, unit: str, parts: set[str], places: Stations | None) -> Scan:
    if len(raw.points) < FEWEST_POINTS:
        raise InputError(
            f"{entry.path}: scan {raw.name!r} has {len(raw.points)} points; expected {FEWEST_POINTS} or more"
        )
    scale = MM_PER_UNIT[unit]
    if raw.step * scale > FLOAT_STEP_MM:
        raise InputError(
            f"{entry.path}: scan {raw.name!r} has its coordinates in 32 bits, which so far from their origin hold "
            f"steps of {raw.step * scale:.3g} mm; export it in double precision, or nearer to its origin"
        )
    origin = raw.origin * scale
    pose = np.array(raw.T_project_scan if entry.pose is None else entry.pose)
    if pose.size:
        pose[:3, 3] *= scale
    position = raw.position if entry.position is None else entry.position
    station = raw.station - 1 if places is not None else raw.station[:0]
    if places is not None and len(station) and not -1 <= station.min() <= station.max() < len(places.ids):
        raise InputError(
            f"{entry.path}: its points name stations {raw.station.min()} to {raw.station.max()}, "
            f"but {STATIONS} has {len(places.ids)}, counted from 1"
        )
    scanner = position if position.size else np.zeros(3)
    grid = scanner_grid.of_scanner(raw.points, raw.grid_row, raw.grid_column, scanner - raw.origin)
    return Scan(
        raw.name,
        used_up(raw, scale),
        origin,
        raw.intensity,
        station.astype(np.int32),
        *grid,
        component=entry.component or (raw.name if raw.name in parts else ""),
        station=entry.station,
        position=position * scale,
        T_project_scan=pose,
        sigma_mm=entry.sigma_mm,
    )


def _stations(scans: list[Scan]) -> Stations | None:
    """Return the scanner positions that the scans give, in the project's frame; the first of a name counts."""
    places: dict[str, Any] = {}
    for scan in scans:
        if scan.position.size:
            T = scan.T_project_scan if scan.T_project_scan.size else np.eye(4)
            places.setdefault(scan.station or scan.name, T[:3, :3] @ scan.position + T[:3, 3])
    return Stations(tuple(places), np.array(list(places.values()))) if places else None


def _check_size(
    path: Path, scan: Scan, unit: str, reason: str, design: ArchDesign | FrameDesign | StructureDesign | None
) -> None:
    """Raise InputError where a scan is larger or smaller than its design by what a mistaken unit would make it.

    Sizes are distances from the middle, which hardly change when a part is turned. Of frames and whole structures often
    a piece is scanned, and within a hall, so only the clear cases count there.
    """
    slips = CLEAREST_SLIPS
    if isinstance(design, ArchDesign):
        part = next((one for one in design.parts if one.name == scan.component), None)
        nominal, slips = part.vertices if part else np.empty((0, 3)), UNIT_SLIPS
    elif isinstance(design, FrameDesign):
        nominal, slips = design.centres if len(design.centres) > 2 else np.empty((0, 3)), FRAME_SLIPS
    else:
        nominal = design.vertices if design else np.empty((0, 3))
    if not len(nominal):
        return
    middle = (nominal.min(axis=0) + nominal.max(axis=0)) / 2.0
    size = float(np.linalg.norm(nominal - middle, axis=1).max())
    points = scan.points[:: max(1, len(scan.points) // 100_000)]
    centre = np.quantile(points, [0.01, 0.99], axis=0).mean(axis=0)
    ratio = float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.99)) / size if size > 0 else 1.0
    slip = next((one for one in slips if abs(ratio / one - 1.0) <= SLIP_TOLERANCE), None)
    if slip is None:
        return
    likely = [name for name, mm in MM_PER_UNIT.items() if abs(MM_PER_UNIT[unit] / mm / slip - 1.0) < 0.01]
    raise InputError(
        f"{path}: scan {scan.name!r} is {ratio:.4g} times as large as the design, close to {slip:.4g}: its unit "
        f"was read as {unit} ({reason}), and that seems wrong{f' (is it {likely[0]}?)' if likely else ''}; "
        f"say which it is by --units or in {PROJECT}, or correct the design's units"
    )
