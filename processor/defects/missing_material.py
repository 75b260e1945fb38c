"""Points that scanners should have on each cell of the design's surface.

A station is expected to see a cell if the incidence is not too oblique, if it saw other parts of the same face, and if
its rays in this direction met nothing before the cell. The number of points follows from the station's density of
points by solid angle. Cells behind an obstacle are not expected.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from processor.defects.alignment import chart_of_cells
from processor.defects.observations import CHUNK, Pairs, Stations
from processor.defects.surface_charts import DesignSurface
from processor.geometry import rigid
from processor.model import Floats, Ints, Scene

LEAST_COS = 0.34  # of incidence
NEARER_MM = 100.0  # than the surface: an obstacle
LEAST_BIN_RAD = 0.003
BIN_STEPS = 5.0  # angular steps of a scanner in a bin of directions
FACE_SHARE = 0.2  # of a face's cells seen by a station, from which on the rest is expected
FEWEST_CELLS = 10  # with points, to estimate the density of points from
FIELD_MARGIN_RAD = 0.02
GAP_RAD = 0.5  # of azimuth without returns, that is still within the field of view


def expected(
    scene: Scene, T_design_project: Floats, pairs: Pairs, surface: DesignSurface, stations: Stations
) -> Floats:
    """Return the number of points (cells,) that all stations together should have on each cell."""
    cells = len(surface.share)
    points = np.zeros(cells)
    chart = chart_of_cells(surface)
    charts = len(surface.charts.kind)
    area = surface.share * surface.charts.cell_mm**2
    whole = np.bincount(chart, surface.share > 0.5, charts)
    rows_of = _rows(pairs, len(stations.names))
    for k, position in enumerate(stations.positions):
        if not np.isfinite(position).all() or not len(rows_of[k]):
            continue
        observed = pairs.cell[rows_of[k]]
        faces = np.bincount(chart[observed], minlength=charts) >= FACE_SHARE * np.maximum(whole, 1)
        cell = np.flatnonzero(faces[chart] & (surface.share > 0.05))
        arm = surface.centres[cell] - position
        distance = np.linalg.norm(arm, axis=1)
        cosine = -np.einsum("ni,ni->n", arm, surface.outward[cell]) / distance
        steep = cosine > LEAST_COS
        cell, arm, distance, cosine = cell[steep], arm[steep], distance[steep], cosine[steep]
        if not len(cell):
            continue
        angle = area[cell] * cosine / distance**2
        count = np.zeros(cells)
        count[observed] = (pairs.count + pairs.stray)[rows_of[k]]
        occupied = count[cell] > 0
        if occupied.sum() < FEWEST_CELLS:
            continue
        density = float(np.median(count[cell][occupied] / angle[occupied]))
        bin_rad = max(LEAST_BIN_RAD, BIN_STEPS / np.sqrt(density))
        nearest, inside = _nearest_ranges(scene, T_design_project, k, stations, bin_rad, arm)
        slack = NEARER_MM + 3.0 * bin_rad * distance * np.sqrt(1.0 - cosine**2) / cosine
        clear = inside & ~(nearest < distance - slack)
        points[cell[clear]] += density * angle[clear]
    return points


def _rows(pairs: Pairs, stations: int) -> list[Ints]:
    """Return the rows of each station's pairs."""
    order = np.argsort(pairs.station, kind="stable")
    at = np.searchsorted(pairs.station[order], np.arange(stations + 1))
    return [order[at[k] : at[k + 1]] for k in range(stations)]


def _nearest_ranges(
    scene: Scene, T_design_project: Floats, station: int, stations: Stations, bin_rad: float, arm: Floats
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return the shortest range about directions arm (n, 3), and whether they are within the station's field of view.

    Bins of azimuth without any return are outside it, except for gaps as wide as structures have.
    """
    wide, high = int(np.ceil(2.0 * np.pi / bin_rad)), int(np.ceil(np.pi / bin_rad))
    nearest = np.full(wide * high, np.inf)
    lowest, highest = np.inf, -np.inf
    columns = np.zeros(wide, bool)

    def bins(arm: Floats) -> tuple[Ints, Ints, Floats]:
        azimuth, elevation = _directions(arm)
        i = np.minimum((azimuth + np.pi) / bin_rad, wide - 1).astype(np.int64)
        j = np.minimum((elevation + 0.5 * np.pi) / bin_rad, high - 1).astype(np.int64)
        return i, j, elevation

    for points in _points_of(scene, T_design_project, station):
        local = points - stations.positions[station]
        i, j, elevation = bins(local)
        np.minimum.at(nearest, i * high + j, np.linalg.norm(local, axis=1))
        columns[i] = True
        lowest, highest = min(lowest, float(elevation.min())), max(highest, float(elevation.max()))
    nearest = ndimage.minimum_filter(nearest.reshape(wide, high), 3, mode=("wrap", "nearest"))
    closing = np.ones(max(1, int(GAP_RAD / bin_rad)))
    columns |= ndimage.binary_closing(np.tile(columns, 3), closing)[wide : 2 * wide]
    i, j, elevation = bins(arm)
    inside = columns[i] & (elevation > lowest - FIELD_MARGIN_RAD) & (elevation < highest + FIELD_MARGIN_RAD)
    return nearest[i, j], inside


def _directions(arm: Floats) -> tuple[Floats, Floats]:
    """Return azimuth and elevation (n,), rad."""
    return np.arctan2(arm[:, 1], arm[:, 0]), np.arctan2(arm[:, 2], np.hypot(arm[:, 0], arm[:, 1]))


def _points_of(scene: Scene, T_design_project: Floats, station: int) -> Iterator[Floats]:
    """Yield the points of a station in chunks, in the design's frame."""
    first = 0
    for scan in scene.scans:
        T = T_design_project @ (scan.T_project_scan if scan.T_project_scan.size else np.eye(4))
        T = rigid.transform(T[:3, :3], T[:3, :3] @ scan.origin + T[:3, 3])
        count = 1
        if not scan.position.size and scene.stations is not None and len(scan.point_station):
            count = len(scene.stations.ids) + 1
        if first <= station < first + count:
            for start in range(0, len(scan.points), CHUNK):
                rows = slice(start, start + CHUNK)
                points = scan.points[rows]
                if count > 1:
                    points = points[scan.point_station[rows] == station - first]
                if len(points):
                    yield rigid.apply(T, points)
        first += count
