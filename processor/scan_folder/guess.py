"""The content of a scan folder's project.toml and design.json guessed from its files, with what is not sure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from processor import large_arrays, readers
from processor.geometry import mesh_distance
from processor.model import ArchDesign, Floats, FrameDesign, InputError, Ints
from processor.readers import RawScan
from processor.registration import main_body, principal
from processor.scan_folder import component_names
from processor.scan_folder.checked_table import existing_file_in
from processor.scan_folder.design import is_surface, read_design, read_json, read_surface
from processor.scan_folder.files import DESIGNS, PROJECT, SCANS, STATIONS, scan_files, scan_files_below
from processor.scan_folder.meshes import MESH_SUFFIXES
from processor.scan_folder.shapes import guess_design, surface_files
from processor.scan_folder.shapes.guess_design import GuessedDesign
from processor.scan_folder.units import MM_PER_UNIT, known_unit, radius
from processor.store.atomic_file import replacing
from processor.writers.ply import write_mesh
from processor.writers.project import write_json
from processor.writers.toml import as_toml

UNITS = ("m", "mm", "cm", "inch", "ft")  # candidates, the likeliest first
UNIT_TOLERANCE = 0.25  # relative difference of a scan's size from its design's
LARGEST_M = 2000.0  # a scan larger than this is not in metres
# Greatest difference of extents by the longest: of a scan of the part, of one with gaps, and of another part.
SAME_SHAPE, LIKE_SHAPE, OTHER_SHAPE = principal.SIZE_SHARE, 0.05, 0.15
SAMPLE = 100_000  # points that extents are measured from

Surface = tuple[Floats, Ints]


@dataclass
class ScanGuess:
    """One file of scans with its component and station ("" = none); ``sure`` if nothing contradicts them."""

    file: str
    component: str = ""
    station: str = ""
    reason: str = ""
    sure: bool = True
    error: str = ""  # why the file could not be read
    units: str = ""  # given by the format
    stem: str = ""
    similar: tuple[str, ...] = ()  # components of the scan's shape
    differences: dict[str, float] = field(default_factory=dict)  # of its extents from each component's, by the longest
    sample: Floats = field(default_factory=lambda: np.empty((0, 3)))  # points (n, 3) in the file's unit
    radius: float = 0.0  # from the middle


@dataclass
class Guess:
    """The content of project.toml, each entry with its reason, and messages on what is not sure."""

    folder: str
    name: str
    kind: str = ""
    kind_reason: str = ""
    design: str = ""
    design_reason: str = ""
    design_units: str = ""
    made: GuessedDesign | None = None  # the design that design.json is to hold
    units: str = ""
    units_reason: str = ""
    stations: str = ""
    scans: list[ScanGuess] = field(default_factory=list)
    unsure: list[str] = field(default_factory=list)


def guess(folder: Path, design_units: str = "") -> Guess:
    """Guess project.toml, and design.json where there is none, from the files of a folder.

    ``design_units`` is the unit of a design that states none; "" = it is guessed. Raises InputError without scans, and
    without such a folder.
    """
    if not folder.is_dir():
        raise InputError(f"expected a scan folder, found {'a file' if folder.exists() else 'nothing'}", path=folder)
    project = Guess(str(folder), folder.resolve().name)
    path = _written_design(folder, project)
    groups = [] if path else surface_files.candidates(folder)
    surfaces = [one for group in groups for one in group]
    project.scans = [_read_scan(folder, file, project) for file in scan_files_below(folder, [path, *surfaces])]
    design = _read_design(folder, path, project) if path else _shown_design(folder, groups, design_units, project)
    if not design and len(surfaces) > 1:  # they may be scans with faces
        project.scans += [_read_scan(folder, file, project) for file in scan_files(folder, [path]) if file in surfaces]
    if not project.scans:
        raise InputError(
            f"expected scans ({', '.join(readers.SUFFIXES)}) in the folder or in {SCANS}/, found none", path=folder
        )
    shapes = _shapes(design) if isinstance(design, ArchDesign) else {}
    _guess_units(project, _sizes(design), shapes)
    if shapes:
        _guess_components(project, shapes)
    elif not design:
        _guess_kind(project)
    if (folder / STATIONS).is_file():
        project.stations = f"{STATIONS} gives the scanners' positions"
    return project


# --- design -----------------------------------------------------------------------------------------------------------


def _written_design(folder: Path, project: Guess) -> Path | None:
    """Return a design.json, design.csv or another JSON file that states a kind; None without one."""
    for name in DESIGNS:
        if (folder / name).is_file():
            project.design, project.design_reason = name, "found by its name"
            return folder / name
    tables = [path for path in sorted(folder.glob("*.json")) if path.name != STATIONS and _has_kind(path)]
    if len(tables) == 1:
        project.design, project.design_reason = tables[0].name, "the only candidate"
        return tables[0]
    if tables:
        named = ", ".join(path.name for path in tables[:5])
        project.unsure.append(f"design: several files may be it ({named}); name one as 'design'")
    return None


def _shown_design(
    folder: Path, groups: Sequence[Sequence[Path]], design_units: str, project: Guess
) -> ArchDesign | FrameDesign | Surface | None:
    """Return the design that meshes or CAD files show: of an arch bridge or a frame, else one surface of a whole."""
    scans = [(scan.radius, scan.units) for scan in project.scans if not scan.error]
    stems = [scan.stem for scan in project.scans]
    found = list[GuessedDesign]()
    without = list[GuessedDesign]()
    for group in groups:
        try:
            guessed = guess_design.guess(folder, group, scans, design_units, stems)
        except InputError as error:
            project.unsure.append(f"design: {_within(folder, error)}")
            continue
        (without if guessed.design is None else found).append(guessed)
    if len(found) == 1:
        _take_design(project, found[0])
        return found[0].design
    paths = [path for group in groups for path in group]
    if len(paths) == 1 and not found:
        project.design, project.design_reason = str(paths[0].relative_to(folder)), "the only candidate"
        # The unit of one surface of the whole is that of 'design_units', which has a doubt of its own.
        project.unsure += [text for one in without for text in one.doubts]
        return _read_design(folder, paths[0], project)
    if not paths:
        project.unsure.append("design: none found, so scans are not compared with one")
        return None
    candidates = [one.files[0] for one in found] or [str(path.relative_to(folder)) for path in paths]
    named = ", ".join(candidates[:5])
    project.unsure.append(
        f"design: several files may be it ({named}); name one as 'design', with kind = \"structure\", or write a "
        "design.json"
    )
    project.unsure += [f"design: {text}" for one in without for text in one.questions]
    return None


def _take_design(project: Guess, guessed: GuessedDesign) -> None:
    project.made, project.design = guessed, DESIGNS[0]
    project.kind = "arch-bridge" if isinstance(guessed.design, ArchDesign) else "space-frame"
    project.kind_reason = project.design_reason = guessed.reason
    if guessed.kind_doubt:
        project.unsure.append(f"kind: taken as {project.kind}: {guessed.kind_doubt}")
    project.unsure += guessed.questions


def _has_kind(path: Path) -> bool:
    try:
        return isinstance(read_json(path).values.get("kind"), str)
    except InputError:
        return False


def _read_design(folder: Path, path: Path, project: Guess) -> ArchDesign | FrameDesign | Surface | None:
    """Read the design; if it cannot be read, a message is added and the guess continues without."""
    try:
        existing_file_in(folder, str(path.relative_to(folder)), str(folder))
        if is_surface(path):
            project.kind, project.kind_reason = "structure", f"{project.design} is one surface of the whole"
            return read_surface(path, "mm")[:2]
        design = read_design(folder, path, "m")
    except InputError as error:
        project.unsure.append(f"design: {error}")
        return None
    project.kind = "arch-bridge" if isinstance(design, ArchDesign) else "space-frame"
    project.kind_reason = f"the kind of {project.design}"
    return design


def _sizes(design: ArchDesign | FrameDesign | Surface | None) -> list[float]:
    """Return the radii in mm that scans of the design may have: of each part, or of the whole."""
    if isinstance(design, ArchDesign):
        return [radius(part.vertices) for part in design.parts]
    if isinstance(design, FrameDesign):
        return [radius(design.centres)]
    return [radius(design[0])] if design else []


# --- scans ------------------------------------------------------------------------------------------------------------


def _read_scan(folder: Path, path: Path, project: Guess) -> ScanGuess:
    scan = ScanGuess(str(path.relative_to(folder)), stem=path.stem)
    try:
        existing_file_in(folder, scan.file, str(folder))
        raws = readers.read(path)
    except InputError as error:
        scan.error = _within(folder, error)
        project.unsure.append(f"{scan.file}: cannot be read, so it is written as a comment: {scan.error}")
        return scan
    scan.units = known_unit(raws[0].unit) if raws[0].unit else ""
    points = _sample(raws)
    scan.sample = points
    scan.radius = radius(points - points.mean(axis=0))
    if len(raws) > 1:
        scan.reason = f"holds {len(raws)} scans: {', '.join(raw.name for raw in raws[:6])}"
    return scan


def _within(folder: Path, error: InputError) -> str:
    """Return the message of an error, with the file named as from the folder that it is in."""
    if error.path is None or not error.path.is_relative_to(folder):
        return str(error)
    return f"{error.path.relative_to(folder)}: {error.problem}"


def _sample(raws: Sequence[RawScan]) -> Floats:
    """Return every k-th point of a file, transformed by the poses of several scans, relative to the first origin."""
    share = max(1, sum(len(raw.points) for raw in raws) // SAMPLE)
    pieces = []
    for raw in raws:
        points = large_arrays.every(raw.points, share) + (raw.origin - raws[0].origin)
        if raw.T_project_scan.size and len(raws) > 1:
            T = raw.T_project_scan
            points = (points + raws[0].origin) @ T[:3, :3].T + T[:3, 3]
        pieces.append(points)
    return np.concatenate(pieces)


# --- guesses ----------------------------------------------------------------------------------------------------------


def _shapes(design: ArchDesign) -> dict[str, Floats]:
    """Return the sizes (3,) of a design's parts along their principal axes, longest first, by their names."""
    surfaces = {part.name: mesh_distance.spread(part.vertices, part.faces, lambda _: SAMPLE) for part in design.parts}
    return {name: principal.sizes(surface.points) for name, surface in surfaces.items()}


