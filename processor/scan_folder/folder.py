"""A scan folder, or a single scan file, to a scene in mm."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from processor import large_arrays, readers, record_checks
from processor.geometry import rigid
from processor.language.messages import messages
from processor.meshes.mesh_files import SUFFIXES as MESH_SUFFIXES
from processor.model import (
    ArchDesign,
    Ceiling,
    Floats,
    FrameDesign,
    InputError,
    Instrument,
    PartSupports,
    Reason,
    Scan,
    Scene,
    Stations,
    Steel,
    StructureDesign,
    TargetSearch,
    UsageError,
    instruments,
    reason,
)
from processor.model.inputs import Place, read, shown
from processor.progress import tracked
from processor.readers import RawScan
from processor.readers.raw_scan import file_name_as_text, scaled_in_place, scan_name, summed
from processor.scan_folder import guess, node_list, scanner_grid, units
from processor.scan_folder.clips import FEWEST_POINTS, Clipper
from processor.scan_folder.control_points import control_points, read_control
from processor.scan_folder.design import is_surface, read_design, read_json, read_surface
from processor.scan_folder.file_values import existing_file_in
from processor.scan_folder.files import (
    CAD_SUFFIXES,
    CONTROL,
    DESIGNS,
    PICKS,
    PROJECT,
    SCANS,
    STATIONS,
    TRUTH,
    missing,
    node_list_in,
    scan_files,
)
from processor.scan_folder.picks import read_picks
from processor.scan_folder.project_file import CeilingEntry, ListedStation, Project, ScanEntry, Station
from processor.scan_folder.shapes import surface_files
from processor.scan_folder.text_files import read_toml
from processor.scan_folder.tolerance import check_components, read_tolerance
from processor.scan_folder.units import MM_PER_UNIT, FileUnit, file_unit, known_unit
from processor.store import store

FLOAT_STEP_MM = 1.0
LARGEST_MM = units.LARGEST_KM * MM_PER_UNIT["km"]  # of a scan in a wrong unit that fills the memory
UNIT_ADVICE = (
    "state its unit by --units, or by 'units' of its [[scan]] in project.toml (m, or m/us-ft where the heights have "
    "another), or export it in metres"
)

Design = ArchDesign | FrameDesign | StructureDesign
Keep = Callable[[Scan], Scan]


def truth_file(path: Path) -> Path | None:
    """Return the file that may hold the truth: the scene file itself, or FOLDER/truth.h5 if it exists."""
    if path.is_dir():
        return path / TRUTH if (path / TRUTH).is_file() else None
    return path if path.suffix.lower() == ".h5" else None


def as_read(scan: Scan) -> Scan:
    """Keep a scan as it is."""
    return scan


def read_input(path: Path, units: str | None = None, keep: Keep = as_read) -> Scene:
    """Read a scan folder, a single scan file or a scene file.

    ``units`` is the unit of the scans' coordinates and overrides that of their format; of a scan file also ``m/us-ft``,
    with a unit of the heights. Without it the unit that the project file gives the scan applies, then that of the
    format, then that of the project, then metres; ``Scene.units_reason`` gives the source. ``keep`` receives each scan
    once it is read, before the next, and returns it as the scene is to hold it: without its points where they are too
    many for the memory.

    Raises InputError for input that cannot be used, UsageError for an unknown unit.
    """
    option = file_unit(units) if units else None
    if not path.exists():
        raise missing(path)
    if path.is_dir() and not readers.is_closed(path):
        if option and option.vertical != option.horizontal:
            raise UsageError(
                f"--units {units}: expected one unit for a folder; give a scan a unit of its heights by 'units' in its "
                f"[[scan]] of {PROJECT}"
            )
        return _read_folder(path, option.horizontal if option else "", keep)
    if path.suffix.lower() == ".h5":
        return store.read_scene(path)
    one = ScanEntry(path, units=option, units_by=reason("units.by-option"))
    scene = _scene(Project(scan_name(path), scan=(one,)), None, "", keep=keep)
    return record_checks.check(scene, str(path))


def _read_folder(folder: Path, option: str, keep: Keep) -> Scene:
    project = _read_project(folder)
    made = project.guessed.made if project.guessed else None
    design: Design | None = made.design if made else None
    remarks: tuple[Reason, ...] = ()
    if project.design is not None:
        unit = project.design_units or project.units or option or "m"
        if is_surface(project.design) and project.kind in ("", "structure"):
            design = StructureDesign(scan_name(project.design), *read_surface(project.design, unit))
            if project.design.suffix.lower() in MESH_SUFFIXES:
                named = project.design_units or project.units
                source = f"given in {PROJECT}" if named else "given by --units" if option else "not given, so metres"
                advice = f"give the unit by 'design_units' or 'units' in {PROJECT}"
                units.check_extent(f"{project.design}: the design", design.vertices, unit, source, advice)
        elif project.design.suffix.lower() in node_list.SUFFIXES:
            design, remarks = node_list.read_node_list(project.design, unit)
        else:
            design = read_design(folder, project.design, unit)
        record_checks.check(design, str(project.design))  # before scans are compared with it
    if project.design_frame:
        if not isinstance(design, FrameDesign):
            raise InputError(f"{project.where}: 'design_frame' is for the nodes of a space frame; take it out")
        design = dataclasses.replace(design, coordinates=project.design_frame)
    check_components(str(folder / PROJECT), project.tolerance, _component_names(design))
    unit = project.units or option or "m"
    scene = _scene(project, design, option, _read_stations(folder, unit), keep)
    ceiling = None if project.ceiling is None else _ceiling(project.ceiling, unit, project.design_units or unit)
    scene = dataclasses.replace(scene, units_reason=(*scene.units_reason, *remarks), ceiling=ceiling)
    if (folder / PICKS).exists():
        # Picks are in the unit of their scans; scans in different units need one by --units.
        unit_of_picks = scene.units if scene.units in MM_PER_UNIT else ""
        if not unit_of_picks:
            raise InputError(f"{folder / PICKS}: expected scans in one unit, found {scene.units}; give one by --units")
        existing_file_in(folder, PICKS, str(folder))
        scene = dataclasses.replace(scene, picks=read_picks(folder / PICKS, scene.scans, unit_of_picks))
    files = {"stations": STATIONS, "picks": PICKS, "control": CONTROL if (folder / CONTROL).exists() else PROJECT}
    files |= dict.fromkeys(
        ("arch", "frame", "structure"), str(project.design.relative_to(folder) if project.design else PROJECT)
    )
    of_project = (
        "tolerance",
        "temperature_C",
        "name",
        "ceiling",
        "target_search",
        "part_supports",
        "steel",
        "instruments",
    )
    files |= dict.fromkeys(of_project, PROJECT)
    return record_checks.check(scene, str(folder), {field: str(folder / file) for field, file in files.items()})


def _ceiling(given: CeilingEntry, unit: str, surface_unit: str) -> Ceiling:
    """Return a ceiling in mm: ``unit`` is that of its level, ``surface_unit`` that of a mesh that states none."""
    clearance, longest = given.clearance_mm, given.hanger_longest_mm
    if given.surface is None:
        return Ceiling(level=given.level * MM_PER_UNIT[unit], clearance_mm=clearance, longest_mm=longest)
    vertices, faces = read_surface(given.surface, surface_unit)[:2]
    return Ceiling(vertices=vertices, faces=faces, clearance_mm=clearance, longest_mm=longest)


def _supports(
    project: Project, scans: Sequence[Scan], units: Sequence[FileUnit], refused: Collection[str]
) -> PartSupports | None:
    """Return the supports of a bridge's components, in mm, but for those whose scans are ``refused``.

    ``units`` are those of the scans.
    """
    supports = [one for one in project.support if one.component not in refused]
    if not supports:
        return None
    first = {scan.component: unit for scan, unit in reversed(list(zip(scans, units, strict=True)))}
    for one in supports:
        if one.component not in first:
            known = ", ".join(sorted(first)) or "none"
            raise InputError(
                f"{project.where}: [[support]] names {one.component!r}, of which there is no scan ({known})"
            )
    nowhere = np.full(3, np.nan)
    return PartSupports(
        tuple(one.component for one in supports),
        places=np.array([nowhere if s.at is None else s.at * first[s.component].factors for s in supports]),
        chainages=np.array([one.chainage_mm for one in supports]),
    )


def _component_names(design: Design | None) -> Sequence[str]:
    """Return the names that a design gives its components."""
    if isinstance(design, ArchDesign):
        return [part.name for part in design.parts]
    return design.bodies.names if isinstance(design, StructureDesign) and design.bodies is not None else ()


def _read_stations(folder: Path, unit: str) -> Stations | None:
    """Read stations.json, if it exists: positions of scanners in the project's frame, by name or listed with ids."""
    path = folder / STATIONS
    if not path.exists():
        return None
    existing_file_in(folder, STATIONS, str(folder))
    value, place = read_json(path), Place(str(path))
    stations: dict[str, Floats] = {}
    if isinstance(value, list):
        for number, item in enumerate(value, 1):
            within = place.within(str(number))
            listed: Any = read(ListedStation, item, within)
            if listed.id in stations:
                raise within.refused(f"id {listed.id!r} is given more than once; give each station its own")
            stations[listed.id] = listed.position
    elif isinstance(value, dict):
        stations = {name: read(Station, item, place.within(name)).position for name, item in value.items()}
    else:
        raise place.refused(f"expected a table of names and values, found {shown(value)}")
    return Stations(tuple(stations), np.array(list(stations.values())).reshape(-1, 3) * MM_PER_UNIT[unit])


