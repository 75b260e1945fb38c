"""M3C2 between two clouds, in their own unit, without a design.

Within :func:`processor.large_arrays.in_files` large clouds and results lie in files: no step holds all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from processor import large_arrays, readers, scene_cloud
from processor.adjustment import distance_summary
from processor.adjustment.distance_summary import Summary
from processor.compare import core_tiles, diagnosis, units
from processor.compare import normals_file as scan_folder_normals
from processor.compare.core_tiles import Lengths
from processor.geometry import coincident_points, m3c2, nearest_neighbours, normal_orientation
from processor.geometry.m3c2 import CloudNormals, Distances, Scales
from processor.geometry.normal_orientation import Turned
from processor.geometry.point_grid import PointGrid
from processor.language.messages import messages
from processor.large_arrays import allocate, blocks, put_back
from processor.model import Floats, InputError, Reason, Scan, UsageError, reason
from processor.readers import RawScan
from processor.readers.raw_scan import FAR, ORIGIN_STEP, summed
from processor.scan_folder.units import MM_PER_UNIT, FileUnit
from processor.store import checksums, store

CLOUDS = ("reference", "compared", "core")


@dataclass(frozen=True)
class Request:
    """Files and parameters of a comparison; lengths in the unit of the clouds, 0 = derived from their density."""

    reference: Path
    compared: Path
    core: Path | None = None
    normals: Path | None = None
    normal_diameter: float = 0.0
    projection_diameter: float = 0.0
    max_depth: float = 0.0
    registration_error: float = 0.0
    units: str = ""  # of the files, see units.of_files; "" = as they give them

    def __post_init__(self) -> None:
        for name in ("normal_diameter", "projection_diameter", "max_depth", "registration_error"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise UsageError(f"--{name.replace('_', '-')}: expected a length of 0 or more, found {value!r}")


@dataclass(frozen=True)
class Comparison:
    """Distances and normals (k, 3) at core points, and how they were computed."""

    request: Request
    origin: Floats  # (3,)
    core: Floats  # (k, 3), relative to ``origin``
    normals: Floats
    distances: Distances
    scales: Scales
    summary: Summary
    unit: str  # "" = given by neither the reference nor the compared cloud
    units: dict[str, str]  # of each file, "" = not given
    points: dict[str, int]
    hashes: dict[str, str]
    normals_from: Reason
    turned: Turned | None  # None: the normals were given with their signs
    read: tuple[Reason, ...] = ()  # how the files were read, and which points of them coincide

    @property
    def notes(self) -> tuple[Reason, ...]:
        """Notes on the files, on the unit, then on the normals."""
        unit = () if self.unit_note is None else (self.unit_note,)
        return (*self.read, *unit, *self.normals_notes)

    @property
    def unit_note(self) -> Reason | None:
        """Which files give the unit, if some do and some do not."""
        files = {name: getattr(self.request, name).name for name in self.units}
        with_unit = tuple(name for name, unit in self.units.items() if unit)
        without = tuple(files[name] for name, unit in self.units.items() if not unit)
        if not (with_unit and without):
            return None
        given_by = tuple(files[name] for name in with_unit)
        return reason("compare.unit", unit=self.units[with_unit[0]], given_by=given_by, without=without)

    @property
    def normals_notes(self) -> tuple[Reason, ...]:
        """How normals of upright surfaces were oriented; nothing where +z decided all signs."""
        turned = self.turned
        if turned is None or not turned.upright:
            return ()
        notes = [reason("compare.upright", count=turned.upright, total=turned.up + turned.upright)]
        if turned.scanner:
            notes.append(reason("compare.towards-scanner", count=turned.scanner))
        if turned.neighbours:
            notes.append(reason("compare.as-adjacent", count=turned.neighbours))
        if turned.convention:
            notes.append(reason("compare.by-convention", count=turned.convention, surfaces=turned.surfaces))
        return tuple(notes)


@dataclass(frozen=True)
class _Cloud:
    """The scans of a file."""

    path: Path
    scans: list[RawScan]
    sha256: str
    stated: str = ""  # unit that the command line gives the file
    scale: Floats = field(default_factory=lambda: np.ones(3))  # to the unit of the comparison, along x, y, z
    left_out: int = 0  # points that coincide with others

    @property
    def unit(self) -> str:
        """Unit that the command line or else the file gives, "" for none."""
        return self.stated or next((scan.unit for scan in self.scans if scan.unit), "")

    @property
    def count(self) -> int:
        """Number of points of all scans."""
        return sum(len(scan.points) for scan in self.scans)

    def lowest(self) -> Floats:
        """Return the least coordinates (3,)."""
        corner: Floats = np.min([part.min(axis=0) for part in self._placed(np.zeros(3))], axis=0)
        return corner

    def relative_to(self, origin: Floats) -> Floats:
        """Return the points (n, 3) of all scans minus an origin; offsets are subtracted first, for precision."""
        points, count = allocate(self.count, 3), 0
        for part in self._placed(origin):
            points[count : count + len(part)] = part
            count += len(part)
        return points

    def scanners(self, origin: Floats) -> list[Floats]:
        """Return the scanner's position (3,) of each scan minus an origin; NaN where the file has none."""
        return [
            self._at(replace(scan, origin=scan.position), np.zeros((1, 3)), origin)[0]
            if scan.position.size
            else np.full(3, np.nan)
            for scan in self.scans
        ]

    def otherwise(self, given: FileUnit) -> Reason | None:
        """Return what the file states of its unit, None where that is the unit ``given`` or nothing."""
        stated = next((scan.unit for scan in self.scans if scan.unit), "")
        if stated and stated != str(given):
            return reason("units.file-states", unit=stated)
        return self.fault

    @property
    def fault(self) -> Reason | None:
        """Why the unit that the file states cannot be used."""
        return next((scan.unit_fault for scan in self.scans if scan.unit_fault), None)

    def _placed(self, origin: Floats) -> Iterator[Floats]:
        for scan in self.scans:
            for rows in blocks(len(scan.points), large_arrays.AT_ONCE):
                yield self._at(scan, scan.points[rows], origin)

    def _at(self, scan: RawScan, points: Floats, origin: Floats) -> Floats:
        offset, scale = scan.origin, self.scale
        if scan.T_project_scan.size:
            T = scan.T_project_scan
            points, offset = points @ T[:3, :3].T, T[:3, :3] @ offset + T[:3, 3]
        placed: Floats = (
            points + (offset - origin) if (scale == 1.0).all() else points * scale + (offset * scale - origin)
        )
        return placed


