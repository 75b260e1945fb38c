"""M3C2 between two clouds in their own unit, without a design."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from processor import readers
from processor.compare import diagnosis
from processor.deviation import scales, statistics
from processor.deviation.scales import Scales
from processor.deviation.statistics import Summary
from processor.geometry import m3c2, normal_orientation, point_neighbors
from processor.geometry.m3c2 import CloudNormals, Distances
from processor.geometry.normal_orientation import Turned
from processor.geometry.point_grid import PointGrid
from processor.language.messages import messages
from processor.model import Floats, InputError, Reason, UsageError, reason
from processor.readers import RawScan
from processor.scan_folder import normals as scan_folder_normals
from processor.store import store

FAR = 10_000.0  # units; of coordinates beyond this an origin is subtracted before any algebra
ORIGIN_STEP = 1_000.0
CLOUDS = ("reference", "compared", "core")


@dataclass(frozen=True)
class Request:
    """Files to compare and the lengths of M3C2 in the clouds' unit; 0 = derived from the clouds' density."""

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
    """Distances at core points (k, 3) with normals (k, 3); coordinates relative to ``origin`` (3,), the input's unit."""

    request: Request
    origin: Floats
    core: Floats
    normals: Floats
    distances: Distances
    scales: Scales
    summary: Summary
    unit: str  # "" = stated neither by the reference nor by the compared cloud
    units: dict[str, str]  # unit that each file states
    points: dict[str, int]
    hashes: dict[str, str]
    normals_from: Reason
    turned: Turned | None  # None: the normals were given with their signs

    @property
    def unit_note(self) -> Reason | None:
        """Which of the files state the unit where not all do; None where all or none do."""
        stating = [name for name, unit in self.units.items() if unit]
        silent = [name for name, unit in self.units.items() if not unit]
        if not (stating and silent):
            return None
        return reason(
            "compare.unit-of-some-files",
            unit=self.units[stating[0]],
            stating=tuple(getattr(self.request, name).name for name in stating),
            silent=tuple(getattr(self.request, name).name for name in silent),
        )

    @property
    def normals_notes(self) -> tuple[Reason, ...]:
        """How the normals of upright surfaces got their signs; nothing where +z decided all."""
        turned = self.turned
        if turned is None or not turned.upright:
            return ()
        notes = [reason("compare.upright", count=turned.upright, total=turned.up + turned.upright)]
        if turned.scanner:
            notes.append(reason("compare.towards-scanner", count=turned.scanner))
        if turned.neighbours:
            notes.append(reason("compare.as-neighbours", count=turned.neighbours))
        if turned.convention:
            notes.append(reason("compare.by-convention", count=turned.convention, surfaces=turned.surfaces))
        return tuple(notes)

    @property
    def notes(self) -> tuple[Reason, ...]:
        """Notes on units, then on normals."""
        unit_note = self.unit_note
        return self.normals_notes if unit_note is None else (unit_note, *self.normals_notes)


@dataclass(frozen=True)
class _Cloud:
    """The scans of a file; placed by :meth:`less`."""

    path: Path
    scans: list[RawScan]
    sha256: str

    @property
    def unit(self) -> str:
        """Unit that the file states, or nothing."""
        return next((scan.unit for scan in self.scans if scan.unit), "")

    @property
    def count(self) -> int:
        """Points of all scans."""
        return sum(len(scan.points) for scan in self.scans)

    def lowest(self) -> Floats:
        """Least coordinates (3,)."""
        least: Floats = np.min([self._placed(scan, np.zeros(3)).min(axis=0) for scan in self.scans], axis=0)
        return least

    def less(self, origin: Floats) -> Floats:
        """Points (n, 3) of all scans less an origin; offsets are subtracted from each other before they meet a point."""
        return np.concatenate([self._placed(scan, origin) for scan in self.scans])

    def scanners(self, origin: Floats) -> list[Floats]:
        """Scanner positions (3,) of the scans, less an origin; NaN where the file has none."""
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
        points: Floats = scan.points @ T[:3, :3].T + (T[:3, :3] @ scan.origin + (T[:3, 3] - origin))
        return points


