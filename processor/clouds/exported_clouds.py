"""What is exported: clouds of a run by the name of their content."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from processor import scene_cloud
from processor.clouds.earlier_run import Run
from processor.clouds.points import NAMES, TYPES, blocks
from processor.clouds.poses import Placed
from processor.defects import surface_charts
from processor.geometry import rigid
from processor.model import Floats, Ints, Stations
from processor.views import Views, views
from processor.writers.cloud import BLOCK, COLOURS, COLUMN, GRID, INTENSITY, ROW, STATION, Block, Cloud

FULL = 65535  # intensities up to here that are whole numbers are written as they are
SINGLE = np.dtype(np.float32)
SAME_MM = 1e-3  # rounding: copies of one scanner's place in several scans, far below any error of a station
FOUND_MM = 200.0  # core points lie on the design's surface: its samples are nearer


def fields_of(run: Run, numbers: Sequence[int], *, grid: bool) -> dict[str, np.dtype[Any]]:
    """Return the types of the columns that any of the scans of these numbers has."""
    present = {name for name in NAMES for number in numbers if len(run.points.column(number, name))}
    fields: dict[str, np.dtype[Any]] = {}
    if "intensity" in present:
        fields[INTENSITY] = SINGLE
    if "colour" in present:
        fields |= dict.fromkeys(COLOURS, TYPES["colour"])
    if "point_station" in present:
        fields[STATION] = TYPES["point_station"]
    elif grid and "grid_row" in present:
        # A merged cloud has no grid: the rows and columns of its scans repeat.
        fields |= dict.fromkeys(GRID, TYPES["grid_row"])
    return fields


def _columns(found: Mapping[str, Any], fields: Mapping[str, np.dtype[Any]], station: Ints) -> dict[str, Any]:
    """Return the columns of a block by their names in files, zeros where a scan has none, with its stations (n,)."""
    count = len(found["points"])
    columns: dict[str, Any] = {name: np.zeros(count, dtype) for name, dtype in fields.items()}
    for name, field in (("intensity", INTENSITY), ("grid_row", ROW), ("grid_column", COLUMN)):
        if field in columns and name in found:
            columns[field] = found[name].astype(fields[field])
    if "colour" in found:
        columns |= dict(zip(COLOURS, found["colour"].T, strict=True))
    if STATION in columns:
        columns[STATION] = station.astype(fields[STATION])
    return columns


def scan_cloud(run: Run, placed: Placed) -> Cloud:
    """Return the cloud of a scan in its own frame, with its pose, and rows and columns of the scanner's grid."""
    in_place = replace(placed, T=np.eye(4))
    cloud = _cloud(run, in_place, placed.scan.name, in_place.origin(), grid=True)
    largest = {}
    for name, field in (("grid_row", ROW), ("grid_column", COLUMN)) if ROW in cloud.fields else ():
        column = run.points.column(placed.number, name)
        largest[field] = max(int(column[i : i + BLOCK].max()) for i in range(0, len(column), BLOCK))
    return replace(
        cloud,
        T_project_scan=placed.T if placed.known else np.empty(0),
        largest=largest,
    )


def part_cloud(run: Run, placed: Placed) -> Cloud:
    """Return the cloud of a part in the frame that its pose leads to."""
    return _cloud(run, placed, placed.component, np.zeros(3), grid=False)


def _cloud(run: Run, placed: Placed, name: str, origin: Floats, *, grid: bool) -> Cloud:
    """Return the cloud of a scan in the frame that its pose leads to, with the numbers of the scene's stations."""
    fields = fields_of(run, [placed.number], grid=grid)

    def read() -> Iterator[Block]:
        for found in blocks(run.points, placed.number):
            station = found["point_station"] + 1 if STATION in fields else np.empty(0, np.int64)
            yield Block(placed.moved(found["points"], origin), _columns(found, fields, station))

    return Cloud(name, fields, read, origin, len(run.points.column(placed.number, "points")))


def merged_cloud(run: Run, scans: Sequence[Placed]) -> Cloud:
    """Return all scans as one cloud in the project's frame, with the number of the station of each point."""
    seen, number = _views(run, scans)
    fields = fields_of(run, [placed.number for placed in scans], grid=False)
    if number.max() > 1:
        fields[STATION] = TYPES["point_station"]
    origin = np.floor(scans[0].origin() / scene_cloud.ORIGIN_STEP_MM) * scene_cloud.ORIGIN_STEP_MM

    def read() -> Iterator[Block]:
        for row, placed in enumerate(scans):
            for found in blocks(run.points, placed.number):
                points = found["points"]
                view = seen.of_points(row, found.get("point_station", ()), len(points))
                yield Block(placed.moved(points, origin), _columns(found, fields, number[view]))

    count = sum(len(run.points.column(placed.number, "points")) for placed in scans)
    return Cloud("merged", fields, read, origin, count)