def compare(request: Request, log: Callable[[str], None] = lambda _: None) -> Comparison:
    """Compute M3C2 distances from the reference to the compared cloud at every core point, in their order.

    Without a core file every point of the reference is a core point. Without a file of normals, planes are fitted to
    the reference and their normals point upwards; normals of upright surfaces are oriented by
    :mod:`processor.geometry.normal_orientation`. ``log`` receives one line a message. Raises InputError for a file that
    cannot be used, and where no core point has a distance.
    """
    clouds, read = _read_clouds(request)
    reference, compared = clouds["reference"], clouds["compared"]
    unit = _unit(list(clouds.values()))
    origin = _origin(reference)
    core = clouds.get("core", reference).relative_to(origin)
    first, second = (nearest_neighbours.of_spacing(cloud.relative_to(origin)) for cloud in (reference, compared))
    tiled = nearest_neighbours.of_spacing(core) if "core" in clouds else first
    used = m3c2.derive_scales(
        first, second, core, request.normal_diameter, request.projection_diameter, request.max_depth
    )
    if why := diagnosis.other_unit(first.cells.points, second.cells.points, used):
        raise InputError(f"{request.reference} and {request.compared}: {why}")
    _log_scales(request, used, unit, log)
    if request.normals is not None:
        turned, source = None, reason("compare.normals-of-file", file=request.normals.name)
        normals = scan_folder_normals.read(request.normals, core, origin, used.projection_diameter_mm)[tiled.order]
    else:
        turned = _fitted_normals(reference, first, tiled, origin, used.normal_diameter_mm)
        normals = turned.normals
        source = reason("compare.normals-of-planes-upright") if turned.upright else reason("compare.normals-of-planes")
    distances = _distances((first, second), tiled, normals, used, request.registration_error)
    normals = put_back(normals, tiled.order)
    turned = turned and replace(turned, normals=normals)
    summary = distance_summary.of_distances(
        distances, core, normals, used.projection_diameter_mm, m3c2.PAPER_POINTS_A_CYLINDER
    )
    if not any(np.isfinite(distances.distance[rows]).any() for rows in blocks(len(core))):
        why = diagnosis.no_distance(first.cells.points, second.cells.points, core, summary.without_normal, used)
        raise InputError(f"{request.reference} and {request.compared}: no core point has a distance: {why}")
    given = {} if request.normals is None else {"normals": checksums.of_file(request.normals)}
    comparison = Comparison(
        request=request,
        origin=origin,
        core=core,
        normals=normals,
        distances=distances,
        scales=used,
        summary=summary,
        unit=unit,
        units={name: cloud.unit for name, cloud in clouds.items()},
        points={name: cloud.count for name, cloud in clouds.items()},
        hashes={name: cloud.sha256 for name, cloud in clouds.items()} | given,
        normals_from=source,
        turned=turned,
        read=read,
    )
    _log_warnings(comparison, log)
    return comparison


