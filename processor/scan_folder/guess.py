"""The content of a scan folder's project.toml and design.json guessed from its files, with reasons and doubts.

A doubt is a reason why an entry may be wrong, or why it is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from processor import large_arrays, readers
from processor.geometry import mesh_distance
from processor.geometry.thinning import thinned
from processor.language.messages import Text, messages, text
from processor.meshes.mesh_files import SUFFIXES as MESH_SUFFIXES
from processor.model import ArchDesign, Floats, FrameDesign, InputError, Ints, Reason, reason
from processor.readers import RawScan
from processor.registration import located_part, main_body, pose_search, principal
from processor.registration.located_part import Located
from processor.registration.pose_search import DesignSurface
from processor.scan_folder import component_names
from processor.scan_folder.design import read_design, read_json, read_surface
from processor.scan_folder.file_values import existing_file_in
from processor.scan_folder.files import DESIGNS, PROJECT, SCANS, STATIONS, node_list_in, scan_files, scan_files_below
from processor.scan_folder.shapes import guess_design, surface_files
from processor.scan_folder.shapes.guess_design import GuessedDesign
from processor.scan_folder.units import MM_PER_UNIT, known_unit, radius
from processor.store.whole_output import replacing
from processor.writers.ply import write_mesh
from processor.writers.project import write_json
from processor.writers.toml import as_toml

UNITS = ("m", "mm", "cm", "inch", "ft")  # candidates, the likeliest first
UNIT_TOLERANCE = 0.25  # relative difference of a scan's size from its design's
LARGEST_M = 2000.0  # a scan larger than this is not in metres
# Greatest difference of extents by the longest: of a scan of the part, of one with gaps, and of another part.
SAME_SHAPE, LIKE_SHAPE, OTHER_SHAPE = principal.SIZE_SHARE, 0.05, 0.15
SAMPLE, SCAN_SAMPLE = 100_000, 400_000  # points that extents are measured from, and that a part is located among
LARGEST_ROOM = 12.0  # times the longest part: surroundings that belong to a scan of it
# Share of a part's surface that is shown in a scan with surroundings, beyond which no other unit is tried: in the right
# one 0.49 to 0.89, in a wrong one up to 0.33 (30 rooms).
SURELY_SHOWN = 0.45

Surface = tuple[Floats, Ints]


@dataclass
class ScanGuess:
    """One file of scans with its component and station ("" = none); ``sure`` if nothing contradicts them."""

    file: str
    component: str = ""
    station: str = ""
    reasons: tuple[Reason, ...] = ()
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
    """The content of project.toml, each entry with its reasons, and the doubts about them."""

    folder: str
    name: str
    kind: str = ""
    kind_reasons: tuple[Reason, ...] = ()
    design: str = ""
    design_reasons: tuple[Reason, ...] = ()
    design_units: str = ""
    made: GuessedDesign | None = None  # the design that design.json is to hold
    units: str = ""
    units_reasons: tuple[Reason, ...] = ()
    stations: str = ""  # the file with the scanners' positions
    scans: list[ScanGuess] = field(default_factory=list)
    doubts: list[Reason] = field(default_factory=list)


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
    shapes = _Shapes(design) if isinstance(design, ArchDesign) else None
    _guess_units(project, _sizes(design), shapes)
    if shapes:
        _guess_components(project, shapes)
    elif not design:
        project.kind, project.kind_reasons = "structure", (reason("init.needs-no-design"),)
        for scan in project.scans:
            scan.station = component_names.station(scan.stem)
        project.doubts.append(reason("init.kind-without-design"))
    if (folder / STATIONS).is_file():
        project.stations = STATIONS
    return project


# --- design -----------------------------------------------------------------------------------------------------------


def _written_design(folder: Path, project: Guess) -> Path | None:
    """Return a design.json, design.csv or another JSON file that states a kind; None without one."""
    for name in DESIGNS:
        if (folder / name).is_file():
            project.design, project.design_reasons = name, (reason("init.by-file-name"),)
            return folder / name
    if listed := node_list_in(folder, ()):
        project.design, project.design_reasons = listed, (reason("init.node-list"),)
        return folder / listed
    tables = [path for path in sorted(folder.glob("*.json")) if path.name != STATIONS and _has_kind(path)]
    if len(tables) == 1:
        project.design, project.design_reasons = tables[0].name, (reason("init.only-candidate"),)
        return tables[0]
    if tables:
        project.doubts.append(reason("init.several-designs", files=tuple(path.name for path in tables[:5])))
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
            project.doubts.append(reason("init.design-unreadable", error=_within(folder, error)))
            continue
        (without if guessed.design is None else found).append(guessed)
    if len(found) == 1:
        made = project.made = found[0]
        project.design = DESIGNS[0]
        project.kind = "arch-bridge" if isinstance(made.design, ArchDesign) else "space-frame"
        project.kind_reasons = project.design_reasons = made.reasons
        project.doubts += [reason("init.kind-taken", kind=project.kind, reason=doubt) for doubt in made.kind_doubts]
        project.doubts += made.doubts
        return made.design
    paths = [path for group in groups for path in group]
    if len(paths) == 1 and not found:
        project.design, project.design_reasons = str(paths[0].relative_to(folder)), (reason("init.only-candidate"),)
        # The unit of one surface of the whole is that of 'design_units', which has a doubt of its own.
        project.doubts += [doubt for one in without for doubt in one.other_doubts]
        # An error of reading ends the guess: of what kind the project is, nothing else shows.
        existing_file_in(folder, project.design, str(folder))
        surface = read_surface(paths[0], "mm")[:2]
        project.kind, project.kind_reasons = "structure", (reason("init.one-surface", file=project.design),)
        return surface
    if not paths:
        project.doubts.append(reason("init.no-design"))
        return None
    candidates = [one.files[0] for one in found] or [str(path.relative_to(folder)) for path in paths]
    project.doubts.append(reason("init.several-surfaces", files=tuple(candidates[:5])))
    project.doubts += [reason("init.of-design", reason=doubt) for one in without for doubt in one.doubts]
    return None


def _has_kind(path: Path) -> bool:
    try:
        return isinstance(read_json(path)["kind"], str)
    except (InputError, LookupError, TypeError):
        return False


def _read_design(folder: Path, path: Path, project: Guess) -> ArchDesign | FrameDesign | None:
    """Read design.json or a table of nodes; if it cannot be read, a doubt is added and the guess continues without."""
    try:
        existing_file_in(folder, str(path.relative_to(folder)), str(folder))
        design = read_design(folder, path, "m")
    except InputError as error:
        project.doubts.append(reason("init.design-unreadable", error=str(error)))
        return None
    project.kind = "arch-bridge" if isinstance(design, ArchDesign) else "space-frame"
    project.kind_reasons = (reason("init.kind-of-design", file=project.design),)
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
        project.doubts.append(reason("init.scan-unreadable", file=scan.file, error=scan.error))
        return scan
    scan.units = known_unit(raws[0].unit) if raws[0].unit else ""
    points = _sample(raws)
    scan.sample = points
    scan.radius = radius(points - points.mean(axis=0))
    if len(raws) > 1:
        names = tuple(raw.name for raw in raws[:6])
        scan.reasons = (reason("init.several-scans", scans=len(raws), names=names),)
    return scan


def _within(folder: Path, error: InputError) -> str:
    """Return the message of an error, with the file named as from the folder that it is in."""
    if error.path is None or not error.path.is_relative_to(folder):
        return str(error)
    return f"{error.path.relative_to(folder)}: {error.problem}"


def _sample(raws: Sequence[RawScan]) -> Floats:
    """Return every k-th point of a file, transformed by the poses of several scans, relative to the first origin."""
    share = max(1, sum(len(raw.points) for raw in raws) // SCAN_SAMPLE)
    pieces = []
    for raw in raws:
        points = large_arrays.every(raw.points, share) + (raw.origin - raws[0].origin)
        if raw.T_project_scan.size and len(raws) > 1:
            T = raw.T_project_scan
            points = (points + raws[0].origin) @ T[:3, :3].T + T[:3, 3]
        pieces.append(points)
    return np.concatenate(pieces)


# --- guesses ----------------------------------------------------------------------------------------------------------


class _Shapes:
    """The parts of a design: sizes (3,) along their principal axes, longest first, by name; and their surfaces."""

    def __init__(self, design: ArchDesign) -> None:
        surfaces = {
            part.name: mesh_distance.spread(part.vertices, part.faces, lambda _: SAMPLE) for part in design.parts
        }
        self.design = design
        self.located: dict[tuple[str, str], list[list[Located]]] = {}  # in a file's scan, in a unit
        self.sizes = {name: principal.sizes(surface.points) for name, surface in surfaces.items()}

    @cached_property
    def surfaces(self) -> dict[str, DesignSurface]:
        """One part of each size, prepared for the search in scans with surroundings."""
        different: list[str] = []
        for name, size in self.sizes.items():
            limits = (principal.SIZE_SHARE * self.sizes[one][0] for one in different)
            if all(np.abs(self.sizes[one] - size).max() > limit for one, limit in zip(different, limits, strict=True)):
                different.append(name)
        parts = {part.name: part for part in self.design.parts}
        return {
            name: pose_search.prepared(mesh_distance.of_mesh(parts[name].vertices, parts[name].faces))
            for name in different
        }


def _differences(scan: ScanGuess, unit: str, shapes: _Shapes, named: Sequence[str] = ()) -> dict[str, float]:
    """Return the largest difference of a scan's extents from each part's, by the part's longest size.

    The extents of a scan with surroundings are those of the part that is located in it: of one that is ``named``, if
    it is shown as well as others.
    """
    points = scan.sample * MM_PER_UNIT[unit]
    sizes = list(shapes.sizes.values())
    longest = max(float(np.linalg.norm(size)) for size in sizes)
    extents, others = [principal.sizes(thinned(points, SAMPLE))], list[Floats]()
    spread = float(np.linalg.norm(np.ptp(points, axis=0)))
    if spread < LARGEST_ROOM * longest and main_body.holds_more(points, sizes):
        names, designs = list(shapes.surfaces), list(shapes.surfaces.values())
        if (scan.file, unit) not in shapes.located:
            shapes.located[scan.file, unit] = located_part.locate(points, designs)
        located = shapes.located[scan.file, unit]
        alike = [
            k
            for k, name in enumerate(names)
            if any(np.abs(shapes.sizes[name] - shapes.sizes[one]).max() < 2.0 * SAME_SHAPE * longest for one in named)
        ]
        found = located_part.which(points, designs, located, named=alike[0] if len(alike) == 1 else -1)
        of_bodies = [[shapes.sizes[names[k]] for k in body.numbers] for body in found]
        extents, others = (of_bodies[0], [one for body in of_bodies[1:] for one in body]) if found else (extents, [])
    return {
        # What another body is, the scan may be of as well, if rather of this one.
        name: min(
            *(float(np.abs(one - shape).max() / shape[0]) for one in extents),
            *(max(float(np.abs(one - shape).max() / shape[0]), 0.5 * SAME_SHAPE) for one in others),
            float("inf"),
        )
        for name, shape in shapes.sizes.items()
    }


def _misfit(scan: ScanGuess, unit: str, shapes: _Shapes) -> tuple[float, float]:
    """Return how much a scan's extents differ from the nearest part's, and less the share of surface that is shown."""
    least = min(_differences(scan, unit, shapes).values())
    return least, -located_part.most_shown(shapes.located.get((scan.file, unit), []))


def _guess_units(project: Guess, nominal: Sequence[float], shapes: _Shapes | None) -> None:
    """Take the unit of the formats; else the one in which the scans have the design's size; else metres.

    ``nominal`` are the radii of what is designed, ``shapes`` an arch's parts.
    """
    without = [scan for scan in project.scans if not scan.units and not scan.error]
    if project.design and project.kind == "structure" and Path(project.design).suffix.lower() in MESH_SUFFIXES:
        project.design_units = "mm"
        project.doubts.append(reason("init.mesh-without-unit", file=project.design))
    if not without:
        given = tuple(sorted({scan.units for scan in project.scans if scan.units}))
        project.units_reasons = (reason("init.units-by-formats", units=given),) if given else ()
        return
    if shapes:
        # Of scans with surroundings a part is found in several units: in the right one more of its surface is shown.
        of_unit = dict[str, list[float]]()
        for unit in UNITS:
            of_unit[unit] = np.median([_misfit(scan, unit, shapes) for scan in without], axis=0).tolist()
            if of_unit[unit][0] <= LIKE_SHAPE and of_unit[unit][1] < -SURELY_SHOWN:
                break
        best = min(of_unit, key=of_unit.__getitem__)
        if of_unit[best][0] <= LIKE_SHAPE:
            project.units, project.units_reasons = best, (reason("init.units-by-design"),)
            return
    if nominal:
        sizes = np.array(nominal)
        misfits = {
            unit: max(np.abs(np.log(scan.radius * MM_PER_UNIT[unit] / sizes)).min() for scan in without)
            for unit in UNITS
        }
        project.units = best = min(UNITS, key=misfits.__getitem__)
        if misfits[best] <= np.log1p(UNIT_TOLERANCE):
            project.units_reasons = (reason("init.units-by-design"),)
            return
        why = reason("init.units-nearest", factor=np.exp(misfits[best]))
    else:
        extent = 2.0 * float(np.median([scan.radius for scan in without]))
        project.units = "m" if extent <= LARGEST_M else "mm"
        why = reason("init.units-by-extent", extent=extent)
    project.units_reasons = (why,)
    project.doubts.append(reason("init.units-taken", units=project.units, reason=why))


def _guess_components(project: Guess, shapes: _Shapes) -> None:
    """Assign components to scans by name and shape; contradictions and ambiguities are added to the doubts."""
    names = list(shapes.sizes)
    scans = [scan for scan in project.scans if not scan.error]
    for scan in scans:
        named = component_names.components(scan.stem, names)
        scan.differences = _differences(scan, scan.units or project.units or "m", shapes, named)
        scan.station = component_names.station(scan.stem)
        _choose(scan, named)
    _assign_similar(scans, names)
    project.doubts += [_doubt(scan) for scan in scans if not scan.sure]
    files = {name: tuple(scan.file for scan in project.scans if scan.component == name) for name in names}
    missing = tuple(name for name in names if not files[name])
    if missing:
        project.doubts.append(reason("init.components-without-scan", components=missing))
    project.doubts += [
        reason("init.component-of-several-scans", component=name, scans=len(files[name]), files=files[name])
        for name in names
        if len(files[name]) > 1
    ]


def _doubt(scan: ScanGuess) -> Reason:
    if not scan.component:
        return reason("init.scan-of-no-component", file=scan.file, reasons=scan.reasons)
    return reason("init.scan-of-component", file=scan.file, component=scan.component, reasons=scan.reasons)


def _assign_similar(scans: Sequence[ScanGuess], names: Sequence[str]) -> None:
    """Assign the scans whose shape matches several components to those left, with the least differences in sum."""
    taken = {scan.component for scan in scans if scan.sure}
    left = [name for name in names if name not in taken]
    doubtful = [scan for scan in scans if not scan.sure and len(scan.similar) > 1]
    cost = np.array([[scan.differences[name] if name in scan.similar else 1.0 for name in left] for scan in doubtful])
    for row, column in zip(*linear_sum_assignment(cost.reshape(len(doubtful), len(left))), strict=True):
        scan, name = doubtful[row], left[column]
        if name in scan.similar:
            scan.component = name
            only = sum(other in left for other in scan.similar) == 1
            scan.reasons += (reason("init.only-one-left") if only else reason("init.any-of-them"),)


def _choose(scan: ScanGuess, named: Sequence[str]) -> None:
    """Choose a scan's component among those ``named`` by its file, else among all, by the differences of extents."""
    several, differences = scan.reasons, scan.differences
    by_shape = sorted(named or differences, key=lambda name: differences[name])
    best = by_shape[0]
    within = reason("init.extents-within", percent=100.0 * differences[best])
    if len(named) == 1:
        scan.component = best
        # A scan with gaps may have other extents than its part, but by chance those of another.
        nearest = min(differences, key=lambda name: differences[name])
        other = differences[nearest] <= SAME_SHAPE < differences[best]
        scan.sure = differences[best] <= OTHER_SHAPE and not several and not other
        scan.reasons = (*several, reason("init.by-name"), within)
        if other or differences[best] > OTHER_SHAPE:
            scan.reasons = (*several, reason("init.name-contradicted", percent=100.0 * differences[best]))
            if differences[nearest] <= LIKE_SHAPE:
                scan.reasons += (reason("init.extents-of-other", component=nearest),)
        return
    same = [name for name in by_shape if differences[name] <= SAME_SHAPE]
    similar = same or [name for name in by_shape if differences[name] <= LIKE_SHAPE]
    scan.component, scan.similar = best if similar else "", tuple(name for name in differences if name in similar)
    scan.sure = len(same) == 1 and not several
    name = reason("init.name-of-several", components=tuple(named)) if named else reason("init.name-of-none")
    shape: tuple[Reason, ...] = (reason("init.by-shape"), within)
    if not similar:
        shape = (reason("init.extents-of-none", component=best, percent=100.0 * differences[best]),)
    elif len(similar) > 1:
        shape = (reason("init.extents-of-several", components=scan.similar),)
    scan.reasons = (*several, name, *shape)