def _differences(scan: ScanGuess, unit: str, shapes: Mapping[str, Floats]) -> dict[str, float]:
    """Return the largest difference of a scan's extents from each part's, by the part's longest size.

    Ground and what stands about the part is left out.
    """
    points = scan.sample * MM_PER_UNIT[unit]
    of_part = main_body.of_sizes(points, list(shapes.values()))
    extents = principal.sizes(points if of_part is None else points[of_part])
    return {name: float(np.abs(extents - shape).max() / shape[0]) for name, shape in shapes.items()}


def _guess_units(project: Guess, nominal: Sequence[float], shapes: Mapping[str, Floats]) -> None:
    """Take the unit of the formats; else the one in which the scans have the design's size; else metres.

    ``nominal`` are the radii of what is designed, ``shapes`` the sizes of an arch's parts.
    """
    without = [scan for scan in project.scans if not scan.units and not scan.error]
    if project.design and project.kind == "structure" and Path(project.design).suffix.lower() in MESH_SUFFIXES:
        project.design_units = "mm"
        project.unsure.append(f"design_units: {project.design} has no unit; taken as mm, as CAD writes meshes")
    if not without:
        given = sorted({scan.units for scan in project.scans if scan.units})
        project.units_reason = f"given by the scans' formats: {', '.join(given)}" if given else ""
        return
    if shapes:
        of_unit = {
            unit: float(np.median([min(_differences(scan, unit, shapes).values()) for scan in without]))
            for unit in UNITS
        }
        best = min(UNITS, key=of_unit.__getitem__)
        if of_unit[best] <= LIKE_SHAPE:
            project.units, project.units_reason = best, "the scans are as large as the design in it"
            return
    if nominal:
        sizes = np.array(nominal)
        misfits = {
            unit: max(np.abs(np.log(scan.radius * MM_PER_UNIT[unit] / sizes)).min() for scan in without)
            for unit in UNITS
        }
        project.units = best = min(UNITS, key=misfits.__getitem__)
        if misfits[best] <= np.log1p(UNIT_TOLERANCE):
            project.units_reason = "the scans are as large as the design in it"
            return
        project.units_reason = f"the nearest to the design's size, and off by a factor of {np.exp(misfits[best]):.3g}"
    else:
        extent = 2.0 * float(np.median([scan.radius for scan in without]))
        project.units = "m" if extent <= LARGEST_M else "mm"
        project.units_reason = f"a scan has an extent of {extent:.4g}"
    project.unsure.append(f"units: taken as {project.units}: {project.units_reason}")