def _read_project(folder: Path) -> Project:
    """Read project.toml, if it exists, with the files that it names or else those that are found."""
    path = folder / PROJECT
    place = Place(str(path), folder=folder)
    guessed, content = None, {}
    if path.exists():
        existing_file_in(folder, PROJECT, str(folder))
        content = read_toml(path)
    elif not any((folder / name).exists() for name in DESIGNS) and surface_files.candidates(folder):
        found = guess.guess(folder)  # as `processor init` does; taken where the surfaces show a bridge or a frame
        guessed = found if found.made and not found.made.kind_doubts else None
    project = read(Project, content, place)
    control, control_file = read_control(folder, project.control)
    name = project.name or file_name_as_text(folder.resolve().name)
    project = dataclasses.replace(project, name=name, measured=control, guessed=guessed)
    if guessed:
        components = {folder / scan.file: scan.component for scan in guessed.scans}
        gap = guessed.made.root_gap_mm if guessed.made else 0.0
        return dataclasses.replace(
            project,
            units=guessed.units,
            scan=tuple(ScanEntry(scan, components[scan]) for scan in _open_scans(folder, list(components))),
            tolerance=read_tolerance({"root_gap_mm": gap}, place) if gap > 0.0 else None,
        )
    design = project.design
    if design is None:
        file = next((name for name in DESIGNS if (folder / name).exists()), "")
        cad = [one.name for one in folder.iterdir() if one.suffix.lower() in CAD_SUFFIXES and one.is_file()]
        if not file and not path.exists() and len(cad) == 1:
            file = cad[0]  # no scan can be one
        if not file and project.kind in ("", "space-frame"):
            file = node_list_in(folder, (*(scan.file for scan in project.scan), control_file))
        design = existing_file_in(folder, file, str(path)) if file else None
    scans = project.scan or tuple(
        ScanEntry(file) for file in _open_scans(folder, scan_files(folder, (design, control_file)))
    )
    return dataclasses.replace(project, design=design, scan=scans)