# --- the guess as project.toml and as JSON ----------------------------------------------------------------------------


def to_toml(project: Guess, lang: str = "en") -> str:
    """Return the text of project.toml, with reasons and further keys as comments in a language."""

    def comment(message: Text | Reason) -> str:
        return f"# {_one_line(message, lang)}"

    lines = [comment(text("Made by `processor init`. What is unsure is marked with a question mark."))]
    lines += [f"# ? {_one_line(doubt, lang)}" for doubt in project.doubts] + [""]
    lines.append(f"name = {as_toml(project.name)}")
    lines.append(f"kind = {as_toml(project.kind)}  # {_one_line(project.kind_reasons, lang)}")
    if project.units:
        why = text("of scans whose format gives none: {reasons}", reasons=project.units_reasons)
        lines.append(f"units = {as_toml(project.units)}  {comment(why)}")
    else:
        lines.append(f'# units = "m"  {comment(text("not needed: {reasons}", reasons=project.units_reasons))}')
    if project.design:
        lines.append(f"design = {as_toml(project.design)}  # {_one_line(project.design_reasons, lang)}")
    else:
        of_whole = text("or one mesh, STEP or IFC file of the whole, of kind structure")
        lines.append(f'# design = "design.json"  {comment(of_whole)}')
    if project.design_units:
        of_mesh = text("of the mesh, which has no unit")
        lines.append(f"design_units = {as_toml(project.design_units)}  {comment(of_mesh)}")
    lines.append(f"# temperature_C = 20.0  {comment(text('of the steel while it was scanned'))}")
    if project.stations:
        lines.append(comment(text("{file} gives the scanners' positions", file=project.stations)))
    for scan in project.scans:
        lines += ["", *_scan_lines(scan, lang)]
    gap = project.made.root_gap_mm if project.made else 0.0
    if gap > 0.0:
        lines += ["", "[tolerance]", f"root_gap_mm = {gap!r}  {comment(text('between the ends as modelled'))}"]
    else:
        lines += ["", "# [tolerance]"]
    return "\n".join([*lines, '# standard = "GB 50205-2020"', ""])