def _guess_kind(project: Guess) -> None:
    project.kind, project.kind_reason = "structure", "the only kind that needs no design"
    for scan in project.scans:
        scan.station = component_names.station(scan.stem)
    project.unsure.append(
        "kind: taken as structure; a roof of bolt balls is a space-frame, a bridge in parts needs a design.json"
    )


def _guess_components(project: Guess, shapes: Mapping[str, Floats]) -> None:
    """Assign components to scans by name and shape; contradictions and ambiguities are added to ``unsure``."""
    names = list(shapes)
    scans = [scan for scan in project.scans if not scan.error]
    for scan in scans:
        scan.differences = _differences(scan, scan.units or project.units or "m", shapes)
        scan.station = component_names.station(scan.stem)
        _choose(scan, component_names.components(scan.stem, names))
    _assign_similar(scans, names)
    project.unsure += [
        f"{scan.file}: {scan.component or 'no component'}: {scan.reason}" for scan in scans if not scan.sure
    ]
    files = {name: [scan.file for scan in project.scans if scan.component == name] for name in names}
    missing = [name for name in names if not files[name]]
    if missing:
        project.unsure.append(f"no scan is assigned to {', '.join(missing)}")
    project.unsure += [
        f"{name}: {len(files[name])} scans are assigned to it ({', '.join(files[name])})"
        for name in names
        if len(files[name]) > 1
    ]


