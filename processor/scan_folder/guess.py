"""What a scan folder's project.toml should say, guessed from its files; what was not sure is said."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from processor import readers
from processor.geometry import principal
from processor.model import ArchDesign, Floats, FrameDesign, InputError, Ints
from processor.readers import RawScan
from processor.scan_folder import cad, component_names
from processor.scan_folder.checked_toml import inside
from processor.scan_folder.design import read_design, read_json, read_surface
from processor.scan_folder.meshes import MESH_SUFFIXES
from processor.scan_folder.units import MM_PER_UNIT, known_unit

PROJECT, STATIONS, SCANS, DESIGN = "project.toml", "stations.json", "scans", "design"
DESIGNS = ("design.json", "design.csv")
SURFACES = (*MESH_SUFFIXES, *cad.SUFFIXES)
NOT_SCANS = ("design.csv", "picks.csv", "deviation.csv", "index.csv")
TRIED = ("m", "mm", "cm", "inch", "ft")  # units, the likeliest first
UNIT_TOLERANCE = 0.25  # of a scan's size against its design's
LARGEST_M = 2000.0  # of a scan; what is larger is no scan in metres
SAME_SHAPE, OTHER_SHAPE = 0.05, 0.15  # greatest difference of extents by the longest: taken for, not taken for
FEW = 20_000  # points that a shape is measured from


@dataclass
class ScanGuess:
    """One file of scans: its component and station ("" = none), and why; ``sure`` where nothing speaks against it."""

    file: str
    component: str = ""
    station: str = ""
    reason: str = ""
    sure: bool = True
    error: str = ""  # why it could not be read
    units: str = ""  # that its format says
    stem: str = ""
    near: tuple[str, ...] = ()  # components that it may be by its shape
    extents: Floats = field(default_factory=lambda: np.zeros(3))  # in the file's unit, longest first
    radius: float = 0.0  # from the middle


@dataclass
class Guess:
    """What project.toml should say, each with its reason, and what was not sure."""

    folder: str
    name: str
    kind: str = ""
    kind_reason: str = ""
    design: str = ""
    design_reason: str = ""
    design_units: str = ""
    units: str = ""
    units_reason: str = ""
    stations: str = ""
    scans: list[ScanGuess] = field(default_factory=list)
    unsure: list[str] = field(default_factory=list)


def guess(folder: Path) -> Guess:
    """Look at a folder's files and guess. Raises InputError where there are no scans, or no such folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a scan folder, found {'a file' if folder.exists() else 'nothing'}")
    found = Guess(str(folder), folder.resolve().name)
    path = _find_design(folder, found)
    design = _read_design(folder, path, found)
    files = _scan_files(folder, path)
    if not files:
        raise InputError(
            f"{folder}: expected scans ({', '.join(readers.SUFFIXES)}) in the folder or in {SCANS}/, found none"
        )
    found.scans = [_read_scan(folder, one, found) for one in files]
    nominal = _sizes(design)
    _guess_units(found, nominal)
    if isinstance(design, ArchDesign):
        _guess_components(found, design)
    elif not design:
        _guess_kind(found)
    if (folder / STATIONS).is_file():
        found.stations = f"{STATIONS} gives the scanners' positions"
    return found


# --- design -----------------------------------------------------------------------------------------------------------


def _find_design(folder: Path, found: Guess) -> Path | None:
    for name in DESIGNS:
        if (folder / name).is_file():
            found.design, found.design_reason = name, "found by its name"
            return folder / name
    surfaces = [
        one
        for place in (folder, folder / DESIGN)
        for one in (sorted(place.iterdir()) if place.is_dir() else [])
        if one.suffix.lower() in SURFACES and one.is_file() and _is_surface(one)
    ]
    tables = [one for one in sorted(folder.glob("*.json")) if one.name != STATIONS and _says_kind(one)]
    chosen = tables or surfaces
    if len(chosen) > 1:
        named = ", ".join(str(one.relative_to(folder)) for one in chosen[:5])
        found.unsure.append(
            f"design: {len(chosen)} files may be it ({named}): name one, of kind structure, or make a design.json"
        )
        return None
    if chosen:
        found.design = str(chosen[0].relative_to(folder))
        found.design_reason = "the only file that may be one"
        return chosen[0]
    found.unsure.append("design: none is there, so nothing is held against one")
    return None