def _scan_lines(scan: ScanGuess, lang: str) -> list[str]:
    if scan.error:
        unreadable = text("{file} cannot be read: {error}", file=repr(scan.file), error=scan.error)
        return [f"# {_one_line(unreadable, lang)}", "# [[scan]]", f"# file = {as_toml(scan.file)}"]
    lines = ["[[scan]]", f"file = {as_toml(scan.file)}"]
    why = f"  # {'' if scan.sure else '? '}{_one_line(scan.reasons, lang)}" if scan.reasons else ""
    if scan.component:
        lines.append(f"component = {as_toml(scan.component)}{why}")
    elif why:
        lines.append(why.strip())
    if scan.station:
        lines.append(f"# station = {as_toml(scan.station)}")
    return lines


def _one_line(message: Text | Reason | tuple[Reason, ...], lang: str) -> str:
    written = messages(lang).text(message)
    return "".join(c if c.isprintable() else " " for c in " ".join(written.split()))


def as_json(project: Guess) -> dict[str, Any]:
    """Return the guess as an object for JSON, its texts in English."""
    english = messages("en").text
    scans = [
        {
            "file": scan.file,
            "component": scan.component,
            "station": scan.station,
            "reason": english(scan.reasons),
            "sure": scan.sure,
            "error": scan.error,
        }
        for scan in project.scans
    ]
    made = (project.design, *(name for name, _, _ in project.made.meshes)) if project.made else ()
    return {
        "file": f"{project.folder}/{PROJECT}",
        "name": project.name,
        "kind": project.kind,
        "kind_reason": english(project.kind_reasons),
        "design": project.design,
        "design_reason": english(project.design_reasons),
        "design_units": project.design_units,
        "units": project.units,
        "units_reason": english(project.units_reasons),
        "unsure": [english(doubt) for doubt in project.doubts],
        "scans": scans,
        "made": [f"{project.folder}/{name}" for name in made],
    }


def summary(project: Guess) -> Text:
    """Return what the guessed design holds, in a line."""
    design = project.made.design if project.made else None
    if isinstance(design, ArchDesign):
        names = tuple(part.name for part in design.parts)
        return text(
            "{parts} parts ({names}), {joints} joint(s)",
            parts=len(design.parts),
            names=names,
            joints=len(design.joint_names),
        )
    if isinstance(design, FrameDesign):
        return text("{nodes} node(s), {members} member(s)", nodes=len(design.ids), members=len(design.member_a))
    return text("no design")


def write_design(folder: Path, project: Guess, lang: str = "en") -> None:
    """Write the guessed design.json with its doubts in a language, and the meshes that it names, to a folder."""
    if project.made is None:
        return
    for name, vertices, faces in project.made.meshes:
        (folder / name).parent.mkdir(exist_ok=True)
        with replacing(folder / name) as temporary:
            write_mesh(temporary, vertices, faces)
    doubts = [messages(lang).text(doubt) for doubt in (*project.made.kind_doubts, *project.made.doubts)]
    with replacing(folder / project.design) as temporary:
        write_json(temporary, guess_design.content(project.made, doubts))