def _open_scans(folder: Path, files: Sequence[Path]) -> list[Path]:
    """Return the scan files that can be read. Raises InputError for none, and for one in a closed format only."""
    for path in files:
        existing_file_in(folder, str(path.relative_to(folder)), str(folder))
    scans = [path for path in files if not readers.is_closed(path)]
    # A scanner's own files often lie beside the files exported from them.
    exported = {path.stem for path in scans}
    closed = [path for path in files if readers.is_closed(path) and path.stem not in exported]
    if closed and not scans:
        readers.read(closed[0])
    if closed:
        raise InputError(
            f"{closed[0]}: is in a closed format, and no other file here has its name; export it to E57 under that "
            f"name, or name the files to be read by [[scan]] in {PROJECT}"
        )
    if not scans:
        packed = [path.name for path in sorted(folder.iterdir()) if path.suffix.lower() in readers.ARCHIVES]
        raise InputError(
            f"expected scans ({', '.join(readers.SUFFIXES)}) in the folder or in {SCANS}/, found none"
            + (f"; unpack {packed[0]} first" if packed else ""),
            path=folder,
        )
    return scans


@dataclasses.dataclass
class _Found:
    """The scans of a project, what is to be said of them, and why those of some parts of a bridge are ``refused``."""

    clipper: Clipper
    scans: list[Scan] = dataclasses.field(default_factory=list)
    units: list[FileUnit] = dataclasses.field(default_factory=list)
    units_by: dict[str, Reason] = dataclasses.field(default_factory=dict)  # why a unit was taken, by units
    remarks: list[Reason] = dataclasses.field(default_factory=list)
    days: set[str] = dataclasses.field(default_factory=set)
    of_scans: dict[str, Instrument] = dataclasses.field(default_factory=dict)  # of scans with one of their own
    doubted: list[InputError] = dataclasses.field(default_factory=list)
    refused: dict[str, InputError] = dataclasses.field(default_factory=dict)

    def faults(self) -> Iterator[Reason]:
        """Yield what is wrong with scans of parts, the other parts of which are answered."""
        yield from (reason("units.doubted", error=str(error)) for error in self.doubted)
        yield from (reason("read.scan-refused", error=str(error)) for error in self.refused.values())