def _is_surface(path: Path) -> bool:
    """Whether a mesh has faces: a PLY or OBJ file may be a scan as well."""
    if path.suffix.lower() != ".ply":
        return True
    with path.open("rb") as file:
        head = file.read(1 << 14).split(b"end_header")[0]
    return any(line.startswith(b"element face") and not line.endswith(b" 0") for line in head.splitlines())


def _says_kind(path: Path) -> bool:
    try:
        return isinstance(read_json(path).values.get("kind"), str)
    except InputError:
        return False


def _read_design(
    folder: Path, path: Path | None, found: Guess
) -> ArchDesign | FrameDesign | tuple[Floats, Ints] | None:
    """Read the design; where it cannot be read that is said, and the guess goes on without."""
    if path is None:
        return None
    try:
        inside(folder, str(path.relative_to(folder)), str(folder))
        if path.suffix.lower() in SURFACES:
            found.kind, found.kind_reason = "structure", f"{found.design} is one surface of the whole"
            return read_surface(path, "mm")
        design = read_design(folder, path, "m")
    except InputError as error:
        found.unsure.append(f"design: {error}")
        return None
    found.kind = "arch-bridge" if isinstance(design, ArchDesign) else "space-frame"
    found.kind_reason = f"{found.design} is one"
    return design


def _sizes(design: ArchDesign | FrameDesign | tuple[Floats, Ints] | None) -> list[float]:
    """Half the greatest extents in mm that a scan of the design may have: of the parts, or of the whole."""
    if isinstance(design, ArchDesign):
        return [_radius(part.vertices) for part in design.parts]
    if isinstance(design, FrameDesign):
        return [_radius(design.centres)]
    return [_radius(design[0])] if design else []


def _radius(points: Floats) -> float:
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    return float(np.linalg.norm(points - middle, axis=1).max())


# --- scans ------------------------------------------------------------------------------------------------------------


def _scan_files(folder: Path, design: Path | None) -> list[Path]:
    files = []
    for place in (folder, folder / SCANS):
        for one in sorted(place.iterdir()) if place.is_dir() else []:
            scan = one.suffix.lower() in readers.SUFFIXES and one.name not in NOT_SCANS and one != design
            if not one.name.startswith(".") and ((scan and one.is_file()) or readers.is_closed(one)):
                files.append(one)
    return files


def _read_scan(folder: Path, path: Path, found: Guess) -> ScanGuess:
    one = ScanGuess(str(path.relative_to(folder)), stem=path.stem)
    try:
        inside(folder, one.file, str(folder))
        raws = readers.read(path)
    except InputError as error:
        one.error = str(error).replace(f"{folder}/", "")
        found.unsure.append(f"{one.file}: cannot be read, so it stands as a comment: {one.error}")
        return one
    one.units = known_unit(raws[0].unit) if raws[0].unit else ""
    points = _thinned(raws)
    local = points - points.mean(axis=0)
    along = local @ principal.of_points(local).axes
    one.extents = np.sort(np.ptp(np.quantile(along, [0.001, 0.999], axis=0), axis=0))[::-1]
    one.radius = _radius(local)
    if len(raws) > 1:
        one.reason = f"holds {len(raws)} scans: {', '.join(raw.name for raw in raws[:6])}"
    return one


