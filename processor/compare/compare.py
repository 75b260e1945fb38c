"""Plain M3C2 between two clouds, in their own unit, for those who have no design."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from processor import readers
from processor.compare import diagnosis
from processor.geometry import m3c2, neighbors, normal_orientation
from processor.geometry.m3c2 import CloudNormals, Distances, Scales, Summary
from processor.geometry.normal_orientation import Turned
from processor.geometry.point_grid import PointGrid
from processor.model import Floats, InputError, UsageError
from processor.readers import RawScan
from processor.scan_folder import normals as scan_folder_normals
from processor.store import store

FAR = 10_000.0  # units; beyond this an origin is taken off before any algebra
ORIGIN_STEP = 1_000.0
CLOUDS = ("reference", "compared", "core")


@dataclass(frozen=True)
class Request:
    """What to compare, and how; lengths in the clouds' unit, 0 = derive it from their density."""

    reference: Path
    compared: Path
    core: Path | None = None
    normals: Path | None = None
    normal_diameter: float = 0.0
    projection_diameter: float = 0.0
    max_depth: float = 0.0
    registration_error: float = 0.0

    def __post_init__(self) -> None:
        for name in ("normal_diameter", "projection_diameter", "max_depth", "registration_error"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise UsageError(f"--{name.replace('_', '-')}: expected a length of 0 or more, got {value!r}")


@dataclass(frozen=True)
class Comparison:
    """Distances at core points (k, 3), coordinates less ``origin`` (3,), with normals (k, 3), and how they came."""

    request: Request
    origin: Floats
    core: Floats
    normals: Floats
    distances: Distances
    scales: Scales
    summary: Summary
    unit: str  # "" = neither the reference nor the compared cloud says
    units: dict[str, str]  # what each file says
    points: dict[str, int]
    hashes: dict[str, str]
    normals_from: str
    turned: Turned | None  # None: the normals were given with their signs


@dataclass(frozen=True)
class _Cloud:
    """The scans of a file; placed by :meth:`less`."""

    path: Path
    scans: list[RawScan]
    sha256: str

    @property
    def unit(self) -> str:
        """Unit that the file says, or nothing."""
        return next((scan.unit for scan in self.scans if scan.unit), "")

    @property
    def count(self) -> int:
        """Points of all scans."""
        return sum(len(scan.points) for scan in self.scans)

    def lowest(self) -> Floats:
        """Least coordinates (3,)."""
        found: Floats = np.min([self._placed(scan, np.zeros(3)).min(axis=0) for scan in self.scans], axis=0)
        return found

    def less(self, origin: Floats) -> Floats:
        """Points (n, 3) of all scans less an origin; offsets are taken from each other before they meet a point."""
        return np.concatenate([self._placed(scan, origin) for scan in self.scans])

    def scanners(self, origin: Floats) -> list[Floats]:
        """Where each scan (3,) was seen from, less an origin; NaN where the file does not say."""
        return [
            self._placed(replace(scan, points=np.zeros((1, 3)), origin=scan.position), origin)[0]
            if scan.position.size
            else np.full(3, np.nan)
            for scan in self.scans
        ]

    @staticmethod
    def _placed(scan: RawScan, origin: Floats) -> Floats:
        if not scan.T_project_scan.size:
            return scan.points + (scan.origin - origin)
        T = scan.T_project_scan
        moved: Floats = scan.points @ T[:3, :3].T + (T[:3, :3] @ scan.origin + (T[:3, 3] - origin))
        return moved


def compare(request: Request, say: Callable[[str], None] = lambda _: None) -> Comparison:
    """Measure from the reference to the compared cloud at every core point, in the core points' order.

    Without a core file every point of the reference is one; without a file of normals they are those of the
    reference's planes, turned upwards; those of upright surfaces by :mod:`processor.geometry.normal_orientation`.
    Raises InputError for a file that cannot be used, and where no core point at all has an answer.
    """
    reference, compared = _read(request.reference), _read(request.compared)
    core_cloud = reference if request.core is None else _read(request.core)
    clouds = [reference, compared] if request.core is None else [reference, compared, core_cloud]
    for one in (reference, compared):
        if one.count < m3c2.FEWEST_FOR_LOD:
            raise InputError(
                f"{one.path}: holds {one.count} point{'s' * (one.count > 1)}; expected a cloud: with fewer than "
                f"{m3c2.FEWEST_FOR_LOD} there is no level of detection"
            )
    unit = _unit(clouds)
    origin = _origin(reference)
    core = np.ascontiguousarray(core_cloud.less(origin))
    first, second = (neighbors.of_spacing(one.less(origin)) for one in (reference, compared))
    used = m3c2.derive_scales(
        first, second, core, request.normal_diameter, request.projection_diameter, request.max_depth
    )
    if why := diagnosis.other_unit(first.cells.points, second.cells.points, used):
        raise InputError(f"{request.reference} and {request.compared}: {why}")
    units = {name: one.unit for name, one in zip(CLOUDS, clouds, strict=False)}
    _say_scales(request, used, unit, units, say)
    turned = None
    if request.normals is not None:
        normals = scan_folder_normals.read(request.normals, core, origin, used.projection_diameter_mm)
        said = f"file {request.normals.name}"
    else:
        fitted = m3c2.normals(_sorted(first, used.normal_diameter_mm), core, used.normal_diameter_mm)
        scanner = _seen_from(reference, core, fitted, used.normal_diameter_mm, origin)
        turned = normal_orientation.turned(fitted, core, used.normal_diameter_mm, scanner)
        normals = turned.normals
        said = "planes of the reference, turned towards +z" + (", upright ones otherwise" if turned.upright else "")
    found = m3c2.distances(
        _sorted(first, used.projection_diameter_mm),
        _sorted(second, used.projection_diameter_mm),
        core,
        normals,
        projection_diameter_mm=used.projection_diameter_mm,
        max_depth_mm=used.max_depth_mm,
        registration_error_mm=request.registration_error,
    )
    total = m3c2.summary(found, core, normals, used.projection_diameter_mm, m3c2.PAPER_POINTS_A_CYLINDER)
    if not np.isfinite(found.distance).any():
        why = diagnosis.no_answer(first.cells.points, second.cells.points, core, total.without_normal, used)
        raise InputError(f"{request.reference} and {request.compared}: no core point has an answer: {why}")
    if turned is not None and (note := turned_note(turned)):
        say(note)
    _say_doubts(total, used, say)
    hashes = {name: one.sha256 for name, one in zip(CLOUDS, clouds, strict=False)}
    if request.normals is not None:
        hashes["normals"] = _sha256(request.normals)
    points = {name: one.count for name, one in zip(CLOUDS, clouds, strict=False)}
    return Comparison(request, origin, core, normals, found, used, total, unit, units, points, hashes, said, turned)


def _seen_from(
    reference: _Cloud, core: Floats, fitted: CloudNormals, normal_diameter: float, origin: Floats
) -> Floats | None:
    """Return where the reference was seen from (k, 3) at the core points whose normals need it, NaN elsewhere.

    None where the file knows no scanner.
    """
    scanners = reference.scanners(origin)
    rows = np.flatnonzero(normal_orientation.undecided(fitted, normal_diameter))
    if not len(rows) or not any(np.isfinite(one).all() for one in scanners):
        return None
    found = np.full(core.shape, np.nan)
    if len(scanners) == 1:
        found[rows] = scanners[0]
        return found
    _, nearest = cKDTree(reference.less(origin)).query(core[rows], workers=-1)
    ends = np.cumsum([len(scan.points) for scan in reference.scans])
    found[rows] = np.array(scanners)[np.searchsorted(ends, nearest, side="right")]
    return found


def _sorted(grid: PointGrid, diameter: float) -> PointGrid:
    """Return a grid of the same points for a diameter, the same one where its cells fit."""
    ratio = diameter / m3c2.CELLS_PER_DIAMETER / grid.cells.size
    return grid if 0.5 <= ratio <= 1.5 else m3c2.grid(grid.cells.points, diameter)


def _read(path: Path) -> _Cloud:
    if path.suffix.lower() == ".h5" and path.is_file():
        scans = store.read_scene(path).scans
        raws = [
            RawScan(s.name, s.points, s.origin, position=s.position, T_project_scan=s.T_project_scan, unit="mm")
            for s in scans
        ]
    else:
        raws = readers.read(path)
    if not sum(len(scan.points) for scan in raws):
        raise InputError(f"{path}: holds no points")
    return _Cloud(path, [scan for scan in raws if len(scan.points)], _sha256(path))


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def _unit(clouds: list[_Cloud]) -> str:
    """Return the unit that the reference or the compared file says, "" where neither does: a core file cannot for them.

    Raises InputError where files say different ones.
    """
    said = {one.unit: one.path for one in clouds if one.unit}
    if len(said) > 1:
        (a, first), (b, second) = list(said.items())[:2]
        raise InputError(
            f"{second}: is in {b}, but {first} is in {a}; expected clouds in one unit: convert one of them"
        )
    return next((one.unit for one in clouds[:2] if one.unit), "")


def _origin(reference: _Cloud) -> Floats:
    """Return whole thousands near to the reference where it is far from zero, however its points are ordered."""
    lowest = reference.lowest()
    far = np.abs(lowest).max() > FAR
    found: Floats = np.floor(lowest / ORIGIN_STEP) * ORIGIN_STEP if far else np.zeros(3)
    return found


def _say_scales(request: Request, used: Scales, unit: str, units: dict[str, str], say: Callable[[str], None]) -> None:
    spacing = max(used.reference_spacing_mm, used.compared_spacing_mm)
    say(
        f"lengths are in the files' unit{f' ({unit})' if unit else ', which they do not say'}; "
        f"spacing {used.reference_spacing_mm:.4g} (reference), {used.compared_spacing_mm:.4g} (compared)"
    )
    if note := unit_note(units, {"reference": request.reference, "compared": request.compared, "core": request.core}):
        say(note)
    held = np.pi / 4.0 * (used.projection_diameter_mm / spacing) ** 2
    if request.normals is not None:
        unused = "; --normal-diameter is not used" if request.normal_diameter else ""
        say(f"normals of file {request.normals.name}{unused}")
    else:
        say(f"normal diameter {used.normal_diameter_mm:.6g}, {_how(request.normal_diameter, 'spacing and roughness')}")
    say(f"projection diameter {used.projection_diameter_mm:.6g}, {_how(request.projection_diameter, 'the spacing')}")
    say(f"max depth to either side {used.max_depth_mm:.6g}, {_how(request.max_depth, 'how far apart the clouds are')}")
    say(f"a cylinder holds about {held:.3g} points of the sparser cloud")


def turned_note(turned: Turned) -> str:
    """Say how upright normals got their signs; nothing where +z decided all."""
    if not turned.upright:
        return ""
    said = [
        f"{turned.upright} of {turned.up + turned.upright} normals are of upright surfaces, whose side +z does not tell"
    ]
    if turned.scanner:
        said.append(f"{turned.scanner} look towards the scanner")
    if turned.neighbours:
        said.append(f"{turned.neighbours} look the way of the surface that theirs joins")
    if turned.convention:
        said.append(
            f"{turned.convention}, of {turned.surfaces} connected surfaces, by convention:"
            f" {normal_orientation.CONVENTION}"
        )
    return "; ".join(said)


def unit_note(units: Mapping[str, str], files: Mapping[str, Any]) -> str:
    """Say which of the files says the unit where not all do; nothing where all or none do."""
    saying = [name for name, one in units.items() if one]
    silent = [name for name, one in units.items() if not one]
    if not (saying and silent):
        return ""
    return (
        f"the unit {units[saying[0]]} is said by {', '.join(str(files[name]) for name in saying)} alone; not by "
        f"{', '.join(str(files[name]) for name in silent)}, whose coordinates must be in it too"
    )


def _how(given: float, made_of: str) -> str:
    return "given" if given else f"made of {made_of}"


def _say_doubts(total: Summary, used: Scales, say: Callable[[str], None]) -> None:
    if total.without_lod:
        say(
            f"{total.without_lod} of {total.core_points} core points have no level of detection: fewer than "
            f"{m3c2.FEWEST_FOR_LOD} points of a cloud within {used.max_depth_mm:.6g} of them, or no normal; "
            "a larger --max-depth or --projection-diameter may help"
        )
    if total.few_points > 0.1 * max(total.core_points - total.without_lod, 1):
        say(
            f"{total.few_points} core points have fewer than {m3c2.PAPER_POINTS_A_CYLINDER} points of a cloud in "
            "their cylinder: their levels of detection are too small (a larger --projection-diameter helps)"
        )