def _read_scans(project: Project, design: Design | None, option: str, stations: Stations | None, keep: Keep) -> _Found:
    """Read the scans of a project. Raises InputError for one that cannot be used, of a bridge only if none can."""
    parts = {part.name for part in design.parts} if isinstance(design, ArchDesign) else set()
    unit_of_boxes = MM_PER_UNIT[project.units or option or "m"]
    found = _Found(
        Clipper([dataclasses.replace(one, box=one.box * unit_of_boxes) for one in project.clip], project.where)
    )
    for entry in tracked(project.scan):
        if entry.component and parts and entry.component not in parts:
            raise InputError(
                f"the design has no component {entry.component!r}; it has {', '.join(sorted(parts))}", path=entry.file
            )
        try:
            for raw in _read_raws(entry, found.scans):
                unit, why = _unit(raw, entry, project, option)
                scan = found.clipper.clip(_scan(raw, entry, unit, parts, stations))
                try:
                    _check_unit(entry.file, scan, unit, messages("en").text(why), design)
                except InputError as error:
                    if not parts or np.ptp(large_arrays.corners(scan.points), axis=0).max() > LARGEST_MM:
                        raise
                    found.doubted.append(error)  # at such a unit a part fits its design nowhere
                found.days |= {raw.scanned} - {""}
                found.units_by.setdefault(str(unit), why)
                found.remarks += raw.remarks
                found.scans.append(keep(scan))
                if entry.scanner is not None:
                    found.of_scans[scan.name] = entry.scanner
                found.units.append(unit)
        except InputError as error:
            if not parts:
                raise
            found.refused[entry.component or scan_name(entry.file)] = error
        names = [scan.name for scan in found.scans]
        if twice := [name for name in names if names.count(name) > 1]:
            raise InputError(f"a second scan named {twice[0]!r}; rename one of the files", path=entry.file)
    errors = [*found.doubted, *found.refused.values()]
    if errors and len(found.doubted) == len(found.scans):
        raise errors[0]
    return found