def _read_clouds(request: Request) -> tuple[dict[str, _Cloud], tuple[Reason, ...]]:
    """Read the clouds of CLOUDS, and return how; without a core file there is no "core"."""
    files = {name: path for name in CLOUDS if (path := getattr(request, name)) is not None}
    stated = units.of_files(request.units, tuple(files))
    clouds = {name: _read(path) for name, path in files.items()}
    remarks = summed(remark for cloud in clouds.values() for scan in cloud.scans for remark in scan.remarks)
    for cloud in () if stated else clouds.values():
        if cloud.fault is not None:
            why = messages("en").text(cloud.fault)
            raise InputError(f"{why}; state the unit by --units (m, or m/us-ft with that of heights)", path=cloud.path)
    if stated:
        other = {name: cloud.otherwise(stated[name]) for name, cloud in clouds.items()}
        said = tuple(
            reason("compare.file", name=files[name].name, stated=one) for name, one in other.items() if one is not None
        )
        remarks = (*remarks, reason("compare.over-files", files=said)) if said else remarks
        into = MM_PER_UNIT[stated["reference"].horizontal]
        for name, unit in stated.items():
            scale = np.array([MM_PER_UNIT[axis] for axis in (unit.horizontal, unit.horizontal, unit.vertical)]) / into
            clouds[name] = replace(clouds[name], stated=stated["reference"].horizontal, scale=scale)
    for name in CLOUDS[:2]:  # rows of core points stay those of their file
        cloud = clouds[name] = _once(clouds[name])
        if cloud.left_out:
            count = cloud.left_out + cloud.count
            remarks = (*remarks, scene_cloud.coincident(cloud.left_out, count, cloud.path.name))
    for cloud in (clouds["reference"], clouds["compared"]):
        if cloud.count < m3c2.FEWEST_FOR_LOD:
            raise InputError(
                f"{cloud.path}: holds {cloud.count} point{'s' * (cloud.count > 1)}; expected "
                f"{m3c2.FEWEST_FOR_LOD} or more, which a level of detection needs"
            )
    return clouds, remarks


def _distances(
    clouds: tuple[PointGrid, PointGrid], core: PointGrid, normals: Floats, used: Scales, registration_error: float
) -> Distances:
    """Measure at core points with normals (k, 3) in the order of their grid; returns distances in that of the file."""
    diameter = used.projection_diameter_mm
    lengths = Lengths(diameter, used.max_depth_mm, registration_error)
    reference, compared = (_sorted(cloud, diameter) for cloud in clouds)
    measured = core_tiles.distances(reference, compared, core, normals, lengths)
    return Distances(**{name: put_back(column, core.order) for name, column in vars(measured).items()})


def _fitted_normals(reference: _Cloud, grid: PointGrid, core: PointGrid, origin: Floats, diameter: float) -> Turned:
    """Return oriented normals (k, 3) of planes fitted to the reference, whose points are in ``grid``."""
    fitted = core_tiles.normals(_sorted(grid, diameter), core, diameter)
    scanner = _seen_from(reference, grid, core, fitted, diameter, origin)
    return normal_orientation.turned(fitted, core.cells.points, diameter, scanner)


def _seen_from(
    reference: _Cloud, grid: PointGrid, core: PointGrid, fitted: CloudNormals, diameter: float, origin: Floats
) -> Floats | None:
    """Return the scanner's position (k, 3) at core points whose normals have no sign yet, NaN elsewhere.

    None where all normals have a sign, or the file gives no scanner.
    """
    scanners = np.array([*reference.scanners(origin), np.full(3, np.nan)])
    if not np.isfinite(scanners).all(axis=1).any():
        return None
    wanted = allocate(core.count, dtype=np.bool_)
    for rows in blocks(core.count):
        wanted[rows] = normal_orientation.undecided(fitted.take(rows), diameter)
    if not wanted.any():
        return None
    ends, positions = np.cumsum([len(scan.points) for scan in reference.scans]), allocate(core.count, 3)
    # A normal was fitted to points within half of the diameter.
    nearest = core_tiles.nearest(grid, core, wanted, 0.5 * diameter) if len(ends) > 1 else None
    for rows in blocks(core.count):
        row = np.where(wanted[rows], 0, -1) if nearest is None else nearest[rows]
        scan = np.searchsorted(ends, row, side="right")
        positions[rows] = scanners[np.where(row < 0, len(ends), scan)]
    return positions


def _sorted(grid: PointGrid, diameter: float) -> PointGrid:
    """Return a grid of the same points with cells that fit a diameter, the same grid if its cells do."""
    ratio = diameter / m3c2.CELLS_PER_DIAMETER / grid.cells.size
    return grid if 0.5 <= ratio <= 1.5 else m3c2.grid(grid.cells.points, diameter)