def compare(request: Request, say: Callable[[str], None] = lambda _: None) -> Comparison:
    """Measure from the reference to the compared cloud at every core point, in the core points' order.

    Without a core file the points of the reference are the core points. Without a file of normals these are of planes
    fitted to the reference, turned upwards; those of upright surfaces by :mod:`processor.geometry.normal_orientation`.
    Raises InputError for a file that cannot be used, and where no core point has a result. ``say`` is called with the
    lengths used, and with warnings.
    """
    clouds = _clouds(request)
    reference, core_cloud = clouds["reference"], clouds.get("core", clouds["reference"])
    unit, units = _unit(list(clouds.values())), {name: cloud.unit for name, cloud in clouds.items()}
    origin = _origin(reference)
    core = np.ascontiguousarray(core_cloud.less(origin))
    first, second = (point_neighbors.of_spacing(clouds[name].less(origin)) for name in ("reference", "compared"))
    used = scales.derived(first, second, core, request.normal_diameter, request.projection_diameter, request.max_depth)
    both = f"{request.reference} and {request.compared}"
    if why := diagnosis.other_unit(first.cells.points, second.cells.points, used):
        raise InputError(f"{both}: {why}")
    _report_scales(request, used, unit, say)
    normals, normals_from, turned = _normals(request, reference, first, core, origin, used)
    distances = m3c2.distances(
        _sorted(first, used.projection_diameter_mm),
        _sorted(second, used.projection_diameter_mm),
        core,
        normals,
        projection_diameter_mm=used.projection_diameter_mm,
        max_depth_mm=used.max_depth_mm,
        registration_error_mm=request.registration_error,
    )
    total = statistics.of_distances(
        distances, core, normals, used.projection_diameter_mm, scales.PAPER_POINTS_A_CYLINDER
    )
    if not np.isfinite(distances.distance).any():
        why = diagnosis.no_answer(first.cells.points, second.cells.points, core, total.without_normal, used)
        raise InputError(f"{both}: no core point has a distance: {why}")
    hashes = {name: cloud.sha256 for name, cloud in clouds.items()}
    if request.normals is not None:
        hashes["normals"] = _sha256(request.normals)
    result = Comparison(
        request=request,
        origin=origin,
        core=core,
        normals=normals,
        distances=distances,
        scales=used,
        summary=total,
        unit=unit,
        units=units,
        points={name: cloud.count for name, cloud in clouds.items()},
        hashes=hashes,
        normals_from=normals_from,
        turned=turned,
    )
    _report_warnings(result, say)
    return result


def _clouds(request: Request) -> dict[str, _Cloud]:
    """Read the clouds by the names of CLOUDS. Raises InputError for one too small for a level of detection."""
    files = {name: getattr(request, name) for name in CLOUDS}
    clouds = {name: _read(path) for name, path in files.items() if path is not None}
    for cloud in (clouds["reference"], clouds["compared"]):
        if cloud.count < m3c2.FEWEST_FOR_LOD:
            raise InputError(
                f"{cloud.path}: holds {cloud.count} point{'s' * (cloud.count > 1)}; expected at least "
                f"{m3c2.FEWEST_FOR_LOD}, which a level of detection needs"
            )
    return clouds


def _normals(
    request: Request, reference: _Cloud, grid: PointGrid, core: Floats, origin: Floats, used: Scales
) -> tuple[Floats, Reason, Turned | None]:
    """Read or fit the normals (k, 3) of the core points; also their source, and how the fitted ones were turned."""
    if request.normals is not None:
        given = scan_folder_normals.read(request.normals, core, origin, used.projection_diameter_mm)
        return given, reason("compare.normals-of-file", file=request.normals.name), None
    diameter = used.normal_diameter_mm
    fitted = m3c2.normals(_sorted(grid, diameter), core, diameter)
    scanner = _seen_from(reference, core, fitted, diameter, origin)
    turned = normal_orientation.turned(fitted, core, diameter, scanner)
    source = reason("compare.normals-of-planes-upright") if turned.upright else reason("compare.normals-of-planes")
    return turned.normals, source, turned