def _scene(
    project: Project, design: Design | None, option: str, stations: Stations | None = None, keep: Keep = as_read
) -> Scene:
    arch = design if isinstance(design, ArchDesign) else None
    frame = design if isinstance(design, FrameDesign) else None
    kind = "arch-bridge" if arch else "space-frame" if frame else project.kind or "structure"
    if project.kind and project.kind != kind:
        raise InputError(f"{project.design}: expected a design of kind {project.kind} by {PROJECT}, found {kind}")
    found = _read_scans(project, design, option, stations, keep)
    scans, reasons = found.scans, found.units_by
    where = stations or _stations(scans)
    of_project, why_units = project.units or option or "m", list(reasons.values())
    different = (one for i, one in enumerate(why_units) if one not in why_units[:i])  # reasons have no hash
    guessed: tuple[Reason, ...] = ()  # that the design was found in the files
    if project.guessed is not None:
        unsure = bool(project.guessed.doubts)
        guessed = (reason("units.design-guessed-unsure") if unsure else reason("units.design-guessed"),)
    search = TargetSearch(find.side_mm, find.sphere_radius_mm) if (find := project.targets) else None
    return Scene(
        project.name,
        kind,
        tuple(scans),
        arch=arch,
        frame=frame,
        stations=where,
        temperature_C=project.temperature_C,
        units=", ".join(reasons),
        units_reason=(*different, *guessed, *summed(found.remarks), *found.faults()),
        structure=design if isinstance(design, StructureDesign) else None,
        tolerance=project.tolerance,
        control=control_points(project.measured, scans, found.units, where, of_project, search is not None),
        target_search=search,
        title_block=project.report,
        clips=found.clipper.record(),
        part_supports=_supports(project, scans, found.units, found.refused),
        steel=None if project.steel is None else Steel(project.steel.E_MPa, project.steel.density_kg_m3),
        scanned=tuple(sorted(found.days)),
        instruments=_instruments(project.scanner, found),
    )


def _instruments(of_all: Instrument | None, found: _Found) -> tuple[Instrument, ...]:
    """Return the instruments of a project's scans: those of single scans, then that of the others.

    Where other scans have none, its class is assumed; () where no scan has one.
    """
    if of_all is None and not found.of_scans:
        return ()
    alike: dict[str, tuple[Instrument, list[str]]] = {}
    for scan, one in found.of_scans.items():
        alike.setdefault(repr(one), (one, []))[1].append(scan)
    own = [dataclasses.replace(one, scans=tuple(scans)) for one, scans in alike.values()]
    return (*own, *([] if len(found.of_scans) == len(found.scans) else [of_all or instruments.of_class()]))


def _read_raws(entry: ScanEntry, scans: Sequence[Scan]) -> Iterator[RawScan]:
    """Yield the scans of a file, each released before the next; a name in ``scans`` is replaced by the file's name."""
    raws = readers.read(entry.file)
    several = len(raws) > 1
    if several and (entry.pose is not None or entry.position is not None):
        raise InputError(f"holds {len(raws)} scans, so one 'pose' or 'position' does not fit them", path=entry.file)
    for number in range(1, len(raws) + 1):
        raw = raws.pop(0)
        if several and any(raw.name == other.name for other in scans):  # scanners name the first of each file S1
            raw = dataclasses.replace(raw, name=f"{scan_name(entry.file)}-{number}")
        yield raw


def _unit(raw: RawScan, entry: ScanEntry, project: Project, option: str) -> tuple[FileUnit, Reason]:
    """Return the unit of a scan and who gives it: the user for it, its file, the user for all, or the convention."""
    stated = FileUnit(known_unit(raw.unit), known_unit(raw.unit)) if raw.unit else None
    fault, file_format = raw.unit_fault, entry.file.suffix.lower()[1:]
    if option or entry.units:
        unit, by = entry.units or FileUnit(option, option), entry.units_by
        if option:
            unit, by = FileUnit(option, option), reason("units.by-option")
        if stated and stated != unit:
            fault = reason("units.file-states", unit=str(stated))
        return unit, by if fault is None else reason("units.over-file", by=by, format=file_format, file=fault)
    if stated:
        return stated, reason("units.by-format", format=file_format)
    # The unit of a project does not say which of two units of a file is wrong.
    if fault is not None and (not project.units or fault.code == "units.file-in-two"):
        raise InputError(f"{messages('en').text(fault)}; {UNIT_ADVICE}", path=entry.file)
    if project.units:
        by = reason("units.by-size") if project.guessed else reason("units.by-project", file=PROJECT)
        by = by if fault is None else reason("units.over-file", by=by, format=file_format, file=fault)
        return FileUnit(project.units, project.units), by
    if project.design is None and project.guessed is None and (why := units.not_metres(raw.points)):
        return FileUnit("mm", "mm"), why
    return FileUnit("m", "m"), reason("units.as-scanners-write")