def has_stations(run: Run, placed: Placed) -> bool:
    """Whether a scan is a merged cloud whose points name their stations."""
    return len(run.points.column(placed.number, "point_station")) > 0


def _views(run: Run, scans: Sequence[Placed]) -> tuple[Views, Ints]:
    """Return the views of scans as they are placed, and the number (v,) of each as a station in files, from 1.

    That of the points of a merged cloud that name no station is 0: unknown.
    """
    moved = []
    for one in scans:
        origin, position = one.scale * one.scan.origin, one.scale * one.scan.position
        moved.append(replace(one.scan, T_project_scan=one.T, origin=origin, position=position))
    stations = run.scene.stations if any(has_stations(run, one) for one in scans) else None
    seen = views(replace(run.scene, scans=tuple(moved), stations=stations), origin=np.zeros(3))
    known = np.ones(len(seen.names), bool)
    known[seen.stations :] = [one.scan.position.size > 0 or not has_stations(run, one) for one in scans]
    return seen, np.where(known, np.cumsum(known), 0)


def stations_of(run: Run, scans: Sequence[Placed]) -> Stations | None:
    """Return the positions of the stations as numbered, in the project's frame; None where one is not known."""
    seen, number = _views(run, scans)
    positions = seen.positions.copy()
    if seen.stations:
        moved = stations_moved(run, scans)
        positions[: seen.stations] = np.nan if moved is None else moved.positions
    rows = np.flatnonzero(number)
    if not np.isfinite(positions[rows]).all():
        return None
    return Stations(tuple(seen.names[row] for row in rows), positions[rows])


def stations_moved(run: Run, scans: Sequence[Placed]) -> Stations | None:
    """Return the scene's stations as the clouds that name them were moved; None where these moved differently."""
    stations = run.scene.stations
    places = []
    for placed in scans:
        if stations is not None and has_stations(run, placed):
            given = placed.scan.pose
            T = placed.T @ rigid.invert(given) if placed.known else np.eye(4)
            places.append(rigid.apply(T, placed.scale * stations.positions))
    if stations is None or not places or any(np.abs(one - places[0]).max() > SAME_MM for one in places):
        return None
    return Stations(stations.ids, places[0])


def core_cloud(run: Run) -> Cloud:
    """Return the core points of step deviation in the design's frame, with their deviation, LOD95 and component.

    The components are numbered from 1, in the order of the design's bodies, or as in the names of the defects without
    named bodies.
    """
    result = run.step("deviation", "deviation")
    core = result.core
    component = np.zeros(len(core.points), np.int32)
    if run.scene.structure is not None and len(core.points):
        vertices, origin = scene_cloud.local_design(run.scene.structure)
        design = run.scene.structure
        surface, of_facet = surface_charts.with_components(vertices, design.faces, design.bodies)
        facet, _, _ = surface.distances(core.points + (result.origin - origin), FOUND_MM)
        component = np.where(facet >= 0, of_facet[np.maximum(facet, 0)] + 1, 0).astype(np.int32)
    fields = {"deviation_mm": core.distance, "lod95_mm": core.lod95, "component": component}

    def read() -> Iterator[Block]:
        for start in range(0, len(core.points), BLOCK):
            rows = slice(start, start + BLOCK)
            yield Block(core.points[rows], {name: column[rows] for name, column in fields.items()})

    types = {name: column.dtype for name, column in fields.items()}
    return Cloud("deviation", types, read, result.origin, len(core.points))


def brightest(run: Run, numbers: Sequence[int]) -> float:
    """Return the greatest intensity of scans; 0 where all are whole numbers of 16 bits, which need no scaling."""
    whole, most = True, 0.0
    for number in numbers:
        column = run.points.column(number, "intensity")
        for start in range(0, len(column), BLOCK):
            values = column[start : start + BLOCK]
            most = max(most, float(values.max()))
            whole = whole and bool((values >= 0.0).all() and (values == np.rint(values)).all())
    return 0.0 if whole and 1.0 < most <= FULL else most