def _seen_from(
    reference: _Cloud, core: Floats, fitted: CloudNormals, normal_diameter: float, origin: Floats
) -> Floats | None:
    """Return the scanner positions (k, 3) for the core points whose normals need them, NaN elsewhere.

    None where the file has no scanner position.
    """
    scanners = reference.scanners(origin)
    rows = np.flatnonzero(normal_orientation.undecided(fitted, normal_diameter))
    if not len(rows) or not any(np.isfinite(position).all() for position in scanners):
        return None
    positions = np.full(core.shape, np.nan)
    if len(scanners) == 1:
        positions[rows] = scanners[0]
        return positions
    _, nearest = cKDTree(reference.less(origin)).query(core[rows], workers=-1)
    ends = np.cumsum([len(scan.points) for scan in reference.scans])
    positions[rows] = np.array(scanners)[np.searchsorted(ends, nearest, side="right")]
    return positions


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
    """Return the unit that the reference or the compared file states, "" where neither does; the core file has no part.

    Raises InputError where files state different units.
    """
    stated = {cloud.unit: cloud.path for cloud in clouds if cloud.unit}
    if len(stated) > 1:
        (a, first), (b, second) = list(stated.items())[:2]
        raise InputError(
            f"{second}: is in {b}, but {first} is in {a}; expected clouds in one unit: convert one of them"
        )
    return next((cloud.unit for cloud in clouds[:2] if cloud.unit), "")


def _origin(reference: _Cloud) -> Floats:
    """Return whole thousands near the reference where it is far from zero, in whatever order its points are."""
    lowest = reference.lowest()
    far = np.abs(lowest).max() > FAR
    origin: Floats = np.floor(lowest / ORIGIN_STEP) * ORIGIN_STEP if far else np.zeros(3)
    return origin


def _report_scales(request: Request, used: Scales, unit: str, say: Callable[[str], None]) -> None:
    """Report the lengths used and their source."""
    spacing = max(used.reference_spacing_mm, used.compared_spacing_mm)
    say(
        f"lengths are in the files' unit{f' ({unit})' if unit else ', which they do not state'}; "
        f"spacing {used.reference_spacing_mm:.4g} (reference), {used.compared_spacing_mm:.4g} (compared)"
    )
    if request.normals is not None:
        unused = "; --normal-diameter is not used" if request.normal_diameter else ""
        say(f"normals of file {request.normals.name}{unused}")
    else:
        source = _source(request.normal_diameter, "spacing and roughness")
        say(f"normal diameter {used.normal_diameter_mm:.6g}, {source}")
    say(f"projection diameter {used.projection_diameter_mm:.6g}, {_source(request.projection_diameter, 'the spacing')}")
    distances = _source(request.max_depth, "the distances between the clouds")
    say(f"max depth to either side {used.max_depth_mm:.6g}, {distances}")
    points = np.pi / 4.0 * (used.projection_diameter_mm / spacing) ** 2
    say(f"a cylinder contains about {points:.3g} points of the sparser cloud")


def _source(given: float, derived_from: str) -> str:
    return "given" if given else f"derived from {derived_from}"


def _report_warnings(result: Comparison, say: Callable[[str], None]) -> None:
    """Report how units and signs of normals were decided, and core points without a reliable level of detection."""
    for note in result.notes:
        say(messages("en").text(note))
    total, used = result.summary, result.scales
    if total.without_lod:
        say(
            f"{total.without_lod} of {total.core_points} core points have no level of detection: fewer than "
            f"{m3c2.FEWEST_FOR_LOD} points of a cloud within {used.max_depth_mm:.6g} of them, or no normal; "
            "a larger --max-depth or --projection-diameter may help"
        )
    if total.few_points > 0.1 * max(total.core_points - total.without_lod, 1):
        say(
            f"{total.few_points} core points have fewer than {scales.PAPER_POINTS_A_CYLINDER} points of a cloud in "
            "their cylinder: their levels of detection are too small (a larger --projection-diameter helps)"
        )