def _scan(raw: RawScan, entry: ScanEntry, unit: FileUnit, parts: set[str], stations: Stations | None) -> Scan:
    if len(raw.points) < FEWEST_POINTS:
        raise InputError(
            f"scan {raw.name!r} has {len(raw.points)} points; expected {FEWEST_POINTS} or more", path=entry.file
        )
    scale = unit.factors
    step_mm = raw.step * float(scale.max())
    if step_mm > FLOAT_STEP_MM:
        raise InputError(
            f"the coordinates of scan {raw.name!r} are in 32 bits, which so far from their origin have "
            f"steps of {step_mm:.3g} mm; export it in double precision, or nearer to its origin",
            path=entry.file,
        )
    pose = np.array(raw.T_project_scan if entry.pose is None else entry.pose)
    if pose.size:
        if unit.vertical != unit.horizontal:
            raise InputError(
                f"expected one unit of a scan with a pose, found {unit}; export it in one", path=entry.file
            )
        pose[:3, 3] *= scale
    position = raw.position if entry.position is None else entry.position
    station = raw.station if stations is not None else raw.station[:0]
    if stations is not None and not position.size and not station.any():
        named = entry.station or raw.name
        if named in stations.ids:
            position = stations.positions[stations.ids.index(named)]
            position = (rigid.apply(rigid.invert(pose), position) if pose.size else position) / scale
            station = station[:0]
    if stations is not None and len(station):
        least, most = map(int, large_arrays.extremes(raw.station))
        if not 0 <= least <= most <= len(stations.ids):
            raise InputError(
                f"its points name stations {least} to {most}, but {STATIONS} has {len(stations.ids)}, counted from 1",
                path=entry.file,
            )
    scanner = position if position.size else np.zeros(3)
    origin = raw.origin * scale
    row, column = scanner_grid.of_scanner(raw.points, raw.grid_row, raw.grid_column, scanner - raw.origin)
    # As rows of the scene's stations: of those counted from 1, 0 is unknown
    rows = large_arrays.allocate(len(station), dtype=np.int32)
    for part in large_arrays.blocks(len(station)):
        rows[part] = station[part] - 1
    return Scan(
        raw.name,
        scaled_in_place(raw, scale),
        origin,
        intensity=raw.intensity,
        point_station=rows,
        grid_row=row,
        grid_column=column,
        component=entry.component or (raw.name if raw.name in parts else ""),
        station=entry.station,
        position=position * scale[: position.size],
        T_project_scan=pose,
        sigma_mm=entry.sigma_mm,
        colour=raw.colour,
    )


def _stations(scans: list[Scan]) -> Stations | None:
    """Return the scanner positions of the scans, in the project's frame; the first of a name counts."""
    positions: dict[str, Floats] = {}
    for scan in scans:
        if scan.position.size:
            T = scan.pose
            positions.setdefault(scan.station or scan.name, T[:3, :3] @ scan.position + T[:3, 3])
    return Stations(tuple(positions), np.array(list(positions.values()))) if positions else None


def _check_unit(path: Path, scan: Scan, unit: FileUnit, source: str, design: Design | None) -> None:
    """Raise InputError if a scan's size shows that its unit is wrong, by itself or beside its design."""
    nominal, ratios, faces = np.empty((0, 3)), units.STRUCTURE_RATIOS, None
    if isinstance(design, ArchDesign):
        part = next((part for part in design.parts if part.name == scan.component), None)
        ratios = units.PART_RATIOS
        nominal, faces = (part.vertices, part.faces) if part else (nominal, None)
    elif isinstance(design, FrameDesign):
        nominal, ratios = design.centres if len(design.centres) > 2 else nominal, units.FRAME_RATIOS
    elif design is not None:
        nominal = design.vertices
    what, advice = f"{path}: scan {scan.name!r}", f"give its unit by --units or in {PROJECT}"
    units.check_ratio(
        what, scan.points, nominal, ratios, unit.horizontal, source, f"{advice}, or correct the design's units", faces
    )
    units.check_extent(what, scan.points, unit.horizontal, source, advice, units.STRAY)