def _read(path: Path) -> _Cloud:
    if path.suffix.lower() == ".h5" and path.is_file():
        scans = [_bare(scan, "mm") for scan in store.read_scene(path).scans]
    else:
        scans = [
            replace(_bare(scan, scan.unit), unit_fault=scan.unit_fault, remarks=scan.remarks)
            for scan in readers.read(path)
        ]
    if not sum(len(scan.points) for scan in scans):
        raise InputError(f"{path}: expected points, found none")
    return _Cloud(path, [scan for scan in scans if len(scan.points)], checksums.of_file(path))


def _once(cloud: _Cloud) -> _Cloud:
    """Return a cloud in which coincident points count once; scans with one pose are one."""
    scans, left_out = list(cloud.scans), 0
    for pose in {scan.T_project_scan.tobytes(): None for scan in scans}:
        rows = [row for row, scan in enumerate(scans) if scan.T_project_scan.tobytes() == pose]
        offsets = [scans[row].origin - scans[rows[0]].origin for row in rows]
        for row, kept in zip(
            rows, coincident_points.used_once_of([scans[row].points for row in rows], offsets) or (), strict=False
        ):
            left_out += len(kept) - int(np.count_nonzero(kept))
            scans[row] = replace(scans[row], points=large_arrays.chosen(scans[row].points, kept))
    return replace(cloud, scans=[scan for scan in scans if len(scan.points)], left_out=left_out)


def _bare(scan: Scan | RawScan, unit: str) -> RawScan:
    """Return a scan without what no distance needs, such as intensities."""
    return RawScan(
        scan.name, scan.points, scan.origin, position=scan.position, T_project_scan=scan.T_project_scan, unit=unit
    )


def _unit(clouds: list[_Cloud]) -> str:
    """Return the unit of the reference or the compared file, "" if neither gives one; a core file does not count.

    Raises InputError for files in different units.
    """
    paths = {cloud.unit: cloud.path for cloud in clouds if cloud.unit}
    if len(paths) > 1:
        (a, first), (b, second) = list(paths.items())[:2]
        raise InputError(
            f"{second}: expected clouds in one unit, found {b}, and {a} in {first}; state them by "
            f"--units {a},{b}, or convert one of them"
        )
    return next((cloud.unit for cloud in clouds[:2] if cloud.unit), "")


def _origin(reference: _Cloud) -> Floats:
    """Return whole thousands below the reference if it is far from zero; independent of the order of its points."""
    lowest = reference.lowest()
    far = np.abs(lowest).max() > FAR
    origin: Floats = np.floor(lowest / ORIGIN_STEP) * ORIGIN_STEP if far else np.zeros(3)
    return origin


def _log_scales(request: Request, used: Scales, unit: str, log: Callable[[str], None]) -> None:
    def source(given: float, derived_from: str) -> str:
        return "given" if given else f"derived from {derived_from}"

    spacing = max(used.reference_spacing_mm, used.compared_spacing_mm)
    of_lengths = (
        f"files read as {request.units} (--units), lengths are in {unit}"
        if request.units
        else f"lengths are in the unit of the files{f' ({unit})' if unit else ', which they do not give'}"
    )
    log(f"{of_lengths}; spacing {used.reference_spacing_mm:.4g} (reference), {used.compared_spacing_mm:.4g} (compared)")
    if request.normals is not None:
        unused = "; --normal-diameter is not used" if request.normal_diameter else ""
        log(f"normals of file {request.normals.name}{unused}")
    else:
        log(f"normal diameter {used.normal_diameter_mm:.6g}, {source(request.normal_diameter, 'spacing, roughness')}")
    log(f"projection diameter {used.projection_diameter_mm:.6g}, {source(request.projection_diameter, 'the spacing')}")
    log(f"max depth to either side {used.max_depth_mm:.6g}, {source(request.max_depth, 'the distance of the clouds')}")
    points = np.pi / 4.0 * (used.projection_diameter_mm / spacing) ** 2
    log(f"a cylinder holds about {points:.3g} points of the sparser cloud")


def _log_warnings(comparison: Comparison, log: Callable[[str], None]) -> None:
    summary, used = comparison.summary, comparison.scales
    for note in comparison.notes:
        log(messages("en").text(note))
    if summary.without_lod:
        log(
            f"{summary.without_lod} of {summary.core_points} core points have no level of detection: fewer than "
            f"{m3c2.FEWEST_FOR_LOD} points of a cloud within {used.max_depth_mm:.6g} of them, or no normal; "
            "a larger --max-depth or --projection-diameter may help"
        )
    if summary.few_points > 0.1 * max(summary.core_points - summary.without_lod, 1):
        log(
            f"{summary.few_points} core points have fewer than {m3c2.PAPER_POINTS_A_CYLINDER} points of a cloud in "
            "their cylinder: their levels of detection are too small (a larger --projection-diameter helps)"
        )