def _thinned(raws: Sequence[RawScan]) -> Floats:
    """Take some of a file's points, in the frame of its poses where it has them, less the first origin."""
    share = max(1, sum(len(raw.points) for raw in raws) // FEW)
    pieces = []
    for raw in raws:
        points = raw.points[::share] + (raw.origin - raws[0].origin)
        if raw.T_project_scan.size and len(raws) > 1:
            T = raw.T_project_scan
            points = (points + raws[0].origin) @ T[:3, :3].T + T[:3, 3]
        pieces.append(points)
    return np.concatenate(pieces)


# --- guesses ----------------------------------------------------------------------------------------------------------


def _guess_units(found: Guess, nominal: Sequence[float]) -> None:
    """Take the unit of the formats; else that in which the scans are as large as the design; else metres."""
    silent = [one for one in found.scans if not one.units and not one.error]
    if found.design and found.kind == "structure" and Path(found.design).suffix.lower() in MESH_SUFFIXES:
        found.design_units = "mm"
        found.unsure.append(f"design_units: {found.design} does not say its unit; taken as mm, as CAD writes meshes")
    if not silent:
        said = sorted({one.units for one in found.scans if one.units})
        found.units_reason = f"said by the scans themselves: {', '.join(said)}" if said else ""
        return
    radius = float(np.median([one.radius for one in silent]))
    if nominal:
        sizes = np.array(nominal)
        fits = {
            unit: float(
                np.abs(np.log(np.array([[one.radius * MM_PER_UNIT[unit]] for one in silent]) / sizes)).min(axis=1).max()
            )
            for unit in TRIED
        }
        best = min(TRIED, key=fits.__getitem__)
        found.units = best
        if fits[best] <= np.log1p(UNIT_TOLERANCE):
            found.units_reason = "in it the scans are as large as the design"
            return
        found.units_reason = f"the nearest to the design's size, and off by a factor of {np.exp(fits[best]):.3g}"
    else:
        found.units = "m" if 2.0 * radius <= LARGEST_M else "mm"
        found.units_reason = f"a scan is {2.0 * radius:.4g} of them across"
    found.unsure.append(f"units: taken as {found.units}: {found.units_reason}")


def _guess_kind(found: Guess) -> None:
    found.kind, found.kind_reason = "structure", "without a design it is the one that asks for none"
    for one in found.scans:
        one.station = component_names.station(one.stem)
    found.unsure.append(
        "kind: taken as structure; a roof of bolt balls is a space-frame, a bridge in parts needs a design.json"
    )


def _guess_components(found: Guess, design: ArchDesign) -> None:
    """Find each scan's component by its name and by its shape; where the two differ, or leave a choice, say so."""
    names = [part.name for part in design.parts]
    shapes = {part.name: _extents(part.vertices, part.faces) for part in design.parts}
    scale = MM_PER_UNIT[found.units or "m"]
    for one in found.scans:
        if one.error:
            continue
        own = one.extents * (MM_PER_UNIT[one.units] if one.units else scale)
        differs = {name: float(np.abs(own - shape).max() / shape[0]) for name, shape in shapes.items()}
        one.station = component_names.station(one.stem)
        _choose(one, component_names.meant(one.stem, names), differs)
    taken = {one.component for one in found.scans if one.sure}
    for one in found.scans:
        left = [name for name in one.near if name not in taken]
        if left and not one.sure and len(one.near) > 1:
            one.component = left[0]
            one.reason += f"; {'of these it alone is left' if len(left) == 1 else 'taken in the order of the bridge'}"
            taken.add(left[0])
    for one in found.scans:
        if not one.sure and not one.error:
            found.unsure.append(f"{one.file}: {one.component or 'no component'}: {one.reason}")
    missing = [name for name in names if name not in {one.component for one in found.scans}]
    if missing:
        found.unsure.append(f"no scan is taken for {', '.join(missing)}")
    for name in names:
        several = [one.file for one in found.scans if one.component == name]
        if len(several) > 1:
            found.unsure.append(f"{name}: {len(several)} scans are taken for it ({', '.join(several)})")


def _choose(one: ScanGuess, named: Sequence[str], differs: dict[str, float]) -> None:
    several = f"{one.reason}; " if one.reason else ""
    by_shape = sorted(named or differs, key=lambda name: differs[name])
    best = by_shape[0]
    near = [name for name in by_shape if differs[name] <= SAME_SHAPE]
    shape = f"extents within {100.0 * differs[best]:.2g} % of the design's"
    if len(named) == 1:
        one.component = best
        one.sure = differs[best] <= OTHER_SHAPE and not several
        one.reason = f"{several}by its name; {shape}"
        if differs[best] > OTHER_SHAPE:
            nearest = min(differs, key=lambda name: differs[name])
            one.reason = f"{several}by its name, but its extents are {100.0 * differs[best]:.0f} % off" + (
                f"; it has the shape of {nearest}" if differs[nearest] <= SAME_SHAPE else ""
            )
        return
    one.component, one.near = best if near else "", tuple(name for name in differs if name in near)
    one.sure = len(near) == 1 and not several
    which = f"of {', '.join(named)}, which its name may mean, " if named else "its name says nothing; "
    if not near:
        one.reason = f"{several}{which}none has its shape (the nearest, {best}, is {100.0 * differs[best]:.0f} % off)"
    elif len(near) > 1:
        one.reason = f"{several}{which}{', '.join(one.near)} have its shape"
    else:
        one.reason = f"{several}{which}by its shape alone; {shape}"


def _extents(vertices: Floats, faces: Ints) -> Floats:
    """Extents (3,) of a mesh along its principal axes, longest first."""
    along = (vertices - vertices.mean(axis=0)) @ principal.of_mesh(vertices, faces).axes
    found: Floats = np.sort(np.ptp(along, axis=0))[::-1]
    return found


# --- A guess of what a scan folder's project.toml should say, as that file and as JSON.


def written(found: Guess) -> str:
    """Return project.toml, with comments that say why, and what may be added."""
    lines = ["# Made by `processor init`. What is unsure is marked with a question mark."]
    lines += [f"# ? {_one_line(text)}" for text in found.unsure] + [""]
    lines.append(f"name = {_text(found.name)}")
    lines.append(f"kind = {_text(found.kind)}  # {_one_line(found.kind_reason)}")
    if found.units:
        lines.append(
            f"units = {_text(found.units)}  # of scans whose format says none: {_one_line(found.units_reason)}"
        )
    else:
        lines.append(f'# units = "m"  # not needed: {_one_line(found.units_reason)}')
    if found.design:
        lines.append(f"design = {_text(found.design)}  # {_one_line(found.design_reason)}")
    else:
        lines.append('# design = "design.json"  # or one mesh, STEP or IFC file of the whole, of kind structure')
    if found.design_units:
        lines.append(f"design_units = {_text(found.design_units)}  # of the mesh, which does not say")
    lines.append("# temperature_C = 20.0  # of the steel while it was scanned")
    if found.stations:
        lines.append(f"# {_one_line(found.stations)}")
    for one in found.scans:
        lines += ["", *_scan_lines(one)]
    lines += ["", "# [tolerance]", '# standard = "GB 50205-2020"', ""]
    return "\n".join(lines)


def _scan_lines(one: ScanGuess) -> list[str]:
    if one.error:
        return [f"# {one.file!a} cannot be read: {_one_line(one.error)}", "# [[scan]]", f"# file = {_text(one.file)}"]
    lines = ["[[scan]]", f"file = {_text(one.file)}"]
    reason = f"  # {'' if one.sure else '? '}{_one_line(one.reason)}" if one.reason else ""
    if one.component:
        lines.append(f"component = {_text(one.component)}{reason}")
    elif reason:
        lines.append(reason.strip())
    if one.station:
        lines.append(f"# station = {_text(one.station)}")
    return lines


def _text(text: str) -> str:
    """Return a text as TOML has it between quotes."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _one_line(text: str) -> str:
    return "".join(one if one.isprintable() else " " for one in " ".join(text.split()))


def as_json(found: Guess) -> dict[str, Any]:
    """Return the guess as JSON can hold it."""
    keys = ("kind", "kind_reason", "design", "design_reason", "design_units", "units", "units_reason", "unsure")
    scan_keys = ("file", "component", "station", "reason", "sure", "error")
    scans = [{key: getattr(one, key) for key in scan_keys} for one in found.scans]
    return {"file": f"{found.folder}/{PROJECT}", "name": found.name} | {
        **{key: getattr(found, key) for key in keys},
        "scans": scans,
    }