def _assign_similar(scans: Sequence[ScanGuess], names: Sequence[str]) -> None:
    """Assign the scans whose shape matches several components to those left, with the least differences in sum."""
    taken = {scan.component for scan in scans if scan.sure}
    left = [name for name in names if name not in taken]
    unsure = [scan for scan in scans if not scan.sure and len(scan.similar) > 1]
    cost = np.array([[scan.differences[name] if name in scan.similar else 1.0 for name in left] for scan in unsure])
    for row, column in zip(*linear_sum_assignment(cost.reshape(len(unsure), len(left))), strict=True):
        scan, name = unsure[row], left[column]
        if name in scan.similar:
            scan.component = name
            only = sum(other in left for other in scan.similar) == 1
            scan.reason += f"; {'the only one of them left' if only else 'any of them may be right'}"


def _choose(scan: ScanGuess, named: Sequence[str]) -> None:
    """Choose a scan's component among those ``named`` by its file, else among all, by the differences of extents."""
    several, differences = f"{scan.reason}; " if scan.reason else "", scan.differences
    by_shape = sorted(named or differences, key=lambda name: differences[name])
    best = by_shape[0]
    shape = f"extents within {100.0 * differences[best]:.2g} % of the design's"
    if len(named) == 1:
        scan.component = best
        # A scan with gaps may have other extents than its part, but by chance those of another.
        nearest = min(differences, key=lambda name: differences[name])
        other = differences[nearest] <= SAME_SHAPE < differences[best]
        scan.sure = differences[best] <= OTHER_SHAPE and not several and not other
        scan.reason = f"{several}by its name; {shape}"
        if other or differences[best] > OTHER_SHAPE:
            scan.reason = f"{several}by its name, but its extents differ by {100.0 * differences[best]:.2g} %" + (
                f"; the extents match {nearest}" if differences[nearest] <= LIKE_SHAPE else ""
            )
        return
    same = [name for name in by_shape if differences[name] <= SAME_SHAPE]
    similar = same or [name for name in by_shape if differences[name] <= LIKE_SHAPE]
    scan.component, scan.similar = best if similar else "", tuple(name for name in differences if name in similar)
    scan.sure = len(same) == 1 and not several
    which = f"its name matches {', '.join(named)}; " if named else "its name matches no component; "
    if not similar:
        difference = f"the nearest, {best}, differs by {100.0 * differences[best]:.0f} %"
        scan.reason = f"{several}{which}its extents match none of them ({difference})"
    elif len(similar) > 1:
        scan.reason = f"{several}{which}its extents match {', '.join(scan.similar)}"
    else:
        scan.reason = f"{several}{which}by its shape alone; {shape}"


# --- the guess as project.toml and as JSON ----------------------------------------------------------------------------


def to_toml(project: Guess) -> str:
    """Return the text of project.toml, with reasons and further keys as comments."""
    lines = ["# Made by `processor init`. What is unsure is marked with a question mark."]
    lines += [f"# ? {_one_line(text)}" for text in project.unsure] + [""]
    lines.append(f"name = {as_toml(project.name)}")
    lines.append(f"kind = {as_toml(project.kind)}  # {_one_line(project.kind_reason)}")
    if project.units:
        lines.append(
            f"units = {as_toml(project.units)}  # of scans whose format gives none: {_one_line(project.units_reason)}"
        )
    else:
        lines.append(f'# units = "m"  # not needed: {_one_line(project.units_reason)}')
    if project.design:
        lines.append(f"design = {as_toml(project.design)}  # {_one_line(project.design_reason)}")
    else:
        lines.append('# design = "design.json"  # or one mesh, STEP or IFC file of the whole, of kind structure')
    if project.design_units:
        lines.append(f"design_units = {as_toml(project.design_units)}  # of the mesh, which has no unit")
    lines.append("# temperature_C = 20.0  # of the steel while it was scanned")
    if project.stations:
        lines.append(f"# {_one_line(project.stations)}")
    for scan in project.scans:
        lines += ["", *_scan_lines(scan)]
    gap = project.made.root_gap_mm if project.made else 0.0
    lines += [
        "",
        *(
            ["[tolerance]", f"root_gap_mm = {gap!r}  # between the ends as modelled"]
            if gap > 0.0
            else ["# [tolerance]"]
        ),
    ]
    lines += ['# standard = "GB 50205-2020"', ""]
    return "\n".join(lines)


def _scan_lines(scan: ScanGuess) -> list[str]:
    if scan.error:
        return [
            f"# {scan.file!a} cannot be read: {_one_line(scan.error)}",
            "# [[scan]]",
            f"# file = {as_toml(scan.file)}",
        ]
    lines = ["[[scan]]", f"file = {as_toml(scan.file)}"]
    reason = f"  # {'' if scan.sure else '? '}{_one_line(scan.reason)}" if scan.reason else ""
    if scan.component:
        lines.append(f"component = {as_toml(scan.component)}{reason}")
    elif reason:
        lines.append(reason.strip())
    if scan.station:
        lines.append(f"# station = {as_toml(scan.station)}")
    return lines


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in " ".join(text.split()))


def as_json(project: Guess) -> dict[str, Any]:
    """Return the guess as an object for JSON."""
    keys = ("kind", "kind_reason", "design", "design_reason", "design_units", "units", "units_reason", "unsure")
    scan_keys = ("file", "component", "station", "reason", "sure", "error")
    scans = [{key: getattr(scan, key) for key in scan_keys} for scan in project.scans]
    return {"file": f"{project.folder}/{PROJECT}", "name": project.name} | {
        **{key: getattr(project, key) for key in keys},
        "scans": scans,
        "made": [f"{project.folder}/{name}" for name in (project.design, *_meshes(project))] if project.made else [],
    }


def summary(project: Guess) -> str:
    """Return what the guessed design holds, in a line."""
    design = project.made.design if project.made else None
    if isinstance(design, ArchDesign):
        order = ", ".join(part.name for part in design.parts)
        return f"{len(design.parts)} parts ({order}), {len(design.joint_names)} joint(s)"
    if isinstance(design, FrameDesign):
        return f"{len(design.ids)} node(s), {len(design.member_a)} member(s)"
    return "no design"


def _meshes(project: Guess) -> list[str]:
    return [name for name, _, _ in project.made.meshes] if project.made else []


def write_design(folder: Path, project: Guess) -> None:
    """Write the guessed design.json, and the meshes that it names, to a folder."""
    if project.made is None:
        return
    for name, vertices, faces in project.made.meshes:
        (folder / name).parent.mkdir(exist_ok=True)
        with replacing(folder / name) as temporary:
            write_mesh(temporary, vertices, faces)
    questions = [*([project.made.kind_doubt] if project.made.kind_doubt else []), *project.made.questions]
    with replacing(folder / project.design) as temporary:
        write_json(temporary, guess_design.content(project.made, questions))
